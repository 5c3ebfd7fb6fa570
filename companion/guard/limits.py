"""Limits of a setpoint: fence, envelope of motion, stopping distance, distance from home.

Fence. A setpoint is inside of all polygons that apply and outside of every keep-out, by a margin.

Motion. All limits are by elapsed time, and a late tick moves no farther than a slow one.

Stopping. A vehicle that is to stop continues for the latency of the link, then brakes, and its
position has an error: v t + v^2 / 2a + 3 sigma. The first two are in the direction of motion; the
last is a distance to keep on all sides.

Reserve. The way home costs charge in proportion to its length, so the charge above the reserve is a
distance. A vehicle beyond it is not pulled back (that is for the pilot, or for the autopilot's own
failsafe) but goes no farther. The distance of an unknown battery is zero.

Standard library only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.geometry.obstacles import ROUNDING_M, FreeSpace, check_corners
from companion.geometry.polygons import Corners, Point, check_polygon, deepest_point, depth_m

MIN_FENCE_M2 = 1.0
MIN_KEEP_OUT_M2 = 1e-3
"""Minimum area of a keep-out: that of a mast is valid."""


@dataclass(frozen=True, slots=True)
class Fence:
    """A simple polygon in local east and north, keep-outs in it, and a margin to their borders.

    `also_inside_enu_m` are polygons that apply at the same time: the allowed area lies inside all
    of them. A `ValueError` names the fault: fewer than 3 corners, crossing edges, no area, more
    corners in all than can be checked in time, a negative margin, or no area left by it.
    """

    polygon_enu_m: Corners
    margin_m: float
    keep_out_enu_m: tuple[Corners, ...] = ()
    also_inside_enu_m: tuple[Corners, ...] = ()
    space: FreeSpace = field(init=False, repr=False, compare=False)
    """Area left by the fence, the keep-outs and the margin."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for polygons without area, and for a fence without usable area."""
        check_corners((self.polygon_enu_m, *self.keep_out_enu_m, *self.also_inside_enu_m))
        for polygon in (self.polygon_enu_m, *self.also_inside_enu_m):
            check_polygon("fence", polygon, MIN_FENCE_M2)
        for polygon in self.keep_out_enu_m:
            check_polygon("keep-out", polygon, MIN_KEEP_OUT_M2)
        if not self.margin_m >= 0.0:
            raise ValueError("the margin of a fence must be 0 or more")
        middle = deepest_point(self.polygon_enu_m)
        if depth_m(self.polygon_enu_m, middle) <= self.margin_m:
            raise ValueError(f"the margin of {self.margin_m:g} m leaves nothing of the fence")
        space = self.free_space(self.margin_m)
        object.__setattr__(self, "space", space)
        if not any(space.boundary):
            rest = "its other borders" if self.also_inside_enu_m else "the keep-outs"
            raise ValueError(f"{rest} leave nothing of the fence")

    def free_space(self, margin_m: float) -> FreeSpace:
        """Return the area that another margin would leave."""
        return FreeSpace(self.polygon_enu_m, self.keep_out_enu_m, margin_m, self.also_inside_enu_m)

    def allows(self, point: Point) -> bool:
        """Return True if a point is inside, and outside every keep-out, by at least the margin."""
        return self.space.allows(point)

    def limited(self, start: Point, goal: Point) -> Point:
        """Return the farthest point of the line from `start` to `goal` with all before allowed.

        From a start that is not allowed itself (blown outside, or started there) the result is the
        nearest allowed point instead: only ever the shortest way back.
        """
        if self.allows(goal) and self.space.is_clear(start, goal):
            return goal
        first, end = next(self.space.pieces(start, goal), (goal, goal))
        if math.dist(first, start) <= ROUNDING_M:
            return self.nearest_allowed(end)
        return self.nearest_allowed(start)

    def nearest_allowed(self, point: Point) -> Point:
        """Return `point` if it is allowed, otherwise the nearest allowed one."""
        nearest = self.space.nearest_allowed(point)
        assert nearest is not None  # the constructor has checked that there is free space
        return nearest


