"""The order and the loss of one sender's frames, by their sequence numbers.

Theory of operation. A sender counts its frames modulo 256. Unwrapped to the nearest value, the
count tells which of two frames was sent first and how many never came; both are right as long as
no frame is late by 128 others or more. After a silence, or where nobody read for a while, a count
that seems to have gone back went ahead instead. The loss is taken over the last seconds: how many
numbers the count advanced, and how many of these numbers came.

Source: MAVLink developer guide, "Packet Loss"; PX4 1.15 sends 405 frames a second, so 128 of them
are 0.3 s.
"""

from __future__ import annotations

import math
from collections import deque

MODULUS = 256
HALF = MODULUS // 2
SILENCE_S = 0.3
"""After it nothing is late any more, only lost."""
WINDOW_S = 3.0
BUCKET_S = 0.1
MIN_EXPECTED = 20
"""With fewer frames to expect in the window a share says nothing."""


class SequenceMonitor:
    """One sender's frames; its autopilot component, for example."""

    def __init__(self) -> None:
        self.received = 0
        """Frames so far, duplicates not counted."""
        self.lost = 0
        """Numbers that were passed over and have not come since."""
        self.duplicates = 0
        self.late = 0
        """Frames that were overtaken."""
        self._newest: int | None = None
        self._heard_s = 0.0
        self._seen = 0
        """Bit n: whether number `newest - n` came."""
        self._buckets: deque[tuple[float, int, int]] = deque()
        """Of each tenth of a second: begin, numbers that the count advanced, frames that came."""

    def take(self, sequence: int, now_s: float) -> int:
        """The unwrapped number of a frame that came, perhaps not for the first time."""
        if self._newest is None:
            return self._start(sequence, now_s)
        ahead = (sequence - self._newest) % MODULUS
        if ahead >= HALF and now_s - self._heard_s <= SILENCE_S:
            ahead -= MODULUS
        if ahead == 0 and now_s - self._heard_s > SILENCE_S:
            ahead = MODULUS
        self._heard_s = max(now_s, self._heard_s)
        if ahead > 0:
            self._advance(ahead, now_s)
        elif self._seen >> -ahead & 1:
            self.duplicates += 1
        else:
            self.late += 1
            self.lost = max(0, self.lost - 1)  # one from before the first was not missed
            self._seen |= 1 << -ahead
            self._count(0, now_s)
        return self._newest + min(ahead, 0)

    def loss(self, now_s: float) -> float | None:
        """Share of the last seconds' frames that did not come, 0 to 1; None if too few were due."""
        since_s = now_s - WINDOW_S
        expected = came = 0
        for began_s, numbers, frames in self._buckets:
            if began_s > since_s:
                expected += numbers
                came += frames
        if expected < MIN_EXPECTED:
            return None
        return min(max(0.0, 1.0 - came / expected), 1.0)

    def skip(self) -> None:
        """What comes next is ahead, however far: much of what was sent last may never come."""
        self._heard_s = -math.inf

    def restart(self) -> None:
        """Begin anew, because the sender did; the totals stay."""
        self._newest = None
        self._buckets.clear()

    def _start(self, sequence: int, now_s: float) -> int:
        self._newest = sequence
        self._seen = 1
        self._heard_s = now_s
        self._count(1, now_s)
        return sequence

    def _advance(self, ahead: int, now_s: float) -> None:
        assert self._newest is not None
        self._newest += ahead
        self._seen = (self._seen << ahead | 1) & (1 << HALF) - 1
        self.lost += ahead - 1
        self._count(ahead, now_s)

    def _count(self, advanced: int, now_s: float) -> None:
        self.received += 1
        if not self._buckets or now_s - self._buckets[-1][0] >= BUCKET_S:
            self._buckets.append((now_s, 0, 0))
            while self._buckets[0][0] <= now_s - WINDOW_S:
                self._buckets.popleft()
        begin_s, numbers, frames = self._buckets[-1]
        self._buckets[-1] = (begin_s, numbers + advanced, frames + 1)
