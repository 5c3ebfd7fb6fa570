"""What the parts of a session share: vehicle, estimate, phase, and what is to be done."""

from __future__ import annotations

from collections import Counter
from typing import Any

from companion.domain import FlightMode, TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.guard.gate import Guard
from companion.guidance.authority import Authority
from companion.guidance.commands import (
    Announce,
    Command,
    Record,
    ReportResult,
    SetMode,
    Severity,
    WithdrawRequest,
)
from companion.guidance.containment import Containment
from companion.guidance.emitters import EmitterQueue
from companion.guidance.fencing import Fencing
from companion.guidance.finding_news import FindingNews
from companion.guidance.findings import Finding, Reason
from companion.guidance.flight_plan import FlightPlan
from companion.guidance.launch import Launch
from companion.guidance.params import SessionParams
from companion.guidance.states import (
    HAS_VEHICLE,
    IN_CONTROL,
    OUT_OF_CONTROL,
    STREAMING,
    Phase,
    Trigger,
)
from companion.guidance.steering import Steering
from companion.guidance.tuning import Tuning
from companion.guidance.vehicle import VehicleView
from companion.planning.base import Planner


class Situation:
    """The state of one session, and the commands that a call has collected so far.

    Args:
        params: How the mission is flown.
        emitters: The estimates of the targets, and whose turn it is.
        planner: Where to fly, given the estimate.
        guard: What may be sent.
        fencing: Gives the guard its fence.
        needs_origin: Whether setpoints are global, so that nothing flies without an origin.
    """

    def __init__(
        self,
        params: SessionParams,
        emitters: EmitterQueue,
        planner: Planner[Any],
        guard: Guard,
        fencing: Fencing,
        *,
        needs_origin: bool,
    ) -> None:
        self.params = params
        self.emitters = emitters
        self.guard = guard
        self.vehicle = VehicleView(needs_origin=needs_origin)
        self.flight_plan = FlightPlan(planner, guard, emitters, params.altitude_m)
        self.fencing = fencing
        self.steering = Steering(guard, params.altitude_m)
        self.authority = Authority()
        self.estimate: TargetEstimate | None = None
        self.reports: dict[int | None, ReportResult] = {}
        """What was reported of each emitter, the newest last."""
        self.launch: Launch | None = None
        self.has_launched = False
        self.is_stopping = False
        """Whether the process ends as soon as the vehicle is not in our hands."""
        self.finding: Finding | None = None
        """What is wrong now."""
        self.reasons: Counter[Reason] = Counter()
        """How often each reason was what is wrong."""
        self._finding_news = FindingNews()
        self.containment = Containment()
        self.commands: list[Command] = []
        self._passing: tuple[Finding, float] | None = None

    @property
    def phase(self) -> Phase:
        """Where the session stands."""
        return self.authority.phase

    @property
    def tracker(self) -> TargetTracker:
        """The estimate of the emitter that is looked for."""
        return self.emitters.current

    @property
    def result(self) -> ReportResult | None:
        """What was reported last, if anything was."""
        return next(reversed(self.reports.values()), None)

    def take_commands(self) -> list[Command]:
        """What was collected; the next call begins with nothing."""
        commands, self.commands = self.commands, []
        return commands + self.containment.take_news()

    def enter(self, trigger: Trigger, now_s: float) -> bool:
        """Apply a trigger; whether the phase changed."""
        left = self.authority.enter(trigger, now_s)
        if left is None:
            return False
        self.record("phase", old=left.value, new=self.phase.value, trigger=trigger.value)
        if self.phase in OUT_OF_CONTROL:
            self.withdraw()
        if self.phase not in IN_CONTROL:
            self._finding_news = FindingNews()
        if not (left in IN_CONTROL and self.phase in STREAMING):
            self.steering.forget_setpoint()
        self.vehicle.keep_home(self.phase in HAS_VEHICLE)
        if self.is_stopping and self.phase in OUT_OF_CONTROL:
            self.enter(Trigger.STOP, now_s)
        return True

    def find(self, finding: Finding | None, now_s: float) -> bool:
        """Take note of what is wrong now, or that nothing is; whether that is news."""
        self.finding = finding
        if not self._finding_news.is_due(finding, now_s):
            return False
        if finding is None:
            return True
        self.reasons[finding.reason] += 1
        verdict = finding.verdict.name.lower()
        self.record("finding", verdict=verdict, reason=finding.reason.value, text=finding.text)
        return True

    def hold_until(self, finding: Finding, until_s: float) -> None:
        """Something happened that is over already, but shall be held on for a while."""
        self._passing = (finding, until_s)

    def passing_finding(self, now_s: float) -> Finding | None:
        """What is held on for a while, if that is not over."""
        if self._passing is None or now_s >= self._passing[1]:
            return None
        return self._passing[0]

    def announce(self, severity: Severity, text: str) -> None:
        """A text for the operator."""
        self.commands.append(Announce(severity, text))

    def record(self, kind: str, **fields: object) -> None:
        """A line for the event log."""
        self.commands.append(Record(kind, fields))

    def ask_mode(self, mode: FlightMode) -> None:
        """Ask the autopilot for a mode."""
        self.commands.append(SetMode(mode, self.vehicle.is_armed))

    def report(self, result: ReportResult) -> None:
        """Tell where an emitter is."""
        self.reports.pop(result.emitter_id, None)
        self.reports[result.emitter_id] = result
        self.commands.append(result)

    def withdraw(self) -> None:
        """What was asked and not answered must not be sent again."""
        self.commands.append(WithdrawRequest())

    def plan_now(self, now_s: float) -> None:
        """Renew the plan; without one, after an error, the vehicle will stay."""
        self.containment.run("planner", now_s, lambda: self._renew_plan(now_s))

    def _renew_plan(self, now_s: float) -> None:
        setpoint = self.steering.setpoint_enu_m
        self.commands += self.flight_plan.renew(now_s, self.vehicle, setpoint, self.estimate)

    def retune(self, tuning: Tuning) -> None:
        """Go on with other parameters."""
        self.params = tuning.params
        self.fencing.use_limits(tuning.limits)
        self.steering.use_altitude(tuning.params.altitude_m)
        self.flight_plan.use(tuning.planner, tuning.params.altitude_m)

    def forget_target(self) -> None:
        """Drop all estimates and every plan that stands on them."""
        self.emitters.restart()
        self.flight_plan.forget()
        self.estimate = None
