"""End of the mission: reports of emitters, the end of a search, and the mode that follows.

A target counts as found once the stop rule is met. Targets are reported as they are found, or
because the battery is low or the search over.

Theory of operation of the stop rules. Random errors fall with the number of measurements; errors
that are constant over a position or a flight do not: ground height, GNSS, reflections from walls.
So R95 settles at a radius that depends on the radio, the antenna and the site, and cannot be
predicted. If that is above the radius to stop at, further crossings bring no information.
"""

from __future__ import annotations

import math
from dataclasses import replace

from companion.domain import BatteryLevel, EstimateState, FlightMode, PositionEnu, TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.guidance.commands import Severity
from companion.guidance.context import SessionContext
from companion.guidance.health.autopilot_health import LEG_S, BatteryWatch
from companion.guidance.measurements import EmitterScheduler
from companion.guidance.messages import radius_texts, result_of
from companion.guidance.phases import FLYING, IN_CONTROL, Phase, Trigger


class StopRule:
    """Met once the estimate has one position within a radius for long enough without a break."""

    def __init__(self) -> None:
        self._since_s: float | None = None

    def reset(self) -> None:
        """Restart the confirmation time."""
        self._since_s = None

    def is_met(
        self, estimate: TargetEstimate | None, now_s: float, radius_m: float, confirm_s: float
    ) -> bool:
        """Return True if the target is found; a missing estimate restarts the confirmation time."""
        is_one_position = estimate is not None and estimate.state is EstimateState.LOCALISED
        if estimate is None or not is_one_position or estimate.settled_r95_m > radius_m:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s >= confirm_s


IMPROVED_SHARE = 0.92
"""Share of the mark below which R95 has improved."""
WORSE_RATIO = 1.5
"""Growth of R95 that sets a new mark, because measurements contradicted the old one."""
MAX_SETTLED_M = 100.0
"""R95 above which no position is reported, unless `localised_r95_m` is larger."""
ONE_POSITION = (EstimateState.LOCALISED, EstimateState.SEARCHING)


class SettledRule:
    """Met once R95 of one position no longer improves although measurements arrive.

    Only time between measurements that were accepted in flight counts: while the vehicle holds, or
    its radio or its clock fails, there is no information, and a constant R95 is not evidence.
    """

    def __init__(self) -> None:
        self._measuring_s = 0.0
        """Time between accepted measurements."""
        self._heard_s: float | None = None
        """Time of the last accepted measurement; None since a hold, or a long pause."""
        self._mark: tuple[float, float] | None = None
        """Measuring time and R95 at the latest improvement of R95."""

    def reset(self) -> None:
        """Drop the latest improvement."""
        self._mark = None

    def is_met(
        self, estimate: TargetEstimate | None, heard_s: float | None, settle_s: float
    ) -> bool:
        """Return True if R95 has not improved for `settle_s` of time with measurements.

        `estimate` is None while the plan is not followed, or no measurements arrive: time then
        stops.
        """
        if estimate is None or heard_s is None:
            self._heard_s = None
            return False
        if self._heard_s is not None:
            self._measuring_s += max(0.0, heard_s - self._heard_s)
        self._heard_s = heard_s
        r95_m = estimate.r95_m
        is_localised = estimate.state is EstimateState.LOCALISED
        if estimate.state not in ONE_POSITION or (r95_m > MAX_SETTLED_M and not is_localised):
            self._mark = None
            return False
        if self._mark is None or not (
            IMPROVED_SHARE * self._mark[1] <= r95_m <= WORSE_RATIO * self._mark[1]
        ):
            self._mark = (self._measuring_s, r95_m)
        return self._measuring_s - self._mark[0] >= settle_s


SAME_LEG_M = 1.0
"""Longest move of a waypoint that is only a refinement of it."""
REACHED_M = 3.0
FINAL_AGAIN_S = 5.0
"""Period of the requests, longer than one takes with all its repetitions."""
ENDED_EARLY = "SEARCH ENDED, battery low:"
SEARCH_OVER = "SEARCH OVER:"
LOCALISED, SETTLED = "LOCALISED", "SETTLED"


