"""A value that stands still while the vehicle moves was not measured.

A radio that hangs repeats its last number with fresh stamps. Noise never repeats itself to the last
bit, and a radio with coarse numbers repeats them only while the vehicle hardly moves.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu

FROZEN_COUNT = 5
FROZEN_S = 1.0
FROZEN_M = 2.0
"""So many equal values in a row, over so much time and own motion, are frozen."""


class FrozenValue:
    """Watches one value of one radio."""

    def __init__(self) -> None:
        self._value: float | None = None
        self._since_s = 0.0
        self._since_enu_m: PositionEnu = (0.0, 0.0, 0.0)
        self._count = 0

    def clear(self) -> None:
        """Forget everything."""
        self._value = None

    def forget_samples(self) -> None:
        """The same: there is nothing else to keep."""
        self.clear()

    def add(self, value: float, time_s: float, sensor_enu_m: PositionEnu) -> bool:
        """Take in a value; whether it is frozen.

        Args:
            value: As the radio has it.
            time_s: When it was measured, allegedly.
            sensor_enu_m: Where the antenna was then.
        """
        if value != self._value:
            self._value, self._count = value, 1
            self._since_s, self._since_enu_m = time_s, sensor_enu_m
            return False
        self._count += 1
        has_moved = math.dist(sensor_enu_m, self._since_enu_m) >= FROZEN_M
        return has_moved and self._count >= FROZEN_COUNT and time_s - self._since_s >= FROZEN_S
