"""EM for the noise: recovered parameters, its guard rails, and the bias of the paper's M-step."""

from __future__ import annotations

import itertools
import math
from dataclasses import astuple, replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.estimation.noise.adaptation import (
    DEFAULTS,
    AdaptationParams,
    AdaptiveBearingNoise,
    AdaptiveRangeNoise,
    BearingNoise,
    RangeNoise,
    thresholds_of,
)
from companion.estimation.noise.mixtures import range_expectations
from companion.kernel import Matrix, Vector
from tools.study.printed_adaptation import (
    PrintedMeanBias,
    compare_mean_bias,
    drawn_residuals_m,
    printed_fixed_point_m,
    printed_mean_bias_m,
)
from tools.study.range_noise_fit import fit_range_noise

START = RangeNoise(sigma_m=1.5, mean_bias_m=5.0, nlos_share=0.5)
BEARING_START = BearingNoise(math.radians(2.0), math.radians(15.0), 0.2)
NO_PRIOR = AdaptationParams(prior_count=1e-3, tail_prior_count=1e-3)
SIGMAS_M = (0.5, 1.5, 2.5)
MEAN_BIASES_M = (2.0, 6.0, 15.0)


def _drawn_m(noise: RangeNoise, count: int, seed: int) -> Vector:
    return drawn_residuals_m(noise, count, np.random.default_rng(seed))


def _parameters(noise: RangeNoise) -> tuple[float, float, float]:
    return (noise.sigma_m, noise.mean_bias_m, noise.nlos_share)


def _standard_errors(truth: RangeNoise, residuals_m: Vector) -> Vector:
    """Of sigma, mean bias and share: the Fisher information from the scores at the truth."""

    def log_densities(values: list[float]) -> Vector:
        sigma_m, mean_m, share = values
        rows = (range_expectations(float(r), sigma_m, mean_m, share, 0.0) for r in residuals_m)
        return np.array([row[4] for row in rows])

    columns = []
    for index, value in enumerate(_parameters(truth)):
        above, below = list(_parameters(truth)), list(_parameters(truth))
        above[index], below[index] = value * (1.0 + 1e-4), value * (1.0 - 1e-4)
        columns.append((log_densities(above) - log_densities(below)) / (2e-4 * value))
    scores: Matrix = np.stack(columns, axis=1)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(scores.T @ scores))))


@pytest.mark.slow
@pytest.mark.parametrize("mean_bias_m", MEAN_BIASES_M)
@pytest.mark.parametrize("sigma_m", SIGMAS_M)
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_the_fit_recovers_what_was_drawn_within_its_standard_errors(
    share: float, sigma_m: float, mean_bias_m: float
) -> None:
    truth = RangeNoise(sigma_m, mean_bias_m, share)
    residuals_m = _drawn_m(truth, 1500, seed=11)
    fit = fit_range_noise(residuals_m, START, NO_PRIOR, tolerance=1e-7)
    errors = np.array(_parameters(fit.noise)) - np.array(_parameters(truth))
    assert fit.is_converged
    assert np.all(np.abs(errors) < 3.5 * _standard_errors(truth, residuals_m))


@pytest.mark.slow
@pytest.mark.parametrize("mean_bias_m", MEAN_BIASES_M)
@pytest.mark.parametrize("sigma_m", SIGMAS_M)
def test_nothing_but_reflections_is_recognised(sigma_m: float, mean_bias_m: float) -> None:
    residuals_m = _drawn_m(RangeNoise(sigma_m, mean_bias_m, 1.0), 1500, seed=12)
    noise = fit_range_noise(residuals_m, START).noise
    assert noise.nlos_share > (0.95 if mean_bias_m > 2.0 * sigma_m else 0.85)
    assert noise.mean_bias_m == pytest.approx(mean_bias_m, rel=0.15)
    assert noise.sigma_m == pytest.approx(sigma_m, abs=0.45)


@pytest.mark.parametrize("sigma_m", SIGMAS_M)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pure_line_of_sight_leaves_the_mean_bias_at_its_prior(sigma_m: float, seed: int) -> None:
    residuals_m = _drawn_m(RangeNoise(sigma_m, 5.0, 0.0), 1500, seed)
    noise = fit_range_noise(residuals_m, START).noise
    assert noise.nlos_share < 0.03
    assert noise.sigma_m == pytest.approx(sigma_m, rel=0.06)
    assert noise.mean_bias_m == pytest.approx(START.mean_bias_m, rel=0.45)


def test_no_residuals_leave_the_prior() -> None:
    fit = fit_range_noise(np.empty(0), START)
    assert astuple(fit.noise) == pytest.approx(astuple(START), rel=1e-12)


