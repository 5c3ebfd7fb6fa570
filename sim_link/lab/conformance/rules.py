"""Rules, how they are run against a peer, and how the outcome is reported to people and tools.

A rule is one sentence, its source, the side that it binds, and a method of a probe that tries it.
The method returns when the rule holds, raises `Violation` when it does not, and `NotApplicable`
when the peer gives no occasion to judge:

    class FrameRules(VehicleProbe):
        book = RuleBook("frames")

        @book.rule("MAVLink guide, Packet Serialization")
        def bad_crc_is_dropped(self) -> None:
            '''A frame whose CRC is wrong has no effect.'''

The rule's id is `frames.bad_crc_is_dropped`, its statement the first line of the docstring.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from fnmatch import fnmatchcase
from functools import cache
from importlib.resources import files
from typing import Any

import msgspec


class Role(Enum):
    """Kind of the peer under test."""

    VEHICLE = "vehicle"
    COMPANION = "companion"


class Flavour(Enum):
    """The autopilot: the one under test, or the one that a companion is shown."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


BOTH = frozenset(Flavour)
PX4 = frozenset({Flavour.PX4})
ARDUPILOT = frozenset({Flavour.ARDUPILOT})


class Effect(Enum):
    """Strongest effect of a probe on the vehicle; each includes the ones before it."""

    ASKS = "asks"
    """Nothing that outlasts the connection: asks, listens, changes stream rates."""
    CHANGES = "changes"
    """Overwrites stored plans, parameters or home, or changes the mode while disarmed."""
    FLIES = "flies"
    """Arms or may arm: propellers off, or a simulator."""


ASKS, CHANGES, FLIES = Effect
CHANGE_FLAG, FLIGHT_FLAG, HARM_FLAG = "--allow-changes", "--allow-flight", "--allow-harm"
FLAG_OF = {CHANGES: CHANGE_FLAG, FLIES: FLIGHT_FLAG}


class Violation(Exception):  # noqa: N818  what a rule finds is no error of ours
    """Violation of the rule by the peer; the text describes it."""


class NotApplicable(Exception):  # noqa: N818
    """The rule cannot be tested with this peer; the text gives the reason."""


class NotReady(Exception):  # noqa: N818
    """Vehicle cannot be armed, so the rule was not tried; the text gives the reason."""


class AutopilotNotes(msgspec.Struct, frozen=True):
    """Behaviour of one real autopilot, by rule; a flavour in `autopilot_notes.yaml`."""

    version: str
    deviates: dict[str, str]
    asks: dict[str, str]
    modes: dict[str, tuple[int, int]] = {}  # msgspec copies it
    """Main and sub mode; ArduPilot has no sub modes, its `offboard` is GUIDED and `hold` BRAKE."""
    base_modes: dict[str, int] = {}
    """HEARTBEAT.base_mode, disarmed."""
    parameters: list[str] = []
    """Names of parameters that clients request."""
    rates_hz: dict[str, float] = {}
    """Lowest rates of the messages that clients need, also on a ground station's link."""


@cache
def autopilot_notes() -> dict[Flavour, AutopilotNotes]:
    """Return the notes of each flavour."""
    text = files("sim_link.lab.conformance").joinpath("autopilot_notes.yaml").read_bytes()
    return msgspec.yaml.decode(text, type=dict[Flavour, AutopilotNotes])


Probe = Callable[[Any], None]
"""A method of a `VehicleProbe` or a `CompanionProbe`, by the rule's role."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Rule of the MAVLink protocol with its test."""

    rule_id: str
    """`group.what_must_hold`."""
    statement: str
    source: str
    book: RuleBook
    effect: Effect
    flavours: frozenset[Flavour]
    harms: bool
    """True if it sends input that may crash a fragile autopilot: NaN, absurd values, a reboot."""
    probe: Probe = field(repr=False)

    @property
    def role(self) -> Role:
        """Kind of peer that the rule binds."""
        role: Role = self.book.prober.role
        return role

    @property
    def needs(self) -> list[str]:
        """The options without which it is not tried."""
        flags = [FLAG_OF[self.effect]] if self.effect in FLAG_OF else []
        return [*flags, HARM_FLAG] if self.harms else flags

    def deviation(self, flavour: Flavour) -> str:
        """Return the real autopilot's known deviation, with its version; empty: it has none."""
        notes = autopilot_notes()[flavour]
        text = notes.deviates.get(self.rule_id)
        return f"{flavour.value} {notes.version}: {text}" if text else ""


class RuleBook:
    """Collects the rules of a group in order; effect and flavours are theirs unless one differs."""

    prober: type[Any]
    """The class whose methods the rules are."""

    def __init__(
        self,
        group: str,
        effect: Effect = Effect.ASKS,
        flavours: frozenset[Flavour] = BOTH,
        begin: Probe = lambda _: None,
    ) -> None:
        self.rules: list[Rule] = []
        self.begin = begin
        """Start of every rule of the group."""
        self._group, self._effect, self._flavours = group, effect, flavours

    def __set_name__(self, owner: type[Any], name: str) -> None:
        self.prober = owner

    def rule(
        self,
        source: str,
        *,
        effect: Effect | None = None,
        flavours: frozenset[Flavour] | None = None,
        harms: bool = False,
    ) -> Callable[[Probe], Probe]:
        """Make the method a rule, named as it is, stated by its docstring and found in `source`."""

        def register(probe: Probe) -> Probe:
            rule = Rule(
                rule_id=f"{self._group}.{probe.__name__}",
                statement=(probe.__doc__ or "").strip().partition("\n")[0],
                source=source,
                book=self,
                effect=effect or self._effect,
                flavours=flavours or self._flavours,
                harms=harms,
                probe=probe,
            )
            self.rules.append(rule)
            return probe

        return register


