"""The log files of a flight, written in the background and read back: tlog, inputs, events.

`flight.tlog` is the format of MAVLink tools: 8-byte big-endian microseconds since 1970, raw frame.

`flight.inputs` has the endpoint's inputs, exactly and in order, for replaying a flight: a header of
fixed size (`_HEADER`), the sender's address as text, the data, and a CRC-32 of all these, which
files of format 2 do not have. Times are the endpoint's own float64 seconds, because a replay is
identical to the last bit only if they are. Signatures are left out, and frames that carry a key
altogether.

`events.jsonl` has the flight's events as JSON lines.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from companion.errors import ConfigError, decoding_problem
from companion.guidance import events
from companion.guidance.commands import Severity
from companion.io.checkpoints import CheckpointError, decode_memory, encode_memory
from companion.io.files import BackgroundFile, OnDamage, json_line, read_file
from companion.mav.codec import (
    CRC_EXTRA_BY_ID,
    HEADER_LENGTH,
    INCOMPAT_SIGNED,
    MAGIC,
    MAGIC_V2,
    frame_end,
    has_good_crc,
    message_id,
    without_signature,
)
from companion.mav.endpoint import Address
from companion.mav.signing import SETUP_SIGNING

_STAMP = struct.Struct(">Q")


class TlogWriter(BackgroundFile):
    """Tlog that is written from a background thread."""

    def write(self, frame: bytes, unix_s: float) -> None:
        """Record one whole frame; a signature is left out, a SETUP_SIGNING altogether."""
        record = tlog_record(frame, unix_s)
        if record is not None:
            self.append(record)


def tlog_record(frame: bytes, unix_s: float) -> bytes | None:
    """Return the tlog record of a frame with its Unix time; None if it must not be logged."""
    kept = frame_for_log(frame)
    return None if kept is None else _STAMP.pack(max(0, round(unix_s * 1e6))) + kept


def frame_for_log(frame: bytes) -> bytes | None:
    """Return a whole frame without its signature; None if it holds a key, which no log may have."""
    if frame[0] != MAGIC_V2:
        return frame  # MAVLink 1 has neither
    if frame[7:10] == SETUP_SIGNING:
        return None
    if not frame[2] & INCOMPAT_SIGNED:
        return frame
    return without_signature(frame, CRC_EXTRA_BY_ID.get(message_id(frame)))


@dataclass(frozen=True, slots=True)
class TlogRecord:
    """One frame of a tlog."""

    unix_us: int
    frame: bytes


def read_tlog(path: Path, on_damage: OnDamage | None = None) -> Iterator[TlogRecord]:
    """Yield the frames of a tlog in order, without a torn last one.

    Bytes that are not a frame are skipped up to the next frame with a valid checksum, and
    `on_damage` is called with the offset of the first; so are messages that the dialect does not
    have, whose checksum cannot be verified and which no flight records. Without `on_damage`
    messages of other dialects are yielded, and bytes that are not a frame are a `ConfigError`, as
    is a file without any.
    """
    data, offset = read_file(path), 0
    while offset + _STAMP.size < len(data):
        start = offset + _STAMP.size
        end = _end_of_frame(data, start)
        if end is None or (on_damage is not None and not _is_proved(data, start)):
            is_torn = data[start] in HEADER_LENGTH and frame_end(data, start) > len(data)
            if on_damage is None and not is_torn:
                raise ConfigError(f"{path}: no MAVLink frame at byte {start}; is this a tlog?")
            if on_damage is None:
                return
            on_damage(offset)
            found = (
                m.start() for m in MAGIC.finditer(data, start + 1) if _is_proved(data, m.start())
            )
            offset = next(found, len(data)) - _STAMP.size
            if offset + _STAMP.size >= len(data):
                return
            continue
        (unix_us,) = _STAMP.unpack_from(data, offset)
        yield TlogRecord(unix_us, data[start:end])
        offset = end
    if offset < len(data) and on_damage is not None:
        on_damage(offset)


def _end_of_frame(data: bytes, start: int) -> int | None:
    """Return the end of the frame at `start`; None if there is none, or its checksum is wrong."""
    if data[start] not in HEADER_LENGTH:
        return None
    end = frame_end(data, start)
    if end > len(data):
        return None
    frame = data[start:end]
    crc_extra = CRC_EXTRA_BY_ID.get(message_id(frame))
    return end if crc_extra is None or has_good_crc(frame, crc_extra) else None


def _is_proved(data: bytes, start: int) -> bool:
    """Return True if a frame of a known message begins at `start`."""
    end = _end_of_frame(data, start)
    return end is not None and message_id(data[start:end]) in CRC_EXTRA_BY_ID


FAMILY = b"companion inputs "
FORMAT = FAMILY + b"3"
UNCHECKED = FAMILY + b"2"
"""Magic bytes of the 1.0.0rc1 format, whose records have no checksum."""
MAGIC_WITHIN = 64
"""The first bytes of a file, which name its format in every version."""
_HEADER = struct.Struct("<IdBBBI")
"""Number of the record, time_s, kind, link, length of the sender's address, length of the data."""
_CRC = struct.Struct("<I")
_AGE = struct.Struct("<d")
SEARCHED_AT_ONCE = 1 << 20
"""Bytes of a damaged file that are searched for the next record together."""


