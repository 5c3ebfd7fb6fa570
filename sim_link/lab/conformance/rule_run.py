"""Run of rules one after another on a vehicle that is restored in any case.

Theory of operation. Every rule has a probe of its own; all changes are recorded in one `Baseline`.
After a rule, passed or not, the vehicle lands, and parameters, stream rates and home are put back;
plans and the mode are at the end. A vehicle that falls silent is waited for. If it returns it is
restored first, and the rules continue; otherwise the rest is not run. What could not be restored is
listed with its former value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.protocol_clients import PlanClient
from sim_link.lab.conformance.puppet import CompanionProbe
from sim_link.lab.conformance.rules import (
    ASKS,
    HARM_FLAG,
    Flavour,
    NotApplicable,
    Role,
    Rule,
    RuleOutcome,
    RuleVerdict,
    Violation,
    require,
    try_rule,
)
from sim_link.lab.conformance.station import Baseline, ProbeLink
from sim_link.lab.conformance.vehicle_probe import FLIGHT_HEIGHT_M, SILENCE_S, VehicleProbe

LAND_S = 60.0
NEAR_M = 20.0
GO_BACK_S = 60.0
COME_BACK_S = 90.0
"""Longest wait for a silent vehicle, in s: a real autopilot boots within 40 s."""
MAX_LANDINGS = 2
"""Consecutive failed landings after which a vehicle is left to its operator."""


class Caretaker(PlanClient):
    """Lands a vehicle and restores changes made by rules."""

    def put_in_order(self) -> None:
        """Land, then restore all but plans and mode; `Violation`: the vehicle refuses."""
        self.come_to_rest()
        baseline = self.baseline
        for name in list(baseline.parameters):
            with suppress(Violation):  # it is listed at the end
                self.put_back(name)
        self.restore_intervals()
        if baseline.home is not None:
            self.set_home(baseline.home)
            baseline.home = None
        if mav.FENCE in baseline.plans:
            with suppress(Violation):
                self.clear(mav.FENCE)

    def come_to_rest(self) -> None:
        """If it is armed, land it at the start of the flights and wait until it is disarmed."""
        if not self.is_armed():
            return
        with suppress(Violation):
            self._go_back()
        self.set_mode("land")
        self.await_disarmed(LAND_S)

    def _go_back(self) -> None:
        """Fly to the start of the flights, unless it is near or the vehicle refuses."""
        start_e7 = self.baseline.start_e7
        if start_e7 is None or mav.distance_m(self.where_e7(), start_e7) < NEAR_M:
            return
        above_home_m = max(FLIGHT_HEIGHT_M, self.home().z - self.position()[2])
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
        if self.reposition(frame, (*start_e7, above_home_m)) == mav.ACCEPTED:
            self.run_until(lambda: self._is_near(start_e7), GO_BACK_S)

    def _is_near(self, position_e7: tuple[int, int]) -> bool:
        self.run(1.0)
        return mav.distance_m(self.where_e7(), position_e7) < NEAR_M / 2.0

    def leave(self) -> None:
        """Restore the plans and the mode after all rules."""
        plans = self.baseline.plans
        for kind, items in list(plans.items()):
            if items is None:
                continue
            result = self.upload(items, kind) if items else self.clear(kind)
            require(result == 0, f"a plan of type {kind} is not taken back: ACK {result}")
            del plans[kind]
        number = self.baseline.custom_mode
        if number is not None and self.heartbeat().custom_mode != number:
            main, sub = (number >> 16 & 255, number >> 24) if self.is_px4 else (number, 0)
            self.command(mavlink.MAV_CMD_DO_SET_MODE, float(mav.CUSTOM), float(main), float(sub))


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Peer under test, and the permitted actions."""

    role: Role = Role.VEHICLE
    flavour: Flavour = Flavour.PX4
    """The autopilot that a companion is shown."""
    signing_key: bytes | None = None
    allowed: frozenset[str] = frozenset()
    """The options given, as rules need them."""


