"""The robust losses as the paper states them: Propositions A.1 to A.4 and their consequences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.estimation.losses import (
    asymmetric_huber_influence,
    asymmetric_huber_loss,
    asymmetric_huber_weight,
    map_bias_m,
    threshold_k_from_lambda,
)

residuals = st.floats(-1e4, 1e4)
thresholds = st.floats(0.01, 100.0) | st.just(math.inf)
rates_per_m = st.floats(0.01, 10.0)
sigmas_m = st.floats(0.05, 20.0)
residuals_m = st.floats(-200.0, 200.0)


@given(residuals, thresholds, thresholds)
def test_the_weight_is_positive_and_at_most_one(u: float, k_long: float, k_short: float) -> None:
    assert 0.0 < asymmetric_huber_weight(u, k_long, k_short) <= 1.0


@given(residuals, thresholds, thresholds)
def test_weight_times_residual_is_the_influence(u: float, k_long: float, k_short: float) -> None:
    weighted = asymmetric_huber_weight(u, k_long, k_short) * u
    assert weighted == pytest.approx(asymmetric_huber_influence(u, k_long, k_short), rel=1e-12)


@given(st.floats(-50.0, 50.0), thresholds, thresholds)
def test_the_influence_is_the_derivative_of_the_loss(
    u: float, k_long: float, k_short: float
) -> None:
    h = 1e-5
    above = asymmetric_huber_loss(u + h, k_long, k_short)
    below = asymmetric_huber_loss(u - h, k_long, k_short)
    influence = asymmetric_huber_influence(u, k_long, k_short)
    # Across a threshold the central difference is off by up to h / 4, the rest is rounding.
    assert (above - below) / (2.0 * h) == pytest.approx(influence, abs=h)


@given(residuals, st.floats(0.0, 10.0), thresholds, thresholds)
def test_the_influence_is_continuous_and_grows(
    u: float, further: float, k_long: float, k_short: float
) -> None:
    influence = asymmetric_huber_influence(u, k_long, k_short)
    next_influence = asymmetric_huber_influence(u + further, k_long, k_short)
    assert 0.0 <= next_influence - influence <= (u + further) - u


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_loss_and_weight_are_continuous_at_the_thresholds(k_long: float, k_short: float) -> None:
    for k in (k_long, -k_short):
        beyond = math.nextafter(k, math.copysign(math.inf, k))
        for function in (
            asymmetric_huber_loss,
            asymmetric_huber_influence,
            asymmetric_huber_weight,
        ):
            at, after = function(k, k_long, k_short), function(beyond, k_long, k_short)
            assert after == pytest.approx(at, rel=1e-12)


@given(residuals, residuals, st.floats(0.0, 1.0), thresholds, thresholds)
def test_the_loss_is_convex(
    a: float, b: float, share: float, k_long: float, k_short: float
) -> None:
    between = asymmetric_huber_loss(share * a + (1.0 - share) * b, k_long, k_short)
    chord = share * asymmetric_huber_loss(a, k_long, k_short) + (
        1.0 - share
    ) * asymmetric_huber_loss(b, k_long, k_short)
    assert between <= chord + 1e-12 * (1.0 + chord)


@given(residuals, thresholds)
def test_equal_thresholds_are_symmetric(u: float, k: float) -> None:
    assert asymmetric_huber_loss(u, k, k) == asymmetric_huber_loss(-u, k, k)
    assert asymmetric_huber_weight(u, k, k) == asymmetric_huber_weight(-u, k, k)


@given(residuals, thresholds, thresholds)
def test_exchanged_thresholds_mirror_the_loss(u: float, k_long: float, k_short: float) -> None:
    mirrored = asymmetric_huber_loss(-u, k_short, k_long)
    assert asymmetric_huber_loss(u, k_long, k_short) == mirrored


@given(st.floats(0.1, 100.0), st.floats(0.01, 50.0))
def test_the_one_sided_loss_is_asymmetric_beyond_its_threshold(excess: float, k: float) -> None:
    long, short = (asymmetric_huber_loss(sign * (k + excess), k, math.inf) for sign in (1, -1))
    assert long < short


@given(st.floats(-1e4, 0.0), thresholds)
def test_the_one_sided_loss_is_quadratic_for_everything_too_short(u: float, k: float) -> None:
    assert asymmetric_huber_loss(u, k, math.inf) == 0.5 * u * u
    assert asymmetric_huber_weight(u, k, math.inf) == 1.0


@given(residuals)
def test_infinite_thresholds_are_least_squares(u: float) -> None:
    assert asymmetric_huber_loss(u, math.inf, math.inf) == 0.5 * u * u
    assert asymmetric_huber_influence(u, math.inf, math.inf) == u
    assert asymmetric_huber_weight(u, math.inf, math.inf) == 1.0


def _map_cost(bias_m: float, residual_m: float, rate_per_m: float, sigma_m: float) -> float:
    return (residual_m - bias_m) ** 2 / (2.0 * sigma_m**2) + rate_per_m * bias_m


@given(residuals_m, rates_per_m, sigmas_m, st.floats(0.0, 400.0))
def test_a1_no_other_bias_is_more_probable_than_the_closed_form(
    residual_m: float, rate_per_m: float, sigma_m: float, other_m: float
) -> None:
    best_m = map_bias_m(residual_m, rate_per_m, sigma_m)
    assert best_m >= 0.0
    best = _map_cost(best_m, residual_m, rate_per_m, sigma_m)
    other = _map_cost(other_m, residual_m, rate_per_m, sigma_m)
    curvature = (other_m - best_m) ** 2 / (2.0 * sigma_m**2)  # strictly convex: it is unique
    assert other >= best + curvature - 1e-9 * (1.0 + other)


@given(residuals_m, rates_per_m, sigmas_m)
def test_a1_the_closed_form_is_where_the_gradient_vanishes_or_the_border(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    bias_m = map_bias_m(residual_m, rate_per_m, sigma_m)
    slope = (bias_m - residual_m) / sigma_m**2 + rate_per_m
    if bias_m > 0.0:
        assert slope == pytest.approx(0.0, abs=1e-9 * (1.0 + abs(residual_m) / sigma_m**2))
    else:
        assert slope >= -1e-9


@given(residuals_m, rates_per_m, sigmas_m)
def test_a2_and_a4_the_marginalised_cost_is_the_loss_with_k_equal_to_lambda_sigma(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    bias_m = map_bias_m(residual_m, rate_per_m, sigma_m)
    marginalised = _map_cost(bias_m, residual_m, rate_per_m, sigma_m)
    k = threshold_k_from_lambda(rate_per_m, sigma_m)
    loss = asymmetric_huber_loss(residual_m / sigma_m, k, math.inf)
    assert loss == pytest.approx(marginalised, rel=1e-9, abs=1e-9)


@given(residuals_m, rates_per_m, sigmas_m)
def test_a2_the_two_branches_are_those_printed(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    tau_m = rate_per_m * sigma_m**2
    if residual_m <= tau_m:
        printed = residual_m**2 / (2.0 * sigma_m**2)
    else:
        printed = rate_per_m * residual_m - 0.5 * rate_per_m**2 * sigma_m**2
    loss = asymmetric_huber_loss(residual_m / sigma_m, rate_per_m * sigma_m, math.inf)
    assert loss == pytest.approx(printed, rel=1e-9, abs=1e-9)


@given(residuals_m, rates_per_m, sigmas_m)
def test_a3_the_slope_of_the_cost_never_exceeds_the_rate(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    k = threshold_k_from_lambda(rate_per_m, sigma_m)
    assume(k > 0.0)
    slope_per_m = asymmetric_huber_influence(residual_m / sigma_m, k, math.inf) / sigma_m
    tau_m = k * sigma_m
    printed = min(residual_m, tau_m) / sigma_m**2
    assert slope_per_m == pytest.approx(printed, rel=1e-12)
    assert slope_per_m <= rate_per_m * (1.0 + 1e-12)


def test_a1_against_a_search_over_a_fine_grid() -> None:
    grid_m = np.linspace(0.0, 30.0, 30_001)
    for residual_m in (-4.0, 0.0, 0.2, 0.3, 5.0, 25.0):
        cost = (residual_m - grid_m) ** 2 / (2.0 * 1.5**2) + 0.125 * grid_m
        found_m = float(grid_m[np.argmin(cost)])
        assert map_bias_m(residual_m, 0.125, 1.5) == pytest.approx(found_m, abs=1e-3)
