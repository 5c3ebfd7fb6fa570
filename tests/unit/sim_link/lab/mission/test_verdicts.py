"""Verdicts: every kind of expectation, met and broken."""

from __future__ import annotations

import pytest

from companion.mav.dialect import mavlink
from companion.report.flight_summary import EstimatePoint
from sim_link.lab.mission.results import (
    STEPS,
    ExpectationVerdict,
    FlightRecord,
    OperatorText,
    Report,
    StepOutcome,
    verdicts_of,
)
from sim_link.lab.mission.script import Mission
from sim_link.lab.mission.script_file import parse_mission
from sim_link.lab.monitor.monitor import NOTHING, WIRE
from sim_link.lab.monitor.scene import InvariantViolation


def flown(expectation: str) -> tuple[Mission, FlightRecord]:
    """A flight that found emitter 1 half a metre off, and was 100 s long."""
    text = f"""\
name: m
emitters: [{{emitter_id: 2, position_enu_m: [10, 10]}}]
steps: [connect]
expectations: [{{name: it, {expectation}}}]
"""
    record = FlightRecord(
        steps=[StepOutcome(1, "connect", "hearing", 0.0, 1.0)],
        estimates=[
            EstimatePoint(20.0, (90.0, 90.0), 30.0, "ambiguous", emitter_id=1),
            EstimatePoint(30.0, (50.5, 50.0), 0.4, "localised", emitter_id=1, absolute_r95_m=2.5),
            EstimatePoint(31.0, (10.0, 13.0), 2.0, "searching", emitter_id=2),
        ],
        reports=[Report(32.0, 1, (50.5, 50.0), 0.4)],
        texts=[
            OperatorText(32.0, "companion", "LOCALISED 47 8 R95 0.4 m"),
            OperatorText(40.0, "autopilot", "Landing detected"),
        ],
        violations=[
            InvariantViolation(25.0, "I7", "gap of 0.3 s"),
            InvariantViolation(26.0, "I7", "gap of 0.2 s"),
        ],
        breaches={"it": 12.0},
        engaged_s=10.0,
        ended_s=100.0,
        distance_m=250.0,
        scope=WIRE,
    )
    record.messages["companion", mavlink.MAVLINK_MSG_ID_HEARTBEAT] = 99
    record.situation.vehicle.is_armed = False
    return parse_mission(text, "m"), record


def test_what_is_measured_after_the_report_is_no_longer_looked_for() -> None:
    _, record = flown("final_error_m: {at_most: 1}")
    record.estimates.append(EstimatePoint(60.0, (20.0, 20.0), 15.0, "diverged", emitter_id=1))
    reported = record.last_estimate(1)
    assert reported is not None
    assert reported.time_s == 30.0
    record.reports.clear()
    last = record.last_estimate(1)
    assert last is not None
    assert last.time_s == 60.0


def verdict(expectation: str) -> ExpectationVerdict:
    steps, own = verdicts_of(*flown(expectation))
    assert steps.is_met
    assert own.name == "it"
    return own


@pytest.mark.parametrize(
    ("kind", "met", "broken", "found"),
    [
        ("final_error_m", "{at_most: 0.6}", "{at_most: 0.4}", "0.50 m"),
        ("final_error_m", "{at_most: 4, emitter: 2}", "{at_most: 2, emitter: 2}", "3.00 m"),
        ("error_over_r95", "{at_most: 1.3}", "{at_most: 1.2}", "1.25 times the R95 of 0.40 m"),
        ("error_over_absolute_r95", "{at_most: 0.3}", "{at_most: 0.1}", "absolute R95 of 2.50 m"),
        ("reported_s", "{at_most: 22}", "{at_most: 21}", "22.00 s"),
        ("time_s", "{at_least: 90, at_most: 100}", "{at_most: 99}", "100.00 s"),
        ("distance_m", "{at_most: 300}", "{at_least: 300}", "250.00 m"),
        ("violations", "{at_most: 2}", "{at_most: 1}", "expected at most"),
        ("violations", "{invariants: [I1]}", "{invariants: [I7]}", "expected at most 0"),
        ("appears", "{text: LOCALISED}", "{text: LOCALISED, from: autopilot}", "seen"),
        ("appears", "{message: HEARTBEAT}", "{message: HEARTBEAT, at_least: 100}", "seen 99 times"),
        ("never", "{text: contradicted}", "{text: Landing}", "expected never"),
        ("holds", "vehicle.is_armed == false", "vehicle.is_armed", "at the end"),
    ],
)
def test_an_expectation_met_and_broken(kind: str, met: str, broken: str, found: str) -> None:
    assert verdict(f"{kind}: {met}").is_met
    failed = verdict(f"{kind}: {broken}")
    assert not failed.is_met
    assert found in failed.found


def test_what_never_came_is_never_good_enough() -> None:
    assert "no estimate" in _without("estimates", "final_error_m: {at_most: 1000}")
    assert "no estimate" in _without("estimates", "error_over_r95: {at_most: 1000}")
    assert "not reported" in _without("reports", "reported_s: {at_most: 1000}")


def test_a_log_from_before_the_absolute_radius_is_no_promise_of_it() -> None:
    bound = "error_over_absolute_r95: {at_most: 1000, emitter: 2}"
    assert "not reported" in verdict(bound).found
    assert not verdict(bound).is_met


def _without(what: str, expectation: str) -> str:
    mission, without = flown(expectation)
    getattr(without, what).clear()
    own = verdicts_of(mission, without)[1]
    assert not own.is_met
    return own.found


def test_an_always_is_broken_once_it_was_false() -> None:
    assert verdict("always: vehicle.height_m < 40").found.endswith("was false at 12.0 s")
    mission, unbroken = flown("always: vehicle.height_m < 40")
    unbroken.breaches.clear()
    assert verdicts_of(mission, unbroken)[1].is_met


def test_violations_tell_the_first_one() -> None:
    assert "first I7 at 25.00 s: gap of 0.3 s" in verdict("violations: {}").found


def test_unmonitored_invariants_are_not_judged() -> None:
    mission, unwatched = flown("violations: {}")
    unwatched.scope = NOTHING
    own = verdicts_of(mission, unwatched)[1]
    assert own.is_met
    assert "not judged" in own.found


def test_what_this_kind_of_flight_cannot_judge_is_named() -> None:
    assert verdict("violations: {at_most: 2}").found.endswith("; not judged: I8, I10, I12")
    only = verdict("violations: {invariants: [I8]}")
    assert only.is_met
    assert only.found == f"not judged: I8 {WIRE.unjudged['I8']}"
    assert "not judged" not in verdict("violations: {invariants: [I1]}").found


def test_a_failed_step_is_a_verdict_of_its_own() -> None:
    mission, failed = flown("time_s: {at_most: 200}")
    failed.steps.append(StepOutcome(2, "arm", "arming", 1.0, 6.0, "refused"))
    steps, own = verdicts_of(mission, failed)
    assert steps == ExpectationVerdict(STEPS, False, "step 2 arm: refused")
    assert own.is_met


def test_a_mission_that_ended_otherwise_says_so() -> None:
    mission, failed = flown("time_s: {at_most: 200}")
    failed.failure = "interrupted"
    assert verdicts_of(mission, failed)[0] == ExpectationVerdict(STEPS, False, "interrupted")
