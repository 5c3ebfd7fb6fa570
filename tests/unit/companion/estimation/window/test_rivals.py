"""Probabilities of optima against each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.measurement_model import RANGE
from companion.estimation.window.rivals import (
    IMPROBABLE_LOG_RATIO,
    Contrast,
    Optimum,
    contrast_of,
    log_erfc,
    log_ratio,
    weigh_optima,
)
from companion.estimation.window.sandwich import Scores
from companion.estimation.window.spatial_noise import SpatialNoise, SpatialPrior, fit_spatial_noise
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import START, params, reflected, walk

N = 100


def _optimum(
    east_m: float,
    cost: float,
    *,
    sigma_m: float = 0.5,
    inflation: float = 1.0,
    psi: Matrix | None = None,
) -> Optimum:
    """An optimum whose measurements leave no doubt, unless their influences are given."""
    covariance = np.diag([sigma_m**2, sigma_m**2, 1.0, 0.01])
    influences = np.zeros((3, N)) if psi is None else psi
    mean = np.array([east_m, 0.0, 1.0, 0.0])
    return Optimum(mean, cost, covariance, inflation, _scores(influences), (1.0, 1.0, 1.0))


def _scores(psi: Matrix, partials: Matrix | None = None) -> Scores:
    """Ranges with these influences (3, n), and partials (n, 4) of the state."""
    H = np.zeros((3 * psi.shape[1], 4))
    if partials is not None:
        H[: psi.shape[1]] = partials
    is_measured = np.zeros(psi.shape, dtype=bool)
    is_measured[RANGE] = True
    return Scores(psi, psi, H, is_measured)


def test_without_rivals_there_is_nothing_to_weigh() -> None:
    assert weigh_optima([]) == []
    alone = _optimum(0.0, 100.0)
    assert weigh_optima([alone]) == [(0.0, alone)]


def test_of_two_alike_neither_is_more_probable() -> None:
    one, other = _optimum(0.0, 100.0), _optimum(50.0, 100.0)
    assert [log for log, _ in weigh_optima([one, other])] == [0.0, 0.0]


def test_a_difference_of_costs_is_a_log_ratio() -> None:
    best, rival = _optimum(0.0, 100.0), _optimum(9.0, 103.0)
    assert log_ratio(rival, best) == pytest.approx(-3.0)
    assert log_ratio(best, best) == 0.0


def test_inflation_keeps_a_rival_alive_that_white_noise_would_rule_out() -> None:
    def rivals(inflation: float) -> list[Optimum]:
        return [_optimum(0.0, 100.0, inflation=inflation), _optimum(9.0, 120.0)]

    assert len(weigh_optima(rivals(1.0))) == 1
    assert len(weigh_optima(rivals(10.0))) == 2
    assert weigh_optima(rivals(10.0))[1][0] == pytest.approx(-2.0)


def test_a_wrong_place_does_not_excuse_itself_by_its_own_systematic_residuals() -> None:
    near = _optimum(0.0, 1880.0, inflation=4.0)
    far = _optimum(80.0, 2160.0, sigma_m=28.0, inflation=45.0)
    assert [o for _, o in weigh_optima([far, near])] == [near]


def test_what_a_few_noises_made_may_be_chance() -> None:
    """Ten influences carry the difference: their scatter keeps the rival alive."""
    psi, rival_psi = np.zeros((3, N)), np.zeros((3, N))
    psi[0, :10] = [1.5, -1.5] * 5
    rival_psi[0, :10] = -psi[0, :10]
    best, rival = _optimum(0.0, 100.0, psi=psi), _optimum(9.0, 120.0, psi=rival_psi)
    assert IMPROBABLE_LOG_RATIO < log_ratio(rival, best) < 0.0
    assert log_ratio(rival, best) > log_ratio(_optimum(9.0, 120.0), _optimum(0.0, 100.0))


def test_what_all_measurements_agree_on_is_no_chance() -> None:
    """Better at every one of a hundred positions, by a little, with influences that are small."""
    psi = 0.1 * np.random.default_rng(1).normal(size=(3, N))
    best, rival = _optimum(0.0, 100.0, psi=psi), _optimum(9.0, 160.0, psi=psi + 0.3)
    assert log_ratio(rival, best) < IMPROBABLE_LOG_RATIO


def test_the_best_one_comes_first_and_the_improbable_not_at_all() -> None:
    optima = [_optimum(float(i), cost) for i, cost in enumerate((130.0, 104.0, 100.0, 101.0))]
    kept = weigh_optima(optima)
    assert {o.cost for _, o in kept} == {100.0, 101.0, 104.0}
    assert max(kept, key=lambda pair: pair[0])[1].cost == 100.0
    assert all(IMPROBABLE_LOG_RATIO < log <= 0.0 for log, _ in kept)


def test_a_walk_that_bends_ever_more_decides_for_the_true_side() -> None:
    solver = WindowMap(params())
    logs = []
    for bend_m in (0.0, 0.5, 2.0, 15.0):
        rows = walk(np.random.default_rng(2), bearings=False, straight=True, noise=0.0)
        bent = np.array(rows)
        bent[:, 1] = bend_m * np.sin(np.linspace(0.0, 2.0 * math.pi, 200))
        away = np.array([40.0, 25.0]) - bent[:, :2]
        error = 0.5 * np.random.default_rng(3).normal(size=200)
        bent[:, 3] = np.sqrt((away**2).sum(axis=1) + 100.0) + error
        optima = solver.optima(bent, [START, START * [1.0, -1.0, 1.0, 1.0]])
        logs.append(log_ratio(optima[1], optima[0]) if len(optima) > 1 else -math.inf)
        assert (optima[0].mean[1] > 0.0) or bend_m < 1.0
    assert logs[0] == pytest.approx(0.0, abs=0.01)
    assert logs[2] < -2.0
    assert logs[3] < IMPROBABLE_LOG_RATIO
    assert logs[1:] == sorted(logs[1:], reverse=True)


def test_under_reflections_it_is_decided_later() -> None:
    solver, logs = WindowMap(params(range_k_long=1.0)), []
    for share in (0.0, 0.9):
        rows = walk(np.random.default_rng(2), bearings=False, straight=True)
        rows[:, 1] = 2.0 * np.sin(np.linspace(0.0, 2.0 * math.pi, 200))
        away = np.array([40.0, 25.0]) - rows[:, :2]
        rng = np.random.default_rng(3)
        rows[:, 3] = np.sqrt((away**2).sum(axis=1) + 100.0) + 0.5 * rng.normal(size=200)
        rows = reflected(rng, rows, share)
        optima = solver.optima(rows, [START, START * [1.0, -1.0, 1.0, 1.0]])
        logs.append(log_ratio(optima[1], optima[0]) if len(optima) > 1 else -math.inf)
    assert logs[0] < 2.0 * logs[1] < 0.0


def _field_along(positions: Matrix, psi: Vector) -> SpatialNoise:
    partials, prior = np.zeros((len(psi), 1)), np.eye(1)
    return fit_spatial_noise(positions, psi, partials, 1.0, prior, SpatialPrior(0.6, 2.0))


def test_the_odds_are_those_of_a_likelihood_where_errors_are_independent() -> None:
    """Of two costs of independent errors the difference is the log odds, and its variance twice
    its mean."""
    contrast = Contrast(mean=4.0, variance=8.0, degrees=1e9)
    assert contrast.log_ratio(3.0) == pytest.approx(-3.0, rel=1e-6)
    assert contrast.log_ratio(0.0) == 0.0


def test_few_independent_places_leave_more_doubt_than_many() -> None:
    logs = [Contrast(4.0, 8.0, degrees).log_ratio(4.0) for degrees in (2.0, 8.0, 32.0, 1e6)]
    assert logs == sorted(logs, reverse=True)
    assert logs[0] > -2.5 > -3.9 > logs[-1]


def test_the_odds_of_a_contrast_hold_when_errors_repeat() -> None:
    """A position that differs by a wave along the path is wrong as often as the odds say.

    Errors have the prior's strength and length: where a constant error would be worth one
    measurement, a wave is worth more.
    """
    rng, way_m = np.random.default_rng(5), np.arange(0.0, 40.0, 0.25)
    positions = np.stack([way_m, np.zeros_like(way_m)], axis=1)
    apart_m = np.abs(way_m[:, None] - way_m)
    half = np.linalg.cholesky(0.36 * np.exp(-apart_m / 2.0) + 0.04 * np.eye(len(way_m)))
    wave = 0.5 * np.sin(way_m / 2.5)
    stated, wrong, sharp = 0.0, 0, 0
    for _ in range(100):
        psi = np.zeros((3, len(way_m)))
        psi[RANGE] = half @ rng.normal(size=len(way_m))
        pair = psi, psi + np.stack([wave, 0.0 * wave, 0.0 * wave])
        first, second = sorted(pair, key=lambda each: float(np.sum(each**2)))
        field = _field_along(positions, first[RANGE])
        gap = 0.5 * float(np.sum(second**2) - np.sum(first**2)) / field.repetition
        fields = (field, None, None)
        log = contrast_of(_scores(second), _scores(first), fields, 0.0).log_ratio(gap)
        stated += math.exp(log) / (1.0 + math.exp(log))
        wrong += first is pair[1]
        sharp += log < 1.5 * -gap
    assert abs(wrong - stated) <= 3.0 * math.sqrt(stated)
    assert sharp > 50


def test_a_path_that_bends_within_its_own_error_decides_nothing() -> None:
    way_m = np.arange(0.0, 40.0, 0.25)
    positions = np.stack([way_m, np.zeros_like(way_m)], axis=1)
    psi = np.zeros((3, len(way_m)))
    psi[RANGE] = 0.3 * np.sin(way_m / 3.0)
    rival = psi + 0.2 * np.stack([np.cos(way_m / 5.0)] * 3)
    left, right = np.zeros((len(way_m), 4)), np.zeros((len(way_m), 4))
    left[:, 1], right[:, 1] = 2.0, -2.0  # north of the path, and south of it
    fields = (_field_along(positions, psi[RANGE]), None, None)
    contrasts = [
        contrast_of(_scores(rival, right), _scores(psi, left), fields, own_m)
        for own_m in (0.0, 0.2, 1.0)
    ]
    logs = [contrast.log_ratio(contrast.mean) for contrast in contrasts]
    assert logs == sorted(logs)
    assert logs[0] < -1.0
    assert logs[-1] > -0.1


@pytest.mark.parametrize("x", [-5.0, 0.0, 1.0, 5.0, 19.9])
def test_the_logarithm_of_erfc(x: float) -> None:
    assert log_erfc(x) == pytest.approx(math.log(math.erfc(x)), rel=1e-12)


def test_which_does_not_end_where_erfc_does() -> None:
    assert math.erfc(30.0) == 0.0
    assert log_erfc(20.0) == pytest.approx(log_erfc(math.nextafter(20.0, 0.0)), rel=1e-4)
    assert log_erfc(30.0) == pytest.approx(-900.0 - math.log(30.0 * math.sqrt(math.pi)))
