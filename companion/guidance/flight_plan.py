"""What the planner was asked, what it answered, and what the operator is told of it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from companion.domain import Point, PositionEnu, TargetEstimate, Waypoint
from companion.geometry.arrays import Matrix
from companion.geometry.polygons import depth_m
from companion.guard.fence import Fence
from companion.guard.gate import Guard
from companion.guidance.commands import Announce, Command, Severity
from companion.guidance.conditions import is_search_due
from companion.guidance.emitters import EmitterQueue
from companion.guidance.records import waypoint_record
from companion.guidance.vehicle import VehicleView
from companion.planning.base import Planner, PlanRequest

PLAN_PERIOD_S = 0.2
"""A plan is renewed at least this often, with or without a measurement: the vehicle moves."""


TOLD_AGAIN_S = 20.0
"""How long after a text about the target's place there is no other one."""


class FlightPlan:
    """The planner with its memory, and the waypoint that it wants now.

    Args:
        planner: Where to fly.
        guard: Knows the fence with its keep-outs.
        emitters: The current one's estimate is planned on.
        altitude_m: Search altitude above home.
    """

    def __init__(
        self,
        planner: Planner[Any],
        guard: Guard,
        emitters: EmitterQueue,
        altitude_m: float,
    ) -> None:
        self.waypoint: Waypoint | None = None
        self._planner = planner
        self._memory = planner.initial_memory()
        self._guard = guard
        self._emitters = emitters
        self._altitude_m = altitude_m
        self._planned_s: float | None = None
        self._is_searching: bool | None = None
        self.is_target_outside = False
        """Whether the target is believed to be where the vehicle may not go."""
        self._where_target_is = ""
        self._told_outside_s = -math.inf

    @property
    def search_after_s(self) -> float | None:
        """See `Planner`."""
        return self._planner.search_after_s

    def forget(self) -> None:
        """The next plan starts from nothing."""
        self.is_target_outside = False
        self._where_target_is = ""
        self.waypoint = None
        self._planned_s = None
        self._is_searching = None
        self._memory = self._planner.initial_memory()

    def use(self, planner: Planner[Any], altitude_m: float) -> None:
        """Go on with another planner of the same kind, from what the one before remembered."""
        self._planner = planner
        self._altitude_m = altitude_m

    def is_due(self, now_s: float) -> bool:
        """Whether the plan is too old."""
        return self._planned_s is None or now_s - self._planned_s >= PLAN_PERIOD_S

    def renew(
        self,
        now_s: float,
        vehicle: VehicleView,
        setpoint_enu_m: PositionEnu | None,
        estimate: TargetEstimate | None,
    ) -> list[Command]:
        """Ask the planner; what is to be told of its answer.

        Args:
            now_s: The present.
            vehicle: Without a position nothing is planned.
            setpoint_enu_m: What it follows, where the leg to the waypoint begins; None: itself.
            estimate: Where the target is believed to be.
        """
        place_enu_m, height_m = vehicle.position_enu_m, vehicle.height_m
        if place_enu_m is None:
            return []
        previous, self._planned_s = self.waypoint, now_s
        request = replace(
            self._request(now_s, place_enu_m, estimate),
            leg_from_enu_m=None if setpoint_enu_m is None else setpoint_enu_m[:2],
            altitude_offset_m=None if height_m is None else height_m - self._altitude_m,
        )
        plan = self._planner.plan(request, self._memory)
        self.waypoint, self._memory = plan.waypoint, plan.memory
        commands = self._search_news(now_s, estimate)
        if previous is None or previous.detail != plan.waypoint.detail:
            commands.append(waypoint_record(plan.waypoint))
        return commands + self._target_news(now_s, estimate)

    def _request(
        self, now_s: float, place_enu_m: PositionEnu, estimate: TargetEstimate | None
    ) -> PlanRequest:
        fence, tracker = self._guard.limits.fence, self._emitters.current
        return PlanRequest(
            vehicle_enu_m=place_enu_m[:2],
            estimate=estimate,
            fence_enu_m=None if fence is None else fence.polygon_enu_m,
            fence_margin_m=0.0 if fence is None else fence.margin_m,
            baseline_m=tracker.baseline_m(place_enu_m[2]),
            keep_out_enu_m=() if fence is None else fence.keep_out_enu_m,
            time_s=now_s,
            contact_s=tracker.last_accepted_s,
            height_m=place_enu_m[2] - tracker.params.filter.target_height_m,
            joint_covariance=self._joint_covariance(),
        )

    def _joint_covariance(self) -> Matrix | None:
        """Of east, north and both offsets in the best hypothesis."""
        hypotheses = self._emitters.current.hypotheses
        return hypotheses[0].state.covariance[:4, :4] if hypotheses else None

    def _search_news(self, now_s: float, estimate: TargetEstimate | None) -> list[Command]:
        """A text when a search begins, ends, or begins again."""
        after_s, heard_s = self.search_after_s, self._emitters.current.last_accepted_s
        if after_s is None or after_s == 0.0:
            return []
        was_searching = self._is_searching
        self._is_searching = is_search_due(estimate, heard_s, after_s, now_s)
        if self._is_searching is was_searching:
            return []
        if not self._is_searching:
            return [Announce(Severity.INFO, "contact: flying at the target")]
        if heard_s is None:
            return [Announce(Severity.INFO, "no contact yet: flying the search pattern")]
        text = f"no contact for {after_s:g} s: back to the search pattern"
        return [Announce(Severity.WARNING, text)]

    def _target_news(self, now_s: float, estimate: TargetEstimate | None) -> list[Command]:
        """A text when the target turns out to be where the vehicle may not go.

        A target that goes to and fro across the fence is told of now and then only.
        """
        fence = self._guard.limits.fence
        if estimate is None or fence is None:
            return []
        where = _forbidden_place(fence, estimate.position_enu_m)
        is_news, self._where_target_is = where != self._where_target_is, where
        self.is_target_outside = bool(where)
        if not (where and is_news) or now_s - self._told_outside_s < TOLD_AGAIN_S:
            return []
        self._told_outside_s = now_s
        return [Announce(Severity.WARNING, where)]


def _forbidden_place(fence: Fence, place: Point) -> str:
    """Why the vehicle may not be at an estimated place, or nothing."""
    if fence.allows(place):
        return ""
    if depth_m(fence.polygon_enu_m, place) < fence.margin_m:
        return "the estimate is outside the fence: it can only be looked at from inside"
    return "the estimate is in a keep-out: it can only be looked at from around it"