def require(condition: bool, problem: str) -> None:
    """Raise `Violation` with `problem` unless the condition holds."""
    if not condition:
        raise Violation(problem)


def assume(condition: bool, reason: str) -> None:
    """Raise `NotApplicable` with `reason` unless the condition holds."""
    if not condition:
        raise NotApplicable(reason)


class RuleVerdict(Enum):
    """Outcome of a rule."""

    PASS = "PASS"
    NOTED = "NOTED"
    """Failed, as a known deviation of the real autopilot."""
    FAIL = "FAIL"
    HANG = "HANG"
    """The vehicle fell silent: it hangs, crashed, or the link is cut."""
    ERROR = "ERROR"
    """The suite itself failed."""
    SKIP = "SKIP"
    NOT_RUN = "NOT RUN"
    """Selected, but could not be run."""


@dataclass(frozen=True, slots=True)
class RuleOutcome:
    """A rule and its outcome."""

    rule: Rule
    verdict: RuleVerdict
    detail: str = ""
    """Reason of a failure or of an omission."""
    duration_s: float = 0.0
    """Time of the link that it took."""


def select(rules: Iterable[Rule], role: Role, pattern: str | None = None) -> list[Rule]:
    """Return the rules of a role whose id begins with or matches a pattern (`*`, `?`)."""
    begin = pattern or ""
    return [
        rule
        for rule in rules
        if rule.role is role
        and (rule.rule_id.startswith(begin) or fnmatchcase(rule.rule_id, begin))
    ]


def try_rule(rule: Rule, probe: Any) -> RuleOutcome:
    """Try one rule with an attached probe; every error becomes a verdict."""
    started_s = probe.now_s
    verdict, detail = RuleVerdict.PASS, ""
    try:
        rule.book.begin(probe)
        rule.probe(probe)
    except Violation as violation:
        note = rule.deviation(probe.flavour)
        verdict = RuleVerdict.NOTED if note else RuleVerdict.FAIL
        detail = f"{violation} ({note})" if note else str(violation)
    except NotApplicable as reason:
        verdict, detail = RuleVerdict.SKIP, str(reason)
    except NotReady as reason:
        verdict, detail = RuleVerdict.NOT_RUN, str(reason)
    except Exception as error:  # the vehicle is to be landed all the same
        verdict, detail = RuleVerdict.ERROR, f"{type(error).__name__}: {error}"
    return RuleOutcome(rule, verdict, detail, probe.now_s - started_s)


def line(outcome: RuleOutcome) -> str:
    """Return one rule: its verdict, id and source, and why it failed or was left out."""
    rule = outcome.rule
    text = f"{outcome.verdict.value}  {rule.rule_id}  [{rule.source}]"
    return f"{text}\n      {outcome.detail}" if outcome.detail else text


FURTHER = {
    RuleVerdict.NOTED: "deviate as noted",
    RuleVerdict.HANG: "made it fall silent",
    RuleVerdict.ERROR: "broke the suite",
    RuleVerdict.NOT_RUN: "not run",
    RuleVerdict.SKIP: "skipped",
}
EXIT_PASSED, EXIT_FAILED, EXIT_BAD_INPUT, EXIT_NOTED = range(4)


def exit_code(outcomes: Iterable[RuleOutcome], problems: Sequence[str] = ()) -> int:
    """Return 0 if everything passed, 3 for noted deviations only, 1 otherwise."""
    verdicts = {outcome.verdict for outcome in outcomes} - {RuleVerdict.PASS, RuleVerdict.SKIP}
    if problems or verdicts - {RuleVerdict.NOTED}:
        return EXIT_FAILED
    return EXIT_NOTED if verdicts else EXIT_PASSED


def summary(outcomes: Sequence[RuleOutcome]) -> str:
    """Return the closing line."""
    counts = Counter(outcome.verdict for outcome in outcomes)
    text = f"{counts[RuleVerdict.PASS]} passed, {counts[RuleVerdict.FAIL]} failed"
    for verdict, words in FURTHER.items():
        text += f", {counts[verdict]} {words}" if counts[verdict] else ""
    return text


def listing(rules: Iterable[Rule]) -> list[str]:
    """Return the text of the rules, with their sources and each flavour's deviation."""
    lines = []
    for rule in rules:
        flavours = ", ".join(sorted(flavour.value for flavour in rule.flavours))
        harms = "; harms" if rule.harms else ""
        lines.append(f"{rule.rule_id}  ({flavours}; {rule.effect.value}{harms})")
        lines.append(f"    {rule.statement}")
        lines.append(f"    source: {rule.source}")
        for flavour, notes in autopilot_notes().items():
            asked = notes.asks.get(rule.rule_id)
            lines += [f"    {flavour.value}: {asked}"] if asked else []
            lines += [f"    deviates: {each}" for each in (rule.deviation(flavour),) if each]
    return lines


def record(
    outcomes: Sequence[RuleOutcome], peer: str, problems: Sequence[str] = ()
) -> dict[str, object]:
    """Return all outcomes with their circumstances as JSON values."""
    return {
        "peer": peer,
        "summary": summary(outcomes),
        "exit_code": exit_code(outcomes, problems),
        "problems": list(problems),
        "rules": [
            {
                "id": outcome.rule.rule_id,
                "statement": outcome.rule.statement,
                "source": outcome.rule.source,
                "verdict": outcome.verdict.value,
                "detail": outcome.detail,
                "duration_s": round(outcome.duration_s, 3),
            }
            for outcome in outcomes
        ],
    }
