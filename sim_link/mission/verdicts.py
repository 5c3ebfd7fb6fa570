"""From the record of a flight to a verdict on every expectation, and on the steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.domain import Point
from sim_link.mission.conditions import parse_condition
from sim_link.mission.expectations import (
    Appears,
    Bound,
    EmitterBound,
    Expectation,
    TextSeen,
    Violations,
)
from sim_link.mission.messages import numbers_by_name
from sim_link.mission.record import EstimatePoint, FlightRecord
from sim_link.mission.script import Mission
from sim_link.mission.situation import Situation

STEPS = "all steps"
"""The name of the verdict on the steps."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one expectation."""

    name: str
    is_met: bool
    found: str
    """What was found, and what was expected of it."""


@dataclass(frozen=True, slots=True)
class Flown:
    """What verdicts are made of."""

    mission: Mission
    record: FlightRecord
    situation: Situation
    """At the end."""


def verdicts_of(flown: Flown) -> list[Verdict]:
    """The verdict on the steps first, then those on the expectations in the script's order."""
    return [_on_steps(flown.record), *(_on(each, flown) for each in flown.mission.expectations)]


def true_places(mission: Mission) -> dict[int, Point]:
    """Where the emitters truly are, by id; the one that a script calls `emitter` first."""
    emitters = (mission.emitter, *mission.emitters)
    return {each.emitter_id: each.position_enu_m for each in emitters}


def _on_steps(record: FlightRecord) -> Verdict:
    failed = next((step for step in record.steps if step.failure), None)
    if failed is not None:
        return Verdict(STEPS, False, f"{failed.title}: {failed.failure}")
    if record.failure:
        return Verdict(STEPS, False, record.failure)
    return Verdict(STEPS, True, f"{len(record.steps)} done in {record.ended_s:.1f} s")


def _on(expectation: Expectation, flown: Flown) -> Verdict:
    if isinstance(expectation.always, str):
        return Verdict(expectation.name, *_always(expectation, flown))
    judge = JUDGES[expectation.kind]
    return Verdict(expectation.name, *judge(getattr(expectation, expectation.kind), flown))


def _final_error(bound: EmitterBound, flown: Flown) -> tuple[bool, str]:
    point, truth = _final(bound, flown)
    if point is None:
        return False, "there is no estimate"
    return _bounded(math.dist(point.position_enu_m, truth), bound, "m")


def _error_over_r95(bound: EmitterBound, flown: Flown) -> tuple[bool, str]:
    point, truth = _final(bound, flown)
    if point is None:
        return False, "there is no estimate"
    ratio = math.dist(point.position_enu_m, truth) / point.r95_m
    return _bounded(ratio, bound, f"times the R95 of {point.r95_m:.2f} m")


def _final(bound: EmitterBound, flown: Flown) -> tuple[EstimatePoint | None, Point]:
    emitter = flown.mission.emitter.emitter_id if bound.emitter is None else bound.emitter
    return flown.record.last_estimate(emitter), true_places(flown.mission)[emitter]


def _reported(bound: EmitterBound, flown: Flown) -> tuple[bool, str]:
    emitter = flown.mission.emitter.emitter_id if bound.emitter is None else bound.emitter
    report, engaged_s = flown.record.report_of(emitter), flown.record.engaged_s
    if report is None or engaged_s is None:
        return False, "the target was not reported"
    return _bounded(report.time_s - engaged_s, bound, "s")


def _time(bound: Bound, flown: Flown) -> tuple[bool, str]:
    return _bounded(flown.record.ended_s, bound, "s")


def _distance(bound: Bound, flown: Flown) -> tuple[bool, str]:
    return _bounded(flown.record.distance_m, bound, "m")


def _violations(limit: Violations, flown: Flown) -> tuple[bool, str]:
    unjudged = flown.record.scope.unjudged_of(limit.invariants)
    if len(unjudged) == len(limit.invariants):
        reasons = (f"{name} {flown.record.scope.unjudged[name]}" for name in unjudged)
        return True, f"not judged: {'; '.join(reasons)}"
    counted = [v for v in flown.record.violations if v.invariant in limit.invariants]
    found = f"{len(counted)}, expected at most {limit.at_most}"
    if counted:
        first = counted[0]
        found += f"; first {first.invariant} at {first.time_s:.2f} s: {first.text}"
    if unjudged:
        found += f"; not judged: {', '.join(unjudged)}"
    return len(counted) <= limit.at_most, found


def _appears(wanted: Appears, flown: Flown) -> tuple[bool, str]:
    count, when = _seen(wanted, flown.record)
    return count >= wanted.at_least, f"seen {_times(count)}{when}, expected {wanted.at_least}"


def _never(unwanted: TextSeen, flown: Flown) -> tuple[bool, str]:
    count, when = _seen(unwanted, flown.record)
    return count == 0, f"seen {_times(count)}{when}, expected never"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _seen(wanted: TextSeen, record: FlightRecord) -> tuple[int, str]:
    """How often, and when first."""
    sources = ("companion", "autopilot") if wanted.from_ is None else (wanted.from_,)
    if wanted.message is not None:
        number = numbers_by_name()[wanted.message]
        return sum(record.messages[source, number] for source in sources), ""
    text = wanted.text or ""
    said = [each for each in record.texts if each.source in sources and text in each.text]
    return len(said), f", first at {said[0].time_s:.1f} s: {said[0].text}" if said else ""


def _holds(condition: str, flown: Flown) -> tuple[bool, str]:
    is_met = parse_condition(condition).holds(flown.situation)
    return is_met, f"at the end {condition} {'holds' if is_met else 'does not hold'}"


def _always(expectation: Expectation, flown: Flown) -> tuple[bool, str]:
    broken_s = flown.record.breaches.get(expectation.name)
    if broken_s is None:
        return True, f"{expectation.always} was never false"
    return False, f"{expectation.always} was false at {broken_s:.1f} s"


def _bounded(value: float, bound: Bound, unit: str) -> tuple[bool, str]:
    return bound.holds(value), f"{value:.2f} {unit}, expected {bound}"


JUDGES: dict[str, Callable[..., tuple[bool, str]]] = {
    "final_error_m": _final_error,
    "error_over_r95": _error_over_r95,
    "reported_s": _reported,
    "time_s": _time,
    "distance_m": _distance,
    "violations": _violations,
    "appears": _appears,
    "never": _never,
    "holds": _holds,
}
"""Each kind of expectation with its judge, but `always`, which is watched on the way."""
