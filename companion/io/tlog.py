"""The flight log that MAVLink tools read: 8-byte big-endian microseconds since 1970, raw frame."""

from __future__ import annotations

import struct

from companion.io.background_file import BackgroundLog
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.framing import message_id, without_signature
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
        if is_secret(frame):
            return
        unsigned = without_signature(frame, CRC_EXTRA_BY_ID.get(message_id(frame)))
        self._file.append(_STAMP.pack(max(0, round(unix_s * 1e6))) + unsigned)
