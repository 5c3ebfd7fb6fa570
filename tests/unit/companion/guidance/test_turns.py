"""A session with several emitters: each is found and reported in turn."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest

from companion.domain import BatteryLevel, FlightMode, PositionEnu
from companion.guidance.commands import Record, SessionParams
from companion.guidance.emitters import QueueParams
from companion.guidance.events import (
    BatteryReported,
    MemoryRecalled,
    SessionMemory,
    UncleanExitFound,
)
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight

NEAR, FAR = (25.0, 20.0, 0.0), (60.0, 30.0, 0.0)
TARGETS: dict[int, PositionEnu] = {7: FAR, 3: NEAR}
PARAMS = SessionParams(stop_confirm_s=2.0, stop_radius_m=1.9)
LIMIT_S = 90.0


def flight_of(
    queue: QueueParams,
    targets: dict[int, PositionEnu] = TARGETS,
    params: SessionParams = PARAMS,
) -> ScriptedFlight:
    flight = ScriptedFlight(params, emitters=queue)
    flight.targets = dict(targets)
    flight.follows = True
    return flight


def fly_until_reported(flight: ScriptedFlight, count: int) -> None:
    while len(flight.results) < count:
        flight.fly(0.5)
        assert flight.now_s < LIMIT_S


@cache
def nearest_first() -> ScriptedFlight:
    """Flown until both are reported; look at it, and leave it as it is."""
    flight = flight_of(QueueParams(order="nearest")).in_control()
    fly_until_reported(flight, 2)
    flight.fly(1.0)
    return flight


@cache
def after_the_first() -> SessionMemory:
    """Return the memory once the nearer emitter is reported."""
    flight = flight_of(QueueParams(order="nearest")).in_control()
    fly_until_reported(flight, 1)
    flight.fly(1.0)
    return flight.session.memory


@pytest.mark.slow
def test_each_is_reported_once_in_turn_and_where_it_is() -> None:
    flight = nearest_first()
    assert [result.emitter_id for result in flight.results] == [3, 7]
    for result in flight.results:
        truth = TARGETS[result.emitter_id or 0]
        assert math.dist(result.estimate.position_enu_m, truth[:2]) < result.estimate.r95_m
    assert any(text.startswith("LOCALISED emitter 3: 47.4") for text in flight.texts)


def test_the_mode_that_follows_is_asked_for_after_the_last_one_only() -> None:
    flight = nearest_first()
    assert flight.asked_modes() == [FlightMode.HOLD]
    assert flight.is_in(Phase.FINISHED)
    phases = [str(record["new"]) for record in flight.records("phase")]
    assert phases.count("finished") == 1
    assert phases.count("hold") == 1  # the check before the plan is flown, and none in between


def test_it_says_whose_turn_it_is_and_flies_there() -> None:
    flight = nearest_first()
    assert flight.records("turn") == [
        {"emitter_id": 3, "waiting": [7]},
        {"emitter_id": 7, "waiting": []},
    ]
    assert "searching for emitter 3, then 7" in flight.texts
    assert math.dist(flight.position_enu_m[:2], FAR[:2]) < math.dist(
        flight.position_enu_m[:2], NEAR[:2]
    )


def test_the_one_that_waits_is_learnt_of_meanwhile_and_not_taken_for_the_current_one() -> None:
    flight = nearest_first()
    waiting = flight.records("waiting")
    assert {record["emitter_id"] for record in waiting[:50]} == {7}
    marks = [c for c in flight.sent(Record) if c.kind in ("turn", "estimate")]
    second = max(i for i, c in enumerate(marks) if c.kind == "turn")
    first = next(i for i, c in enumerate(marks) if c.kind == "turn")
    assert {c.fields["emitter_id"] for c in marks[first:second]} == {3}
    assert {c.fields["emitter_id"] for c in marks[second:]} == {7}
    assert flight.results[1].estimate.measurements > flight.results[0].estimate.measurements


def test_the_status_names_all_of_them() -> None:
    flight = nearest_first()
    status = flight.session.status(flight.now_s)
    assert [(e.emitter_id, e.is_current, e.is_reported) for e in status.emitters] == [
        (7, True, True),
        (3, False, True),
    ]
    assert status.accepted == sum(t.accepted for t in flight.session.context.emitters.trackers)
    assert flight.session.has_found_all


def test_who_is_not_listed_is_never_flown_at() -> None:
    flight = flight_of(QueueParams(order="listed", listed=(7,))).in_control()
    fly_until_reported(flight, 1)
    assert flight.results[0].emitter_id == 7
    assert flight.is_in(Phase.FINISHED)
    assert flight.session.status(flight.now_s).refused["other emitter"] > 10


@pytest.mark.slow
def test_with_a_low_battery_everybody_who_is_known_is_reported() -> None:
    queue, targets = QueueParams(order="nearest"), TARGETS
    flight = flight_of(queue, targets, SessionParams(stop_confirm_s=60.0)).in_control()
    flight.fly(4.0)
    for _ in range(3):
        flight.give(BatteryReported(flight.now_s, 15.0, BatteryLevel.LOW))
    while not flight.results:
        flight.fly(0.5)
        assert flight.now_s < LIMIT_S
    assert [result.emitter_id for result in flight.results] == [7, 3]
    assert flight.asked_modes() == [FlightMode.RETURN]
    assert any("battery low: emitter 3:" in text for text in flight.texts)
    assert flight.session.has_found_all


@pytest.mark.slow
def test_one_that_falls_silent_gives_way_to_one_that_is_heard() -> None:
    flight = flight_of(QueueParams(order="nearest")).in_control()
    flight.fly(2.0)
    del flight.targets[3]
    fly_until_reported(flight, 1)
    assert flight.results[0].emitter_id == 7
    flight.targets[3] = NEAR
    fly_until_reported(flight, 2)
    assert flight.results[1].emitter_id == 3


@pytest.mark.slow
def test_after_a_restart_the_others_are_still_to_be_found() -> None:
    memory = after_the_first()
    assert memory.report is not None
    assert memory.report.emitter_id == 3
    assert memory.belief is not None
    assert memory.belief.emitter_id == 7
    assert [belief.emitter_id for belief in memory.others] == [3]
    flight = flight_of(QueueParams(order="nearest"))
    flight.give(UncleanExitFound(0.0))
    flight.give(MemoryRecalled(0.0, memory, 5.0))
    flight.ready().fly(2.0)
    flight.in_control()
    assert [result.emitter_id for result in flight.results] == [3]
    assert not flight.session.has_found_all
    fly_until_reported(flight, 2)
    assert [result.emitter_id for result in flight.results] == [3, 7]
    assert flight.is_in(Phase.FINISHED)


def test_after_a_restart_all_reports_are_handed_over_again() -> None:
    memory = nearest_first().session.memory
    assert [report.emitter_id for report in memory.earlier] == [3]
    flight = flight_of(QueueParams(order="nearest"))
    flight.give(UncleanExitFound(0.0))
    flight.give(MemoryRecalled(0.0, memory, 5.0))
    assert [result.emitter_id for result in flight.results] == [3, 7]
    assert flight.is_in(Phase.FINISHED)
    assert any("emitters 3, 7 were reported already" in text for text in flight.texts)


def test_a_belief_that_makes_no_sense_does_not_take_the_others_with_it() -> None:
    memory = after_the_first()
    (other,) = memory.others
    flight = flight_of(QueueParams(order="nearest"), {})
    flight.give(UncleanExitFound(0.0))
    broken = replace(memory, others=(replace(other, places=()),))
    flight.give(MemoryRecalled(0.0, broken, 5.0))
    flight.ready()
    assert any("estimate reset: checkpoint has 0 hypotheses" in text for text in flight.texts)
    estimate = flight.session.estimate
    assert estimate is not None
    assert estimate.position_enu_m == pytest.approx(FAR[:2], abs=5.0)
