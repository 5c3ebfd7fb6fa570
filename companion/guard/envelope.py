"""How a setpoint may move: speed, climb, acceleration, lead and height. Standard library only.

Everything is by elapsed time, and a tick that comes late moves no farther than a slow one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.geometry.polygons import Point

MAX_TICK_S = 0.2
"""A tick that comes later than this moves the setpoint no farther than one of this length."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """Limits of motion and height.

    Raises:
        ValueError: Limits that contradict each other; the text begins with the name of one.
    """

    altitude_min_m: float
    """Above home."""
    altitude_max_m: float
    """Above home."""
    speed_mps: float
    climb_mps: float
    acceleration_mps2: float
    """Of the setpoint, horizontally and vertically."""
    step_m: float
    """Farther ahead of the vehicle than this the setpoint is no faster than the vehicle."""

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        for name in ("speed_mps", "climb_mps", "acceleration_mps2", "step_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be a finite number above 0")
        if not 0.0 < self.altitude_min_m < self.altitude_max_m < math.inf:
            raise ValueError("altitude_min_m: must be above 0 and below altitude_max_m")

    def next_velocity(self, velocity: Point, wanted: Point, dt_s: float) -> Point:
        """The velocity nearest to the wanted one that the acceleration allows."""
        change = (wanted[0] - velocity[0], wanted[1] - velocity[1])
        size, most = math.hypot(*change), self.acceleration_mps2 * dt_s
        share = most / size if size > most else 1.0
        return (velocity[0] + share * change[0], velocity[1] + share * change[1])