class Reporting:
    """Reports each emitter once, and requests the following mode after the last one."""

    def __init__(
        self, context: SessionContext, battery: BatteryWatch, scheduler: EmitterScheduler
    ) -> None:
        self._context = context
        self._battery = battery
        self._scheduler = scheduler
        self._stop_rule = StopRule()
        self._settled_rule = SettledRule()
        self._leg: tuple[float, PositionEnu | None] | None = None
        """Time at which the battery was found low, and the waypoint of that leg."""
        self._final: tuple[FlightMode, float] | None = None
        """Mode after the last report, and time of its request; None if no request is pending."""
        self.has_finished = False
        """True once the mode after the last report, or the end of the search, was requested."""
        self.is_search_over = False
        """True if the search ended before all emitters were heard."""

    def tick(self, now_s: float) -> None:
        """Report an emitter if a report is due."""
        if self._final is not None:
            self._ask_again(*self._final, now_s)
        context, params = self._context, self._context.params
        heard_s = context.emitters.current.last_accepted_s
        is_fresh = heard_s is not None and now_s - heard_s <= params.ranging_timeout_s
        is_reportable = is_fresh and context.emitters.current.params.is_range_calibrated
        if self._battery.level < BatteryLevel.LOW:
            self._leg = None
        flown = context.estimate if context.authority.phase in FLYING and is_reportable else None
        head = self._head(flown, heard_s, now_s)
        if head is not None and flown is not None:
            if head is SETTLED:
                text = f"stop radius out of reach: relative R95 settled at {flown.r95_m:.2g} m"
                context.announce(Severity.NOTICE, text)
            self._report(context.emitters.current, flown, head, now_s)
            if context.emitters.report_current():
                self._stop_rule.reset()
                self._settled_rule.reset()
                self._scheduler.follow(now_s)
            else:
                self._finish(FlightMode(params.on_localised), now_s)
        elif self._battery.level >= BatteryLevel.LOW and self._is_battery_end(now_s):
            self._battery.note_mission_end()
            self._end_early(now_s)
            self._finish(self._low_battery_mode, now_s)
        elif context.authority.phase in FLYING and self._is_searching(now_s, is_fresh=is_fresh):
            self._end_search(now_s)
        if not context.emitters.is_single:
            self._scheduler.announce()

    @property
    def _low_battery_mode(self) -> FlightMode:
        is_landing = self._context.params.on_localised == "land"
        return FlightMode.LAND if is_landing else FlightMode.RETURN

    def _is_searching(self, now_s: float, *, is_fresh: bool) -> bool:
        """Return True while a search for emitters that were not heard is flown."""
        context, searching = self._context, self._context.searching
        if searching.contact_s is None or not searching.is_counting:
            return searching.is_counting
        return not is_fresh and context.flight_plan.is_search_due(context.estimate, now_s)

    def _end_search(self, now_s: float) -> None:
        """End a search that is complete, or has no charge left to continue."""
        context, searching = self._context, self._context.searching
        if not context.vehicle.mode_watch.may_request_mode(now_s):
            return
        mode = FlightMode(context.params.on_localised)
        why = searching.end(context.flight_plan.sweeps)
        if why is None and self._is_charge_spent():
            why, mode = "remaining charge is for the way home", self._low_battery_mode
        if why is None:
            return
        self.is_search_over = True
        found = "no further emitter heard" if searching.contact_s is not None else "nothing heard"
        context.announce(Severity.NOTICE, f"SEARCH OVER, {found}: {why}")
        self._report_known(SEARCH_OVER, now_s)
        self._announce_searched()
        self._finish(mode, now_s)

    def _is_charge_spent(self) -> bool:
        """Return True if the vehicle is as far from home as the charge above the reserve lasts."""
        reserve, motion = self._context.guard.limits.reserve, self._context.vehicle.motion
        if reserve is None or motion is None or motion.battery_pct is None:
            return False
        if not self._context.searching.is_worth_reporting:
            return False
        away_m = math.dist(motion.position_enu_m[:2], motion.home_enu_m[:2])
        return away_m >= reserve.reach_m(motion.battery_pct)

    def _announce_searched(self) -> None:
        """Announce the searched area in the sentence for the radio."""
        self._context.searching.progress = self._context.emitters.progress
        text = self._context.searching.statement()
        if text is not None:
            self._context.announce(Severity.NOTICE, text)

    def _head(
        self, flown: TargetEstimate | None, heard_s: float | None, now_s: float
    ) -> str | None:
        """Return the head of the report that is due now, or None."""
        params = self._context.params
        confirm_s, settle_s = params.stop_confirm_s, params.settle_s
        is_reached = self._stop_rule.is_met(flown, now_s, params.stop_radius_m, confirm_s)
        if settle_s is None:
            return LOCALISED if is_reached else None
        is_settled = self._settled_rule.is_met(flown, heard_s, max(settle_s, confirm_s))
        return LOCALISED if is_reached else SETTLED if is_settled else None

    def _is_battery_end(self, now_s: float) -> bool:
        """Return True if the battery is low and the current leg is finished."""
        context = self._context
        if context.authority.phase not in IN_CONTROL or not self._battery.ends_mission:
            self._leg = None
            return False
        if not context.vehicle.mode_watch.may_request_mode(now_s):
            return False  # a pilot may have control, and the return mode would take it
        waypoint, vehicle = context.flight_plan.waypoint, context.vehicle.position_enu_m
        goal = None if waypoint is None else (*waypoint.position_enu_m, 0.0)
        if self._leg is None:
            self._leg = (now_s, goal)
        began_s, begun = self._leg
        if (
            context.authority.phase not in FLYING
            or goal is None
            or begun is None
            or vehicle is None
        ):
            return True
        is_next = math.dist(goal, begun) > SAME_LEG_M
        is_there = math.dist(goal[:2], vehicle[:2]) <= REACHED_M
        return is_next or is_there or now_s - began_s > LEG_S

    def _end_early(self, now_s: float) -> None:
        """End the search at low battery, and report the emitters known so far."""
        context = self._context
        is_any_known = self._report_known(ENDED_EARLY, now_s)
        if not is_any_known:
            found = "no further emitter found" if context.reports else "no emitter found"
            context.announce(Severity.NOTICE, f"{ENDED_EARLY} {found}")
        self.is_search_over = context.searching.is_counting
        if self.is_search_over or not is_any_known:
            self._announce_searched()

    def _report_known(self, head: str, now_s: float) -> bool:
        """Report all emitters not reported yet, the current one last; return False if none is."""
        emitters = self._context.emitters
        waiting = [emitters.tracker_of(n) for n in reversed(emitters.waiting)]
        estimates = [(each, each.estimate(now_s)) for each in (*waiting, emitters.current)]
        known = [(tracker, estimate) for tracker, estimate in estimates if estimate is not None]
        for tracker, estimate in known:
            self._report(tracker, estimate, head, now_s)
        emitters.reported.update(t.emitter_id for t, _ in known if t.emitter_id is not None)
        return bool(known)

    def _report(
        self, tracker: TargetTracker, estimate: TargetEstimate, head: str, now_s: float
    ) -> None:
        context = self._context
        # those of many emitters at once, at an early end, would delay a setpoint
        budget_m = {} if head in (ENDED_EARLY, SEARCH_OVER) else tracker.budget(now_s)
        if not context.emitters.is_single:
            head = f"{head} emitter {tracker.emitter_id}:"
        height_m, origin = tracker.target_height_m, context.vehicle.origin
        result, text = result_of(estimate, origin, height_m, tracker.emitter_id, head)
        context.report(replace(result, budget_m=budget_m))
        context.searching.learn(tracker.emitter_id, estimate.position_enu_m, context.vehicle)
        for each in (text, *radius_texts(estimate)):
            context.announce(Severity.NOTICE, each)

    def _finish(self, mode: FlightMode, now_s: float) -> None:
        self._context.enter(Trigger.LOCALISED, now_s)
        self.has_finished, self._final = True, (mode, now_s)
        self._context.ask_mode(mode)

    def _ask_again(self, mode: FlightMode, asked_s: float, now_s: float) -> None:
        """Request the mode after the report until it, or another mode, is shown.

        An answer may be lost, and a stall of the computer withdraws earlier requests.
        """
        context, vehicle = self._context, self._context.vehicle
        is_left = vehicle.mode_watch.is_known(now_s) and not vehicle.is_ours
        if context.authority.phase is not Phase.FINISHED or is_left:
            self._final = None
        elif now_s - asked_s >= FINAL_AGAIN_S and vehicle.mode_watch.may_request_mode(now_s):
            self._final = (mode, now_s)
            context.ask_mode(mode)
