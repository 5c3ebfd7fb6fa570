"""All watches of a session; here those of its inputs, of the operator and of the fence.

Theory of operation of the inputs: link, mode, vehicle position, ranging, a usable estimate. While
ranging ages, the estimate is extrapolated: the target is where it was, less certain by the second,
and the vehicle slows down accordingly. When ranging is too old, or the estimate too uncertain, the
vehicle holds, and a single measurement does not end that: some must agree first. A link or a
vehicle position that was lost must be back for a while, with the mode reported again, before
control continues: an input that has just returned is often lost again.

HOLD, RESUME, RETURN and GRANT of the operator, besides the mode switch, are answered with a text:
accepted, or refused with the reason. Views ask for the objection beforehand, so that a button
without effect is grey and shows the reason.
"""

from __future__ import annotations

import math

from companion.domain import R95_OF_SIGMA, BatteryLevel, FlightMode, TargetEstimate
from companion.estimation.screen import Objection
from companion.guidance import events
from companion.guidance.commands import Announce, Severity
from companion.guidance.context import SessionContext
from companion.guidance.control_authority import Finding, Reason, Verdict, Watch
from companion.guidance.events import OperatorCommand
from companion.guidance.health.autopilot_health import BatteryWatch, HealthWatch, LandingWatch
from companion.guidance.health.contention import EchoWatch, StickWatch
from companion.guidance.health.position_jumps import JumpWatch
from companion.guidance.messages import RateLimited
from companion.guidance.phases import IN_CONTROL, Phase, Trigger

REGAIN_S = 1.0
"""Time for which link and position must be back."""
LINK_LOSS_REASONS = (Reason.NO_LINK, Reason.MODE_UNKNOWN)
AGREEING = 5
"""Accepted measurements after which a dropout of the ranging is over."""
COAST_SHARE = 0.5
"""Largest share of the speed limit while ranging ages."""
OTHER_TARGET_EVERY_S = 10.0


