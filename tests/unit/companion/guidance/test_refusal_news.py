from __future__ import annotations

import pytest

from companion.estimation.screen import RejectReason
from companion.guidance.commands import Announce, Record
from companion.guidance.messages import MANY, TEXT_PERIOD_S, RejectMessages


def announced(reason: RejectReason, times_s: list[float]) -> tuple[list[Record], list[Announce]]:
    news = RejectMessages()
    commands = [command for time_s in times_s for command in news.messages_for(reason, time_s)]
    records = [command for command in commands if isinstance(command, Record)]
    return records, [command for command in commands if isinstance(command, Announce)]


def test_the_first_refusal_is_logged_at_once_and_the_rest_by_the_second() -> None:
    records, _ = announced(RejectReason.STALE, [0.05 * step for step in range(101)])
    assert [record.fields["count"] for record in records] == [1, 20, 20, 20, 20, 20]
    assert {record.fields["reason"] for record in records} == {"stale"}


def test_each_reason_has_a_rhythm_of_its_own() -> None:
    news = RejectMessages()
    assert len(news.messages_for(RejectReason.STALE, 0.0)) == 1
    assert len(news.messages_for(RejectReason.NOT_FINITE, 0.1)) == 1
    assert news.messages_for(RejectReason.STALE, 0.2) == []


def test_many_are_reported_to_people_once_a_minute() -> None:
    _, texts = announced(RejectReason.NOT_FINITE, [0.1 * step for step in range(1000)])
    assert len(texts) == 1 + int((99.9 - 0.1 * MANY) // TEXT_PERIOD_S)
    assert texts[0].text == "measurements rejected: not finite; check the radio"


@pytest.mark.parametrize("reason", [RejectReason.NO_POSITION, RejectReason.NO_YAW])
def test_what_the_autopilot_did_not_send_is_not_blamed_on_the_radio(reason: RejectReason) -> None:
    """A second of delay on the autopilot's line: 'position unknown; check the radio'."""
    _, texts = announced(reason, [0.1 * step for step in range(2 * MANY)])
    assert [each.text for each in texts] == [
        f"measurements rejected: {reason.value}; check rates and link"
    ]


def test_a_few_are_not_nor_what_says_nothing_against_the_radio() -> None:
    assert announced(RejectReason.NOT_FINITE, [float(step) for step in range(200)])[1] == []
    assert announced(RejectReason.DUPLICATE, [0.1 * step for step in range(500)])[1] == []
