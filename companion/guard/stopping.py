"""How far a vehicle still goes: link latency, braking and navigation. Standard library only.

Theory of operation. A vehicle that is told to stop flies on for the latency of the link, then
brakes, and is not exactly where it believes to be: v t + v^2 / 2a + 3 sigma. The first two are in
the direction it moves in; the last is a distance to keep to all sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.geometry.polygons import Point

SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Stopping:
    """What a vehicle needs to stop.

    Raises:
        ValueError: A latency or sigma that is negative, a deceleration that is not positive, or
            one that is not finite; the text begins with the name of the limit.
    """

    latency_s: float
    """From a motion that is measured to a setpoint that is obeyed."""
    deceleration_mps2: float
    """What the vehicle surely brakes with."""
    navigation_sigma_m: float
    """Standard deviation of its position, per axis."""

    def __post_init__(self) -> None:
        """Refuse what is not a number or stops nothing."""
        if not 0.0 <= self.latency_s < math.inf:
            raise ValueError("latency_s: must be a finite number and not negative")
        if not 0.0 < self.deceleration_mps2 < math.inf:
            raise ValueError("acceleration_mps2: must be a finite number above 0")
        if not 0.0 <= self.navigation_sigma_m < math.inf:
            raise ValueError("navigation_sigma_m: must be a finite number and not negative")

    @property
    def clearance_m(self) -> float:
        """Distance to keep from every border, moving or not."""
        return SIGMAS * self.navigation_sigma_m

    def point(self, place: Point, velocity_mps: Point) -> Point:
        """Where something that moves like this stops, at the farthest."""
        speed_mps = math.hypot(*velocity_mps)
        time_s = self.latency_s + 0.5 * speed_mps / self.deceleration_mps2
        return ahead(place, velocity_mps, time_s)

    def speed_mps(self, room_m: float, wait_s: float) -> float:
        """The greatest speed from which `room_m` is enough: v wait + v^2 / 2a = room.

        Args:
            room_m: Not negative.
            wait_s: How long the speed is kept before braking.
        """
        waiting_mps = self.deceleration_mps2 * wait_s
        squared = waiting_mps * waiting_mps + 2.0 * self.deceleration_mps2 * room_m
        return math.sqrt(squared) - waiting_mps


def ahead(place: Point, velocity_mps: Point, time_s: float) -> Point:
    """Where something is after a time, if it goes on like this."""
    return (place[0] + velocity_mps[0] * time_s, place[1] + velocity_mps[1] * time_s)
