"""MCAP log for Foxglove: estimate, poses, residuals, texts, frames and inputs.

Theory of operation. The flight puts values into a bounded queue; one thread turns them into
messages and writes them. A full queue loses messages, which are counted, and never delays the
flight. The file is written in small chunks, so that after a power cut `mcap recover` loses only
seconds.

Channels are JSON with Foxglove's own schemas where it has one, so that its map, 3-D and log panels
work unchanged. Source: Foxglove, "Message schemas"; MCAP format specification.

A replay reads the frames, inputs and events back.
"""

from __future__ import annotations

import json
import logging
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.errors import CompanionError, ConfigError, how_to_install
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import ellipse_95
from companion.guidance.commands import ReportResult, Severity
from companion.io.files import CLOSE_TIMEOUT_S, WriterThread, json_line, open_file
from companion.io.log_files import frame_for_log

FRAME_CHANNEL, INPUT_CHANNEL = "/mavlink", "/companion/inputs"

_NUMBER, _WHOLE, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
RESIDUALS = ("nis", "range_innovation", "range_weight", "bearing_innovation", "bearing_weight")


def _object(**properties: object) -> dict[str, object]:
    return {"type": "object", "properties": properties}


def _numbers(*names: str) -> dict[str, object]:
    return _object(**dict.fromkeys(names, _NUMBER))


_TIME = {**_object(sec=_WHOLE, nsec=_WHOLE), "title": "time"}
_POSE = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    pose=_object(position=_numbers("x", "y", "z"), orientation=_numbers("x", "y", "z", "w")),
)
_FIX = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    latitude=_NUMBER,
    longitude=_NUMBER,
    altitude=_NUMBER,
    position_covariance={"type": "array", "items": _NUMBER},
    position_covariance_type=_WHOLE,
)
_LOG = _object(timestamp=_TIME, level=_WHOLE, message=_TEXT, name=_TEXT, file=_TEXT, line=_WHOLE)


@dataclass(frozen=True, slots=True)
class McapChannel:
    """Topic with its schema."""

    topic: str
    schema_name: str = ""
    schema: Mapping[str, object] | None = None
    """Foxglove's schema; None if the messages are bytes without a schema."""
    message_encoding: str = "json"


CHANNELS = (
    McapChannel("/estimate/fix", "foxglove.LocationFix", _FIX),
    McapChannel("/estimate/ellipse", "foxglove.GeoJSON", _object(geojson=_TEXT)),
    McapChannel("/estimate/pose", "foxglove.PoseInFrame", _POSE),
    McapChannel("/vehicle/pose", "foxglove.PoseInFrame", _POSE),
    McapChannel("/residual", "companion.Residual", _numbers(*RESIDUALS)),
    McapChannel("/log", "foxglove.Log", _LOG),
    McapChannel("/events", "companion.Event", _object(t_s=_NUMBER, kind=_TEXT)),
    McapChannel(FRAME_CHANNEL, message_encoding="mavlink"),
    McapChannel(INPUT_CHANNEL, message_encoding="companion-inputs"),
)

log = logging.getLogger("companion.io")

MAX_QUEUED = 10_000
CHUNK_BYTES = 65_536
MESSAGE_OVERHEAD = 47
"""Bytes of a message's header and of its index entry."""
LEVELS = {Severity.ERROR: 4, Severity.WARNING: 3, Severity.NOTICE: 2, Severity.INFO: 2}
"""foxglove.Log: 2 is INFO, 3 WARNING, 4 ERROR."""
FRAME_ID = "local_enu"
"""Name of the local frame: east, north, up from the autopilot's origin."""

Json = dict[str, object]
Message = tuple[str, bytes, int]
"""Channel, data, nanoseconds since 1970."""


