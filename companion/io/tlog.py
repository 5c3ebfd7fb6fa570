"""The flight log that MAVLink tools read: 8-byte big-endian microseconds since 1970, raw frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ConfigError
from companion.io.background_file import BackgroundLog
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.framing import HEADER_LENGTH, frame_end, message_id, without_signature
from companion.mav.signing import is_secret

_STAMP = struct.Struct(">Q")


class TlogWriter(BackgroundLog):
    """Writes frames from a background thread; see `BackgroundLog`."""

    def write(self, frame: bytes, unix_s: float) -> None:
        """Record one whole frame; its signature, if any, is left out, a SETUP_SIGNING altogether.

        Args:
            frame: A frame as it was on the wire.
            unix_s: When it was sent or received, seconds since 1970.
        """
        record = tlog_record(frame, unix_s)
        if record is not None:
            self._file.append(record)


def tlog_record(frame: bytes, unix_s: float) -> bytes | None:
    """A frame as a tlog has it; None: it holds a secret, and no tlog may have it.

    Args:
        frame: A whole frame as it was on the wire; its signature, if any, is left out.
        unix_s: When it was sent or received, seconds since 1970.
    """
    if is_secret(frame):
        return None
    unsigned = without_signature(frame, CRC_EXTRA_BY_ID.get(message_id(frame)))
    return _STAMP.pack(max(0, round(unix_s * 1e6))) + unsigned


@dataclass(frozen=True, slots=True)
class TlogRecord:
    """One frame of a tlog."""

    unix_us: int
    frame: bytes


def read_tlog(path: Path) -> Iterator[TlogRecord]:
    """The frames of a tlog, in order; a torn last record (a power cut) ends them.

    Raises:
        ConfigError: The file cannot be read, or is no tlog.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    offset = 0
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
