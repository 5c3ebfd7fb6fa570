"""Guard of setpoints, the only code that makes one. Standard library only.

Theory of operation. The autopilot obeys a setpoint as it is (PX4 accepted x = 1e9 and flew), and an
ArduPilot position target never times out. So the setpoint is a carrot: it starts at the vehicle, at
rest, and moves towards the goal within the envelope, slowing down so that it can stop before the
end of its way. Every setpoint that moves satisfies

- it is inside the fence and outside every keep-out by the margin, and in the altitude band;
- the point where it would stop (latency, braking) keeps 3 sigma from every border, and so does the
  straight line to it from the vehicle, both from the measured position and from the predicted one
  at the arrival of the setpoint;
- it is no farther from home than the leash and the battery allow, or nearer than it was.

A step that violates one of these is not made: the setpoint stays at its previous, safe position.
Each setpoint is therefore safe to be the last one that is ever sent. The stream restarts at the
vehicle, at rest, in the band, when its setpoint cannot be reached: its position jumped, it is too
fast to stop at a border, or the path is not free. From outside, or from the margin, the setpoint is
moved in on the shortest path, no farther out than the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import chain

from companion.geometry.obstacles import FreeSpace, limited_to_reach
from companion.geometry.polygons import FARTHEST_M, Point
from companion.guard.limits import MAX_TICK_S, Envelope, Fence, Reserve, Stopping, ahead

Position = tuple[float, float, float]

AT_REST = (0.0, 0.0, 0.0)
JUMP_STEPS = 2.0
"""Steps between vehicle and setpoint that mean a jump of the position: no lag explains it."""
ASIDE_M = 2.0
"""Lateral distance within which a setpoint is on the vehicle's way back inside."""


class GuardReason(Enum):
    """Reason why a setpoint differs from the planner's."""

    NO_FENCE = "there is no fence yet"
    NOT_FINITE = "invalid (NaN) input: goal, vehicle, home or time"
    FENCE = "goal is outside the fence or in a keep-out"
    OUTSIDE = "vehicle is outside the fence or in a keep-out: returning inside"
    MARGIN = "within the margin of the fence or a keep-out: moving away"
    ALTITUDE = "goal is outside the altitude band"
    LEASH = "goal is too far from home"
    BATTERY = "battery is too low to go farther from home"
    BATTERY_UNKNOWN = "battery charge is unknown: no farther from home"
    LAGGING = "vehicle lags behind its setpoint"
    JUMPED = "vehicle is far from its setpoint: holding position"
    TOO_FAST = "vehicle is too fast to stop before the fence or a keep-out"
    CUT_OFF = "no straight path to the setpoint: waiting for the vehicle"


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """Limits of every setpoint; a `ValueError` begins with the name of a contradicting one."""

    fence: Fence | None
    """Current fence; None: not known yet, so that nothing moves."""
    envelope: Envelope
    stopping: Stopping
    distance_home_m: float = math.inf
    """Largest distance of a setpoint from home."""
    reserve: Reserve | None = None
    """Charge reserved for the way home; None: the battery is not used."""

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        if not self.distance_home_m > 0.0:
            raise ValueError("distance_home_m: must be above 0")
        clearance_m, envelope = self.stopping.clearance_m, self.envelope
        if not self.altitude_m[0] < self.altitude_m[1]:
            band = f"{envelope.altitude_min_m:g} to {envelope.altitude_max_m:g} m"
            raise ValueError(
                f"altitude_min_m: nothing is left of {band} at {clearance_m:g} m from both ends"
            )
        if self.fence is not None and not self.fence.margin_m >= clearance_m:
            raise ValueError(
                f"fence_margin_m: {self.fence.margin_m:g} m is less than {clearance_m:g} m, "
                "3 sigma of the vehicle position, which it needs even at rest"
            )

    @property
    def altitude_m(self) -> tuple[float, float]:
        """The smallest and the largest height of a setpoint above home."""
        clearance_m, envelope = self.stopping.clearance_m, self.envelope
        return envelope.altitude_min_m + clearance_m, envelope.altitude_max_m - clearance_m


@dataclass(frozen=True, slots=True)
class Motion:
    """State of the vehicle for the guard; local east, north and up."""

    position_enu_m: Position
    velocity_enu_mps: Position
    home_enu_m: Position
    battery_pct: float | None = None
    """Remaining charge, 0 to 100; None: unknown."""


