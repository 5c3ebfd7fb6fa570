"""The gate: every setpoint passes here, and nothing else makes one. Standard library only.

Theory of operation. The autopilot takes a setpoint as it is (PX4 accepted x = 1e9 and flew), and
an ArduPilot position target never times out. So the setpoint is a carrot: it starts where the
vehicle is and moves towards the goal no faster than the speed limit, waits when the vehicle falls
behind by more than the step limit, starts anew at the vehicle when that is far off (its position
jumped, or wind took it), and never leaves the fence or the altitude band, nor enters a keep-out.
Each one is therefore safe to be the last one that is ever sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from companion.guard.fence import Fence

Position = tuple[float, float, float]

JUMP_STEPS = 2.0
"""A vehicle farther from its setpoint than this many steps did not lag: its position jumped."""
MAX_TICK_S = 0.2
"""A tick that comes late moves the setpoint no farther than one of this length."""


class GuardReason(Enum):
    """Why a setpoint is not where the planner wanted it."""

    NOT_FINITE = "goal, vehicle, home or time is not a finite number"
    FENCE = "goal is outside the fence or in a keep-out"
    OUTSIDE = "vehicle is outside the fence or in a keep-out"
    ALTITUDE = "goal is outside the altitude band"
    LAGGING = "vehicle lags behind its setpoint"
    JUMPED = "vehicle is far from its setpoint: staying where it is"


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """What no setpoint may exceed."""

    fence: Fence | None
    altitude_min_m: float
    """Above home."""
    altitude_max_m: float
    """Above home."""
    speed_mps: float
    climb_mps: float
    step_m: float
    """How far the setpoint may be ahead of the vehicle."""

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        values = (self.speed_mps, self.climb_mps, self.step_m)
        if not all(math.isfinite(v) and v > 0.0 for v in values):
            raise ValueError("speed, climb and step limits must be positive")
        if not 0.0 < self.altitude_min_m < self.altitude_max_m < math.inf:
            raise ValueError("the altitude band must be positive and not empty")


@dataclass(frozen=True, slots=True)
class Guarded:
    """A setpoint that is safe to send, and what was changed to make it so."""

    position_enu_m: Position
    reasons: tuple[GuardReason, ...]


class Guard:
    """Turns goals into setpoints.

    Args:
        limits: What no setpoint may exceed.
    """

    def __init__(self, limits: GuardLimits) -> None:
        self.limits = limits

    def here(self, vehicle_enu_m: Position, home_up_m: float) -> Guarded:
        """The setpoint "stay where you are", moved inside the limits if that is outside."""
        reasons: list[GuardReason] = []
        up = self._in_band(vehicle_enu_m[2], home_up_m, reasons)
        place = (vehicle_enu_m[0], vehicle_enu_m[1])
        if self.limits.fence is not None and not self.limits.fence.allows(place):
            place = self.limits.fence.nearest_allowed(place)
            reasons.append(GuardReason.OUTSIDE)
        return Guarded((*place, up), tuple(reasons))

    def towards(
        self,
        goal_enu_m: Position,
        previous_enu_m: Position,
        vehicle_enu_m: Position,
        home_up_m: float,
        dt_s: float,
    ) -> Guarded:
        """The next setpoint on the way to a goal.

        Args:
            goal_enu_m: Where the planner wants to be, at its altitude.
            previous_enu_m: The setpoint before.
            vehicle_enu_m: Where the vehicle is.
            home_up_m: Height of home in the local frame.
            dt_s: Time since the setpoint before.
        """
        reasons: list[GuardReason] = []
        if not all(map(math.isfinite, (*goal_enu_m, *vehicle_enu_m, home_up_m, dt_s))):
            return Guarded(previous_enu_m, (GuardReason.NOT_FINITE,))
        dt_s = min(max(dt_s, 0.0), MAX_TICK_S)
        goal_up = self._in_band(goal_enu_m[2], home_up_m, reasons)
        climb = self.limits.climb_mps * dt_s
        up = previous_enu_m[2] + min(max(goal_up - previous_enu_m[2], -climb), climb)
        if math.dist(previous_enu_m[:2], vehicle_enu_m[:2]) > JUMP_STEPS * self.limits.step_m:
            reasons.append(GuardReason.JUMPED)
            place = self.here(vehicle_enu_m, home_up_m).position_enu_m[:2]
        else:
            place = self._advanced(goal_enu_m, previous_enu_m, vehicle_enu_m, dt_s, reasons)
        return Guarded((*place, up), tuple(reasons))

    def _in_band(self, up_m: float, home_up_m: float, reasons: list[GuardReason]) -> float:
        low = home_up_m + self.limits.altitude_min_m
        high = home_up_m + self.limits.altitude_max_m
        if not low <= up_m <= high:
            reasons.append(GuardReason.ALTITUDE)
        return min(max(up_m, low), high)

    def _advanced(
        self,
        goal: Position,
        previous: Position,
        vehicle: Position,
        dt_s: float,
        reasons: list[GuardReason],
    ) -> tuple[float, float]:
        start, end = previous[:2], goal[:2]
        distance = math.dist(start, end)
        share = 1.0 if distance == 0.0 else min(1.0, self.limits.speed_mps * dt_s / distance)
        place = (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
        lead = math.dist(place, vehicle[:2])
        if lead > self.limits.step_m and lead > math.dist(start, vehicle[:2]):
            reasons.append(GuardReason.LAGGING)
            place = start
        fence = self.limits.fence
        if fence is None:
            return place
        if not fence.allows(end):
            reasons.append(GuardReason.FENCE)
        return fence.limited(start, place)
