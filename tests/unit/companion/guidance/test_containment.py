"""Errors of the estimator and the planner, and the flight during them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import pytest

from companion.domain import FlightMode
from companion.guidance.commands import SendSetpoint
from companion.guidance.control import TICK_S
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight

PARTS = ["tracker", "planner"]


def break_part(flight: ScriptedFlight, part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a part fail whenever it is used from now on."""

    def fail(*_: Any, **__: Any) -> NoReturn:
        raise ZeroDivisionError("of the test")

    target = flight.session.tracker if part == "tracker" else flight.session.flight_plan
    monkeypatch.setattr(target, "fusion" if part == "tracker" else "renew", fail)


def now_and_then(call: Callable[..., Any], failures: Iterator[bool]) -> Callable[..., Any]:
    """A call that fails where the iterator says so."""

    def called(*args: Any, **kwargs: Any) -> Any:
        if next(failures):
            raise ValueError("of the test")
        return call(*args, **kwargs)

    return called


@pytest.mark.parametrize("part", PARTS)
def test_a_part_that_keeps_failing_is_held_on_and_handed_back(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = ScriptedFlight().in_control()
    break_part(flight, part, monkeypatch)
    flight.fly(0.3)
    assert flight.is_in(Phase.HOLD, Phase.HANDBACK)
    flight.fly(3.0)
    assert flight.asked_modes() == [FlightMode.HOLD]
    assert any("3 internal errors in 10 s" in text for text in flight.texts)
    assert flight.is_in(Phase.YIELD)


@pytest.mark.parametrize("part", PARTS)
def test_setpoints_go_on_while_parts_fail(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedFlight().in_control()
    break_part(flight, part, monkeypatch)
    since_s = flight.now_s
    flight.fly(1.0)
    assert len(flight.sent(SendSetpoint, since_s)) == 20


def test_one_error_is_held_on_for_a_second_and_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedFlight().in_control()
    failures = itertools.chain([True], itertools.repeat(False))
    tracker = flight.session.tracker
    monkeypatch.setattr(tracker, "fusion", now_and_then(tracker.fusion, failures))
    flight.fly(0.2)
    assert flight.is_in(Phase.HOLD)
    assert "internal error in the estimator: ValueError: of the test" in flight.texts
    (record,) = flight.records("internal_error")
    assert str(record["where"]).startswith("test_containment.py:")
    flight.fly(1.2)
    assert flight.is_in(Phase.NORMAL)
    assert flight.session.context.containment.errors == {"estimator": 1}


@pytest.mark.slow
def test_errors_far_apart_are_no_reason_to_hand_back(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedFlight().in_control()
    failures = (number % 60 == 0 for number in itertools.count())
    tracker = flight.session.tracker
    monkeypatch.setattr(tracker, "fusion", now_and_then(tracker.fusion, failures))
    flight.fly(40.0)
    assert flight.asked_modes() == []
    assert flight.session.context.containment.errors["estimator"] >= 6


def test_an_error_of_the_guard_is_not_contained(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedFlight().in_control()
    broken = now_and_then(flight.session.context.guard.towards, itertools.repeat(True))
    monkeypatch.setattr(flight.session.context.guard, "towards", broken)
    with pytest.raises(ValueError, match="of the test"):
        flight.fly(TICK_S)
