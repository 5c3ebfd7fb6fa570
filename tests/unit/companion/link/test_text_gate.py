"""The gate that every text passes: each cause once a period, states at the last, in a budget."""

from __future__ import annotations

import pytest

from companion.guidance.commands import Announce, Severity, Topic
from companion.link.text_gate import CAUSE_PERIOD_S, MAX_CAUSES, TextGate

BYTES_PER_S = 5760.0


def warning(text: str, topic: Topic | None = None, *, must_pass: bool = False) -> Announce:
    return Announce(Severity.WARNING, text, topic, must_pass=must_pass)


def passed(gate: TextGate, said: list[tuple[float, Announce]], until_s: float) -> list[str]:
    """Offer texts at their times, look for due ones at 20 Hz, and return what was announced."""
    shown: list[str] = []
    waiting = list(said)
    for tick in range(round(until_s * 20) + 1):
        now_s = tick / 20
        shown += [text.text for text in gate.due(now_s)]
        while waiting and waiting[0][0] <= now_s:
            if gate.admit(waiting[0][1], now_s):
                shown.append(waiting[0][1].text)
            del waiting[0]
    return shown


def flapping(first: Announce, second: Announce, until_s: float) -> list[tuple[float, Announce]]:
    return [(n / 2, (first, second)[n % 2]) for n in range(round(2 * until_s))]


def test_a_cause_is_announced_once_a_period_whatever_its_figures() -> None:
    said = [(n / 10, warning(f"vehicle position jumped by {n / 10:.1f} m")) for n in range(900)]
    assert len(passed(TextGate(BYTES_PER_S), said, 90.0)) == 90.0 / CAUSE_PERIOD_S


def test_names_systems_and_emitters_tell_causes_apart() -> None:
    texts = ["radio uwb1: silent", "radio uwb2: silent", "emitter 7 lost", "emitter 8 lost"]
    said = [(0.0, warning(text)) for text in texts]
    assert passed(TextGate(BYTES_PER_S), said, 1.0) == texts


def test_a_state_that_flaps_at_2_hz_is_announced_a_few_times_a_minute() -> None:
    waiting = warning("waiting for own position", Topic.READINESS)
    ready = warning("ready: switch to GUIDED", Topic.READINESS)
    shown = passed(TextGate(BYTES_PER_S), flapping(waiting, ready, 236.0), 236.0)
    assert len(shown) <= 2 * (236.0 // CAUSE_PERIOD_S + 1) + 1


@pytest.mark.parametrize("ends_with", [0, 1])
def test_the_last_text_of_a_topic_is_the_present_state(ends_with: int) -> None:
    states = (warning("hold: no ranging", Topic.PLAN), warning("following the plan", Topic.PLAN))
    said = flapping(*states, 10.0)
    said = said if ends_with else said[:-1]
    shown = passed(TextGate(BYTES_PER_S), said, 10.0 + CAUSE_PERIOD_S)
    assert shown[-1] == states[ends_with].text


def test_the_same_state_after_another_one_is_the_same_cause() -> None:
    said = ["hold: no ranging", "following the plan", "hold: stale", "following the plan"]
    timed = [(float(n), warning(text, Topic.PLAN)) for n, text in enumerate(said)]
    assert passed(TextGate(BYTES_PER_S), timed, 30.0) == said[:3]
    assert passed(TextGate(BYTES_PER_S), timed, 31.0) == said


def test_a_list_of_what_is_waited_for_is_one_cause_and_shown_as_it_is_at_last() -> None:
    """After a start the inputs come one after the other."""
    lists = ["a position and a home and a fence", "a home and a fence", "a fence"]
    said = [
        (float(n), warning(f"GUIDED without control: waiting for {waited}", Topic.READINESS))
        for n, waited in enumerate(lists)
    ]
    assert passed(TextGate(BYTES_PER_S), said, 29.0) == [said[0][1].text]
    assert passed(TextGate(BYTES_PER_S), said, 31.0) == [said[0][1].text, said[2][1].text]


def test_a_text_that_must_pass_counts_for_the_ones_that_need_not() -> None:
    plan = "following the plan"
    said = [(0.0, warning(plan, Topic.PLAN, must_pass=True)), (5.0, warning(plan, Topic.PLAN))]
    assert passed(TextGate(BYTES_PER_S), said, 60.0) == [plan]


def test_a_state_that_stays_is_announced_again_after_a_period_only() -> None:
    said = [(float(n), warning("waiting for home", Topic.READINESS)) for n in range(59)]
    assert len(passed(TextGate(BYTES_PER_S), said, 59.0)) == 2


def test_changes_of_control_always_pass() -> None:
    said = [(float(n), warning("control lost", must_pass=True)) for n in range(10)]
    assert len(passed(TextGate(BYTES_PER_S), said, 10.0)) == 10


def test_texts_keep_to_one_per_cent_of_the_downlink() -> None:
    gate = TextGate(BYTES_PER_S)
    sent = sum(66 for n in range(6000) if gate.fits(warning(str(n)), 66, n / 100))
    assert 3300 < sent <= 0.01 * BYTES_PER_S * 60.0
    assert gate.fits(warning("x"), 66, 130.0)


def test_errors_and_control_exceed_the_budget_rather_than_get_lost() -> None:
    gate = TextGate(BYTES_PER_S)
    while gate.fits(warning("chatter"), 66, 0.0):
        pass
    assert gate.unsent == 1
    assert gate.fits(Announce(Severity.ERROR, "battery critical"), 66, 1.0)
    assert gate.fits(warning("control lost", must_pass=True), 66, 1.0)


def test_invented_causes_do_not_fill_the_memory() -> None:
    gate = TextGate(BYTES_PER_S)
    for n in range(20_000):
        gate.admit(warning(f"emitter {n} lost"), float(n))
    assert len(gate._announced_s) <= MAX_CAUSES + 1
