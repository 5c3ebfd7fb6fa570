"""The log files of a flight, written in the background and read back: tlog, inputs, events.

`flight.tlog` is what MAVLink tools read: 8-byte big-endian microseconds since 1970, raw frame.

`flight.inputs` has the endpoint's inputs, exactly and in order, to replay a flight from: a header
of fixed size (`_HEADER`), the sender's address as text, and the data. Times are the endpoint's own
float64 seconds, because a replay is only the same to the last bit if they are. Signatures are left
out, and frames that carry a key altogether.

`events.jsonl` has the flight's events as JSON lines.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

from companion.errors import ConfigError
from companion.guidance import events
from companion.guidance.commands import Severity
from companion.io.background_files import BackgroundFile
from companion.io.files import json_line, read_file
from companion.io.state.checkpoints import CheckpointError, decode_memory, encode_memory
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.endpoint import Address
from companion.mav.framing import HEADER_LENGTH, frame_end, message_id, without_signature
from companion.mav.signing import is_secret, is_signed

_STAMP = struct.Struct(">Q")


class TlogWriter(BackgroundFile):
    """A tlog that is written from a background thread."""

    def write(self, frame: bytes, unix_s: float) -> None:
        """Record one whole frame; a signature is left out, a SETUP_SIGNING altogether."""
        record = tlog_record(frame, unix_s)
        if record is not None:
            self.append(record)


def tlog_record(frame: bytes, unix_s: float) -> bytes | None:
    """A frame as a tlog has it, with the time it was sent or received; see `frame_for_log`."""
    kept = frame_for_log(frame)
    return None if kept is None else _STAMP.pack(max(0, round(unix_s * 1e6))) + kept


def frame_for_log(frame: bytes) -> bytes | None:
    """A whole frame without its signature; None: it holds a key, and no log may have it."""
    if is_secret(frame):
        return None
    if not is_signed(frame):
        return frame
    return without_signature(frame, CRC_EXTRA_BY_ID.get(message_id(frame)))


@dataclass(frozen=True, slots=True)
class TlogRecord:
    """One frame of a tlog."""

    unix_us: int
    frame: bytes


def read_tlog(path: Path) -> Iterator[TlogRecord]:
    """The frames of a tlog, in order; a torn last record (a power cut) ends them."""
    data, offset = read_file(path), 0
    while offset + _STAMP.size + 2 <= len(data):
        (unix_us,) = _STAMP.unpack_from(data, offset)
        start = offset + _STAMP.size
        if data[start] not in HEADER_LENGTH:
            raise ConfigError(f"{path}: no MAVLink frame at byte {start}; is this a tlog?")
        end = frame_end(data, start)
        if end > len(data):
            return
        yield TlogRecord(unix_us, data[start:end])
        offset = end


FAMILY = b"companion inputs "
FORMAT = FAMILY + b"2"
MAGIC_WITHIN = 64
"""The first bytes of a file, which name its format in every version."""
_HEADER = struct.Struct("<IdBBBI")
"""Number of the record, time_s, kind, link, length of the sender's address, length of the data."""
_AGE = struct.Struct("<d")


class InputKind(IntEnum):
    """What the endpoint received."""

    BEGIN = 0
    """The first record; its data name the format."""
    FRAME = 1
    TICK = 2
    STOP = 3
    OPERATOR_COMMAND = 4
    """Its data name what the operator asked for."""
    EARLIER_RUN = 5
    """An earlier process did not end in order."""
    RECALL = 6
    """Its data are the age, float64 seconds, and what that process knew, in MessagePack."""
    NOTE = 7
    """Its data are the severity by name, a space, and what the process said to the operator."""


AlsoKeeps = Callable[[bytes, float], None]
"""Takes a record and its time."""
_KINDS = frozenset(int(kind) for kind in InputKind)


@dataclass(frozen=True, slots=True)
class Input:
    """One thing that the endpoint received."""

    kind: InputKind
    time_s: float
    link: int = 0
    peer: Address | None = None
    data: bytes = b""


