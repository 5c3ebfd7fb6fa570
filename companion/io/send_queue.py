"""What waits to be written to a slow line: bounded, newest first to survive, whole frames only.

Theory of operation. On a line that cannot take all of it, what is late is worthless: a setpoint of
a second ago is worse than none. So the queue is short. What can be spared (texts, questions for
streams) is let in only while little waits; anything else always finds room, at the expense first of
what can be spared and then of the oldest. A frame that is written in part is finished, because the
other side would lose the next one with it.
"""

from __future__ import annotations

from collections import deque

SPARE_SHARE = 0.25
"""What can be spared is taken only while less than this share of the limit waits."""


class SendQueue:
    """Chunks in the order of their sending.

    Args:
        limit_bytes: How much may wait.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.dropped = 0
        """Chunks that were refused, or gave way to newer ones."""
        self._limit = limit_bytes
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._written = 0
        """Of the first chunk."""

    def __len__(self) -> int:
        """Bytes that wait."""
        return self._bytes - self._written

    def add(self, data: bytes, *, can_be_spared: bool = False) -> bool:
        """Queue a chunk; whether it was taken."""
        if can_be_spared and len(self) > SPARE_SHARE * self._limit:
            self.dropped += 1
            return False
        while len(self) + len(data) > self._limit:
            if len(data) > self._limit or not self._drop_one():
                self.dropped += 1
                return False
        self._waiting.append((data, can_be_spared))
        self._bytes += len(data)
        return True

    def head(self) -> bytes:
        """What to write next: the rest of the first chunk, and all that is behind it."""
        return b"".join(data for data, _ in self._waiting)[self._written :]

    def wrote(self, count: int) -> None:
        """So many bytes of `head` are written."""
        self._written += count
        while self._waiting and self._written >= len(self._waiting[0][0]):
            data, _ = self._waiting.popleft()
            self._written -= len(data)
            self._bytes -= len(data)

    def _drop_one(self) -> bool:
        """Give up the oldest chunk that can be spared, or the oldest; whether there was one."""
        begun = 1 if self._written else 0
        places = range(begun, len(self._waiting))
        spared = (place for place in places if self._waiting[place][1])
        victim = next(spared, begun)
        if victim >= len(self._waiting):
            return False
        self._bytes -= len(self._waiting[victim][0])
        del self._waiting[victim]
        self.dropped += 1
        return True
