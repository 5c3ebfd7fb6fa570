"""The end of a search where the radius to stop at is out of reach."""

from __future__ import annotations

import pytest

from companion.domain import EstimateState, TargetEstimate
from companion.guidance.reporting import MAX_SETTLED_M, SettledRule

SETTLE_S = 30.0


def _estimate(r95_m: float, state: EstimateState = EstimateState.SEARCHING) -> TargetEstimate:
    return TargetEstimate(0.0, state, (0.0, 0.0), ((1.0, 0.0), (0.0, 1.0)), r95_m, 0.0, 0.0, 9)


def _met_at(radii_m: list[float]) -> int | None:
    """The second at which the rule is met, a radius a second; None: never."""
    rule = SettledRule()
    for now_s, r95_m in enumerate(radii_m):
        if rule.is_met(_estimate(r95_m), float(now_s), SETTLE_S):
            return now_s
    return None


def test_a_radius_that_does_not_improve_any_more_is_reported() -> None:
    assert _met_at([40.0, 30.0, 20.0, *[12.0 + 0.3 * (s % 3) for s in range(60)]]) == 33


def test_a_radius_that_improves_slowly_is_waited_for() -> None:
    assert _met_at([40.0 * 0.995**s for s in range(300)]) is None


def test_a_radius_that_grows_is_looked_at_again() -> None:
    assert _met_at([10.0] * 20 + [25.0] * 60) == 50


def test_a_place_that_may_be_anywhere_never_settles() -> None:
    assert _met_at([MAX_SETTLED_M + 1.0] * 100) is None


def test_a_wide_position_settles_unless_a_narrower_one_is_configured() -> None:
    rule = SettledRule()
    wide = _estimate(MAX_SETTLED_M + 20.0, EstimateState.LOCALISED)
    assert [rule.is_met(wide, t, SETTLE_S) for t in (0.0, 29.0, 30.0)] == [False, False, True]


def test_two_places_never_settle() -> None:
    rule = SettledRule()
    two = _estimate(5.0, EstimateState.AMBIGUOUS)
    assert not any(rule.is_met(two, float(s), SETTLE_S) for s in range(100))


@pytest.mark.parametrize("gap_s", [1.0, 12.0, 300.0])
def test_time_without_measurements_is_no_time_without_improvement(gap_s: float) -> None:
    rule = SettledRule()
    assert not any(rule.is_met(_estimate(5.0), float(s), SETTLE_S) for s in range(25))
    assert not rule.is_met(None, 24.0, SETTLE_S)
    again_s = 24.0 + gap_s
    after = [rule.is_met(_estimate(5.0), again_s + s, SETTLE_S) for s in range(8)]
    assert after == [False] * 6 + [True] * 2


def test_a_measurement_that_is_seen_many_times_counts_once() -> None:
    rule = SettledRule()
    assert not any(rule.is_met(_estimate(5.0), 3.0, SETTLE_S) for _ in range(2000))
