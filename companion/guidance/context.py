"""State shared by the parts of a session: vehicle, estimate, phase, and collected commands.

Only the context writes its attributes. The other parts read them, and report events by a method;
components, such as the vehicle view or the guard, are updated directly.

Errors of the estimator and the planner end neither the process nor the control tick: the vehicle
holds. After three within ten seconds the vehicle is handed back. The guard is
not wrapped: without it nothing may be sent, so its error ends the process, and the autopilot's own
failsafe follows.
"""

from __future__ import annotations

import math
import traceback
from collections import Counter, deque
from pathlib import PurePath
from typing import Any

from companion.domain import FlightMode, LandedState, TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.guard.gate import Guard
from companion.guidance.commands import (
    Announce,
    Command,
    Record,
    ReportResult,
    SessionParams,
    SetMode,
    Severity,
    Topic,
    Tuning,
    WithdrawRequest,
)
from companion.guidance.control_authority import Authority, Finding, Reason, Verdict, Watch
from companion.guidance.emitters import EmitterQueue
from companion.guidance.fencing import Fencing
from companion.guidance.launch import Launch
from companion.guidance.messages import RateLimited, StateMessages
from companion.guidance.navigation import FlightPlan, Steering
from companion.guidance.phases import (
    HAS_VEHICLE,
    IN_CONTROL,
    OUT_OF_CONTROL,
    STREAMING,
    Phase,
    Trigger,
)
from companion.guidance.searching import Searching
from companion.guidance.vehicle import VehicleView
from companion.planning.planner import Planner
from companion.search.searched_area import SearchPrior

ERROR_HOLD_S = 1.0
WINDOW_S = 10.0
MAX_ERRORS = 3
TEXT_PERIOD_S = 10.0
"""Shortest time between two texts about errors of the same part."""


class Containment(Watch):
    """Counts internal errors of the parts, and holds or hands back after them."""

    def __init__(self) -> None:
        self.errors: Counter[str] = Counter()
        self._times_s: deque[float] = deque(maxlen=MAX_ERRORS)
        self._texts = RateLimited(TEXT_PERIOD_S)
        self.is_idle = True

    def step(self, now_s: float) -> Finding | None:
        """Return the finding that recent errors cause, or None."""
        times_s = self._times_s
        if len(times_s) == MAX_ERRORS and now_s - times_s[0] <= WINDOW_S:
            text = f"{MAX_ERRORS} internal errors in {WINDOW_S:g} s"
            return Finding(Verdict.HAND_BACK, Reason.INTERNAL_ERROR, text)
        if times_s and now_s - times_s[-1] < ERROR_HOLD_S:
            return Finding(Verdict.HOLD, Reason.INTERNAL_ERROR, "internal error")
        return None

    def note(self, part: str, error: Exception, now_s: float) -> list[Command]:
        """Count an error that a part raised, and return the log record and the text due."""
        self.is_idle = False
        self.errors[part] += 1
        self._times_s.append(now_s)
        what = f"{type(error).__name__}: {error}"
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{PurePath(last.filename).name}:{last.lineno}"
        fields = {"part": part, "error": what, "where": where}
        messages: list[Command] = [Record("internal_error", fields)]
        if self._texts.is_due(part, now_s):
            messages.append(Announce(Severity.ERROR, f"internal error in the {part}: {what}"))
        return messages


class PassingHold(Watch):
    """Holds for a while after an event that is already over."""

    def __init__(self) -> None:
        self._finding: Finding | None = None
        self._until_s = 0.0
        self.is_idle = True

    def hold(self, finding: Finding, until_s: float) -> None:
        """Hold with this finding until a time."""
        self._finding, self._until_s, self.is_idle = finding, until_s, False

    def step(self, now_s: float) -> Finding | None:
        """Return the finding until its hold is over, then None."""
        self.is_idle = now_s >= self._until_s
        return None if self.is_idle else self._finding


CLEARED_AFTER_S = 1.0
"""Time without the announced state after which it is over."""
URGENT = frozenset({Reason.NO_LINK})
REANNOUNCE_S = 10.0
"""Shortest time between two announcements of the same state while states alternate."""


