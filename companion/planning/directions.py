"""Directions in the plane, as the planners' kernels need them: unit vectors as two numbers."""

from __future__ import annotations

import math

from companion.kernel import kernel

MIN_DISTANCE_M = 1e-9
"""Closer than this there is no direction from one point to another."""


@kernel
def direction(
    from_east_m: float, from_north_m: float, to_east_m: float, to_north_m: float
) -> tuple[float, float]:
    """Unit vector from one point to another; east where they coincide."""
    east, north = to_east_m - from_east_m, to_north_m - from_north_m
    distance = math.hypot(east, north)
    if distance < MIN_DISTANCE_M:
        return 1.0, 0.0
    return east / distance, north / distance


@kernel
def turned(east: float, north: float, angle_rad: float) -> tuple[float, float]:
    """A vector turned counter-clockwise."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * east - s * north, s * east + c * north