class RuleRun:
    """Tries rules over a link; `show` gets each outcome, `report` the cause of each wait."""

    def __init__(
        self,
        link: ProbeLink,
        options: RunOptions,
        show: Callable[[RuleOutcome], None],
        report: Callable[[str], None],
    ) -> None:
        self.outcomes: list[RuleOutcome] = []
        self._link, self._options, self._show, self._progress = link, options, show, report
        self._baseline = Baseline(HARM_FLAG in options.allowed, report)
        self._first: Any = None
        self._lost = ""
        """Reason why the rest cannot be run; empty if it can."""
        self._is_in_order = True
        self._failed_landings = 0
        self._silences: list[str] = []

    @property
    def left_behind(self) -> list[str]:
        """Return everything that was not restored on the vehicle, with the remedy."""
        left = self._baseline.leftovers()
        return left if self._is_in_order else [*left, "not in order: land and disarm the vehicle"]

    @property
    def problems(self) -> list[str]:
        """Return problems to report besides the outcomes."""
        return self._silences + self.left_behind

    def run(self, rules: Iterable[Rule]) -> None:
        """Try the rules for the peer; raise `NotApplicable` without a peer."""
        rest, is_there = list(rules), False
        self._first = self._probe(VehicleProbe if self._is_vehicle else CompanionProbe)
        try:
            self._first.attach()
            is_there = True
            rest = [rule for rule in rest if self._first.flavour in rule.flavours]
            while rest:
                self._report(self._outcome_of(rest[0]))
                del rest[0]
        except KeyboardInterrupt:
            self._lost = "stopped"
            self._is_in_order = not is_there
            self._progress("stopped: putting the vehicle in order (once more to leave it as it is)")
        with suppress(KeyboardInterrupt):
            self._finish()
        for rule in rest:
            self._report(self._refusal(rule) or RuleOutcome(rule, RuleVerdict.NOT_RUN, self._lost))

    @property
    def _is_vehicle(self) -> bool:
        return self._options.role is Role.VEHICLE

    def _report(self, outcome: RuleOutcome) -> None:
        self.outcomes.append(outcome)
        self._show(outcome)

    def _probe(self, kind: type[Any]) -> Any:
        self._link.close_others()
        if not self._is_vehicle:
            return kind(self._link, self._options.flavour)
        probe = kind(self._link, self._options.signing_key)
        probe.baseline = self._baseline
        if self._first is not None:
            probe.target, probe.flavour = self._first.target, self._first.flavour
        return probe

    def _refusal(self, rule: Rule) -> RuleOutcome | None:
        missing = [flag for flag in rule.needs if flag not in self._options.allowed]
        if missing:
            return RuleOutcome(rule, RuleVerdict.SKIP, f"needs {' '.join(missing)}")
        return RuleOutcome(rule, RuleVerdict.NOT_RUN, self._lost) if self._lost else None

    def _outcome_of(self, rule: Rule) -> RuleOutcome:
        refused = self._refusal(rule)
        if refused is not None:
            return refused
        try:
            probe = self._attached(rule.book.prober)
        except NotApplicable as silence:
            self._lost = str(silence)
        if self._lost:
            return RuleOutcome(rule, RuleVerdict.NOT_RUN, self._lost)
        outcome = try_rule(rule, probe)
        is_fine = outcome.verdict in (RuleVerdict.PASS, RuleVerdict.SKIP)
        if not is_fine and not probe.is_heard(SILENCE_S):
            self._is_in_order = False
            detail = f"nothing is heard any more: {outcome.detail}"
            return replace(outcome, verdict=RuleVerdict.HANG, detail=detail)
        if self._is_vehicle and (rule.effect is not ASKS or self._baseline.intervals):
            self._put_in_order()
        return outcome

    def _attached(self, kind: type[Any]) -> Any:
        """Return a probe that hears the peer, put in order if due; `NotApplicable`: silence."""
        probe = self._probe(kind)
        try:
            probe.attach()
            if self._is_in_order:
                return probe
        except NotApplicable as silence:
            self._progress(f"{silence}: waiting {COME_BACK_S:g} s for it to come back")
            before = self.outcomes[-1].rule.rule_id if self.outcomes else "the beginning"
            self._silences.append(f"it fell silent after {before}")
            self._is_in_order = not self._is_vehicle
            if not probe.is_heard(COME_BACK_S):
                raise NotApplicable(f"the {self._options.role.value} is silent") from None
        if self._is_vehicle:
            self._put_in_order()
        probe = self._probe(kind)
        probe.attach()
        return probe

    def _put_in_order(self) -> None:
        self._is_in_order = False
        try:
            self._probe(Caretaker).put_in_order()
            self._is_in_order = True
            self._failed_landings = 0
        except Violation as problem:
            self._progress(f"the vehicle is not in order: {problem}")
            self._failed_landings += 1
            if self._failed_landings >= MAX_LANDINGS:
                self._lost = f"the vehicle is not in order: {problem}"

    def _finish(self) -> None:
        if not self._is_vehicle:
            return
        caretaker = self._probe(Caretaker)
        try:
            if not self._is_in_order:
                caretaker.put_in_order()
                self._is_in_order = True
            caretaker.leave()
        except Violation as problem:
            self._progress(f"not all is as it was: {problem}")
