"""Navigation: from the planner's waypoint to the next guarded setpoint.

The flight plan keeps the planner's memory and waypoint, and announces their changes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from companion.domain import PositionEnu, PositionSetpoint, TargetEstimate, Waypoint
from companion.geometry.coordinates import bearing_enu_from_ned
from companion.geometry.polygons import Point, depth_m
from companion.guard.gate import Guard, Guarded, GuardReason, Motion
from companion.guard.limits import Fence
from companion.guidance.commands import Announce, Command, Severity, Topic
from companion.guidance.emitters import EmitterQueue
from companion.guidance.messages import waypoint_record
from companion.guidance.searching import Searching
from companion.guidance.vehicle import VehicleView
from companion.planning.planner import Planner, PlanRequest
from companion.planning.search import SearchMemory, SearchThenCrossMemory
from companion.search.outlook import Outlook

PLAN_PERIOD_S = 0.2
"""Longest age of a plan, with or without a measurement: the vehicle moves."""
REPEAT_AFTER_S = 20.0
"""Shortest time between two texts about a target outside the fence."""


class FlightPlan:
    """The planner with its memory, and its current waypoint."""

    def __init__(
        self,
        planner: Planner[Any],
        guard: Guard,
        emitters: EmitterQueue,
        searching: Searching,
        altitude_m: float,
    ) -> None:
        self._planner = planner
        self._guard = guard
        self._emitters = emitters
        self._searching = searching
        self._altitude_m = altitude_m
        self._announced_outside_s = -math.inf
        self.contact_s = -math.inf
        """Time of the latest usable measurement; a lone packet at the edge of reception is not."""
        self.forget()

    def forget(self) -> None:
        """Start the next plan without memory."""
        self._forbidden_text = ""
        """Text about a target at a position forbidden to the vehicle; empty if it is allowed."""
        self.waypoint: Waypoint | None = None
        self._planned_s: float | None = None
        self._is_searching: bool | None = None
        self._memory: Any = None

    def change_target(self) -> None:
        """Start the next plan for another target; the search resumes where it was left."""
        memory = self._memory
        self.forget()
        if isinstance(memory, SearchThenCrossMemory):
            self._memory = memory.without_target()
        elif isinstance(memory, SearchMemory):
            self._memory = memory

    def use(self, planner: Planner[Any], altitude_m: float) -> None:
        """Continue with another planner of the same kind and the memory of the one before."""
        self._planner = planner
        self._altitude_m = altitude_m

    def is_search_due(self, estimate: TargetEstimate | None, now_s: float) -> bool:
        """Return True if the planner searches now, and needs neither contact nor an estimate."""
        after_s = self._planner.search_after_s
        if after_s is None:
            return False
        return estimate is None or after_s == 0.0 or now_s - self.contact_s > after_s

    @property
    def sweeps(self) -> int:
        """Number of times the search pattern was completed."""
        search = getattr(self._memory, "search", self._memory)
        return search.sweep if isinstance(search, SearchMemory) else 0

    def is_due(self, now_s: float) -> bool:
        """Return True if the plan is too old."""
        return self._planned_s is None or now_s - self._planned_s >= PLAN_PERIOD_S

    def renew(
        self,
        now_s: float,
        vehicle: VehicleView,
        setpoint_enu_m: PositionEnu | None,
        estimate: TargetEstimate | None,
    ) -> list[Command]:
        """Ask the planner, and return texts and records about its answer.

        Without a position the plan stays as it is. The leg to the waypoint begins at the current
        setpoint, or at the vehicle itself.
        """
        vehicle_enu_m = vehicle.position_enu_m
        if vehicle_enu_m is None:
            return []
        previous, self._planned_s = self.waypoint, now_s
        request = self._request(now_s, vehicle, vehicle_enu_m, setpoint_enu_m, estimate)
        plan = self._planner.plan(request, self._memory)
        self.waypoint, self._memory = plan.waypoint, plan.memory
        commands = self._search_messages(now_s, estimate) + _descent_messages(
            0.0 if previous is None else previous.descent_m, plan.waypoint.descent_m
        )
        if previous is None or previous.detail != plan.waypoint.detail:
            commands.append(waypoint_record(plan.waypoint))
        return commands + self._target_messages(now_s, estimate)

    def _range_left_m(self, vehicle: VehicleView) -> float:
        """Return the distance that the charge lasts, without the reserve; infinite if unknown."""
        reserve = self._guard.limits.reserve
        if reserve is None or vehicle.battery_pct is None:
            return math.inf
        return reserve.reach_m(vehicle.battery_pct)

    def _outlook(
        self, now_s: float, vehicle: VehicleView, estimate: TargetEstimate | None
    ) -> Outlook | None:
        if not self.is_search_due(estimate, now_s):
            return None
        return self._searching.outlook(vehicle)

    def _request(
        self,
        now_s: float,
        vehicle: VehicleView,
        vehicle_enu_m: PositionEnu,
        setpoint_enu_m: PositionEnu | None,
        estimate: TargetEstimate | None,
    ) -> PlanRequest:
        fence, tracker = self._guard.limits.fence, self._emitters.current
        home, yaw = vehicle.home_enu_m, vehicle.track.latest_yaw
        target_up_m = tracker.target_height_m if estimate is None else estimate.height_m
        return PlanRequest(
            vehicle_enu_m=vehicle_enu_m[:2],
            estimate=estimate,
            fence_enu_m=None if fence is None else fence.polygon_enu_m,
            fence_margin_m=0.0 if fence is None else fence.margin_m,
            baseline_m=tracker.baseline_m(vehicle_enu_m[2]),
            keep_out_enu_m=() if fence is None else fence.keep_out_enu_m,
            also_inside_enu_m=() if fence is None else fence.also_inside_enu_m,
            time_s=now_s,
            contact_s=self.contact_s,
            height_m=vehicle_enu_m[2] - target_up_m,
            yaw_enu_rad=None if yaw is None else bearing_enu_from_ned(yaw[1]),
            leg_from_enu_m=None if setpoint_enu_m is None else setpoint_enu_m[:2],
            altitude_offset_m=None
            if home is None
            else vehicle_enu_m[2] - home[2] - self._altitude_m,
            home_enu_m=None if home is None else home[:2],
            range_left_m=self._range_left_m(vehicle),
            outlook=self._outlook(now_s, vehicle, estimate),
            sigmas=tracker.latest_sigmas,
            joint_covariance=tracker.joint_covariance(vehicle_enu_m),
        )

    def _search_messages(self, now_s: float, estimate: TargetEstimate | None) -> list[Command]:
        """Yield a text when a search begins, ends or resumes."""
        after_s = self._planner.search_after_s
        if after_s is None or after_s == 0.0:
            return []
        was_searching = self._is_searching
        self._is_searching = self.is_search_due(estimate, now_s)
        if self._is_searching is was_searching:
            return []
        if not self._is_searching:
            return [Announce(Severity.INFO, "contact: flying to the target", Topic.CONTACT)]
        if self.contact_s == -math.inf:
            return [
                Announce(Severity.INFO, "no contact yet: flying the search pattern", Topic.CONTACT)
            ]
        text = f"no contact for {after_s:g} s: back to the search pattern"
        return [Announce(Severity.WARNING, text, Topic.CONTACT)]

    def _target_messages(self, now_s: float, estimate: TargetEstimate | None) -> list[Command]:
        """Return a text when the estimate enters a forbidden area, not repeated too soon."""
        fence = self._guard.limits.fence
        if estimate is None or fence is None:
            return []
        where = _forbidden_by(fence, estimate.position_enu_m)
        is_new, self._forbidden_text = where != self._forbidden_text, where
        if not (where and is_new) or now_s - self._announced_outside_s < REPEAT_AFTER_S:
            return []
        self._announced_outside_s = now_s
        return [Announce(Severity.WARNING, where)]


def _descent_messages(before_m: float, descent_m: float) -> list[Command]:
    """Return a text when crossings begin below the search altitude, and when they end there."""
    if descent_m > 0.0 and before_m == 0.0:
        text = f"lower pass: {descent_m:.0f} m below the search altitude"
        return [Announce(Severity.INFO, text)]
    if before_m > 0.0 and descent_m == 0.0:
        return [Announce(Severity.INFO, "lower pass done: back to the search altitude")]
    return []


def _forbidden_by(fence: Fence, position_enu_m: Point) -> str:
    """Return the reason why the vehicle may not be at an estimated position; empty if it may."""
    if fence.allows(position_enu_m):
        return ""
    borders = (fence.polygon_enu_m, *fence.also_inside_enu_m)
    if any(depth_m(border, position_enu_m) < fence.margin_m for border in borders):
        return "estimate outside the fence: observing from inside"
    return "estimate in a keep-out: observing from outside"


CLIMB_FIRST_M = 1.0
"""Distance below the altitude band beyond which the vehicle climbs before it moves horizontally."""


class Steering:
    """Moves the setpoint towards waypoints, always through the guard."""

    def __init__(self, guard: Guard, altitude_m: float) -> None:
        self._guard = guard
        self.altitude_m = altitude_m
        self._last: Guarded | None = None

    @property
    def setpoint_enu_m(self) -> PositionEnu | None:
        """The setpoint sent last, from which the next one continues; None: none since a reset."""
        return None if self._last is None else self._last.position_enu_m

    @property
    def reasons(self) -> tuple[GuardReason, ...]:
        """Reasons for which the guard changed the setpoint."""
        return () if self._last is None else self._last.reasons

    def shift(self, shift_enu_m: PositionEnu) -> None:
        """Shift the setpoint into a local frame that moved; it stays at the same point."""
        if self._last is not None:
            e, n, u = self._last.position_enu_m
            shifted_enu_m = (e + shift_enu_m[0], n + shift_enu_m[1], u + shift_enu_m[2])
            self._last = replace(self._last, position_enu_m=shifted_enu_m)

    def forget_setpoint(self) -> None:
        """Start the next setpoint at the vehicle's position."""
        self._last = None

    def hold_at_vehicle(self, motion: Motion) -> PositionSetpoint:
        """Hold at the vehicle's current position, following it while the pilot flies."""
        return self._keep(self._guard.here(motion))

    def freeze(self, motion: Motion) -> PositionSetpoint:
        """Keep the setpoint still, even outside the fence: the vehicle position may be wrong."""
        last = self._last
        position_enu_m = motion.position_enu_m if last is None else last.position_enu_m
        return self._keep(self._guard.freeze(position_enu_m))

    def hold(self, motion: Motion, dt_s: float) -> PositionSetpoint:
        """Hold at the position where holding began."""
        if self._last is None:
            return self.hold_at_vehicle(motion)
        return self._keep(self._guard.hold(self._last, motion, dt_s))

    def follow(
        self,
        waypoint: Waypoint | None,
        motion: Motion,
        dt_s: float,
        speed_cap_mps: float = math.inf,
    ) -> PositionSetpoint:
        """Move one tick towards the waypoint at its altitude; without a waypoint, hold."""
        last = self._last
        if last is None or waypoint is None:
            return self.hold(motion, dt_s)
        east, north = waypoint.position_enu_m
        home_up_m = motion.home_enu_m[2]
        floor_m = home_up_m + self._guard.limits.envelope.altitude_min_m
        if motion.position_enu_m[2] < floor_m - CLIMB_FIRST_M:
            east, north = last.position_enu_m[:2]
        goal = (east, north, home_up_m + self.altitude_m + waypoint.altitude_offset_m)
        return self._keep(self._guard.towards(goal, last, motion, dt_s, speed_cap_mps))

    def _keep(self, guarded: Guarded) -> PositionSetpoint:
        self._last = guarded
        return PositionSetpoint(guarded.position_enu_m)
