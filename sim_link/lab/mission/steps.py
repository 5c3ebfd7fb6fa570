"""Flies a script step by step, without a clock or a link.

Theory of operation. A tick evaluates the situation and checks if the current step is over. A step
begins with a request to the operator, repeats it every two seconds until an effect shows (an
autopilot that is not ready refuses, and a frame may be lost), and ends when its effect is complete,
never by an answer alone. A step that takes longer than its limit, or the mission longer than its
own, ends the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

from companion.domain import FlightMode
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults.fault_models import Fault
from sim_link.lab.mission import script
from sim_link.lab.mission.conditions import Condition, parse_condition
from sim_link.lab.mission.results import FlightRecord, StepOutcome
from sim_link.lab.mission.script import Mission, Step, StepParams


class Request(Enum):
    """Requests to the operator without parameters."""

    ARM = "arm the motors"
    GRANT = "let a companion that yielded stand by again"


@dataclass(frozen=True, slots=True)
class TakeOffAction:
    """Take off."""

    height_m: float


Action = Request | TakeOffAction | FlightMode
"""Request of the operator at the start of a step; a flight mode is one to switch to."""


class MissionOperator(Protocol):
    """The operator at the ground station."""

    def ask(self, action: Action) -> None:
        """Begin an action; an unfinished previous one is dropped."""

    def take_refusal(self) -> str | None:
        """Take the reason of the last refusal; None: not refused (yet)."""


ASK_AGAIN_S = 2.0
ARRIVED_M = 0.5
"""Distance below its height at which a takeoff may end."""
LIFTED_M = 0.3
"""Height above which a vehicle has begun to take off."""
ROUNDING_S = 1e-9


class StepRunner:
    """Flies a mission in the situation that its caller updates; `inject` begins faults later."""

    def __init__(
        self,
        mission: Mission,
        record: FlightRecord,
        operator: MissionOperator,
        inject: Callable[[Fault, float], None],
    ) -> None:
        self._mission = mission
        self._situation = record.situation
        self._record = record
        self._operator = operator
        self._inject = inject
        self._steps = mission.named_steps
        self._current: _RunningStep | None = None
        self._next = 0
        self._always = [
            (each.name, parse_condition(each.always))
            for each in mission.expectations
            if isinstance(each.always, str)
        ]

    @property
    def is_over(self) -> bool:
        """True if the last step is done, or one has failed."""
        return bool(self.failure) or (self._current is None and self._next >= len(self._steps))

    @property
    def failure(self) -> str:
        """Reason why the mission ended early; empty if it did not."""
        if self._record.failure:
            return self._record.failure
        last = self._record.steps[-1] if self._record.steps else None
        return "" if last is None or not last.failure else f"{last.title}: {last.failure}"

    @property
    def progress(self) -> tuple[int, int, str]:
        """Number of the step that is flown, of how many, and its name."""
        number = min(self._next, len(self._steps))
        name = self._steps[number - 1][0] if number else ""
        return number, len(self._steps), name

    def tick(self, now_s: float) -> None:
        """Evaluate the situation, and take the actions that are due."""
        self._situation.mission.time_s = now_s
        while not self.is_over:
            current = self._current or self._begin(now_s)
            self._situation.mission.step_time_s = now_s - current.started_s
            for name, condition in self._always:
                if name not in self._record.breaches and condition.is_false(self._situation):
                    self._record.breaches[name] = now_s
            if not self._advance(current, now_s):
                return

    def abandon(self, reason: str, now_s: float) -> None:
        """End the mission for a reason outside of the script."""
        if self._current is not None:
            self._end(self._current, now_s, reason)
        else:
            self._record.failure = reason

    def _begin(self, now_s: float) -> _RunningStep:
        name, step = self._steps[self._next]
        self._next += 1
        running = _RunningStep(self._next, name, _rule_of(step, self._mission), now_s)
        self._current = running
        fields = {"step": self._next, "name": name, "what": running.rule.what}
        self._record.events.append((now_s, "step", fields))
        if isinstance(step, FaultRecord):
            self._inject(step, now_s)
        return running

    def _advance(self, running: _RunningStep, now_s: float) -> bool:
        rule = running.rule
        if rule.is_met.holds(self._situation):
            running.met_s = now_s if running.met_s is None else running.met_s
            if now_s - running.met_s >= rule.for_s - ROUNDING_S:
                self._end(running, now_s, "")
        else:
            running.met_s = None
            self._ask(running, now_s)
            if now_s - running.started_s >= rule.limit_s:
                rule = running.rule
                text = f"{rule.what} did not happen within {rule.limit_s:g} s"
                refusal = running.refusal or self._operator.take_refusal()
                self._end(running, now_s, f"{text} ({refusal})" if refusal else text)
        if self._current is not None and now_s >= self._mission.time_limit_s:
            limit = f"the mission's time limit of {self._mission.time_limit_s:g} s"
            self._end(running, now_s, limit)
        return self._current is None

    def _ask(self, running: _RunningStep, now_s: float) -> None:
        running.refusal = self._operator.take_refusal() or running.refusal
        action, rule = running.rule.action, running.rule
        if action is None or now_s < running.ask_due_s:
            return
        if rule.has_begun is not None and rule.has_begun.holds(self._situation):
            return
        running.ask_due_s = now_s + ASK_AGAIN_S
        self._operator.ask(action)

    def _end(self, running: _RunningStep, now_s: float, failure: str) -> None:
        outcome = StepOutcome(
            running.number, running.name, running.rule.what, running.started_s, now_s, failure
        )
        self._record.steps.append(outcome)
        fields = {"step": running.number, "name": running.name, "failure": failure}
        self._record.events.append((now_s, "step ended", fields))
        self._current = None


@dataclass(frozen=True, slots=True)
class StepRule:
    """Action of a step, and the condition that ends it."""

    what: str
    """Text of the condition that it waits for."""
    is_met: Condition
    action: Action | None = None
    has_begun: Condition | None = None
    """True once the effect of the action shows; None if nothing shows before it is met."""
    limit_s: float = math.inf
    for_s: float = 0.0
    """Time for which it must be met."""


@dataclass(slots=True)
class _RunningStep:
    number: int
    name: str
    rule: StepRule
    started_s: float
    met_s: float | None = None
    ask_due_s: float = 0.0
    refusal: str = ""


ALWAYS = parse_condition("true")
CONNECTED = parse_condition("vehicle.mode == vehicle.mode and companion.phase == companion.phase")
"""True once both are known, because an unknown value equals nothing, not even itself."""
ARMED, DISARMED = parse_condition("vehicle.is_armed"), parse_condition("not vehicle.is_armed")
IN_CONTROL = parse_condition("companion.is_in_control")
GRANTED = parse_condition("companion.phase == standby or companion.is_in_control")
"""After a grant: it stands by, or flies, as a PX4 returns to setpoints by itself."""
READY = parse_condition(f"vehicle.is_ready and ({GRANTED.text})")
HOLDING = parse_condition("vehicle.mode == hold")
RETURNING = parse_condition('vehicle.mode == "return"')
LANDING = parse_condition("vehicle.mode == land")
REPORTED = parse_condition("companion.reported > 0")
CONTACT = parse_condition(
    "estimate.r95_m >= 0 and (companion.waypoint == approach or companion.waypoint == crossing or "
    "companion.waypoint == information or companion.waypoint == hold)"
)


FIXED_RULES: dict[type[StepParams], StepRule] = {
    script.ConnectStep: StepRule("hearing the autopilot", CONNECTED),
    script.WaitReadyStep: StepRule("being ready to arm, the companion in standby", READY),
    script.ArmStep: StepRule("arming", ARMED, Request.ARM),
    script.EngageStep: StepRule("the companion in control", IN_CONTROL, FlightMode.OFFBOARD),
    script.GrantStep: StepRule("the companion granted control", GRANTED, Request.GRANT),
    script.HoldStep: StepRule("holding", HOLDING, FlightMode.HOLD),
    script.ReturnStep: StepRule("standing at home", DISARMED, FlightMode.RETURN, RETURNING),
    script.LandStep: StepRule("standing, disarmed", DISARMED, FlightMode.LAND, LANDING),
}
"""Rules of the steps without parameters other than a time limit."""


def _rule_of(step: Step, mission: Mission) -> StepRule:
    if isinstance(step, FaultRecord):
        return StepRule(str(type(step).__struct_config__.tag), ALWAYS)
    rule = FIXED_RULES.get(type(step)) or _rule_of_params(step, mission)
    limits = {name: getattr(step, name) for name in ("limit_s", "for_s") if hasattr(step, name)}
    return replace(rule, **limits)


def _rule_of_params(step: Step, mission: Mission) -> StepRule:
    match step:
        case script.WaitUntilStep():
            return StepRule(step.condition, parse_condition(step.condition))
        case script.WaitStep():
            return StepRule(f"{step.for_s:g} s", ALWAYS)
        case script.SearchStep():
            is_met = REPORTED if step.until == "reported" else CONTACT
            return StepRule(f"{step.until} in the {step.pattern}", is_met)
        case script.TakeoffStep(altitude_m=height_m):
            height_m = mission.config.mission.altitude_m if height_m is None else height_m
            return StepRule(
                f"a height of {height_m:g} m",
                parse_condition(f"vehicle.height_m >= {height_m - ARRIVED_M}"),
                TakeOffAction(height_m),
                parse_condition(f"vehicle.height_m > {LIFTED_M}"),
            )
        case script.PilotOverrideStep():
            shown = f'vehicle.mode == "{step.mode}"'
            return StepRule(
                f"{step.mode} with the companion out of control",
                parse_condition(f"{shown} and not companion.is_in_control"),
                FlightMode(step.mode),
                parse_condition(shown),
            )
    raise TypeError(f"{step} is not a step")
