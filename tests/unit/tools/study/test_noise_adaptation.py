"""EM for the noise: recovered parameters, its guard rails, and the bias of the paper's M-step."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.kernel import Matrix, Vector
from tools.study.noise_adaptation import (
    DEFAULTS,
    AdaptationParams,
    RangeNoise,
)
from tools.study.noise_mixtures import range_expectations
from tools.study.printed_adaptation import (
    compare_mean_bias,
    drawn_residuals_m,
    printed_fixed_point_m,
    printed_mean_bias_m,
)
from tools.study.range_noise_fit import fit_range_noise

START = RangeNoise(sigma_m=1.5, mean_bias_m=5.0, nlos_share=0.5)
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