class McapLog(WriterThread[Message]):
    """MCAP file of one flight; a journal for the endpoint.

    `flight_json`, the flight's settings, is kept for a replay; beyond `max_bytes` all is lost.
    Raises a `CompanionError` if the file cannot be opened, or the extra `mcap` is not installed.
    """

    def __init__(
        self, path: Path, started_unix_s: float, flight_json: str, max_bytes: int | None = None
    ) -> None:
        self.path = path
        self._started_ns = 1000 * round(started_unix_s * 1e6)
        self._origin: LocalOrigin | None = None
        self._room = math.inf if max_bytes is None else max_bytes
        self._error: Exception | None = None
        self._write, self._finish = _open(path, flight_json)
        super().__init__(f"write {path.name}", MAX_QUEUED)

    # The endpoint's journal

    def frame(self, data: bytes, now_s: float) -> None:
        """Record a raw frame without its signature; frames that carry a key are left out."""
        kept = frame_for_log(data)
        if kept is not None:
            self._put(FRAME_CHANNEL, kept, now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Record an event; an estimate also becomes poses, a position on the map and residuals."""
        self._put_json("/events", {"t_s": round(now_s, 4), "kind": kind, **fields}, now_s)
        if kind == "origin":
            values: Any = fields
            self._origin = LocalOrigin(**values)
        elif kind == "estimate":
            self._put_estimate(fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Record a text."""
        value = {
            "timestamp": self._stamp(now_s),
            "level": LEVELS[severity],
            "message": text,
            "name": "companion",
            "file": "",
            "line": 0,
        }
        self._put_json("/log", value, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Do nothing: the result is recorded as an event, too."""

    def input(self, record: bytes, now_s: float) -> None:
        """Record an input in the format of `InputLog`."""
        self._put(INPUT_CHANNEL, record, now_s)

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write everything queued within `timeout_s`, finish the file; return True on success."""
        is_written = super().close(timeout_s)
        if self.dropped or not is_written:
            log.warning("%s: %d messages lost, %s", self.path, self.dropped, self._error or "slow")
        return is_written

    def write_batch(self, batch: list[Message]) -> None:
        """Add messages to the file; none after the first failure."""
        for message in batch:
            self._attempt(self._write, message)

    def end(self) -> None:
        """Finish the file."""
        self._attempt(self._finish)

    def _attempt(self, action: Callable[..., None], *values: Message) -> None:
        if self._error is None:
            try:
                action(*values)
            except Exception as error:
                self._error = error
                log.warning("%s: cannot be written (%s), the rest is lost", self.path, error)
        if self._error is not None:
            self.failed += 1

    # Messages

    def _put_estimate(self, fields: Mapping[str, object], now_s: float) -> None:
        residual = {name: fields[name] for name in RESIDUALS if name in fields}
        if residual:
            self._put_json("/residual", residual, now_s)
        stamp = self._stamp(now_s)
        sensor = fields.get("sensor_enu_m")
        if isinstance(sensor, tuple):
            self._put_json("/vehicle/pose", _pose(stamp, sensor), now_s)
        position, covariance = fields.get("position_enu_m"), fields.get("covariance_m2")
        if not (isinstance(position, tuple) and isinstance(covariance, tuple)):
            return
        self._put_json("/estimate/pose", _pose(stamp, (*position, 0.0)), now_s)
        if self._origin is not None:
            own_sigma_m = fields.get("own_sigma_m")
            own_m2 = own_sigma_m**2 if isinstance(own_sigma_m, float) else 0.0
            (east, cross), (_, north) = covariance
            on_earth = ((east + own_m2, cross), (cross, north + own_m2))
            self._put_json("/estimate/fix", _fix(stamp, position, on_earth, self._origin), now_s)
            outline = _outline(position, on_earth, self._origin)
            self._put_json("/estimate/ellipse", {"geojson": json.dumps(outline)}, now_s)

    def _stamp(self, now_s: float) -> Json:
        nanoseconds = self._stamp_ns(now_s)
        return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}

    def _stamp_ns(self, now_s: float) -> int:
        return max(0, self._started_ns + round(now_s * 1e9))

    def _put_json(self, channel: str, value: Mapping[str, object], now_s: float) -> None:
        self._put(channel, json_line(value), now_s)

    def _put(self, channel: str, data: bytes, now_s: float) -> None:
        stamp_ns = self._stamp_ns(now_s)
        self._room -= len(data) + MESSAGE_OVERHEAD
        if self._room < 0:  # compression makes it smaller: the cap is kept with room to spare
            self.overflowed += 1
        else:
            self.append((channel, data, stamp_ns))


def _open(path: Path, flight_json: str) -> tuple[Callable[[Message], None], Callable[[], None]]:
    """Return two functions: one writes a message, the other finishes the file."""
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise CompanionError(f"log.mcap needs mcap: {how_to_install('mcap')}") from error
    try:
        file = path.open("wb")
    except OSError as error:
        raise CompanionError(f"{path}: cannot be opened ({error.strerror})") from error
    writer = Writer(file, chunk_size=CHUNK_BYTES)
    writer.start(profile="", library="companion")
    writer.add_metadata("flight", {"flight.json": flight_json})
    numbers = {}
    for channel in CHANNELS:
        schema, topic, number = json.dumps(channel.schema).encode(), channel.topic, 0
        if channel.schema is not None:
            number = writer.register_schema(channel.schema_name, "jsonschema", schema)
        numbers[topic] = writer.register_channel(topic, channel.message_encoding, number)

    def write(message: Message) -> None:
        topic, data, stamp_ns = message
        writer.add_message(numbers[topic], stamp_ns, data, stamp_ns)

    def finish() -> None:
        writer.finish()  # type: ignore[no-untyped-call]
        file.close()

    return write, finish


def _pose(stamp: Json, position: tuple[float, ...]) -> Json:
    """Return a foxglove.PoseInFrame; it has no heading."""
    return {
        "timestamp": stamp,
        "frame_id": FRAME_ID,
        "pose": {
            "position": {"x": position[0], "y": position[1], "z": position[2]},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }


def _fix(
    stamp: Json,
    position: tuple[float, ...],
    covariance: tuple[tuple[float, ...], ...],
    origin: LocalOrigin,
) -> Json:
    """Return a foxglove.LocationFix with covariance type 3 (known): east, north, up, row-major."""
    latitude_deg, longitude_deg, altitude_m = origin.geodetic_from_enu(
        (position[0], position[1], 0.0)
    )
    (east, cross), (_, north) = covariance
    return {
        "timestamp": stamp,
        "frame_id": FRAME_ID,
        "latitude": latitude_deg,
        "longitude": longitude_deg,
        "altitude": altitude_m,
        "position_covariance": [east, cross, 0.0, cross, north, 0.0, 0.0, 0.0, 0.0],
        "position_covariance_type": 3,
    }


def _outline(
    position: tuple[float, ...], covariance: tuple[tuple[float, ...], ...], origin: LocalOrigin
) -> Json:
    """Return the 95 % ellipse as GeoJSON."""
    (east, cross), (_, north) = covariance
    corners = ellipse_95((position[0], position[1]), ((east, cross), (cross, north))).corners_enu_m(
        24
    )
    ring = [origin.geodetic_from_enu((*corner, 0.0)) for corner in (*corners, corners[0])]
    coordinates = [[longitude, latitude] for latitude, longitude, _ in ring]
    geometry = {"type": "Polygon", "coordinates": [coordinates]}
    return {"type": "Feature", "geometry": geometry, "properties": {"name": "95 %"}}


@dataclass(slots=True)
class McapFlight:
    """A flight read from one file."""

    path: Path
    flight_json: bytes
    inputs: bytes = b""
    frames: list[bytes] = field(default_factory=list)
    events: list[dict[str, object]] = field(default_factory=list)


def read_mcap_flight(path: Path) -> McapFlight:
    """Return the flight in an MCAP file; `ConfigError`: unreadable, or of another program."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError as error:
        raise ConfigError(f"{path}: needs mcap: {how_to_install('mcap')}") from error
    inputs: list[bytes] = []
    try:
        with open_file(path) as file:
            reader = make_reader(file)
            kept = [m for m in reader.iter_metadata() if m.name == "flight"]
            if not kept:
                raise ConfigError(f"{path}: is not a flight of the companion's")
            flight = McapFlight(path, kept[0].metadata["flight.json"].encode())
            for _, channel, message in reader.iter_messages(log_time_order=False):
                if channel.topic == FRAME_CHANNEL:
                    flight.frames.append(message.data)
                elif channel.topic == INPUT_CHANNEL:
                    inputs.append(message.data)
                elif channel.topic == "/events":
                    flight.events.append(json.loads(message.data))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (McapError, struct.error, EOFError, KeyError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a whole MCAP file ({error}); try `mcap recover`") from error
    flight.inputs = b"".join(inputs)
    return flight
