"""From the estimate to the next guarded setpoint."""

from __future__ import annotations

from typing import Any

from companion.domain import PositionEnu, PositionSetpoint, TargetEstimate, Waypoint
from companion.guard.gate import Guard, Guarded, GuardReason
from companion.planning.base import Planner, PlanRequest

CLIMB_FIRST_M = 1.0
"""Below the altitude band by more than this the vehicle climbs before it goes anywhere."""


class Steering:
    """Plans waypoints and walks the setpoint towards them, always through the guard.

    Args:
        planner: Where to fly, given the estimate.
        guard: What may be sent.
        altitude_m: Search altitude above home.
    """

    def __init__(self, planner: Planner[Any], guard: Guard, altitude_m: float) -> None:
        self.waypoint: Waypoint | None = None
        self.setpoint_enu_m: PositionEnu | None = None
        self.reasons: tuple[GuardReason, ...] = ()
        self._planner = planner
        self._memory = planner.initial_memory()
        self._guard = guard
        self._altitude_m = altitude_m

    def forget_setpoint(self) -> None:
        """The next setpoint starts where the vehicle is."""
        self.setpoint_enu_m = None

    def forget_plan(self) -> None:
        """The next plan starts from nothing."""
        self.waypoint = None
        self._memory = self._planner.initial_memory()

    def plan(
        self, estimate: TargetEstimate, vehicle_enu_m: PositionEnu, baseline_m: float
    ) -> Waypoint:
        """Ask the planner for the waypoint that follows from an estimate.

        Args:
            estimate: Where the target is believed to be.
            vehicle_enu_m: Where the vehicle is.
            baseline_m: See `PlanRequest`.
        """
        fence = self._guard.limits.fence
        request = PlanRequest(
            vehicle_enu_m=vehicle_enu_m[:2],
            estimate=estimate,
            baseline_m=baseline_m,
            fence_enu_m=None if fence is None else fence.polygon_enu_m,
            fence_margin_m=0.0 if fence is None else fence.margin_m,
        )
        plan = self._planner.plan(request, self._memory)
        self.waypoint, self._memory = plan.waypoint, plan.memory
        return plan.waypoint

    def is_beyond_fence(self, estimate: TargetEstimate) -> bool:
        """Whether the target seems to lie where the vehicle may not go."""
        fence = self._guard.limits.fence
        return fence is not None and not fence.allows(estimate.position_enu_m)

    def stay_with(self, vehicle_enu_m: PositionEnu, home_up_m: float) -> PositionSetpoint:
        """Hold at the vehicle's present place, following it while someone else flies it."""
        return self._sent(self._guard.here(vehicle_enu_m, home_up_m))

    def stay(self, vehicle_enu_m: PositionEnu, home_up_m: float, dt_s: float) -> PositionSetpoint:
        """Hold at the place where holding began."""
        if self.setpoint_enu_m is None:
            return self._sent(self._guard.here(vehicle_enu_m, home_up_m))
        at = self.setpoint_enu_m
        return self._sent(self._guard.towards(at, at, vehicle_enu_m, home_up_m, dt_s))

    def follow(self, vehicle_enu_m: PositionEnu, home_up_m: float, dt_s: float) -> PositionSetpoint:
        """One tick towards the waypoint at search altitude; without a waypoint, stay."""
        previous = self.setpoint_enu_m
        if previous is None or self.waypoint is None:
            return self.stay(vehicle_enu_m, home_up_m, dt_s)
        east, north = self.waypoint.position_enu_m
        floor_m = home_up_m + self._guard.limits.altitude_min_m
        if vehicle_enu_m[2] < floor_m - CLIMB_FIRST_M:
            east, north = previous[:2]
        goal = (east, north, home_up_m + self._altitude_m)
        return self._sent(self._guard.towards(goal, previous, vehicle_enu_m, home_up_m, dt_s))

    def _sent(self, guarded: Guarded) -> PositionSetpoint:
        self.setpoint_enu_m = guarded.position_enu_m
        self.reasons = guarded.reasons
        return PositionSetpoint(guarded.position_enu_m)