def test_the_offset_is_seen_through_the_reflections() -> None:
    truth = RangeNoise(0.8, 8.0, 0.6, offset_m=2.0)
    params = AdaptationParams(estimate_offset=True)
    noise = fit_range_noise(_drawn_m(truth, 3000, seed=4), replace(START, offset_m=0.0), params)
    assert noise.noise.offset_m == pytest.approx(2.0, abs=0.15)
    assert noise.noise.mean_bias_m == pytest.approx(8.0, rel=0.1)
    assert noise.noise.nlos_share == pytest.approx(0.6, abs=0.04)


BOUNDED = AdaptationParams(range_sigma_max_m=1.0, mean_bias_max_m=4.0, estimate_offset=True)


@pytest.mark.slow
@pytest.mark.parametrize("params", [NO_PRIOR, DEFAULTS, BOUNDED], ids=["free", "prior", "bounds"])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_objective_never_falls(params: AdaptationParams, share: float, seed: int) -> None:
    residuals_m = _drawn_m(RangeNoise(1.2, 6.0, share), 300, seed)
    fit = fit_range_noise(residuals_m, RangeNoise(4.0, 1.0, 0.1), params)
    objectives = np.array(fit.objectives)
    assert len(objectives) > 3
    assert np.all(np.diff(objectives) >= -1e-9 * np.abs(objectives[1:]))


@settings(deadline=None, max_examples=25)
@given(st.lists(st.floats(-30.0, 60.0), min_size=1, max_size=40))
def test_the_objective_never_falls_whatever_the_data(values: list[float]) -> None:
    objectives = np.array(fit_range_noise(np.array(values), START, max_iterations=60).objectives)
    assert np.all(np.diff(objectives) >= -1e-9 * (1.0 + np.abs(objectives[1:])))


def test_the_fit_says_that_it_has_not_converged() -> None:
    fit = fit_range_noise(_drawn_m(START, 100, seed=1), START, max_iterations=2)
    assert not fit.is_converged
    assert len(fit.objectives) == 2


@pytest.mark.parametrize("factor", [0.01, 3.0, 1000.0])
def test_the_unit_of_length_does_not_matter(factor: float) -> None:
    residuals_m = _drawn_m(RangeNoise(1.2, 6.0, 0.5, offset_m=0.5), 400, seed=6)
    plain = AdaptationParams(estimate_offset=True)
    scaled = AdaptationParams(
        estimate_offset=True,
        range_sigma_min_m=factor * plain.range_sigma_min_m,
        range_sigma_max_m=factor * plain.range_sigma_max_m,
        mean_bias_min_m=factor * plain.mean_bias_min_m,
        mean_bias_max_m=factor * plain.mean_bias_max_m,
    )
    start = RangeNoise(factor * 1.5, factor * 5.0, 0.5)
    here = fit_range_noise(residuals_m, START, plain, 50, -math.inf).noise
    there = fit_range_noise(factor * residuals_m, start, scaled, 50, -math.inf).noise
    expected = (factor * here.sigma_m, factor * here.mean_bias_m, here.nlos_share)
    assert _parameters(there) == pytest.approx(expected, rel=1e-9)
    assert there.offset_m == pytest.approx(factor * here.offset_m, rel=1e-9)


@pytest.mark.parametrize("estimate_offset", [False, True])
def test_an_offset_known_beforehand_does_not_matter(estimate_offset: bool) -> None:
    residuals_m = _drawn_m(RangeNoise(1.2, 6.0, 0.5), 400, seed=7)
    params = AdaptationParams(estimate_offset=estimate_offset)
    here = fit_range_noise(residuals_m, START, params, 50, -math.inf).noise
    moved = replace(START, offset_m=40.0)
    there = fit_range_noise(residuals_m + 40.0, moved, params, 50, -math.inf).noise
    assert _parameters(there) == pytest.approx(_parameters(here), rel=1e-7)
    assert there.offset_m == pytest.approx(here.offset_m + 40.0, abs=1e-7)


def _fed(noise: AdaptiveRangeNoise, residuals_m: Vector) -> list[AdaptiveRangeNoise]:
    steps = itertools.accumulate(
        (float(r) for r in residuals_m), lambda n, r: n.after(r), initial=noise
    )
    return list(steps)


def test_one_by_one_with_a_long_memory_is_about_the_batch_fit() -> None:
    residuals_m = _drawn_m(RangeNoise(0.8, 10.0, 0.6), 10_000, seed=8)
    batch = fit_range_noise(residuals_m, START).noise
    params = AdaptationParams(memory=1000.0)
    steps = _fed(AdaptiveRangeNoise.starting(START, params), residuals_m)[5000:]
    average = np.mean([_parameters(step.noise) for step in steps], axis=0)
    assert average == pytest.approx(_parameters(batch), rel=0.07)


