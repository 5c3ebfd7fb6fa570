from __future__ import annotations

import math

from companion.domain import BatteryLevel, FlightMode
from companion.guard.gate import GuardReason
from companion.guard.limits import Fence
from companion.guidance.commands import Record
from companion.guidance.events import BatteryReported
from companion.guidance.messages import FenceMessages, GuardMessages
from tests.unit.companion.guidance.scripted import ScriptedFlight

FENCE, LAGGING, JUMPED = GuardReason.FENCE, GuardReason.LAGGING, GuardReason.JUMPED


def test_a_reason_is_reported_once_and_again_after_a_while() -> None:
    news = GuardMessages()
    assert news.texts((FENCE,), 0.0) == ["guard: goal is outside the fence or in a keep-out"]
    assert news.texts((FENCE,), 0.05) == []
    assert news.texts((), 10.0) == []
    assert news.texts((FENCE,), 29.9) == []
    assert news.texts((FENCE,), 30.0) == ["guard: goal is outside the fence or in a keep-out"]
    assert news.texts((FENCE,), 30.1) == []


def test_every_reason_has_a_time_of_its_own() -> None:
    news = GuardMessages()
    assert len(news.texts((FENCE,), 0.0)) == 1
    assert news.texts((FENCE, JUMPED), 1.0) == [f"guard: {JUMPED.value}"]


def test_what_every_corner_brings_is_not_reported() -> None:
    assert GuardMessages().texts((LAGGING, GuardReason.CUT_OFF), 0.0) == []


def test_the_log_has_every_change_but_not_every_flicker() -> None:
    news = GuardMessages()
    assert news.record((), 0.0) is None
    assert news.record((LAGGING,), 0.0) == ["lagging"]
    assert news.record((LAGGING,), 0.05) is None
    assert news.record((), 0.1) is None
    assert news.record((FENCE, LAGGING), 1.0) == ["fence", "lagging"]
    assert news.record((), 2.0) == []
    assert news.record((), 9.0) is None


def _engaged(battery_pct: float | None) -> ScriptedFlight:
    flight = ScriptedFlight()
    flight.give(BatteryReported(0.0, battery_pct, BatteryLevel.UNKNOWN))
    flight.ready()
    flight.show(FlightMode.OFFBOARD)
    flight.follows = True
    flight.fly(20.0)
    return flight


def _farthest_m(flight: ScriptedFlight) -> float:
    return max(math.hypot(*position[:2]) for position in flight.setpoints)


def test_a_charged_battery_flies_and_says_nothing() -> None:
    flight = _engaged(100.0)
    assert _farthest_m(flight) > 20.0
    assert not [text for text in flight.texts if text.startswith("guard:")]


def test_an_unknown_battery_goes_no_farther_from_home_and_the_operator_is_reported() -> None:
    flight = _engaged(None)
    assert _farthest_m(flight) < 0.1
    texts = [text for text in flight.texts if text.startswith("guard:")]
    assert texts == ["guard: battery charge is unknown: no farther from home"]
    records = [c.fields["reasons"] for c in flight.sent(Record) if c.kind == "guard"]
    assert records == [["battery_unknown"]]


def test_a_low_battery_reaches_as_far_as_it_brings_back() -> None:
    """20.15 % with 15 % for a kilometre and 20 % reserve: 10 m."""
    flight = _engaged(20.15)
    assert 9.0 < _farthest_m(flight) <= 10.001
    assert "guard: battery is too low to go farther from home" in flight.texts


def test_a_fence_is_logged_when_it_is_another_one() -> None:
    news, corners = FenceMessages(), ((0.0, 0.0), (60.0, 0.0), (0.0, 60.0))
    assert news.record(None) is None
    first = news.record(Fence(corners, 3.0))
    assert first == {"polygon_enu_m": corners, "keep_out_enu_m": (), "margin_m": 3.0}
    assert news.record(Fence(corners, 3.0)) is None
    assert news.record(Fence(corners, 4.0)) is not None
    gone = news.record(None)
    assert gone is not None
    assert gone["polygon_enu_m"] is None


def test_a_flight_logs_its_fence_once() -> None:
    flight = _engaged(100.0)
    kinds = [command.kind for _, command in flight.log if isinstance(command, Record)]
    assert kinds.count("fence") == 1
