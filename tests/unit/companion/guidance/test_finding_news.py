from __future__ import annotations

from collections.abc import Sequence

import pytest

from companion.domain import Autopilot, FlightMode
from companion.guidance.context import CLEARED_AFTER_S, REANNOUNCE_S, FindingMessages
from companion.guidance.control import TICK_S
from companion.guidance.control_authority import Finding, Reason, Verdict
from companion.guidance.events import OperatorCommand, OperatorCommandReceived
from companion.link.outbound import TEXT_LENGTH
from tests.unit.companion.guidance.scripted import ScriptedFlight

STALE = Finding(Verdict.HOLD, Reason.POSITION_STALE, "")
NO_LINK = Finding(Verdict.HOLD, Reason.NO_LINK, "")
AGES = Finding(Verdict.SLOW, Reason.RANGING_AGES, "")


def announced(
    news: FindingMessages, findings: Sequence[Finding | None], since_s: float = 0.0
) -> list[int]:
    """Return the indices of the findings, one a tick, that are announced."""
    return [i for i, each in enumerate(findings) if news.take(each, since_s + i * TICK_S)]


def test_a_reason_is_reported_at_once_and_once() -> None:
    assert announced(FindingMessages(), [STALE] * 100) == [0]


def test_that_nothing_is_wrong_is_no_news_at_first_and_news_after_something_was() -> None:
    assert announced(FindingMessages(), [None] * 30) == []
    assert announced(FindingMessages(), [STALE] * 30 + [None] * 30) == [0, 30]


def test_two_reasons_that_take_turns_are_reported_once_each() -> None:
    ticks = round(0.9 * REANNOUNCE_S / TICK_S)
    assert announced(FindingMessages(), [STALE, NO_LINK] * (ticks // 2)) == [0, 1]


def test_what_lasts_is_reported_a_moment_after_it_began() -> None:
    flicker: list[Finding | None] = [STALE, NO_LINK] * 10
    moment = round(CLEARED_AFTER_S / TICK_S)
    assert announced(FindingMessages(), flicker + [STALE] * 100) == [
        0,
        1,
        len(flicker) - 1 + moment,
    ]


def test_what_is_worse_does_not_wait() -> None:
    news = FindingMessages()
    assert announced(news, [STALE] * 20 + [AGES] * 40) == [0, 20]
    assert announced(news, [STALE, AGES] * 20, 3.0) == [0]


def test_a_lost_link_never_waits() -> None:
    news = FindingMessages()
    outage = [STALE] * 10 + [NO_LINK] * 20 + [None] * 20
    assert announced(news, [*outage, *outage]) == [0, 10, 30, 50, 60, 99]


def test_reasons_that_take_turns_in_flight_are_reported_calmly() -> None:
    """The operator's command hides the missing ranging in every other tick."""
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(6.0)
    since = len(flight.texts)
    for _ in range(60):
        flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.HOLD))
        flight.fly(TICK_S)
        flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.RESUME))
        flight.fly(TICK_S)
    answers = {"HOLD accepted", "RESUME accepted"}
    announced = [text for text in flight.texts[since:] if text not in answers]
    assert announced == ["hold: operator requested hold"]
    assert len(flight.records("finding")) < 10


def test_control_that_begins_has_nothing_cleared() -> None:
    flight = ScriptedFlight().in_control()
    about = [text for text in flight.texts if text.startswith("following the plan")]
    assert about == ["following the plan"]


def test_a_mode_that_ends_control_promises_ready_only_without_a_failsafe() -> None:
    """The mode may come a HEARTBEAT before the failsafe that caused it."""
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.RETURN)
    flight.fly(0.1)
    assert flight.texts[-1].endswith("ready again after 2 s in that mode without a failsafe")
    flight.show(FlightMode.RETURN, is_failsafe=True)
    flight.fly(5.0)
    assert flight.texts[-1].startswith("grant needed, failsafe")


@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
def test_the_texts_of_an_uneventful_flight_fit_one_statustext(autopilot: Autopilot) -> None:
    flight = ScriptedFlight(autopilot=autopilot).in_control()
    flight.has_ranging = False
    flight.fly(3.0)
    flight.has_ranging = flight.follows = True
    flight.fly_until_reported()
    flight.fly(10.0)
    own = [text for text in flight.texts if "position jumped" not in text]
    assert [text for text in own if len(text) > TEXT_LENGTH] == []
