"""Whether a signed link had to believe a frame, by the letter of MAVLink's signing.

Written for the monitor: nothing of the companion's own check is used but the key.
"""

from __future__ import annotations

import hashlib

from companion.mav.signing import SigningKey

SIGNATURE, TAG, STAMP = 13, 6, 6
MAGIC_V2, SIGNED_FLAG = 0xFD, 0x01


class Proof:
    """Follows the newest timestamp of every component, of those that were read.

    A frame that was dropped unread is as new as before, whoever sends a copy of it.

    Args:
        key: Of the link.
    """

    def __init__(self, key: SigningKey) -> None:
        self._secret = key.secret
        self._newest: dict[tuple[int, int], int] = {}
        self._before: tuple[tuple[int, int], int] | None = None
        """Sender of the frame that was accepted last, and what was its newest before that."""

    def accepts(self, frame: bytes) -> bool:
        """Whether it is signed with the key and newer than all before of its sender."""
        self._before = None
        if frame[0] != MAGIC_V2 or not frame[2] & SIGNED_FLAG:
            return False
        tag = hashlib.sha256(self._secret + frame[:-TAG]).digest()[:TAG]
        if tag != frame[-TAG:]:
            return False
        sender = (frame[5], frame[6])
        stamp = int.from_bytes(frame[-TAG - STAMP : -TAG], "little")
        newest = self._newest.get(sender, -1)
        if stamp <= newest:
            return False
        self._before = (sender, newest)
        self._newest[sender] = stamp
        return True

    def unreadable(self) -> None:
        """A frame came that nobody can read."""
        self._before = None

    def dropped(self) -> None:
        """The frame that came last was not read."""
        if self._before is not None:
            sender, newest = self._before
            self._newest[sender] = newest
            self._before = None