class InputKind(IntEnum):
    """Kinds of endpoint inputs."""

    BEGIN = 0
    """The first record; its data name the format."""
    FRAME = 1
    TICK = 2
    STOP = 3
    OPERATOR_COMMAND = 4
    """Input whose data name the operator's command."""
    EARLIER_RUN = 5
    """Input that records that an earlier process did not end in order."""
    RECALL = 6
    """Input whose data are the age, float64 seconds, and that process's memory, in MessagePack."""
    NOTE = 7
    """Input of a text to the operator: the severity's name, a space, and the text."""


AlsoKeeps = Callable[[bytes, float], None]
"""Takes a record and its time."""
_KINDS = frozenset(int(kind) for kind in InputKind)


@dataclass(frozen=True, slots=True)
class Input:
    """One input of the endpoint."""

    kind: InputKind
    time_s: float
    link: int = 0
    peer: Address | None = None
    data: bytes = b""


class InputLog(BackgroundFile):
    """Inputs, written from a background thread and passed on to `also` (the MCAP file)."""

    def __init__(
        self, path: Path, max_bytes: int | None = None, also: AlsoKeeps | None = None
    ) -> None:
        super().__init__(path, max_bytes)
        self._number = 0
        self._also = also
        self._keep(InputKind.BEGIN, 0.0, data=FORMAT)

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record a frame; a signature is left out, a SETUP_SIGNING altogether."""
        kept = frame_for_log(data)
        if kept is not None:
            self._keep(InputKind.FRAME, now_s, link, peer, kept)

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record raw bytes of a radio with another format than MAVLink."""
        self._keep(InputKind.FRAME, now_s, link, peer, data)

    def tick(self, now_s: float) -> None:
        """Record a tick."""
        self._keep(InputKind.TICK, now_s)

    def event(self, event: events.Event) -> None:
        """Record an event from the process or the operator; see `event_of`."""
        kind, data = InputKind.STOP, b""
        match event:
            case events.OperatorCommandReceived():
                kind, data = InputKind.OPERATOR_COMMAND, event.command.value.encode()
            case events.ProcessMessage():
                kind, data = InputKind.NOTE, f"{event.severity.name} {event.text}".encode()
            case events.UncleanExitFound():
                kind = InputKind.EARLIER_RUN
                data = b"" if event.vehicle is None else msgspec.msgpack.encode(event.vehicle)
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
        body = header + sender + data
        record = body + _CRC.pack(zlib.crc32(body))
        self.append(record)
        if self._also is not None:
            self._also(record, time_s)


@lru_cache(maxsize=16)
def _sender_text(peer: Address) -> bytes:
    return f"{peer[0]} {peer[1]}".encode()[:255]


