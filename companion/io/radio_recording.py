"""Recording of radios: the bytes they sent, and the vehicle's poses at the same time.

Theory of operation. The file is JSON lines: a header, then bytes, poses and, once the autopilot
reports it, the origin of its local frame, all in the order of arrival and with the time on the
companion's clock. Raw bytes are kept, not readings, so that a recording can be decoded again with
other settings. Only whole lines are written; a power cut may still tear the last one, which is then
left out. Neither writer nor reader keeps more than one buffer.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import msgspec

from companion.domain import PositionEnu
from companion.errors import CompanionError, ConfigError, decoding_problem
from companion.geometry.coordinates import LocalOrigin, Projection
from companion.io.files import OnDamage, open_file

VERSION = 1
MAX_DATA_BYTES = 65_536
"""Maximum number of bytes of one record; more are split over several."""
MAX_LINE_BYTES = 262_144
BUFFER_BYTES = 65_536
BUFFER_S = 1.0
"""Longest time whose lines a power cut may cost, in s."""


class RecordedRadio(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a radio in a recording."""

    name: str
    url: str
    options: Mapping[str, object] = {}
    """Options of its format that differ from the defaults."""
    settings: Mapping[str, object] = {}
    """Settings of the common stage that differ from the defaults."""


class RecordedOrigin(msgspec.Struct, frozen=True, kw_only=True, tag="origin", tag_field="kind"):
    """Origin of the vehicle's local frame; the last one reported holds for the whole recording."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    projection: Projection = Projection.ELLIPSOID

    @property
    def local(self) -> LocalOrigin:
        """Return the local frame."""
        return LocalOrigin(self.latitude_deg, self.longitude_deg, self.altitude_m, self.projection)


class RecordingHeader(
    msgspec.Struct, frozen=True, kw_only=True, tag="radio_recording", tag_field="kind"
):
    """First line of a recording."""

    version: int = VERSION
    started_unix_s: float
    radios: tuple[RecordedRadio, ...]
    origin: RecordedOrigin | None = None
    """Origin of the local frame, if it was known from the start."""


class RadioBytes(msgspec.Struct, frozen=True, tag="bytes", tag_field="kind"):
    """Bytes that a radio sent, in base64."""

    t_s: float
    radio: int
    """Index of the radio in the header, from 0."""
    data: bytes


class TimedPose(msgspec.Struct, frozen=True, tag="pose", tag_field="kind", omit_defaults=True):
    """Position and attitude of the vehicle at a time, those that the autopilot reported."""

    t_s: float
    enu_m: PositionEnu
    yaw_rad: float | None = None
    """Yaw, clockwise from north."""
    roll_rad: float | None = None
    """Roll, positive to the right; given together with pitch (positive nose up) or not at all."""
    pitch_rad: float | None = None
    sigma_m: float | None = None
    """Standard deviation of the position per horizontal axis, if its source reports it."""


Record: TypeAlias = RadioBytes | TimedPose | RecordedOrigin

_encoder = msgspec.json.Encoder()
_header_decoder = msgspec.json.Decoder(RecordingHeader)
_decoder = msgspec.json.Decoder(RadioBytes | TimedPose | RecordedOrigin)


class RadioRecordingWriter:
    """Writes a new recording; an old file of that name is replaced.

    Raises a `CompanionError` if the disk refuses it; the file then ends with a whole line.
    """

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        self._path = path
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise CompanionError(f"{path}: cannot be written ({error.strerror})") from error
        self._buffer = bytearray()
        self._flushed_s = -math.inf
        self._written_bytes = 0
        self.dropped = 0
        """Poses with values that are not finite."""
        self._add(header)
        self.flush()

    def write(self, record: Record) -> None:
        """Add a record; it is handed to the system within a second of records."""
        match record:
            case RadioBytes() if len(record.data) > MAX_DATA_BYTES:
                for start in range(0, len(record.data), MAX_DATA_BYTES):
                    part = record.data[start : start + MAX_DATA_BYTES]
                    self.write(RadioBytes(record.t_s, record.radio, part))
                return
            case TimedPose() if not _is_finite(record):
                self.dropped += 1
                return
        self._add(record)
        now_s = self._flushed_s if isinstance(record, RecordedOrigin) else record.t_s
        if len(self._buffer) >= BUFFER_BYTES or not now_s - self._flushed_s < BUFFER_S:
            self._flushed_s = now_s
            self.flush()

    def flush(self) -> None:
        """Hand all lines to the system."""
        view = memoryview(bytes(self._buffer))
        self._buffer.clear()
        try:
            done = 0
            while done < len(view):
                done += self._file.write(view[done:]) or 0
        except OSError as error:
            with suppress(OSError):  # a pipe has no length
                os.ftruncate(self._file.fileno(), self._written_bytes)
            self._file.close()
            raise CompanionError(
                f"{self._path}: cannot be written ({error.strerror}); is the disk full?"
            ) from error
        self._written_bytes += len(view)

    def close(self) -> None:
        """Write the rest and close the file."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()

    def __enter__(self) -> RadioRecordingWriter:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def _add(self, record: Record | RecordingHeader) -> None:
        self._buffer += _encoder.encode(record)
        self._buffer += b"\n"


def _is_finite(pose: TimedPose) -> bool:
    numbers = (pose.t_s, *pose.enu_m, pose.yaw_rad, pose.roll_rad, pose.pitch_rad, pose.sigma_m)
    return all(number is None or math.isfinite(number) for number in numbers)


def is_radio_recording(path: Path) -> bool:
    """Return True if a file begins as a recording does; False if it cannot be read."""
    beginning = b'{"kind":"radio_recording"'
    try:
        with open_file(path) as file:
            return file.read(len(beginning)) == beginning
    except OSError:
        return False


def read_radio_recording(
    path: Path, on_damage: OnDamage | None = None
) -> tuple[RecordingHeader, Iterator[Record]]:
    """Return header and records; a `ConfigError` names a bad line, which `on_damage` skips."""
    lines = _lines(path)
    number, line = next(lines, (1, b""))
    if not line:
        raise ConfigError(f"{path}: is empty; a recording begins with a header")
    try:
        header = _header_decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        problem = f"no header of a radio recording: {decoding_problem(error)}"
        raise ConfigError(f"{path}: line {number}: {problem}") from None
    if header.version > VERSION:
        raise ConfigError(
            f"{path}: line 1: a recording of version {header.version}, and this companion reads "
            f"{VERSION}; use a newer one"
        )
    return header, _records(path, lines, len(header.radios), on_damage)


def _records(
    path: Path, lines: Iterator[tuple[int, bytes]], radios: int, on_damage: OnDamage | None
) -> Iterator[Record]:
    for number, line in lines:
        try:
            record = _decoder.decode(line)
            if isinstance(record, RadioBytes) and not 0 <= record.radio < radios:
                raise msgspec.ValidationError(f"the header has no radio {record.radio}")
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            if not line.endswith(b"\n"):
                return  # the power was cut while it was written
            if on_damage is None:
                raise ConfigError(f"{path}: line {number}: {decoding_problem(error)}") from None
            on_damage(number)
        else:
            yield record


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    try:
        with open_file(path) as file:
            for number in range(1, 2**63):
                line = file.readline(MAX_LINE_BYTES)
                if not line:
                    return
                if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                    raise ConfigError(f"{path}: line {number}: longer than any record")
                yield number, line
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