@pytest.mark.parametrize(("share", "sigma_m", "mean_bias_m"), [(0.9, 1.5, 8.0), (0.3, 0.5, 4.0)])
def test_one_by_one_with_forgetting_stays_about_the_batch_fit(
    share: float, sigma_m: float, mean_bias_m: float
) -> None:
    residuals_m = _drawn_m(RangeNoise(sigma_m, mean_bias_m, share), 6000, seed=9)
    batch = fit_range_noise(residuals_m, START).noise
    steps = _fed(AdaptiveRangeNoise.starting(START), residuals_m)[2000:]
    average = np.mean([_parameters(step.noise) for step in steps], axis=0)
    assert average[0] == pytest.approx(batch.sigma_m, rel=0.1)
    assert average[1:] == pytest.approx(_parameters(batch)[1:], rel=0.1)


def test_forgetting_tracks_a_change() -> None:
    before = _drawn_m(RangeNoise(0.5, 3.0, 0.9), 2000, seed=1)
    after = _drawn_m(RangeNoise(2.0, 12.0, 0.4), 2000, seed=2)
    steps = _fed(AdaptiveRangeNoise.starting(START), np.concatenate([before, after]))
    first, last = steps[2000].noise, steps[-1].noise
    assert first.mean_bias_m == pytest.approx(3.0, rel=0.25)
    assert first.nlos_share > 0.8
    assert first.sigma_m < 1.0
    assert last.mean_bias_m == pytest.approx(12.0, rel=0.3)
    assert last.nlos_share == pytest.approx(0.4, abs=0.12)
    assert last.sigma_m == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("estimate_offset", [False, True])
def test_one_by_one_pure_line_of_sight_rests_at_the_prior(estimate_offset: bool) -> None:
    params = AdaptationParams(estimate_offset=estimate_offset)
    residuals_m = _drawn_m(RangeNoise(0.7, 5.0, 0.0), 5000, seed=3)
    noise = _fed(AdaptiveRangeNoise.starting(START, params), residuals_m)[-1].noise
    assert noise.nlos_share < 0.05
    assert noise.mean_bias_m == pytest.approx(START.mean_bias_m, rel=0.3)
    assert noise.sigma_m == pytest.approx(0.7, rel=0.15)
    assert noise.offset_m == pytest.approx(0.0, abs=0.1)


def test_perfect_ranges_do_not_take_sigma_to_nothing() -> None:
    steps = _fed(AdaptiveRangeNoise.starting(START), np.zeros(3000))
    sigma_m = steps[-1].noise.sigma_m
    assert sigma_m == pytest.approx(START.sigma_m * math.sqrt(3.0 / 303.0), rel=0.02)
    exact = AdaptationParams(prior_count=1e-6)
    steps = _fed(AdaptiveRangeNoise.starting(START, exact), np.zeros(3000))
    assert steps[-1].noise.sigma_m == exact.range_sigma_min_m


def test_bursts_of_short_ranges_do_not_pass_for_thermal_noise() -> None:
    residuals_m = _drawn_m(RangeNoise(0.5, 5.0, 0.3), 2000, seed=5)
    residuals_m[::40] = -19.0
    steps = _fed(AdaptiveRangeNoise.starting(START), residuals_m)
    assert max(step.noise.sigma_m for step in steps[500:]) < 1.0


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-1e6, 1e6), max_size=60), st.booleans())
def test_whatever_is_measured_the_noise_stays_within_its_bounds(
    residuals_m: list[float], estimate_offset: bool
) -> None:
    params = AdaptationParams(estimate_offset=estimate_offset, memory=20.0)
    noise = AdaptiveRangeNoise.starting(START, params)
    for residual_m in residuals_m:
        noise = noise.after(residual_m)
        now = noise.noise
        assert params.range_sigma_min_m <= now.sigma_m <= params.range_sigma_max_m
        assert params.mean_bias_min_m <= now.mean_bias_m <= params.mean_bias_max_m
        assert 0.0 < now.nlos_share < 1.0
        assert math.isfinite(now.offset_m)


def test_learning_leaves_the_value_it_started_from() -> None:
    start = AdaptiveRangeNoise.starting(START)
    assert start.after(3.0) == start.after(3.0) != start
    assert start == AdaptiveRangeNoise.starting(START)
    bearings = AdaptiveBearingNoise.starting(BEARING_START)
    assert bearings.after(0.1) == bearings.after(0.1) != bearings