def read_inputs(path: Path, on_damage: OnDamage | None = None) -> Iterator[Input]:
    """Yield the inputs in a file; see `parse_inputs`."""
    return parse_inputs(read_file(path), str(path), on_damage)


def parse_inputs(data: bytes, name: str, on_damage: OnDamage | None = None) -> Iterator[Input]:
    """Yield the inputs of a flight in order, without a torn last one.

    Where records are missing or damaged, `on_damage` is called with the number of the first, and
    reading continues with the next whole one. Without `on_damage` they are a `ConfigError`.
    """
    beginning = data[:MAGIC_WITHIN]
    if FAMILY in beginning and FORMAT not in beginning and UNCHECKED not in beginning:
        raise ConfigError(
            f"{name}: of another version; replay it with the companion of that flight"
        )
    reader = _RecordReader(data, is_checked=UNCHECKED not in beginning)
    offset, number, last_s = 0, 0, 0.0
    while offset < len(data):
        found = reader.record_at(offset, last_s)
        if found is None or found.number != number:
            if on_damage is not None:
                on_damage(number)
            elif found is None and number > 0 and reader.is_torn(offset):
                break
            else:
                what = f"record {number} is missing: the disk was too slow or full"
                raise ConfigError(f"{name}: {what if number else NO_BEGINNING}")
            found = found or reader.next_record(offset + 1, number, last_s)
            if found is None:
                break
        if found.value.kind != InputKind.BEGIN:
            yield found.value
        offset, number, last_s = found.end, found.number + 1, found.value.time_s
    if number == 0:
        raise ConfigError(f"{name}: has no inputs")


NO_BEGINNING = (
    "does not begin with a flight's start (an old part was given up to the log's cap, or this is "
    "no flight.inputs)"
)
MAX_PAUSE_S = 86_400.0
"""Longest pause between two records: no flight continues after a day."""


@dataclass(frozen=True, slots=True)
class _Record:
    number: int
    value: Input
    end: int
    """Offset of the next record."""