class FindingMessages:
    """Decides when a finding in control is announced; None stands for "no finding"."""

    def __init__(self) -> None:
        self.announced: Finding | None = None
        self._seen_s = -math.inf
        """Last time at which the announced state was current."""
        self._announced_s: dict[Reason | None, float] = {}

    def take(self, finding: Finding | None, now_s: float) -> bool:
        """Record the current finding, or None; return True if it has to be announced."""
        before = self.announced
        reason = None if finding is None else finding.reason
        if reason is (None if before is None else before.reason):
            self._seen_s = now_s
            return False
        since_announced_s = now_s - self._announced_s.get(reason, -math.inf)
        is_worse = _severity(finding) > _severity(before) or reason in URGENT
        is_worse = is_worse and since_announced_s >= CLEARED_AFTER_S
        if not (
            is_worse or now_s - self._seen_s >= CLEARED_AFTER_S or since_announced_s >= REANNOUNCE_S
        ):
            return False
        self.announced, self._seen_s = finding, now_s
        self._announced_s[reason] = now_s
        return True


def _severity(finding: Finding | None) -> int:
    return 0 if finding is None else int(finding.verdict)


class SessionContext:
    """State of one session, and the commands collected so far."""

    def __init__(
        self,
        params: SessionParams,
        emitters: EmitterQueue,
        planner: Planner[Any],
        guard: Guard,
        fencing: Fencing,
        *,
        needs_origin: bool,
        searching: Searching | None = None,
    ) -> None:
        self.params = params
        self.emitters = emitters
        self.guard = guard
        self.vehicle = VehicleView(needs_origin=needs_origin)
        self.searching = searching or Searching()
        emitters.search_prior = self._search_prior
        self.flight_plan = FlightPlan(planner, guard, emitters, self.searching, params.altitude_m)
        self.fencing = fencing
        self.steering = Steering(guard, params.altitude_m)
        self.authority = Authority()
        self.containment = Containment()
        self.passing = PassingHold()
        self.estimate: TargetEstimate | None = None
        self.states = StateMessages()
        """States of the estimate, as announced."""
        self.reports: dict[int | None, ReportResult] = {}
        """Latest report of each emitter, the newest last."""
        self.launch: Launch | None = None
        self.has_launched = False
        """True if an automatic launch was tried or forbidden."""
        self.finding: Finding | None = None
        self.reasons: Counter[Reason] = Counter()
        """Count of findings that became the worst one, by reason."""
        self._is_stopping = False
        self.finding_messages = FindingMessages()
        self._commands: list[Command] = []
        self._is_control_change = False
        """True if control began or ended since commands were taken last."""

    def _search_prior(self) -> SearchPrior | None:
        """Return the searched area's prior of the emitter in the current frame; None: unknown."""
        return self.searching.prior(self.vehicle.frame)

    @property
    def tracker(self) -> TargetTracker:
        """Tracker of the emitter that is searched for now."""
        return self.emitters.current

    @property
    def result(self) -> ReportResult | None:
        """Latest report; None if no emitter was reported."""
        return next(reversed(self.reports.values()), None)

    def take_commands(self) -> list[Command]:
        """Return the collected commands and clear the list."""
        commands, self._commands = self._commands, []
        self._is_control_change = False
        return commands

    def enter(self, trigger: Trigger, now_s: float) -> bool:
        """Apply a trigger; return True if the phase changed."""
        left = self.authority.enter(trigger, now_s)
        if left is None:
            return False
        phase = self.authority.phase
        self.record("phase", old=left.value, new=phase.value, trigger=trigger.value)
        if (left in IN_CONTROL) is not (phase in IN_CONTROL):
            self._is_control_change = True
        if phase in OUT_OF_CONTROL:
            self.withdraw()
        if phase not in IN_CONTROL:
            self.finding_messages = FindingMessages()
        if not (left in IN_CONTROL and phase in STREAMING):
            self.steering.forget_setpoint()
        if trigger is Trigger.MODE_GIVEN:
            self.launch, self.has_launched = None, True
        self.vehicle.keep_home(phase in HAS_VEHICLE)
        if self._is_stopping and phase in OUT_OF_CONTROL:
            self.enter(Trigger.STOP, now_s)
        return True

    @property
    def is_airborne(self) -> bool:
        """True if it may be in the air: armed, and not on the ground by both report and height."""
        vehicle, floor_m = self.vehicle, self.guard.limits.envelope.altitude_min_m
        if vehicle.landed is not LandedState.ON_GROUND or not vehicle.is_armed:
            return vehicle.is_armed
        height_m = vehicle.height_m
        return height_m is not None and height_m >= floor_m

    @property
    def is_launch_wanted(self) -> bool:
        """True while an automatic launch is configured, and was neither tried nor forbidden."""
        return self.params.engage == "auto" and not self.has_launched

    def begin_launch(self, now_s: float) -> None:
        """Start the automatic launch; there is only one attempt."""
        self.has_launched = True
        self.launch = Launch(self.params.altitude_m, now_s)
        self.enter(Trigger.LAUNCH, now_s)

    def forbid_launch(self) -> None:
        """Forbid an automatic launch from now on: the operator hands control over."""
        self.has_launched = True

    def stop(self, now_s: float) -> bool:
        """Stop if the companion has no control; return True if it must hand back first."""
        self._is_stopping = True
        return self.enter(Trigger.STOP, now_s) and self.authority.phase is Phase.HANDBACK

    def record_finding(self, finding: Finding | None, now_s: float) -> bool:
        """Record the current finding, or None; return True if it has to be announced."""
        self.finding = finding
        if not self.finding_messages.take(finding, now_s):
            return False
        if finding is not None:
            self.reasons[finding.reason] += 1
            verdict = finding.verdict.name.lower()
            self.record("finding", verdict=verdict, reason=finding.reason.value, text=finding.text)
        return True

    def send(self, *commands: Command) -> None:
        """Collect commands."""
        self._commands += commands

    def announce(self, severity: Severity, text: str, topic: Topic | None = None) -> None:
        """Announce a text to the operator; it bypasses the rate limit where control changes."""
        must_pass = severity is Severity.NOTICE or self._is_control_change
        self.send(Announce(severity, text, topic, must_pass=must_pass))

    def warn(self, text: str, topic: Topic | None = None) -> None:
        """Announce a warning."""
        self.announce(Severity.WARNING, text, topic)

    def record(self, kind: str, **fields: object) -> None:
        """Add a line to the event log."""
        self.send(Record(kind, fields))

    def ask_mode(self, mode: FlightMode) -> None:
        """Request a mode of the autopilot."""
        self.send(SetMode(mode, self.vehicle.is_armed))

    def report(self, result: ReportResult) -> None:
        """Report the position of an emitter."""
        self.reports.pop(result.emitter_id, None)
        self.reports[result.emitter_id] = result
        self.send(result)

    def withdraw(self) -> None:
        """Withdraw unanswered requests, which must not be sent again."""
        self.send(WithdrawRequest())

    def set_estimate(self, estimate: TargetEstimate | None) -> None:
        """Set the current emitter's estimate."""
        self.estimate = estimate

    def shown_estimate(self, now_s: float) -> TargetEstimate | None:
        """Return the estimate with the announced state, see `StateMessages`; None without one."""
        if self.estimate is None:
            return None
        return self.states.shown(self.estimate, now_s, self.params.ranging_timeout_s)

    def plan_now(self, now_s: float) -> None:
        """Update the plan; after an error there is no plan, and the vehicle holds."""
        setpoint = self.steering.setpoint_enu_m
        try:
            self.send(*self.flight_plan.renew(now_s, self.vehicle, setpoint, self.estimate))
        except Exception as error:
            self.contain("planner", error, now_s)

    def contain(self, part: str, error: Exception, now_s: float) -> None:
        """Record an error that a part raised, and continue."""
        self.send(*self.containment.note(part, error, now_s))

    def retune(self, tuning: Tuning) -> None:
        """Continue with changed parameters."""
        self.params = tuning.params
        self.fencing.use_limits(tuning.limits)
        self.steering.altitude_m = tuning.params.altitude_m
        self.flight_plan.use(tuning.planner, tuning.params.altitude_m)

    def forget_target(self) -> None:
        """Drop all estimates and the plans based on them."""
        self.emitters.restart()
        self.flight_plan.forget()
        self.estimate = None