def _bearings_fed(
    residuals_rad: Vector, params: AdaptationParams = DEFAULTS
) -> list[AdaptiveBearingNoise]:
    start = AdaptiveBearingNoise.starting(BEARING_START, params)
    values = (float(r) for r in residuals_rad)
    return list(itertools.accumulate(values, lambda n, r: n.after(r), initial=start))


@pytest.mark.parametrize("share", [0.1, 0.4, 0.8])
def test_bearing_noise_is_recovered(share: float) -> None:
    rng = np.random.default_rng(21)
    sigma_rad = np.where(rng.random(10_000) < share, 0.35, 0.06)
    residuals_rad = rng.normal(0.0, 1.0, 10_000) * sigma_rad
    steps = _bearings_fed(residuals_rad, AdaptationParams(memory=1000.0))[4000:]
    noise = np.mean([astuple(step.noise) for step in steps], axis=0)
    assert noise[0] == pytest.approx(0.06, rel=0.1)
    assert noise[1] == pytest.approx(0.35, rel=0.1)
    assert noise[2] == pytest.approx(share, abs=0.04)


def test_bearings_without_gross_errors_are_narrow() -> None:
    rng = np.random.default_rng(22)
    noise = _bearings_fed(rng.normal(0.0, 0.05, 5000))[-1].noise
    assert noise.sigma_rad == pytest.approx(0.05, rel=0.15)
    assert noise.wide_share < 0.1
    assert noise.wide_sigma_rad >= DEFAULTS.wide_ratio_min * noise.sigma_rad


def test_two_sigmas_that_come_too_close_are_kept_apart() -> None:
    residuals_rad = np.random.default_rng(23).normal(0.0, 0.05, 2000)
    noise = AdaptiveBearingNoise.starting(BearingNoise(0.05, 0.08, 0.5))
    for residual_rad in residuals_rad:
        noise = noise.after(float(residual_rad))
    ratio = noise.noise.wide_sigma_rad / noise.noise.sigma_rad
    assert ratio == pytest.approx(DEFAULTS.wide_ratio_min, rel=1e-12)
    n = noise.noise
    spread_rad = math.sqrt(
        (1.0 - n.wide_share) * n.sigma_rad**2 + n.wide_share * n.wide_sigma_rad**2
    )
    assert spread_rad == pytest.approx(0.05, rel=0.15)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-math.pi, math.pi), max_size=60))
def test_whatever_the_bearings_their_noise_stays_within_its_bounds(values: list[float]) -> None:
    params = AdaptationParams(memory=10.0)
    low_rad = math.radians(params.bearing_sigma_min_deg)
    high_rad = math.radians(params.bearing_sigma_max_deg)
    for step in _bearings_fed(np.array(values), params):
        assert low_rad <= step.noise.sigma_rad <= high_rad
        ratio = step.noise.wide_sigma_rad / step.noise.sigma_rad
        assert ratio >= params.wide_ratio_min * (1.0 - 1e-12)
        assert 0.0 < step.noise.wide_share < 1.0


def test_thresholds_follow_from_the_noise() -> None:
    learnt = thresholds_of(RangeNoise(1.5, 6.0, 0.9), BEARING_START)
    assert learnt.range_sigma_m == 1.5
    assert learnt.range_k_long == pytest.approx(0.25, rel=1e-12)
    assert learnt.range_k_least_variance == pytest.approx(0.3, abs=0.1)
    assert learnt.bearing_sigma_rad == BEARING_START.sigma_rad
    assert 0.5 < learnt.bearing_k < 2.0


def test_the_more_line_of_sight_the_larger_the_threshold_of_least_variance() -> None:
    shares = (0.9, 0.5, 0.2, 0.05, 1e-6)
    thresholds = [
        thresholds_of(RangeNoise(1.5, 8.0, share), BEARING_START).range_k_least_variance
        for share in shares
    ]
    assert thresholds == sorted(thresholds)
    assert thresholds[-1] > 3.0


@pytest.mark.parametrize(
    ("sigma_m", "mean_bias_m", "k"),
    [(0.02, 100.0, DEFAULTS.k_min), (20.0, 0.2, DEFAULTS.k_max)],
)
def test_thresholds_are_kept_within_their_limits(
    sigma_m: float, mean_bias_m: float, k: float
) -> None:
    bearings = BearingNoise(0.03, 0.3, 0.0)
    learnt = thresholds_of(RangeNoise(sigma_m, mean_bias_m, 0.5), bearings)
    assert learnt.range_k_long == k
    assert learnt.bearing_k == DEFAULTS.k_max  # nothing is wide: least squares is best