class InputWatch(Watch):
    """Watches the inputs at every tick, in control or not."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._lost: Finding | None = None
        """Finding for a missing link, mode, position or home, also of the last second."""
        self._lost_s = 0.0
        self._back_s: float | None = None
        self._agreed = 0
        self._is_dropout = True
        """True if ranging is missing, or too few measurements were accepted since it returned."""

    def note_accepted(self) -> None:
        """Note a measurement that the filter accepted without restarting."""
        self._agreed += 1

    def note_rejected(self) -> None:
        """Note a restart or failure of the filter: measurements before it no longer count."""
        self._agreed = 0
        self._is_dropout = True

    def note_switch(self, agreeing: int) -> None:
        """Note that another emitter is searched for, with its number of agreeing measurements."""
        self._agreed = agreeing
        self._is_dropout = agreeing < AGREEING
        self._context.flight_plan.contact_s = -math.inf

    def step(self, now_s: float) -> Finding | None:
        """Update the state of the inputs; return the worst finding about them, or None."""
        lost = self.missing(now_s)
        if lost is not None:
            self._lost, self._lost_s, self._back_s = lost, now_s, None
        elif self._lost is not None:
            self._watch_return(now_s)
        context = self._context
        estimate, heard_s = context.estimate, context.emitters.current.last_accepted_s
        if heard_s is None or now_s - heard_s > context.params.ranging_timeout_s:
            self._is_dropout, self._agreed = True, 0
        elif self._agreed >= AGREEING:
            self._is_dropout = False
        if heard_s is not None and not self._is_dropout:
            context.flight_plan.contact_s = heard_s
        if self._lost is not None:
            return self._lost
        if context.flight_plan.is_search_due(estimate, now_s):
            return None
        if estimate is None or heard_s is None:
            return Finding(Verdict.HOLD, Reason.NO_RANGING_YET, "waiting for ranging")
        return self._ranging_finding(estimate, heard_s, now_s)

    def coasting_sigma_m(self, estimate: TargetEstimate, age_s: float) -> float:
        """Return the position error of the estimate after a time without ranging, one sigma."""
        drift_m = self._context.params.coast_drift_mps * age_s
        return math.hypot(estimate.r95_m / R95_OF_SIGMA, drift_m)

    def speed_share(self, now_s: float) -> float:
        """Return the speed share for the age of the ranging, less as sigma grows; 1 in a search."""
        context = self._context
        estimate, heard_s = context.estimate, context.emitters.current.last_accepted_s
        if estimate is None or heard_s is None:
            return 1.0
        if context.flight_plan.is_search_due(estimate, now_s):
            return 1.0
        age_s = now_s - heard_s
        if age_s <= context.params.degraded_after_s:
            return 1.0
        limit_m = context.params.coast_sigma_max_m
        return COAST_SHARE * max(0.0, 1.0 - self.coasting_sigma_m(estimate, age_s) / limit_m)

    def missing(self, now_s: float) -> Finding | None:
        """Return a finding for link, mode, position or home if one is missing now."""
        vehicle = self._context.vehicle
        if vehicle.is_link_lost(now_s):
            reason = Reason.NO_LINK
        elif not vehicle.mode_watch.is_known(now_s):
            reason = Reason.MODE_UNKNOWN
        elif not vehicle.is_position_fresh(now_s):
            reason = Reason.POSITION_STALE
        elif vehicle.home_enu_m is None:
            reason = Reason.NO_HOME
        elif not vehicle.has_origin:
            reason = Reason.NO_ORIGIN
        else:
            return None
        return Finding(Verdict.HOLD, reason, reason.value)

    def _watch_return(self, now_s: float) -> None:
        """End the loss once link and position are back; a lost link must report a mode, too."""
        if self._back_s is None:
            self._back_s = now_s
        heartbeat = self._context.vehicle.heartbeat
        was_link_lost = self._lost is not None and self._lost.reason in LINK_LOSS_REASONS
        is_mode_seen = heartbeat is not None and heartbeat.time_s > self._lost_s
        if now_s - self._back_s >= REGAIN_S and (is_mode_seen or not was_link_lost):
            self._lost = self._back_s = None

    def _ranging_finding(
        self, estimate: TargetEstimate, heard_s: float, now_s: float
    ) -> Finding | None:
        params, age_s = self._context.params, now_s - heard_s
        if age_s > params.ranging_timeout_s:
            text = f"no ranging for {params.ranging_timeout_s:g} s"
            return Finding(Verdict.HOLD, Reason.NO_RANGING, text)
        objection = self._context.emitters.current.objection(now_s)
        if objection is not None:
            is_unit = objection in (Objection.RANGE_UNIT, Objection.BEARING_UNIT)
            reason = Reason.WRONG_UNIT if is_unit else Reason.FILTER_DIVERGED
            return Finding(Verdict.HOLD, reason, objection.value)
        if self._is_dropout and self._agreed < AGREEING:
            text = f"waiting for {AGREEING} consistent measurements"
            return Finding(Verdict.HOLD, Reason.RANGING_IS_BACK, text)
        if age_s <= params.degraded_after_s:
            return None
        if self.coasting_sigma_m(estimate, age_s) > params.coast_sigma_max_m:
            text = f"estimate too uncertain to coast: relative R95 {estimate.r95_m:.0f} m"
            return Finding(Verdict.HOLD, Reason.ESTIMATE_VAGUE, text)
        text = f"no ranging for {params.degraded_after_s:g} s: coasting, slower"
        return Finding(Verdict.SLOW, Reason.RANGING_AGES, text)


HELD = Finding(Verdict.HOLD, Reason.OPERATOR_HOLDS, "operator requested hold")
RETURNS = Finding(
    Verdict.HAND_BACK, Reason.OPERATOR_RETURNS, "operator requested return", FlightMode.RETURN
)
NOT_IN_CONTROL = {
    Phase.WAITING: "not ready yet",
    Phase.STANDBY: "not in control yet",
    Phase.LAUNCHING: "taking off",
    Phase.FINISHED: "the search is over",
    Phase.YIELD: "you have control",
    Phase.HANDBACK: "handing back",
    Phase.STOPPED: "ended",
}


class OperatorCommandWatch(Watch):
    """Executes the operator's commands; a hold ends with the control it was requested in."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._finding: Finding | None = None
        self.is_idle = True

    def objection(self, command: OperatorCommand) -> str | None:
        """Return the reason why a command would have no effect now; None if it has one."""
        if command is OperatorCommand.GRANT:
            return self._objection_to_grant()
        if self._context.authority.phase not in IN_CONTROL:
            return NOT_IN_CONTROL[self._context.authority.phase]
        if command is OperatorCommand.RESUME:
            return None if self._finding is HELD else "no HOLD is active"
        is_asked = self._finding is (HELD if command is OperatorCommand.HOLD else RETURNS)
        return "already done" if is_asked else None

    def _objection_to_grant(self) -> str | None:
        context, phase = self._context, self._context.authority.phase
        if context.fencing.refusal is not None:
            return "no control without a fence"
        if context.vehicle.objection is not None:
            return context.vehicle.objection
        if phase in IN_CONTROL:
            return "already in control"
        if phase is Phase.STANDBY:
            return f"not needed: switch to {context.vehicle.guided_name}"
        if phase is Phase.WAITING and context.authority.may_begin:
            return "not needed: not ready yet"
        is_obeyed = phase in (Phase.WAITING, Phase.YIELD, Phase.FINISHED)
        return None if is_obeyed else NOT_IN_CONTROL[phase]

    def handle(self, event: events.Event) -> None:
        """Execute or refuse a command, and answer it."""
        if not isinstance(event, events.OperatorCommandReceived):
            return
        context, name = self._context, event.command.name
        objection = self.objection(event.command)
        if objection is not None:
            text = f"{name} refused: {objection}"
            context.send(Announce(Severity.WARNING, text, must_pass=True))
            return
        text = f"{name} accepted"
        match event.command:
            case OperatorCommand.HOLD:
                self._finding = HELD
            case OperatorCommand.RESUME:
                self._finding = None
            case OperatorCommand.RETURN:
                self._finding = RETURNS
            case OperatorCommand.GRANT:
                context.enter(Trigger.GRANTED, event.time_s)
                switch = f": switch to {context.vehicle.guided_name}"
                text += ": control begins" if context.vehicle.is_ours else switch
        self.is_idle = self._finding is None
        context.announce(Severity.NOTICE, text)

    def step(self, now_s: float) -> Finding | None:
        """Return the finding of the operator's command, which is dropped when control ends."""
        del now_s
        if self._context.authority.phase not in IN_CONTROL:
            self._finding, self.is_idle = None, True
        return self._finding


