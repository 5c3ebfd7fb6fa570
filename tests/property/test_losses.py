"""The robust losses as the paper states them: Propositions A.1 to A.4 and their consequences.

Every loss goes through the same suite first; what is particular to one follows.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from companion.estimation.filters.kalman import (
    asymmetric_huber_influence,
    asymmetric_huber_loss,
    asymmetric_huber_weight,
)
from tests.property.yardstick_losses import (
    RobustLoss,
    asymmetric_cauchy,
    asymmetric_huber,
    asymmetric_tukey,
    one_sided_huber,
    quadratic,
    smoothed_quantile,
    symmetric_huber,
)

residuals = st.floats(-1e4, 1e4)
near_residuals = st.floats(-50.0, 50.0)
thresholds = st.floats(0.01, 100.0) | st.just(math.inf)
scales = st.floats(0.1, 100.0)
levels = st.floats(0.05, 0.95)
bandwidths = st.floats(0.05, 10.0)
rates_per_m = st.floats(0.01, 10.0)
sigmas_m = st.floats(0.05, 20.0)
residuals_m = st.floats(-200.0, 200.0)

hubers = st.one_of(
    st.builds(quadratic),
    st.builds(symmetric_huber, thresholds),
    st.builds(one_sided_huber, thresholds),
    st.builds(asymmetric_huber, thresholds, thresholds),
)
redescending = st.one_of(
    st.builds(asymmetric_cauchy, scales, scales | st.just(math.inf)),
    st.builds(asymmetric_tukey, scales, scales | st.just(math.inf)),
)
quantiles = st.builds(smoothed_quantile, levels, bandwidths)
convex_losses = hubers | quantiles
losses = convex_losses | redescending


@given(losses, near_residuals)
def test_the_influence_is_the_derivative_of_the_loss(loss: RobustLoss, u: float) -> None:
    h = 1e-5
    slope = (loss.loss(u + h) - loss.loss(u - h)) / (2.0 * h)
    # Across a knot the central difference is off by up to h / 4 per unit of curvature.
    assert slope == pytest.approx(loss.influence(u), abs=5.0 * h)


@given(losses, residuals)
def test_weight_times_distance_from_the_centre_is_the_influence(loss: RobustLoss, u: float) -> None:
    weighted = loss.weight(u) * (u - loss.centre)
    assert weighted == pytest.approx(loss.influence(u), rel=1e-9, abs=1e-9)


@given(losses, residuals)
def test_nothing_costs_less_than_the_centre(loss: RobustLoss, u: float) -> None:
    assert loss.loss(u) >= loss.loss(loss.centre) * (1.0 - 1e-12)
    assert loss.influence(loss.centre) == 0.0
    assert loss.influence(u) * (u - loss.centre) >= 0.0


@given(hubers | redescending, residuals)
def test_no_measurement_counts_more_than_one(loss: RobustLoss, u: float) -> None:
    assert loss.centre == 0.0
    assert 0.0 <= loss.weight(u) <= 1.0
    assert loss.weight(0.0) == 1.0


@given(hubers, residuals)
def test_every_measurement_counts_where_nothing_redescends(loss: RobustLoss, u: float) -> None:
    assert loss.weight(u) > 0.0


@given(losses, st.data())
def test_loss_and_influence_are_continuous_at_the_knots(
    loss: RobustLoss, data: st.DataObject
) -> None:
    knot = data.draw(st.sampled_from(loss.knots)) if loss.knots else loss.centre
    for function in (loss.loss, loss.influence, loss.weight):
        at = function(knot)
        for beyond in (math.nextafter(knot, math.inf), math.nextafter(knot, -math.inf)):
            assert function(beyond) == pytest.approx(at, rel=1e-12, abs=1e-12)


@given(losses, near_residuals, st.floats(0.0, 1e-6))
def test_the_influence_does_not_jump(loss: RobustLoss, u: float, further: float) -> None:
    # No curvature exceeds 1, that of the quadratic, or 1 / (4 h) with h >= 0.05, 5.
    assert abs(loss.influence(u + further) - loss.influence(u)) <= 5.0 * further + 1e-12


@given(convex_losses, residuals, residuals, st.floats(0.0, 1.0))
def test_the_loss_is_convex_where_it_claims_so(
    loss: RobustLoss, a: float, b: float, share: float
) -> None:
    assert loss.is_convex
    between = loss.loss(share * a + (1.0 - share) * b)
    chord = share * loss.loss(a) + (1.0 - share) * loss.loss(b)
    assert between <= chord + 1e-12 * (1.0 + chord)


@given(convex_losses, residuals, st.floats(0.0, 10.0))
def test_the_influence_of_a_convex_loss_never_falls(
    loss: RobustLoss, u: float, further: float
) -> None:
    assert loss.influence(u + further) >= loss.influence(u) - 1e-12


@given(scales, st.floats(1.1, 3.0))
def test_the_redescending_losses_are_not_convex(scale: float, factor: float) -> None:
    cauchy, tukey = asymmetric_cauchy(scale, math.inf), asymmetric_tukey(scale, math.inf)
    for loss, near, far in (
        (cauchy, scale, factor * scale),
        (tukey, 0.6 * scale, 0.9 * scale),
    ):
        assert not loss.is_convex
        assert loss.influence(far) < loss.influence(near)
        assert loss.loss(0.5 * (near + far)) > 0.5 * (loss.loss(near) + loss.loss(far))


@pytest.mark.parametrize(
    "loss",
    [
        symmetric_huber(1.345),
        one_sided_huber(0.3),
        asymmetric_huber(1.0, 3.0),
        smoothed_quantile(0.25, 0.3),
        smoothed_quantile(0.05, 0.05),
        smoothed_quantile(0.9, 1.0),
    ],
    ids=lambda loss: loss.name,
)
def test_reweighted_least_squares_ends_where_the_sum_of_losses_is_least(loss: RobustLoss) -> None:
    rng = np.random.default_rng(7)
    values = rng.normal(2.0, 1.0, 101) + rng.exponential(4.0, 101) * (rng.random(101) < 0.6)
    location = float(np.mean(values))
    for _ in range(2000):
        weights = np.array([loss.weight(float(v) - location) for v in values])
        location = float(np.sum(weights * (values - loss.centre)) / np.sum(weights))
    best = minimize_scalar(
        lambda at: sum(loss.loss(float(v) - at) for v in values),
        bounds=(-10.0, 30.0),
        method="bounded",
        options={"xatol": 1e-10},
    )
    assert location == pytest.approx(float(best.x), abs=1e-6)


@given(residuals, st.builds(lambda k: (k, symmetric_huber(k)), thresholds))
def test_a_named_loss_is_its_kernels(u: float, pair: tuple[float, RobustLoss]) -> None:
    k, loss = pair
    assert loss.loss(u) == asymmetric_huber_loss(u, k, k)
    assert loss.influence(u) == asymmetric_huber_influence(u, k, k)
    assert loss.weight(u) == asymmetric_huber_weight(u, k, k)


@given(residuals, thresholds)
def test_equal_thresholds_are_symmetric(u: float, k: float) -> None:
    assert asymmetric_huber_loss(u, k, k) == asymmetric_huber_loss(-u, k, k)
    assert asymmetric_huber_weight(u, k, k) == asymmetric_huber_weight(-u, k, k)


@given(residuals, st.floats(1e6, 1e12))
def test_every_loss_with_scales_is_quadratic_as_they_grow(u: float, scale: float) -> None:
    for family in (asymmetric_huber, asymmetric_cauchy, asymmetric_tukey):
        for size in (scale, math.inf):
            loss = family(size, size)
            assert loss.loss(u) == pytest.approx(0.5 * u * u, rel=1e-3)
            assert loss.influence(u) == pytest.approx(u, rel=1e-3)
    assert quadratic().loss(u) == asymmetric_cauchy(math.inf, math.inf).loss(u) == 0.5 * u * u


@given(st.floats(-1e4, 0.0), scales)
def test_an_infinite_short_scale_is_quadratic_for_everything_too_short(
    u: float, scale: float
) -> None:
    for family in (asymmetric_huber, asymmetric_cauchy, asymmetric_tukey):
        loss = family(scale, math.inf)
        assert loss.loss(u) == pytest.approx(0.5 * u * u, rel=1e-12)
        assert loss.weight(u) == 1.0


@given(residuals, scales, scales)
def test_exchanged_scales_mirror_the_loss(u: float, long: float, short: float) -> None:
    for family in (asymmetric_huber, asymmetric_cauchy, asymmetric_tukey):
        assert family(long, short).loss(u) == family(short, long).loss(-u)
        assert family(long, short).weight(u) == family(short, long).weight(-u)


@given(scales, st.floats(1.0, 100.0))
def test_tukey_ignores_what_is_beyond_its_scale(scale: float, factor: float) -> None:
    loss = asymmetric_tukey(scale, math.inf)
    assert loss.weight(factor * scale) == 0.0
    assert loss.loss(factor * scale) == pytest.approx(scale**2 / 6.0, rel=1e-12)


@given(residuals, levels, st.floats(1e-6, 1.0))
def test_the_smoothed_quantile_loss_tends_to_the_check_loss(
    u: float, level: float, bandwidth: float
) -> None:
    check = u * (level - (u < 0.0))
    above = smoothed_quantile(level, bandwidth).loss(u) - check
    assert -1e-9 <= above <= bandwidth * math.log(2.0) + 1e-9


@given(levels, st.floats(-60.0, 60.0))
def test_the_curvature_of_the_quantile_loss_is_below_twice_its_weight(
    level: float, u: float
) -> None:
    loss, h = smoothed_quantile(level, 1.0), 1e-4  # the bandwidth only sets the scale
    curvature = (loss.influence(u + h) - loss.influence(u - h)) / (2.0 * h)
    assert curvature < 2.0 * loss.weight(u)


@pytest.mark.parametrize("level", [0.1, 0.25, 0.5, 0.8])
def test_the_quantile_loss_finds_the_quantile(level: float) -> None:
    values = np.random.default_rng(3).exponential(1.0, 4001)
    loss = smoothed_quantile(level, 1e-3)
    grid = np.linspace(0.0, 2.0, 201)
    costs = [sum(loss.loss(float(v) - at) for v in values[::8]) for at in grid]
    found = float(grid[int(np.argmin(costs))])
    assert found == pytest.approx(float(np.quantile(values[::8], level)), abs=0.02)


@given(st.floats(0.1, 100.0), st.floats(0.01, 50.0))
def test_the_one_sided_loss_is_asymmetric_beyond_its_threshold(excess: float, k: float) -> None:
    long, short = (asymmetric_huber_loss(sign * (k + excess), k, math.inf) for sign in (1, -1))
    assert long < short


@given(st.floats(-1e4, 0.0), thresholds)
def test_the_one_sided_loss_is_quadratic_for_everything_too_short(u: float, k: float) -> None:
    assert asymmetric_huber_loss(u, k, math.inf) == 0.5 * u * u
    assert asymmetric_huber_weight(u, k, math.inf) == 1.0


def map_bias_m(residual_m: float, rate_per_m: float, sigma_m: float) -> float:
    """The most probable bias, b* = max(0, r - lambda sigma^2). Paper: eq. (6)."""
    return max(0.0, residual_m - rate_per_m * sigma_m**2)


def _map_cost(bias_m: float, residual_m: float, rate_per_m: float, sigma_m: float) -> float:
    return (residual_m - bias_m) ** 2 / (2.0 * sigma_m**2) + rate_per_m * bias_m


@given(residuals_m, rates_per_m, sigmas_m)
def test_a2_and_a4_the_marginalised_cost_is_the_loss_with_k_equal_to_lambda_sigma(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    bias_m = map_bias_m(residual_m, rate_per_m, sigma_m)
    marginalised = _map_cost(bias_m, residual_m, rate_per_m, sigma_m)
    k = rate_per_m * sigma_m
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
    k = rate_per_m * sigma_m
    assume(k > 0.0)
    slope_per_m = asymmetric_huber_influence(residual_m / sigma_m, k, math.inf) / sigma_m
    tau_m = k * sigma_m
    printed = min(residual_m, tau_m) / sigma_m**2
    assert slope_per_m == pytest.approx(printed, rel=1e-12)
    assert slope_per_m <= rate_per_m * (1.0 + 1e-12)


@given(residuals_m, st.floats(0.05, 10.0), st.floats(0.1, 20.0))
def test_a1_and_a2_against_a_numeric_minimisation(
    residual_m: float, rate_per_m: float, sigma_m: float
) -> None:
    best = minimize_scalar(
        _map_cost,
        bounds=(0.0, 250.0),
        method="bounded",
        args=(residual_m, rate_per_m, sigma_m),
        options={"xatol": 1e-9},
    )
    assert map_bias_m(residual_m, rate_per_m, sigma_m) == pytest.approx(float(best.x), abs=1e-3)
    loss = one_sided_huber(rate_per_m * sigma_m).loss(residual_m / sigma_m)
    assert loss == pytest.approx(float(best.fun), rel=1e-6, abs=1e-6)