@pytest.mark.parametrize(
    "bounds",
    [
        {"range_sigma_min_m": 30.0},
        {"mean_bias_min_m": 200.0},
        {"bearing_sigma_min_deg": 70.0},
        {"k_min": 5.0},
    ],
)
def test_bounds_with_nothing_between_them_are_refused(bounds: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError, match="must be below"):
        msgspec.convert(bounds, AdaptationParams)


@pytest.mark.parametrize("mean_bias_m", [4.0, 8.0, 15.0])
@pytest.mark.parametrize("sigma_m", [0.5, 1.0])
def test_the_papers_m_step_is_short_by_three_quarters_of_sigma_squared_over_the_mean(
    sigma_m: float, mean_bias_m: float
) -> None:
    settled_m = printed_fixed_point_m(RangeNoise(sigma_m, mean_bias_m, 1.0))
    short_m = mean_bias_m - settled_m
    assert short_m == pytest.approx(0.75 * sigma_m**2 / mean_bias_m, rel=0.1)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.0])
@pytest.mark.parametrize("sigma_m", SIGMAS_M)
@pytest.mark.parametrize("mean_bias_m", MEAN_BIASES_M)
def test_the_papers_em_settles_where_its_closed_form_says(
    share: float, sigma_m: float, mean_bias_m: float
) -> None:
    truth = RangeNoise(sigma_m, mean_bias_m, share)
    settled_m = printed_fixed_point_m(truth)
    drawn_m = printed_mean_bias_m(_drawn_m(truth, 200_000, seed=31), sigma_m, mean_bias_m)
    assert drawn_m == pytest.approx(settled_m, rel=0.02)
    assert settled_m < mean_bias_m


def test_the_papers_em_takes_line_of_sight_for_reflections_without_bias() -> None:
    settled_m = printed_fixed_point_m(RangeNoise(0.1, 8.0, 0.4))
    assert settled_m == pytest.approx(0.4 * 8.0, rel=0.01)


@pytest.mark.parametrize(("share", "least_ratio"), [(1.0, 1.482), (0.9, 1.577), (0.3, 2.922)])
def test_the_papers_em_collapses_where_biases_are_not_well_above_sigma(
    share: float, least_ratio: float
) -> None:
    assert printed_fixed_point_m(RangeNoise(2.0, 2.0 * 0.99 * least_ratio, share)) == 0.0
    assert printed_fixed_point_m(RangeNoise(2.0, 2.0 * 1.01 * least_ratio, share)) > 0.0


def test_the_papers_em_collapses_from_too_small_a_guess_even_where_it_could_settle() -> None:
    truth = RangeNoise(2.5, 5.0, 0.9)
    residuals_m = _drawn_m(truth, 5000, seed=32)
    settled_m = printed_mean_bias_m(residuals_m, 2.5, 5.0)
    assert settled_m == pytest.approx(printed_fixed_point_m(truth), rel=0.1)
    assert printed_mean_bias_m(residuals_m, 2.5, 0.5) == 0.0


def test_the_papers_em_one_by_one_ends_where_the_batch_does() -> None:
    truth = RangeNoise(1.5, 8.0, 0.9)
    steps = [PrintedMeanBias.starting(5.0, truth.sigma_m, DEFAULTS)]
    for residual_m in _drawn_m(truth, 8000, seed=33):
        steps.append(steps[-1].after(float(residual_m)))
    average_m = float(np.mean([step.mean_bias_m for step in steps[2000:]]))
    assert average_m == pytest.approx(printed_fixed_point_m(truth), rel=0.05)


def test_the_papers_em_one_by_one_collapses_too() -> None:
    noise = PrintedMeanBias.starting(2.0, 2.5, DEFAULTS)
    for residual_m in _drawn_m(RangeNoise(2.5, 2.0, 0.9), 8000, seed=34):
        noise = noise.after(float(residual_m))
    assert noise.mean_bias_m < 0.05 * noise.sigma_m


def test_the_corrected_em_is_right_where_the_papers_is_not() -> None:
    truth = RangeNoise(2.5, 8.0, 0.3)
    case = compare_mean_bias(truth, START, 800, 4, np.random.default_rng(35))
    assert case.printed_limit_m < 2.0
    assert case.printed_m < 3.0
    assert 0.0 <= case.collapsed_share <= 1.0
    assert case.corrected.mean_bias_m == pytest.approx(8.0, rel=0.15)
    assert case.corrected.sigma_m == pytest.approx(2.5, rel=0.1)
    assert case.corrected.nlos_share == pytest.approx(0.3, abs=0.08)
    assert case.corrected_spread_m > 0.0
