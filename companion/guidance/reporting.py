"""How a mission ends: the target is reported, because it is found or because the battery is low."""

from __future__ import annotations

import math

from companion.domain import FlightMode, PositionEnu, TargetEstimate
from companion.guidance.battery import LEG_S, BatteryWatch
from companion.guidance.commands import Severity
from companion.guidance.params import FOLLOW_UP_MODE
from companion.guidance.records import result_of
from companion.guidance.situation import Situation
from companion.guidance.states import FLYING, IN_CONTROL, Trigger
from companion.guidance.stop_rule import StopRule

SAME_LEG_M = 1.0
"""A waypoint that moves by less is the same one, seen better."""
REACHED_M = 3.0


class Reporting:
    """Reports once, and asks for the mode that follows.

    Args:
        situation: Of the session.
        battery: Ends the mission early.
    """

    def __init__(self, situation: Situation, battery: BatteryWatch) -> None:
        self._situation = situation
        self._battery = battery
        self._stop_rule = StopRule(situation.params.stop_radius_m, situation.params.stop_confirm_s)
        self._leg: tuple[float, PositionEnu | None] | None = None
        """When the battery was found low, and the waypoint flown at then."""

    def tick(self, now_s: float) -> None:
        """Report if it is due."""
        situation = self._situation
        heard_s = situation.tracker.last_accepted_s
        is_fresh = heard_s is not None and now_s - heard_s <= situation.params.ranging_timeout_s
        flown = situation.estimate if situation.phase in FLYING and is_fresh else None
        if self._stop_rule.is_met(flown, now_s) and flown is not None:
            mode = FOLLOW_UP_MODE[situation.params.on_localised]
            self._finish(flown, "LOCALISED", mode, now_s)
        elif self._is_battery_end(now_s):
            self._battery.mission_ended()
            is_landing = situation.params.on_localised == "land"
            mode = FlightMode.LAND if is_landing else FlightMode.RETURN
            self._finish(situation.estimate, "SEARCH ENDED, battery low:", mode, now_s)

    def _is_battery_end(self, now_s: float) -> bool:
        """Whether the battery is low and the leg that was flown is finished."""
        situation = self._situation
        if situation.phase not in IN_CONTROL or not self._battery.ends_mission:
            self._leg = None
            return False
        waypoint, vehicle = situation.flight_plan.waypoint, situation.vehicle.position_enu_m
        goal = None if waypoint is None else (*waypoint.position_enu_m, 0.0)
        if self._leg is None:
            self._leg = (now_s, goal)
        began_s, begun = self._leg
        if situation.phase not in FLYING or goal is None or begun is None or vehicle is None:
            return True
        is_next = math.dist(goal, begun) > SAME_LEG_M
        is_there = math.dist(goal[:2], vehicle[:2]) <= REACHED_M
        return is_next or is_there or now_s - began_s > LEG_S

    def _finish(
        self, estimate: TargetEstimate | None, head: str, mode: FlightMode, now_s: float
    ) -> None:
        situation = self._situation
        if estimate is None:
            situation.announce(Severity.NOTICE, f"{head} nothing was found")
        else:
            height_m = situation.tracker.params.filter.target_height_m
            emitter_id, origin = situation.tracker.emitter_id, situation.vehicle.origin
            result, text = result_of(estimate, origin, height_m, emitter_id, head)
            situation.result = result
            situation.commands.append(result)
            situation.announce(Severity.NOTICE, text)
        situation.enter(Trigger.LOCALISED, now_s)
        situation.ask_mode(mode)