@dataclass(frozen=True, slots=True)
class Guarded:
    """A setpoint that is safe to send, its velocity, and the reasons of its changes."""

    position_enu_m: Position
    reasons: tuple[GuardReason, ...] = ()
    velocity_enu_mps: Position = AT_REST


@dataclass(frozen=True, slots=True)
class _Step:
    """Inputs of one tick."""

    goal_enu_m: Position
    previous: Guarded
    motion: Motion
    dt_s: float
    speed_cap_mps: float
    reasons: list[GuardReason]

    @property
    def start(self) -> Point:
        """Setpoint before this tick."""
        return self.previous.position_enu_m[:2]

    @property
    def vehicle(self) -> Point:
        """Measured position of the vehicle."""
        return self.motion.position_enu_m[:2]

    @property
    def ground_mps(self) -> Point:
        """Measured velocity of the vehicle over the ground."""
        return self.motion.velocity_enu_mps[:2]


class Guard:
    """Converts goals into setpoints that are safe to be the last."""

    def __init__(self, limits: GuardLimits) -> None:
        self.use(limits)

    def use(self, limits: GuardLimits) -> None:
        """Set other limits, for example when the fence becomes known."""
        self.limits = limits
        fence, clearance_m = limits.fence, limits.stopping.clearance_m
        self._known = None if fence is None else (fence, fence.free_space(clearance_m))
        """The fence, and the area for the vehicle itself on its way to a setpoint."""
        self._band_m = limits.altitude_m

    def here(self, motion: Motion) -> Guarded:
        """Return the setpoint "stay here", in the band; `ValueError`: no finite position."""
        if not _are_finite(motion.position_enu_m, motion.home_enu_m):
            raise ValueError("the position of vehicle or home is not a number")
        reasons = [GuardReason.NO_FENCE] if self._known is None else []
        up_m = self._in_band(motion.position_enu_m[2], motion, reasons)
        if self._known is not None and not self._known[1].allows(motion.position_enu_m[:2]):
            reasons.append(GuardReason.OUTSIDE)
        return Guarded((*motion.position_enu_m[:2], up_m), tuple(reasons))

    def freeze(self, position_enu_m: Position) -> Guarded:
        """Return the setpoint "do not move", even outside; `ValueError`: no finite position."""
        if not _are_finite(position_enu_m):
            raise ValueError("the position to hold is not a number")
        return Guarded(position_enu_m)

    def hold(self, previous: Guarded, motion: Motion, dt_s: float) -> Guarded:
        """Return the previous setpoint, at rest: it may stop at once. From outside it moves in."""
        at, climb_mps = previous.position_enu_m, previous.velocity_enu_mps[2]
        if self._known is None or self._known[0].allows(at[:2]):
            is_in_band = self._in_band(at[2], motion, []) == at[2]
            rest = (0.0, 0.0, 0.0 if is_in_band else climb_mps)
            previous = Guarded(at, velocity_enu_mps=rest)
        return self.towards(at, previous, motion, dt_s)

    def towards(
        self,
        goal_enu_m: Position,
        previous: Guarded,
        motion: Motion,
        dt_s: float,
        speed_cap_mps: float = math.inf,
    ) -> Guarded:
        """Return the next setpoint on the way to a goal, within `speed_cap_mps` and the limits.

        Raises `ValueError` if neither the previous setpoint nor the vehicle has a finite position.
        """
        if not _are_finite(previous.position_enu_m, previous.velocity_enu_mps):
            return Guarded(self.here(motion).position_enu_m, (GuardReason.NOT_FINITE,))
        if self._known is None:
            return Guarded(previous.position_enu_m, (GuardReason.NO_FENCE,))
        if not _are_numbers(goal_enu_m, motion, dt_s, speed_cap_mps):
            return Guarded(previous.position_enu_m, (GuardReason.NOT_FINITE,))
        fence, ways = self._known
        dt_s = min(max(dt_s, 0.0), MAX_TICK_S)
        step = _Step(goal_enu_m, previous, motion, dt_s, speed_cap_mps, [])
        obstacle = self._obstacle(step, fence, ways)
        if obstacle is GuardReason.OUTSIDE or obstacle is GuardReason.MARGIN:
            return self._led_inside(obstacle, step, fence)
        if obstacle is not None:
            return self._restarted(obstacle, step, fence)
        up_m, climb_mps = self._climbed(step)
        goal = self._permitted(step, fence)
        velocity = self._velocity(step, goal, fence)
        position = ahead(step.start, velocity, dt_s)
        if not self._is_safe(position, velocity, step, fence, ways):
            step.reasons.append(GuardReason.CUT_OFF)
            position, velocity = step.start, (0.0, 0.0)
        return Guarded((*position, up_m), tuple(step.reasons), (*velocity, climb_mps))

    # A vehicle that cannot fly to its setpoint

    def _obstacle(self, step: _Step, fence: Fence, ways: FreeSpace) -> GuardReason | None:
        start, vehicle, limits = step.start, step.vehicle, self.limits
        if not ways.allows(vehicle):
            return GuardReason.OUTSIDE
        if math.dist(start, vehicle) > JUMP_STEPS * limits.envelope.step_m:
            return GuardReason.JUMPED
        if not ways.is_clear(vehicle, start):
            return GuardReason.CUT_OFF
        stop = limits.stopping.point(vehicle, step.ground_mps)
        if not ways.is_clear(vehicle, stop):
            return GuardReason.TOO_FAST
        return None if fence.allows(start) else GuardReason.MARGIN

    def _restarted(self, why: GuardReason, step: _Step, fence: Fence) -> Guarded:
        """Return the vehicle's position, or the last setpoint if a too fast vehicle passed it.

        In the margin the setpoint keeps moving inwards, because wind keeps a vehicle off it;
        it is never farther outside than the vehicle.
        """
        ve, vn = step.ground_mps
        passed = (step.vehicle[0] - step.start[0]) * ve + (step.vehicle[1] - step.start[1]) * vn
        if why is not GuardReason.TOO_FAST or passed < 0.0:
            return Guarded(self.here(step.motion).position_enu_m, (why,))
        stay = Guarded(step.previous.position_enu_m, (why,))
        if fence.allows(step.start):
            return stay
        goal = fence.nearest_allowed(step.start)
        step = replace(step, goal_enu_m=step.previous.position_enu_m, speed_cap_mps=math.inf)
        led = self._walked((why, GuardReason.MARGIN), step, goal, fence)
        return (
            led
            if _outside_m(led.position_enu_m, fence) <= _outside_m(step.vehicle, fence)
            else stay
        )

    def _led_inside(self, why: GuardReason, step: _Step, fence: Fence) -> Guarded:
        """Return the next setpoint on the shortest way back, from the vehicle if off that way."""
        goal = fence.nearest_allowed(step.start)
        step = replace(step, goal_enu_m=step.previous.position_enu_m, speed_cap_mps=math.inf)
        left_m, lead_m = math.dist(step.start, goal), math.dist(step.start, step.vehicle)
        gained_m = math.dist(step.vehicle, inside := fence.nearest_allowed(step.vehicle)) - left_m
        if gained_m < 0.0 or lead_m > gained_m + ASIDE_M:  # from rest a wind would keep it there
            last = replace(step.previous, position_enu_m=(*step.vehicle, step.goal_enu_m[2]))
            step, goal = replace(step, previous=last), inside
        if lead_m > JUMP_STEPS * self.limits.envelope.step_m:
            return Guarded(self.here(step.motion).position_enu_m, (why,))
        return self._walked((why,), step, goal, fence)

    def _walked(
        self, why: tuple[GuardReason, ...], step: _Step, goal: Point, fence: Fence
    ) -> Guarded:
        """Return the next setpoint on the line to `goal`, or the vehicle if it is off that line."""
        left_m = math.dist(step.start, goal)
        velocity = self._velocity(step, goal, fence)
        position = ahead(step.start, velocity, step.dt_s)
        if math.dist(step.start, position) >= left_m:
            position, velocity = goal, (0.0, 0.0)
        if math.dist(position, goal) > left_m:
            return Guarded(self.here(step.motion).position_enu_m, why)
        up_m, climb_mps = self._climbed(step)
        return Guarded((*position, up_m), why, (*velocity, climb_mps))

    # The next setpoint

    def _in_band(self, up_m: float, motion: Motion, reasons: list[GuardReason]) -> float:
        home_up_m = motion.home_enu_m[2]
        low_m, high_m = home_up_m + self._band_m[0], home_up_m + self._band_m[1]
        if not low_m <= up_m <= high_m:
            reasons.append(GuardReason.ALTITUDE)
        return min(max(up_m, low_m), high_m)

    def _climbed(self, step: _Step) -> tuple[float, float]:
        limits, up_m = self.limits, step.previous.position_enu_m[2]
        left_m = self._in_band(step.goal_enu_m[2], step.motion, step.reasons) - up_m
        speed_mps = min(
            limits.envelope.climb_mps,
            step.speed_cap_mps,
            limits.stopping.speed_mps(abs(left_m), step.dt_s),
        )
        before, wanted = step.previous.velocity_enu_mps[2], math.copysign(speed_mps, left_m)
        climb_mps, _ = limits.envelope.next_velocity((before, 0.0), (wanted, 0.0), step.dt_s)
        return up_m + climb_mps * step.dt_s, climb_mps

    def _permitted(self, step: _Step, fence: Fence) -> Point:
        """Return the end of the straight line to the goal that may be flown."""
        limits, home, charge_pct = self.limits, step.motion.home_enu_m[:2], step.motion.battery_pct
        start, (east, north, _) = step.start, step.goal_enu_m
        wanted = (
            min(max(east, -FARTHEST_M), FARTHEST_M),
            min(max(north, -FARTHEST_M), FARTHEST_M),
        )
        goal = limited_to_reach(start, wanted, home, limits.distance_home_m)
        if goal != wanted:
            step.reasons.append(GuardReason.LEASH)
        if limits.reserve is not None:
            near = limited_to_reach(start, goal, home, limits.reserve.reach_m(charge_pct))
            if near != goal:
                why = GuardReason.BATTERY_UNKNOWN if charge_pct is None else GuardReason.BATTERY
                step.reasons.append(why)
            goal = near
        permitted = fence.limited(start, goal)
        if not fence.allows(goal):
            step.reasons.append(GuardReason.FENCE)
        return permitted

    def _velocity(self, step: _Step, goal: Point, fence: Fence) -> Point:
        """Return the velocity towards the goal, within the envelope and the stopping distance."""
        envelope, stopping = self.limits.envelope, self.limits.stopping
        start, vehicle, before = step.start, step.vehicle, step.previous.velocity_enu_mps[:2]
        left_m = math.dist(start, goal)
        if left_m == 0.0:
            return envelope.next_velocity(before, (0.0, 0.0), step.dt_s)
        east, north = (goal[0] - start[0]) / left_m, (goal[1] - start[1]) / left_m
        to_border_m = left_m + fence.margin_m - stopping.clearance_m
        speed_mps = min(
            envelope.speed_mps,
            step.speed_cap_mps,
            stopping.speed_mps(left_m, step.dt_s),
            stopping.speed_mps(to_border_m, stopping.latency_s + step.dt_s),
        )
        lead = (start[0] - vehicle[0], start[1] - vehicle[1])
        if lead[0] * east + lead[1] * north > 0.0:
            ve, vn = step.ground_mps
            room_m = max(0.0, envelope.step_m - math.hypot(*lead))
            pace_mps = max(0.0, ve * east + vn * north) + stopping.speed_mps(room_m, step.dt_s)
            if pace_mps < speed_mps:
                step.reasons.append(GuardReason.LAGGING)
                speed_mps = pace_mps
        return envelope.next_velocity(before, (speed_mps * east, speed_mps * north), step.dt_s)

    def _is_safe(
        self, position: Point, velocity: Point, step: _Step, fence: Fence, ways: FreeSpace
    ) -> bool:
        """Return True if a setpoint may be the last one; see the theory of operation."""
        stopping, vehicle = self.limits.stopping, step.vehicle
        arrival = ahead(vehicle, step.ground_mps, stopping.latency_s)
        return (
            fence.allows(position)
            and ways.is_clear(position, stopping.point(position, velocity))
            and ways.is_clear(vehicle, position)
            and ways.is_clear(arrival, position)
        )


def _are_numbers(goal: Position, motion: Motion, dt_s: float, speed_cap_mps: float) -> bool:
    """Return True if all inputs of a setpoint are numbers within the range of a local frame."""
    for value in (*motion.position_enu_m, *motion.velocity_enu_mps, *motion.home_enu_m):
        if not abs(value) <= FARTHEST_M:
            return False
    return all(map(math.isfinite, (*goal, dt_s))) and speed_cap_mps >= 0.0


def _outside_m(position: Sequence[float], fence: Fence) -> float:
    """Return the distance from a position to the area that the fence allows, metres."""
    point = (position[0], position[1])
    return math.dist(point, fence.nearest_allowed(point))


def _are_finite(*vectors: Position) -> bool:
    return all(map(math.isfinite, chain.from_iterable(vectors)))