class _RecordReader:
    """Finds the records of one file; with `is_checked` each ends with its CRC-32."""

    def __init__(self, data: bytes, *, is_checked: bool) -> None:
        self._data = data
        self._is_checked = is_checked
        self._shortest = _HEADER.size + self._crc_size

    @property
    def _crc_size(self) -> int:
        return _CRC.size if self._is_checked else 0

    def record_at(self, offset: int, last_s: float) -> _Record | None:
        """Return the record at an offset; None if there is none, or its time is impossible."""
        data = self._data
        if offset + self._shortest > len(data):
            return None
        number, time_s, kind, link, peer_size, size = _HEADER.unpack_from(data, offset)
        body_end = offset + _HEADER.size + peer_size + size
        end = body_end + self._crc_size
        if kind not in _KINDS or end > len(data):
            return None
        if not (last_s == 0.0 or abs(time_s - last_s) <= MAX_PAUSE_S) or not math.isfinite(time_s):
            return None
        if self._is_checked:
            (crc,) = _CRC.unpack_from(data, body_end)
            if zlib.crc32(data[offset:body_end]) != crc:
                return None
        body = data[offset + _HEADER.size : body_end]
        if (number == 0 or kind == InputKind.BEGIN) and body not in (FORMAT, UNCHECKED):
            return None
        value = Input(InputKind(kind), time_s, link, _peer(body[:peer_size]), body[peer_size:])
        return _Record(number, value, end)

    def is_torn(self, offset: int) -> bool:
        """Return True if the rest of the file is the beginning of a record without its end."""
        data = self._data
        if offset + _HEADER.size > len(data):
            return True
        _, _, kind, _, peer_size, size = _HEADER.unpack_from(data, offset)
        return kind in _KINDS and offset + self._shortest + peer_size + size > len(data)

    def next_record(self, offset: int, number: int, last_s: float) -> _Record | None:
        """Return the first record after an offset that is followed by another or the end, or None.

        If there is none at a possible time, the previous record's time may have been damaged.
        """
        data = self._data
        for first in range(offset, len(data), SEARCHED_AT_ONCE):
            part = np.frombuffer(data[first : first + SEARCHED_AT_ONCE + 3], np.uint8)
            part = part.astype(np.uint32)
            if part.size < 4:
                break
            numbers = part[:-3] | part[1:-2] << 8 | part[2:-1] << 16 | part[3:] << 24
            likely = (numbers >= number) & (numbers <= number + len(data) // self._shortest)
            for at in np.flatnonzero(likely).tolist():
                found = self.record_at(first + at, last_s)
                if found is None or found.value.kind == InputKind.BEGIN:
                    continue
                follower = self.record_at(found.end, found.value.time_s)
                is_followed = follower is not None and follower.number == found.number + 1
                if self._is_checked or is_followed or found.end == len(data):
                    return found
        return None if last_s == 0.0 else self.next_record(offset, number, 0.0)


def event_of(value: Input) -> events.Event:
    """Return the event that `InputLog.event` recorded; `ConfigError`: its memory is unreadable."""
    now_s, data = value.time_s, value.data
    match value.kind:
        case InputKind.OPERATOR_COMMAND:
            try:
                return events.OperatorCommandReceived(now_s, events.OperatorCommand(data.decode()))
            except ValueError:
                raise ConfigError(f"a command at {now_s} s is not one: {data[:40]!r}") from None
        case InputKind.NOTE:
            name, _, text = data.decode(errors="replace").partition(" ")
            severity = Severity.__members__.get(name)
            if severity is None:
                raise ConfigError(f"a note at {now_s} s has no severity: {name!r}")
            return events.ProcessMessage(now_s, severity, text)
        case InputKind.EARLIER_RUN:
            try:
                mark = msgspec.msgpack.decode(data, type=events.VehicleMark) if data else None
            except msgspec.MsgspecError as error:
                raise ConfigError(
                    f"the vehicle of the earlier run at {now_s} s: {decoding_problem(error)}"
                ) from error
            return events.UncleanExitFound(now_s, mark)
        case InputKind.RECALL:
            try:
                memory, (age_s,) = decode_memory(data[_AGE.size :]), _AGE.unpack_from(data)
            except (CheckpointError, struct.error) as error:
                raise ConfigError(f"the memory restored at {now_s} s: {error}") from error
            return events.MemoryRecalled(now_s, memory, age_s)
    return events.StopRequested(now_s)


def _peer(text: bytes) -> Address | None:
    host, _, port = text.decode("ascii", errors="replace").rpartition(" ")
    return (host, int(port)) if port.isdecimal() else None


class EventLog(BackgroundFile):
    """Event log, written from a background thread."""

    def write(self, record: Mapping[str, object]) -> None:
        """Record one event; NaN and infinity become null, control characters are escaped."""
        self.append(json_line(record) + b"\n")


def event_lines(path: Path, on_damage: OnDamage | None = None) -> list[dict[str, object]]:
    """Return the event log, without a torn last line (a power cut).

    Lines that are not a JSON object are left out, and `on_damage` is called with the number of
    each. Without `on_damage` they are a `ConfigError`.
    """
    lines = read_file(path).split(b"\n")
    values: list[dict[str, object]] = []
    for number, line in enumerate(lines, start=1):
        if not line and number == len(lines):
            break
        try:
            values.append(msgspec.json.decode(line, type=dict[str, object]))
        except (msgspec.DecodeError, ValueError, RecursionError) as error:
            if on_damage is not None:
                on_damage(number)
            elif number < len(lines):
                raise ConfigError(f"{path}: line {number}: {decoding_problem(error)}") from error
    return values


def damage_text(path: Path | str, unit: str, positions: Sequence[int]) -> str:
    """Return the line that locates a log's damage, or an empty text."""
    if not positions:
        return ""
    more = "" if len(positions) == 1 else f" and at {len(positions) - 1} more places"
    return f"{path}: damaged at {unit} {positions[0]}{more}; the rest is read"
