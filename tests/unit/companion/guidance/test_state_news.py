"""The state of the estimate is announced with hysteresis, and views show what was announced."""

from __future__ import annotations

from collections.abc import Sequence

from companion.domain import EstimateState, TargetEstimate
from companion.guidance.messages import StateMessages

SEARCHING, AMBIGUOUS = EstimateState.SEARCHING, EstimateState.AMBIGUOUS
LOCALISED, DIVERGED = EstimateState.LOCALISED, EstimateState.DIVERGED
PERIOD_S, SETTLE_S = 0.5, 5.0


def estimate(state: EstimateState, now_s: float = 0.0) -> TargetEstimate:
    return TargetEstimate(now_s, state, (0.0, 0.0), ((1.0, 0.0), (0.0, 1.0)), 3.0, 0.0, 0.0, 9)


def announced(news: StateMessages, states: Sequence[EstimateState]) -> list[tuple[int, str]]:
    """Return the states that are announced, by index, and their texts; one per measurement."""
    lines = []
    for number, state in enumerate(states):
        now_s = PERIOD_S * number
        if news.is_due(estimate(state, now_s), now_s, SETTLE_S):
            lines.append((number, news.shown(estimate(state), now_s, SETTLE_S).state.value))
    return lines


def test_a_second_place_that_comes_and_goes_is_announced_once() -> None:
    flicker = [SEARCHING] * 4 + [AMBIGUOUS, SEARCHING, SEARCHING] * 20
    assert announced(StateMessages(), flicker) == [(0, "searching"), (4, "ambiguous")]


def test_an_end_of_it_is_announced_when_it_lasts() -> None:
    lasting = [AMBIGUOUS, SEARCHING, AMBIGUOUS] + [SEARCHING] * 30
    patience = round(SETTLE_S / PERIOD_S)
    assert announced(StateMessages(), lasting) == [(0, "ambiguous"), (2 + patience, "searching")]


def test_what_asks_for_more_caution_never_waits() -> None:
    states = [SEARCHING, LOCALISED, AMBIGUOUS, DIVERGED]
    names = [state.value for state in states]
    assert announced(StateMessages(), states) == list(enumerate(names))


def test_a_radius_at_its_threshold_is_announced_as_localised_once() -> None:
    states = [SEARCHING, *[LOCALISED, SEARCHING] * 20]
    assert announced(StateMessages(), states) == [(0, "searching"), (1, "localised")]


def test_after_a_resumed_estimate_its_state_is_no_news() -> None:
    news = StateMessages()
    news.begin(estimate(AMBIGUOUS))
    assert announced(news, [AMBIGUOUS, SEARCHING]) == []


def test_what_is_shown_settles_by_itself_where_nothing_is_measured_any_more() -> None:
    news = StateMessages()
    news.begin(estimate(AMBIGUOUS))
    now = estimate(LOCALISED, 1.0)
    assert not news.is_due(now, 1.0, SETTLE_S)
    assert news.shown(now, 1.0, SETTLE_S).state is AMBIGUOUS
    assert news.shown(now, SETTLE_S, SETTLE_S).state is LOCALISED
