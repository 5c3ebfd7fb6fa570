"""The sandwich: its parts by hand, and whether it is calibrated on drawn noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.sandwich import (
    MAX_CORRELATION,
    MIN_MEASUREMENTS,
    MIN_SLOPE,
    PRIOR_COUNT,
    Scores,
    correlated_variability,
    covariance_of,
    curvature,
    long_run_variance,
    pooled_variability,
    thermal_moment,
)
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import START, TARGET, params, reflected, repeating, walk

K = 1.5
WHITE = np.ones(3)


def _scores(u: Matrix, H: Matrix | None = None) -> Scores:
    """Scores of one to three modalities with symmetric thresholds; NaN: not measured."""
    full = np.full((3, u.shape[1]), np.nan)
    full[: len(u)] = u
    measured = ~np.isnan(full)
    values = np.where(measured, full, 0.0)
    partials = np.zeros((3 * u.shape[1], 2))
    if H is not None:
        partials[: len(H)] = H
    partials[~measured.reshape(-1)] = 0.0
    return Scores(values, np.clip(values, -K, K), partials, measured)


def test_the_slope_is_the_share_on_the_quadratic_part() -> None:
    scores = _scores(np.array([[0.0, 1.0, -1.4, 9.0], [9.0, np.nan, np.nan, -9.0]]))
    assert scores.slopes[0] == 0.75
    assert scores.slopes[1] == MIN_SLOPE
    assert scores.slopes[2] == 1.0


def test_the_moment_is_pooled_with_thermal_noise() -> None:
    u = np.full((1, 96), 1.2)
    expected = (96 * 1.44 + PRIOR_COUNT) / (96 + PRIOR_COUNT) * 97.0 / 95.0
    assert _scores(u).moment(0, 2) == pytest.approx(expected)


def test_residuals_much_smaller_than_thermal_noise_promise_little() -> None:
    tiny = _scores(np.full((1, 400), 1e-3))
    assert tiny.moment(0, 4) == pytest.approx(1.0 - 2.0 * math.sqrt(2.0 / (400 + PRIOR_COUNT)))


def test_few_measurements_are_given_wider_tails() -> None:
    ratios = [_scores(np.full((1, n), 0.5)).quantile_ratio(0) for n in (5, 20, 100, 1000)]
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[-1] == pytest.approx(1.0, abs=0.005)
    saturated = np.array([[0.5, 9.0] * 50])
    assert _scores(saturated).quantile_ratio(0) > ratios[2]


def test_a_fit_makes_residuals_look_more_quadratic_than_they_are() -> None:
    half = _scores(np.array([[0.5, 9.0] * 10]))
    assert half.finite_sample_ratio(0, 4.0) == pytest.approx(1.0 + 4.0 / 20.0)
    assert _scores(np.full((1, 20), 0.5)).finite_sample_ratio(0, 4.0) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.5, 0.8, 0.95])
def test_the_correlation_of_neighbours_is_found(rho: float) -> None:
    u = repeating(np.random.default_rng(1), rho, 2000).T
    scores = _scores(u)
    for modality in range(3):
        assert scores.correlation(modality) == pytest.approx(rho, abs=0.08)
    expected = (1.0 + scores.correlation(0)) / (1.0 - scores.correlation(0))
    assert scores.repetition[0] == pytest.approx(expected)


def test_white_residuals_repeat_nothing() -> None:
    found = [
        _scores(np.random.default_rng(seed).normal(size=(1, 200))).correlation(0)
        for seed in range(100)
    ]
    assert sum(rho > 0.0 for rho in found) <= 12  # one in twenty by chance
    assert _scores(np.array([[1.0, -1.0] * 100])).correlation(0) == 0.0


def test_too_few_or_all_alike_tell_nothing_of_correlation() -> None:
    assert _scores(np.linspace(-1.0, 1.0, MIN_MEASUREMENTS - 1)[None]).correlation(0) == 0.0
    assert _scores(np.linspace(-1.0, 1.0, 200)[None]).correlation(0) == MAX_CORRELATION
    assert _scores(np.full((1, 50), 0.5)).correlation(0) == 0.0


def test_curvature_counts_the_quadratic_share_of_each_modality() -> None:
    H = np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 2.0]])
    scores = _scores(np.array([[0.1, 9.0], [0.1, 0.1]]), H)
    expected = 0.5 * np.eye(2) + 1.0 * 4.0 * np.eye(2)
    np.testing.assert_allclose(curvature(scores), expected)


@pytest.mark.parametrize("n", [10, 11])
def test_the_long_run_variance_by_hand(n: int) -> None:
    """Bandwidth 2: the sum over lags 0, 1, 2 with weights 1, 2/3, 1/3, both ways."""
    s = np.arange(1.0, n + 1.0)[:, None]
    expected = sum(
        weight * float(s[lag:, 0] @ s[: n - lag, 0])
        for lag, weight in ((0, 1.0), (1, 2.0 * 2.0 / 3.0), (2, 2.0 / 3.0))
    )
    assert long_run_variance(s)[0, 0] == pytest.approx(expected)


def test_the_long_run_variance_is_never_negative() -> None:
    for seed in range(20):
        scores = np.random.default_rng(seed).normal(size=(30, 4))
        assert np.linalg.eigvalsh(long_run_variance(scores))[0] > -1e-9
    alternating = np.array([[1.0], [-1.0]] * 30)
    assert 0.0 <= long_run_variance(alternating)[0, 0] < 10.0


def test_repeated_scores_vary_more_in_sum() -> None:
    rng = np.random.default_rng(2)
    H = rng.normal(size=(300, 2))
    sums = {}
    for rho in (0.0, 0.9):
        noise = repeating(rng, rho, 300).T
        noise[1:] = np.nan
        sums[rho] = float(np.trace(correlated_variability(_scores(noise, np.abs(H)))))
    assert sums[0.9] > 4.0 * sums[0.0]


def test_what_names_no_place_has_no_covariance() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        covariance_of(np.diag([1.0, 0.0]), np.eye(2))


def test_of_a_linear_problem_it_is_the_spread_of_the_estimates() -> None:
    """Quadratic loss, noise twice as large as believed: the covariance is the empirical one."""
    rng = np.random.default_rng(3)
    H = rng.normal(size=(300, 2)) * [3.0, 1.0]
    inverse = np.linalg.inv(H.T @ H)
    estimates, covariances = [], []
    for _ in range(400):
        u = 2.0 * rng.normal(size=300)
        x = inverse @ H.T @ u
        estimates.append(x)
        residuals = np.zeros((3, 300))
        residuals[0] = u - H @ x
        partials = np.zeros((900, 2))
        partials[:300] = H
        measured = np.zeros((3, 300), dtype=bool)
        measured[0] = True
        scores = Scores(residuals, residuals, partials, measured)
        A = curvature(scores)
        B = pooled_variability(scores, np.asarray(np.linalg.inv(A)), WHITE)
        covariances.append(covariance_of(A, B))
    found = np.mean(covariances, axis=0)
    np.testing.assert_allclose(found, np.cov(np.array(estimates).T), rtol=0.15, atol=2e-4)


# -- Calibration ---------------------------------------------------------------------------------

CHI2_95 = 5.991


def _coverage(p: FilterParams, kind: dict[str, float | bool], *, is_white: bool) -> float:
    """Share of drawn walks whose 95 % ellipse holds the target."""
    solver, covered, runs = WindowMap(p), 0, 200
    share = float(kind.get("share", 0.0))
    walked = {key: value for key, value in kind.items() if key != "share"}
    start: Vector = np.append(START, p.prior[0][4:])
    for seed in range(runs):
        rng = np.random.default_rng([5, seed])
        rows = reflected(rng, walk(rng, 120, **walked), share)  # type: ignore[arg-type]
        best = solver.optima(rows, [start], is_white=is_white)[0]
        error = best.mean[:2] - TARGET
        covered += float(error @ np.linalg.solve(best.covariance[:2, :2], error)) < CHI2_95
    return covered / runs


QUADRATIC = params(range_k_long=None, bearing_k=None)
SPACE = params(target_height_sigma_m=3.0)


@pytest.mark.parametrize(
    ("p", "kind"),
    [
        (QUADRATIC, {}),
        (params(), {}),
        (params(), {"bearings": False}),
        (SPACE, {"elevations": True, "height_m": 2.0}),
    ],
    ids=["quadratic", "one-sided", "ranges only", "space"],
)
@pytest.mark.parametrize("is_white", [True, False])
def test_with_well_specified_noise_it_holds_what_it_says(
    p: FilterParams, kind: dict[str, float | bool], is_white: bool
) -> None:
    assert 0.91 <= _coverage(p, kind, is_white=is_white) <= 0.985


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_under_reflections_it_holds_at_least_what_it_says(share: float) -> None:
    assert _coverage(params(range_k_long=1.0), {"share": share}, is_white=True) >= 0.93


@pytest.mark.slow
@pytest.mark.parametrize(
    "rho",
    [pytest.param(0.5, marks=pytest.mark.slow), 0.8, pytest.param(0.95, marks=pytest.mark.slow)],
)
def test_with_repeating_noise_it_nearly_holds_what_it_says(rho: float) -> None:
    """Of 120 residuals that repeat each other little is left to estimate how much they do."""
    assert _coverage(params(), {"rho": rho}, is_white=False) >= 0.90
    assert _coverage(params(), {"rho": rho, "bearings": False}, is_white=False) >= 0.84


def test_without_correlation_it_would_be_far_too_sure() -> None:
    """The classical sandwich understates the variance of residuals that repeat each other."""
    solver, covered = WindowMap(params()), 0
    for seed in range(100):
        rows = walk(np.random.default_rng([5, seed]), 120, rho=0.9)
        mean = solver.solve(rows, START)
        assert mean is not None
        scores = solver.scores(rows, mean[0])
        A = curvature(scores)
        A[2:, 2:] += np.diag([1.0 / 5.0**2, 1.0 / math.radians(5.0) ** 2])
        P = covariance_of(A, pooled_variability(scores, np.asarray(np.linalg.inv(A)), WHITE))
        error = mean[0][:2] - TARGET
        covered += float(error @ np.linalg.solve(P[:2, :2], error)) < CHI2_95
    assert covered < 60


@pytest.mark.parametrize("thresholds", [(1.5, math.inf), (1.5, 1.5), (1.0, 3.0), (math.inf,) * 2])
def test_thermal_noise_has_the_second_moment_of_a_clipped_normal(
    thresholds: tuple[float, float],
) -> None:
    u = np.random.default_rng(3).normal(size=400_000)
    k_long, k_short = thresholds
    expected = float(np.mean(np.clip(u, -k_short, k_long) ** 2))
    assert thermal_moment(k_long, k_short) == pytest.approx(expected, rel=0.01)
