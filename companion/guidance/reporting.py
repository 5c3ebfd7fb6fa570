"""How a mission ends: targets are reported, as they are found or because the battery is low."""

from __future__ import annotations

import math

from companion.domain import FlightMode, PositionEnu, TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.guidance.battery import LEG_S, BatteryWatch
from companion.guidance.commands import Severity
from companion.guidance.params import FOLLOW_UP_MODE
from companion.guidance.records import result_of
from companion.guidance.situation import Situation
from companion.guidance.states import FLYING, IN_CONTROL, Trigger
from companion.guidance.stop_rule import StopRule
from companion.guidance.turns import Turns

SAME_LEG_M = 1.0
"""A waypoint that moves by less is the same one, seen better."""
REACHED_M = 3.0
ENDED_EARLY = "SEARCH ENDED, battery low:"


class Reporting:
    """Reports each emitter once, and after the last one asks for the mode that follows.

    Args:
        situation: Of the session.
        battery: Ends the mission early.
        turns: Which emitter is looked for.
    """

    def __init__(self, situation: Situation, battery: BatteryWatch, turns: Turns) -> None:
        self._situation = situation
        self._battery = battery
        self._turns = turns
        self._stop_rule = StopRule()
        self._leg: tuple[float, PositionEnu | None] | None = None
        """When the battery was found low, and the waypoint flown at then."""

    def tick(self, now_s: float) -> None:
        """Report if it is due."""
        situation, params = self._situation, self._situation.params
        heard_s = situation.tracker.last_accepted_s
        is_fresh = heard_s is not None and now_s - heard_s <= params.ranging_timeout_s
        flown = situation.estimate if situation.phase in FLYING and is_fresh else None
        radius_m, confirm_s = params.stop_radius_m, params.stop_confirm_s
        is_met = self._stop_rule.is_met(flown, now_s, radius_m, confirm_s)
        if is_met and flown is not None:
            self._report(situation.tracker, flown, "LOCALISED")
            if situation.emitters.report_current():
                self._stop_rule.begin_anew()
                self._turns.follow(now_s)
            else:
                self._finish(FOLLOW_UP_MODE[params.on_localised], now_s)
        elif self._is_battery_end(now_s):
            self._battery.mission_ended()
            self._report_rest(now_s)
            is_landing = params.on_localised == "land"
            self._finish(FlightMode.LAND if is_landing else FlightMode.RETURN, now_s)

    def _is_battery_end(self, now_s: float) -> bool:
        """Whether the battery is low and the leg that was flown is finished."""
        situation = self._situation
        if situation.phase not in IN_CONTROL or not self._battery.ends_mission:
            self._leg = None
            return False
        if not situation.vehicle.mode_watch.may_be_asked(now_s):
            return False  # a pilot may have it, from whom the return would take it
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

    def _report_rest(self, now_s: float) -> None:
        """What is known of everybody who was not reported, the current emitter last."""
        emitters = self._situation.emitters
        waiting = [emitters.tracker_of(n) for n in reversed(emitters.waiting)]
        believed = [(each, each.estimate(now_s)) for each in (*waiting, emitters.current)]
        known = [(tracker, estimate) for tracker, estimate in believed if estimate is not None]
        for tracker, estimate in known:
            self._report(tracker, estimate, ENDED_EARLY)
        emitters.note_reported(t.emitter_id for t, _ in known if t.emitter_id is not None)
        if not known:
            self._situation.announce(Severity.NOTICE, f"{ENDED_EARLY} nothing was found")

    def _report(self, tracker: TargetTracker, estimate: TargetEstimate, head: str) -> None:
        situation = self._situation
        if not situation.emitters.is_single:
            head = f"{head} emitter {tracker.emitter_id}:"
        height_m, origin = tracker.params.filter.target_height_m, situation.vehicle.origin
        result, text = result_of(estimate, origin, height_m, tracker.emitter_id, head)
        situation.report(result)
        situation.announce(Severity.NOTICE, text)

    def _finish(self, mode: FlightMode, now_s: float) -> None:
        self._situation.enter(Trigger.LOCALISED, now_s)
        self._situation.ask_mode(mode)