MAX_TICK_S = 0.2
"""Longest control period by which a setpoint moves; a later tick moves it no farther."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """Limits of motion and of height above home; a `ValueError` begins with the faulty name."""

    altitude_min_m: float
    altitude_max_m: float
    speed_mps: float
    climb_mps: float
    acceleration_mps2: float
    """Acceleration limit of the setpoint, horizontally and vertically."""
    step_m: float
    """Lead over the vehicle beyond which the setpoint moves no faster than the vehicle."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for contradicting limits."""
        for name in ("speed_mps", "climb_mps", "acceleration_mps2", "step_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be a finite number above 0")
        if not 0.0 < self.altitude_min_m < self.altitude_max_m < math.inf:
            raise ValueError("altitude_min_m: must be above 0 and below altitude_max_m")

    def next_velocity(self, velocity: Point, wanted: Point, dt_s: float) -> Point:
        """Return the velocity nearest to the wanted one that the acceleration allows."""
        change = (wanted[0] - velocity[0], wanted[1] - velocity[1])
        size, most = math.hypot(*change), self.acceleration_mps2 * dt_s
        share = most / size if size > most else 1.0
        return (velocity[0] + share * change[0], velocity[1] + share * change[1])


SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Stopping:
    """Inputs of the stopping distance.

    A `ValueError` begins with the name of the limit: a latency or sigma that is negative, a
    deceleration that is not positive, or one that is not finite.
    """

    latency_s: float
    """Delay from a measurement of the vehicle's motion until it follows the setpoint."""
    deceleration_mps2: float
    """Deceleration that the vehicle reaches in any case."""
    navigation_sigma_m: float
    """Standard deviation of its position, per axis."""
    clearance_m: float = field(init=False)
    """Distance to keep from every border, moving or not."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for invalid values."""
        if not 0.0 <= self.latency_s < math.inf:
            raise ValueError("latency_s: must be a finite number and not negative")
        if not 0.0 < self.deceleration_mps2 < math.inf:
            raise ValueError("acceleration_mps2: must be a finite number above 0")
        if not 0.0 <= self.navigation_sigma_m < math.inf:
            raise ValueError("navigation_sigma_m: must be a finite number and not negative")
        object.__setattr__(self, "clearance_m", SIGMAS * self.navigation_sigma_m)

    def point(self, position: Point, velocity_mps: Point) -> Point:
        """Return the farthest point at which a body with this velocity stops."""
        speed_mps = math.hypot(*velocity_mps)
        time_s = self.latency_s + 0.5 * speed_mps / self.deceleration_mps2
        return ahead(position, velocity_mps, time_s)

    def speed_mps(self, room_m: float, wait_s: float) -> float:
        """Return the highest speed, kept `wait_s`, with v wait + v^2 / 2a = `room_m`."""
        waiting_mps = self.deceleration_mps2 * wait_s
        squared = waiting_mps * waiting_mps + 2.0 * self.deceleration_mps2 * room_m
        return math.sqrt(squared) - waiting_mps


def ahead(position: Point, velocity_mps: Point, time_s: float) -> Point:
    """Return the position after a time at constant velocity."""
    return (position[0] + velocity_mps[0] * time_s, position[1] + velocity_mps[1] * time_s)


M_PER_KM = 1000.0
FULL_PCT = 100.0


@dataclass(frozen=True, slots=True)
class Reserve:
    """Battery charge reserved for the way home.

    A `ValueError` begins with the limit's name: the reserve must be a share of the battery, and the
    cost positive.
    """

    reserve_pct: float
    """Charge that is kept for landing, per cent."""
    cost_pct_per_km: float
    """Charge for a kilometre of the way home, into the wind."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for invalid values."""
        if not 0.0 <= self.reserve_pct < FULL_PCT:
            raise ValueError("battery_reserve_pct: must be from 0 to below 100")
        if not 0.0 < self.cost_pct_per_km < math.inf:
            raise ValueError("battery_pct_per_km: must be a finite number above 0")

    def reach_m(self, battery_pct: float | None) -> float:
        """Return the distance from home that leaves charge to come back; 0 for unknown charge."""
        if battery_pct is None:
            return 0.0
        return max(0.0, battery_pct - self.reserve_pct) / self.cost_pct_per_km * M_PER_KM
