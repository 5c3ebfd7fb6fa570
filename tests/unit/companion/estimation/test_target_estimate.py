"""From hypotheses to the estimate: position, R95, state."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import DEFAULT_ACCURACY, EstimateState, PositionAccuracy, TargetEstimate
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.estimation.hypotheses import AMBIGUOUS_PROBABILITY, Hypothesis, consolidated
from companion.estimation.target_estimate import (
    MAX_AMBIGUOUS,
    KeptEstimate,
    aside_of_m,
    estimate_of,
    position_covariance_m2,
)
from companion.estimation.window.shared_errors import SharedErrors

R95_OF_EQUAL_AXES = 2.447746830680816
"""sqrt of the chi-square 0.95 quantile with 2 degrees of freedom."""
PLANE = FilterParams(own_position_sigma_m=0.3, target_height_m=2.0)


def _hypothesis(
    east_m: float = 0.0,
    probability: float = 1.0,
    sigma_m: float = 0.4,
    least_m: float | None = None,
    params: FilterParams = PLANE,
) -> Hypothesis:
    mean, sigmas = params.prior
    mean[:4] = east_m, 10.0, 1.5, -0.02
    sigmas[:2] = sigma_m
    least = None if least_m is None else least_m**2 * np.eye(2)
    state = FilterState.of(0.0, mean, np.diag(sigmas**2))
    return Hypothesis(math.log(probability), state, least)


def _stated(
    *hypotheses: Hypothesis,
    params: FilterParams = PLANE,
    is_diverged: bool = False,
    own: PositionAccuracy = DEFAULT_ACCURACY,
    lasting_m: float = 0.0,
    wander_m: float = 0.0,
) -> TargetEstimate:
    shared = SharedErrors(lasting_m**2 * np.eye(2), wander_m**2 * np.eye(2), own)
    return estimate_of(
        hypotheses, params.model, 2.0, 77, 5.0, is_diverged=is_diverged, shared=shared
    )


def test_one_place_is_reported_with_the_vehicles_own_error() -> None:
    estimate = _stated(_hypothesis())
    assert estimate.position_enu_m == (0.0, 10.0)
    np.testing.assert_allclose(estimate.covariance_m2, 0.25 * np.eye(2))
    assert estimate.r95_m == pytest.approx(0.5 * R95_OF_EQUAL_AXES)
    assert estimate.state is EstimateState.LOCALISED
    assert (estimate.range_offset_m, estimate.bearing_offset_rad) == (1.5, -0.02)
    assert (estimate.time_s, estimate.measurements) == (5.0, 77)
    assert estimate.alternative_enu_m is None


def test_a_vague_place_is_still_being_searched() -> None:
    estimate = _stated(_hypothesis(sigma_m=1.5))
    assert estimate.r95_m > 2.0
    assert estimate.state is EstimateState.SEARCHING


def test_a_filter_that_was_started_again_is_diverged_whatever_it_says() -> None:
    assert _stated(_hypothesis(), is_diverged=True).state is EstimateState.DIVERGED
    two = (_hypothesis(0.0, 0.5), _hypothesis(50.0, 0.5))
    estimate = _stated(*two, is_diverged=True)
    assert estimate.state is EstimateState.DIVERGED
    assert estimate.alternative_enu_m is None


def test_two_likely_places_are_ambiguous_and_both_are_reported() -> None:
    estimate = _stated(_hypothesis(0.0, 0.6), _hypothesis(50.0, 0.4))
    assert estimate.state is EstimateState.AMBIGUOUS
    assert estimate.position_enu_m == (0.0, 10.0)
    assert estimate.alternative_enu_m == (50.0, 10.0)
    assert 49.0 < estimate.r95_m < 52.0


@pytest.mark.parametrize(
    ("probability", "state"),
    [
        (0.9 * AMBIGUOUS_PROBABILITY, EstimateState.LOCALISED),
        (1.1 * AMBIGUOUS_PROBABILITY, EstimateState.AMBIGUOUS),
    ],
)
def test_an_unlikely_one_does_not_count(probability: float, state: EstimateState) -> None:
    estimate = _stated(_hypothesis(0.0, 1.0 - probability), _hypothesis(50.0, probability))
    assert estimate.state is state


@pytest.mark.parametrize("probability", [0.5, 0.9, 0.99])
def test_places_too_vague_to_be_distinguished_keep_the_circle_of_both(probability: float) -> None:
    both = [
        _hypothesis(-2.7, probability, sigma_m=2.5, least_m=2.5),
        _hypothesis(2.7, 1.0 - probability, sigma_m=2.5, least_m=2.5),
    ]
    merged = consolidated(both)
    assert len(merged) == 1
    assert _stated(*merged).position_enu_m == (-2.7, 10.0)
    assert _stated(*merged).r95_m == pytest.approx(_stated(*both).r95_m, rel=0.1)


def test_many_places_are_no_place() -> None:
    ring = [_hypothesis(50.0 * i, 1.0) for i in range(MAX_AMBIGUOUS + 1)]
    assert _stated(*ring).state is EstimateState.SEARCHING
    assert _stated(*ring[:-1]).state is EstimateState.AMBIGUOUS


def test_certainty_is_not_below_what_the_window_found() -> None:
    assert np.diag(position_covariance_m2(_hypothesis(least_m=0.9), 0.3)) == pytest.approx(0.9)
    assert np.diag(position_covariance_m2(_hypothesis(least_m=0.1), 0.3)) == pytest.approx(0.25)
    assert _stated(_hypothesis(least_m=0.9)).r95_m == pytest.approx(
        math.hypot(0.9, 0.3) * R95_OF_EQUAL_AXES
    )
    assert _stated(_hypothesis(least_m=5.0)).state is EstimateState.SEARCHING


def test_height_and_scale_are_reported_as_known_or_as_estimated() -> None:
    known = _stated(_hypothesis())
    assert (known.height_m, known.height_sigma_m, known.range_scale) == (2.0, None, 0.0)
    params = FilterParams(target_height_m=2.0, target_height_sigma_m=1.25, range_scale_sigma=0.05)
    mean, sigmas = params.prior
    mean[4:] = 0.03, 6.0
    state = FilterState.of(0.0, mean, np.diag(sigmas**2))
    estimate = _stated(Hypothesis(0.0, state), params=params)
    assert (estimate.height_m, estimate.height_sigma_m, estimate.range_scale) == (6.0, 1.25, 0.03)


RTK = PositionAccuracy(0.02, 0.03, is_reported=True)
CITY = PositionAccuracy(6.0, 9.0, is_reported=True)


@pytest.mark.parametrize("own", [DEFAULT_ACCURACY, RTK, CITY])
def test_the_absolute_radius_has_the_own_place_in_it(own: PositionAccuracy) -> None:
    estimate = _stated(_hypothesis(), own=own)
    expected_m = math.hypot(0.5, own.effective_m) * R95_OF_EQUAL_AXES
    assert estimate.absolute_r95_m == pytest.approx(expected_m)
    grown = (0.25 + own.effective_m**2) * np.eye(2)
    np.testing.assert_allclose(estimate.absolute_covariance_m2, grown)
    assert estimate.own == own


def test_a_receiver_without_corrections_counts_half_as_much_again() -> None:
    assert (CITY.effective_m, RTK.effective_m, DEFAULT_ACCURACY.effective_m) == (9.0, 0.02, 3.0)


@pytest.mark.parametrize("own", [RTK, CITY])
def test_the_own_place_changes_nothing_that_stops_the_search(own: PositionAccuracy) -> None:
    for hypotheses in ([_hypothesis()], [_hypothesis(0.0, 0.6), _hypothesis(50.0, 0.4)]):
        here, there = _stated(*hypotheses), _stated(*hypotheses, own=own)
        assert here.settled_r95_m == there.settled_r95_m
        assert (here.state, here.covariance_m2) == (there.state, there.covariance_m2)


def test_the_absolute_radius_counts_rivals_and_never_promises_more() -> None:
    rivals = (_hypothesis(0.0, 0.6), _hypothesis(50.0, 0.4))
    assert _stated(*rivals, own=CITY).absolute_r95_m > _stated(*rivals).r95_m > 49.0
    for share in np.linspace(0.02, 0.12, 21):
        rivals = (_hypothesis(0.0, 1.0 - share), _hypothesis(12.0, share))
        estimate = _stated(*rivals, own=CITY)
        assert estimate.absolute_r95_m >= estimate.r95_m


def test_a_missing_radius_is_that_of_round_errors() -> None:
    estimate = TargetEstimate(
        0.0, EstimateState.LOCALISED, (0.0, 0.0), ((1, 0), (0, 1)), 1.0, 0, 0, 9
    )
    assert estimate.absolute_r95_m == pytest.approx(math.hypot(1.0, 3.0 * R95_OF_EQUAL_AXES))
    assert not estimate.own.is_reported


def test_a_radius_that_is_no_number_does_not_become_a_good_one() -> None:
    lost = replace(_stated(_hypothesis()), r95_m=math.nan)
    assert math.isnan(lost.absolute_r95_m)
    estimate = replace(_stated(_hypothesis()), absolute_r95_m=math.nan)
    assert estimate.absolute_r95_m > estimate.r95_m


def test_a_height_that_is_estimated_has_the_own_height_in_it() -> None:
    estimate = TargetEstimate(
        0.0, EstimateState.LOCALISED, (0.0, 0.0), ((1, 0), (0, 1)), 1.0, 0, 0, 9
    )
    assert estimate.absolute_height_sigma_m is None
    estimated = replace(estimate, height_sigma_m=12.0, own=CITY)
    assert estimated.absolute_height_sigma_m == pytest.approx(15.0)


def test_drift_of_the_vehicle_position_counts_once_and_not_in_what_stops_the_search() -> None:
    still, wandering = _stated(_hypothesis()), _stated(_hypothesis(), wander_m=0.6)
    assert still.settled_r95_m == still.r95_m
    assert wandering.settled_r95_m == pytest.approx(R95_OF_EQUAL_AXES * 0.4)
    assert wandering.state is still.state
    at_least = _stated(_hypothesis(), wander_m=0.1)  # configured are 0.3 m
    assert at_least.r95_m == pytest.approx(R95_OF_EQUAL_AXES * 0.5)
    sigma_m = math.hypot(0.4, 0.6)
    assert wandering.r95_m == pytest.approx(R95_OF_EQUAL_AXES * sigma_m)
    assert wandering.absolute_r95_m >= wandering.r95_m


def test_of_two_places_it_is_reported_how_far_to_the_side_decides() -> None:
    assert aside_of_m(_stated(_hypothesis())) is None
    near, far = (_hypothesis(east, 0.5) for east in (6.0, 80.0))
    assert aside_of_m(_stated(_hypothesis(probability=0.5), near)) == 10.0
    assert aside_of_m(_stated(_hypothesis(probability=0.5), far)) == pytest.approx(20.0)


def test_what_another_view_would_show_keeps_the_search_going() -> None:
    lasting = _stated(_hypothesis(), lasting_m=1.2)
    assert lasting.settled_r95_m == lasting.r95_m
    assert lasting.r95_m == pytest.approx(R95_OF_EQUAL_AXES * math.hypot(0.4, 0.3, 1.2))
    assert lasting.state is EstimateState.SEARCHING


def test_an_estimate_is_kept_until_something_it_was_made_of_is_another_object() -> None:
    kept = KeptEstimate()
    made: list[TargetEstimate] = []

    def make() -> TargetEstimate:
        made.append(_stated(_hypothesis(east_m=float(len(made)))))
        return made[-1]

    hypotheses, count = (_hypothesis(),), 1000
    first = kept.get(make, hypotheses, count)
    assert kept.get(make, hypotheses, count) is first
    second = kept.get(make, (_hypothesis(),), count)
    assert second is not first
    assert kept.get(make, hypotheses, count + 1) is not second
    assert len(made) == 3
