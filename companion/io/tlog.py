"""The flight log that MAVLink tools read: 8-byte big-endian microseconds since 1970, raw frame."""

from __future__ import annotations

import struct
from pathlib import Path

from companion.io.background_file import BackgroundFile
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.framing import message_id, without_signature

_STAMP = struct.Struct(">Q")


class TlogWriter:
    """Writes frames from a background thread; never raises and never waits once it is open.

    Args:
        path: The `.tlog` file; its directory exists. An existing one is continued.

    Raises:
        CompanionError: The file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = BackgroundFile(path)

    @property
    def dropped(self) -> int:
        """Frames lost to a slow or full disk."""
        return self._file.dropped

    def write(self, frame: bytes, unix_s: float) -> None:
        """Record one whole frame; its signature, if any, is left out.

        Args:
            frame: A frame as it was on the wire.
            unix_s: When it was sent or received, seconds since 1970.
        """
        unsigned = without_signature(frame, CRC_EXTRA_BY_ID.get(message_id(frame)))
        self._file.append(_STAMP.pack(max(0, round(unix_s * 1e6))) + unsigned)

    def close(self) -> None:
        """Write what is queued, for one second at most, and close."""
        self._file.close()
