"""Frames that carry our own ids: an echo of ours, or another companion that uses the same ones.

A router that forwards to everyone sends our frames back to us, byte by byte as they were. A frame
with our ids that we did not send is somebody else's: two companions on one vehicle would both obey
its operator and fight over its setpoints. Such a twin is heard as long as its frames come, the
HEARTBEAT of each second at the least.
"""

from __future__ import annotations

import math
import zlib
from collections import deque

from companion.guidance.authority import TWIN_S

KEPT = 1024
"""Frames of ours that are remembered: 20 s at the fastest pace."""
FOREIGN_FRAMES = 3
FOREIGN_SPAN_S = 1.0
"""So many that are not ours, over no less than the span, are a twin's; fewer may be left over from
a run before this one, on a slow way back."""


class OwnFrames:
    """Remembers what we sent."""

    def __init__(self) -> None:
        self.echoes = 0
        self.foreign = 0
        """Frames with our ids that we did not send."""
        self._order: deque[int] = deque()
        self._sent: dict[int, int] = {}
        self._is_told = False
        self._run = 0
        """Foreign frames without a long silence between them, ..."""
        self._began_s = self._heard_s = -math.inf
        """... the first of them, and the last."""

    def sent(self, frame: bytes) -> None:
        """Note a frame of ours."""
        number = zlib.crc32(frame)
        self._order.append(number)
        self._sent[number] = self._sent.get(number, 0) + 1
        if len(self._order) > KEPT:
            oldest = self._order.popleft()
            self._sent[oldest] -= 1
            if not self._sent[oldest]:
                del self._sent[oldest]

    def came_back(self, frame: bytes, now_s: float) -> bool:
        """Note a received frame with our ids; whether a twin sent it."""
        if zlib.crc32(frame) in self._sent:
            self.echoes += 1
            return False
        self.foreign += 1
        if now_s - self._heard_s > TWIN_S:
            self._run, self._began_s = 0, now_s
        self._run += 1
        self._heard_s = now_s
        return self._run >= FOREIGN_FRAMES and now_s - self._began_s >= FOREIGN_SPAN_S

    def is_news(self) -> bool:
        """Whether the operator was not told of a twin yet; from now on he was."""
        was_told, self._is_told = self._is_told, True
        return not was_told