UNREAD_TIMEOUT_S = 20.0
"""Time for two rounds of unanswered requests (8 tries of 0.4 s) and the pause of 10 s between."""
CHANGED_EVERY_S = 30.0


class FenceWatch(Watch):
    """Updates the fence with the state of the flight, and holds while it is unconfirmed."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._wrong_since_s: float | None = None
        self._texts = RateLimited(CHANGED_EVERY_S)

    def handle(self, event: events.Event) -> None:
        """Doubt a fence that the autopilot changed, until it is downloaded."""
        fencing = self._context.fencing
        if not isinstance(event, events.AutopilotFenceChanged) or not fencing.is_followed:
            return
        fencing.doubt()
        if self._texts.is_due("changed", event.time_s):
            self._context.warn("the autopilot's fence changed: reading it again")

    def step(self, now_s: float) -> Finding | None:
        """Update the fence with home and control; hold without one, and hand back if that lasts."""
        context, vehicle, fencing = self._context, self._context.vehicle, self._context.fencing
        home_enu_m = vehicle.reported_home_enu_m
        if home_enu_m is not None and home_enu_m[:2] != fencing.home_enu_m:
            before = fencing.note
            fencing.set_home(home_enu_m[:2])
            if fencing.note is not None and fencing.note != before:
                context.warn(fencing.note)
        if vehicle.heartbeat is not None:  # after a restart of the autopilot it may still fly
            is_airborne, is_in_control = context.is_airborne, context.authority.phase in IN_CONTROL
            if (is_airborne, is_in_control) != (fencing.is_airborne, fencing.is_in_control):
                fencing.follow(is_airborne=is_airborne, is_in_control=is_in_control)
        if fencing.refusal is None and not fencing.is_doubted:
            self._wrong_since_s = None
            return None
        if self._wrong_since_s is None:
            self._wrong_since_s = now_s
        refusal = fencing.refusal
        text = "the autopilot's fence has not been read yet" if refusal is None else refusal
        has_lasted = now_s - self._wrong_since_s > UNREAD_TIMEOUT_S
        return Finding(Verdict.HAND_BACK if has_lasted else Verdict.HOLD, Reason.FENCE, text)


class Watches:
    """All watches of one session."""

    def __init__(self, context: SessionContext) -> None:
        params = context.params
        self.inputs = InputWatch(context)
        self.battery = BatteryWatch(params.battery_low_pct, params.battery_critical_pct)
        self.operator = OperatorCommandWatch(context)
        self.jumps = JumpWatch(context)
        self._context = context
        self.echo = EchoWatch()
        self._sticks = StickWatch(params.on_sticks)
        self.landing = LandingWatch()
        self._for_launch = (
            self._sticks,
            self.battery,
            context.containment,
            HealthWatch(self.battery),
        )
        """Watches that prevent or abort a launch; of equal findings the first one is announced."""
        self._all = (
            self.echo,
            self.operator,
            *self._for_launch,
            self.landing,
            self.jumps,
            FenceWatch(context),
            context.passing,
            self.inputs,
        )
        self._hearing = tuple(w for w in self._all if type(w).handle is not Watch.handle)
        self._other_targets = RateLimited(OTHER_TARGET_EVERY_S)
        self._was_in_control = self._was_launching = False
        self._is_battery_announced = False

    def handle(self, event: events.Event) -> None:
        """Pass an event to all watches, and announce a change of the battery level."""
        before = self.battery.level
        for watch in self._hearing:
            watch.handle(event)
        self._warn_of_other_target(event)
        level = self.battery.level
        if not isinstance(event, events.BatteryReported) or level in (before, BatteryLevel.GOOD):
            return
        severity = Severity.ERROR if level is BatteryLevel.CRITICAL else Severity.WARNING
        self._is_battery_announced = True
        self._context.announce(severity, self.battery.text())

    def _warn_of_other_target(self, event: events.Event) -> None:
        """Warn of a single foreign target, which our next setpoint replaces without a trace."""
        match event:
            case events.OtherCommandHeard():
                who = f" ({event.command} of {event.sender[0]}/{event.sender[1]})"
            case events.SetpointEchoed() if self.echo.take_far_echo():
                who = ""
            case _:
                return
        is_ours = self._context.authority.phase in IN_CONTROL
        if is_ours and self._other_targets.is_due("target", event.time_s):
            text = f"another target was sent to the autopilot{who}: ours replaces it"
            self._context.warn(f"{text}; change the mode to take over")

    def step(self, now_s: float) -> Finding | None:
        """Note the start and end of control, and advance all watches.

        Return the worst finding in control, or of those that prevent a launch in a launch, or None.
        """
        phase = self._context.authority.phase
        is_in_control = phase in IN_CONTROL
        if is_in_control and not self._was_in_control:
            self._begin(now_s)
        elif self._was_in_control and not is_in_control:
            self.echo.end()
        if phase is Phase.LAUNCHING and not self._was_launching:
            self._sticks.begin(now_s)
        if phase is Phase.WAITING and not self._context.vehicle.is_armed:
            self.battery.note_flight_end()
        self._was_in_control, self._was_launching = is_in_control, phase is Phase.LAUNCHING
        found: Finding | None = None
        for watch in self._all:
            finding = None if watch.is_idle else watch.step(now_s)
            if finding is None or not (is_in_control or watch in self._for_launch):
                continue
            if found is None or finding.verdict > found.verdict:
                found = finding
        return found if is_in_control or phase is Phase.LAUNCHING else None

    def note_handback(self, finding: Finding) -> None:
        """Note a hand-back for this finding."""
        if finding.reason is Reason.BATTERY_CRITICAL:
            self.battery.note_handback()

    def _begin(self, now_s: float) -> None:
        for watch in self._all:
            watch.begin(now_s)
        if self.battery.level is BatteryLevel.UNKNOWN and not self._is_battery_announced:
            self._is_battery_announced = True
            self._context.warn("battery charge unknown: monitor it yourself")
