"""Texts for people; long ones in chunks.

Source: MAVLink common, STATUSTEXT: chunks share a non-zero id and count from 0, and a NUL in the
field marks the last one, so a text that fills its last chunk is followed by an empty one.
"""

from __future__ import annotations

from companion.mav.dialect import Message, mavlink

CHUNK_LENGTH = 50
MAX_CHUNKS = 255
MAX_ID = 0xFFFF


class StatusTexts:
    """Makes the messages of texts, and gives out the ids that hold long ones together."""

    def __init__(self) -> None:
        self._last_id = 0

    def messages(self, severity: int, text: str) -> list[Message]:
        """STATUSTEXTs for one text.

        Args:
            severity: MAV_SEVERITY.
            text: Any length; what is not ASCII becomes `?`, which every client shows, and a
                text beyond 255 chunks is cut.
        """
        encoded = text.encode("ascii", errors="replace").replace(b"\0", b"?")
        if len(encoded) <= CHUNK_LENGTH:
            return [mavlink.MAVLink_statustext_message(severity, encoded, 0, 0)]
        self._last_id = self._last_id % MAX_ID + 1
        starts = range(0, len(encoded) + 1, CHUNK_LENGTH)[:MAX_CHUNKS]
        return [
            mavlink.MAVLink_statustext_message(
                severity, encoded[start : start + CHUNK_LENGTH], self._last_id, number
            )
            for number, start in enumerate(starts)
        ]
