"""Frames that carry our own ids: an echo of ours, or another companion that uses the same ones.

A router that forwards to everyone sends our frames back to us, byte by byte as they were. A frame
with our ids that we did not send is somebody else's: two companions on one vehicle would both obey
its operator and fight over its setpoints.
"""

from __future__ import annotations

import zlib
from collections import deque

KEPT = 1024
"""Frames of ours that are remembered: 20 s at the fastest pace."""
FOREIGN_FRAMES = 3
"""So many that are not ours make an alarm; fewer may be left over from a run before this one."""


class OwnFrames:
    """Remembers what we sent."""

    def __init__(self) -> None:
        self.echoes = 0
        self.foreign = 0
        """Frames with our ids that we did not send."""
        self._order: deque[int] = deque()
        self._sent: dict[int, int] = {}

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

    def came_back(self, frame: bytes) -> bool:
        """Note a received frame with our ids; whether it is time to raise the alarm, once."""
        if zlib.crc32(frame) in self._sent:
            self.echoes += 1
            return False
        self.foreign += 1
        return self.foreign == FOREIGN_FRAMES