class InputLog(BackgroundFile):
    """The inputs, written from a background thread, and told to `also` (the MCAP file)."""

    def __init__(
        self, path: Path, max_bytes: int | None = None, also: AlsoKeeps | None = None
    ) -> None:
        super().__init__(path, max_bytes)
        self._number = 0
        self._also = also
        self._keep(InputKind.BEGIN, 0.0, data=FORMAT)

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Keep a frame; its signature, if any, is left out, a SETUP_SIGNING altogether."""
        kept = frame_for_log(data)
        if kept is not None:
            self._keep(InputKind.FRAME, now_s, link, peer, kept)

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Keep bytes of a radio that does not speak MAVLink."""
        self._keep(InputKind.FRAME, now_s, link, peer, data)

    def tick(self, now_s: float) -> None:
        """Keep a tick."""
        self._keep(InputKind.TICK, now_s)

    def event(self, event: events.Event) -> None:
        """Keep what the process or the operator says; see `event_of`."""
        kind, data = InputKind.STOP, b""
        match event:
            case events.OperatorAsked():
                kind, data = InputKind.OPERATOR_COMMAND, event.command.value.encode()
            case events.ProcessNoted():
                kind, data = InputKind.NOTE, f"{event.severity.name} {event.text}".encode()
            case events.EarlierRunFound():
                kind = InputKind.EARLIER_RUN
            case events.MemoryRecalled():
                kind, data = InputKind.RECALL, _AGE.pack(event.age_s) + encode_memory(event.memory)
        self._keep(kind, event.time_s, data=data)

    def _keep(
        self,
        kind: InputKind,
        time_s: float,
        link: int = 0,
        peer: Address | None = None,
        data: bytes = b"",
    ) -> None:
        sender = b"" if peer is None else _sender_text(peer)
        header = _HEADER.pack(self._number, time_s, kind, link, len(sender), len(data))
        self._number = (self._number + 1) & 0xFFFFFFFF
        record = header + sender + data
        self.append(record)
        if self._also is not None:
            self._also(record, time_s)


@lru_cache(maxsize=16)
def _sender_text(peer: Address) -> bytes:
    return f"{peer[0]} {peer[1]}".encode()[:255]


def read_inputs(path: Path) -> Iterator[Input]:
    """The inputs in a file; see `parse_inputs`."""
    return parse_inputs(read_file(path), str(path))


def parse_inputs(data: bytes, name: str) -> Iterator[Input]:
    """The inputs of a flight, without a torn last one; a `ConfigError` if any are missing."""
    if FORMAT not in data[:MAGIC_WITHIN] and FAMILY in data[:MAGIC_WITHIN]:
        raise ConfigError(f"{name}: of another version; replay it with the companion that flew")
    offset, number = 0, 0
    while offset + _HEADER.size <= len(data):
        found, time_s, kind, link, peer_size, size = _HEADER.unpack_from(data, offset)
        end = offset + _HEADER.size + peer_size + size
        if end > len(data):
            break
        body = data[offset + _HEADER.size : end]
        if number == 0 and (kind != InputKind.BEGIN or body != FORMAT):
            raise ConfigError(
                f"{name}: does not begin with a flight's start (an old part was given up to "
                "the log's cap, or this is no flight.inputs)"
            )
        if found != number or kind not in _KINDS:
            raise ConfigError(f"{name}: record {number} is missing: the disk was too slow or full")
        if kind != InputKind.BEGIN:
            yield Input(InputKind(kind), time_s, link, _peer(body[:peer_size]), body[peer_size:])
        offset, number = end, (number + 1) & 0xFFFFFFFF
    if number == 0:
        raise ConfigError(f"{name}: has no inputs")


def event_of(value: Input) -> events.Event:
    """What `InputLog.event` kept; a `ConfigError` for a memory that cannot be read."""
    now_s, data = value.time_s, value.data
    match value.kind:
        case InputKind.OPERATOR_COMMAND:
            return events.OperatorAsked(now_s, events.OperatorCommand(data.decode()))
        case InputKind.NOTE:
            name, _, text = data.decode(errors="replace").partition(" ")
            severity = Severity.__members__.get(name)
            if severity is None:
                raise ConfigError(f"a note at {now_s} s has no severity: {name!r}")
            return events.ProcessNoted(now_s, severity, text)
        case InputKind.EARLIER_RUN:
            return events.EarlierRunFound(now_s)
        case InputKind.RECALL:
            try:
                memory, (age_s,) = decode_memory(data[_AGE.size :]), _AGE.unpack_from(data)
            except (CheckpointError, struct.error) as error:
                raise ConfigError(f"the memory that was taken up at {now_s} s: {error}") from error
            return events.MemoryRecalled(now_s, memory, age_s)
    return events.StopRequested(now_s)


def _peer(text: bytes) -> Address | None:
    host, _, port = text.decode("ascii", errors="replace").rpartition(" ")
    return (host, int(port)) if port.isdecimal() else None


class EventLog(BackgroundFile):
    """The events, written from a background thread."""

    def write(self, record: Mapping[str, object]) -> None:
        """Record one event; NaN and infinity become null, control characters are escaped."""
        self.append(json_line(record) + b"\n")


def event_lines(path: Path) -> list[dict[str, object]]:
    """The event log, without a torn last line (a power cut); `ConfigError` for other damage."""
    try:
        lines = read_file(path).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    values: list[dict[str, object]] = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ConfigError(f"{path}: line {number}: {error}") from error
    return values
