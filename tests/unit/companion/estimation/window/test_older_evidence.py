"""Measurements that left the window: a Gaussian that stands for them."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.map_kernels import OlderEvidence
from companion.estimation.window.optimizer import MeasurementWindow
from companion.estimation.window.rivals import Optimum
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import START, TARGET, params, reflected, truth, walk

QUADRATIC = params(range_k_long=None, bearing_k=None)
ROBUST = params()


def _joined(rows: Matrix, mean: Vector, p: FilterParams) -> OlderEvidence:
    return OlderEvidence.none(mean.size).joined(rows, mean, p.thresholds, p.model)


def _best(p: FilterParams, rows: Matrix, older: OlderEvidence | None = None) -> Optimum:
    return WindowMap(p).optima(rows, [START], older, is_white=True)[0]


def test_at_first_there_is_nothing() -> None:
    none = OlderEvidence.none(5)
    assert none.is_empty
    assert none.information.shape == none.variability.shape == (5, 5)
    assert not none.pull.any()
    rows = walk(np.random.default_rng(1))
    one, other = _best(ROBUST, rows), _best(ROBUST, rows, OlderEvidence.none(4))
    assert one.mean.tobytes() == other.mean.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()


def test_joining_is_adding_up() -> None:
    rows, mean = walk(np.random.default_rng(1)), truth()
    first = _joined(rows[:50], mean, ROBUST)
    both = first.joined(rows[50:120], mean, ROBUST.thresholds, ROBUST.model)
    at_once = _joined(rows[:120], mean, ROBUST)
    for name in ("information", "pull", "variability"):
        np.testing.assert_allclose(getattr(both, name), getattr(at_once, name), rtol=1e-12)
    assert not both.is_empty
    assert np.array_equal(first.information, _joined(rows[:50], mean, ROBUST).information)


def test_expanded_at_the_optimum_it_keeps_the_optimum() -> None:
    """Its gradient there is theirs, so the optimum of all stays the optimum of the rest."""
    rng = np.random.default_rng(2)
    rows = reflected(rng, walk(rng, 300), 0.4)
    everything = _best(ROBUST, rows)
    older = _joined(rows[::2], everything.mean, ROBUST)
    rest = _best(ROBUST, rows[1::2], older)
    np.testing.assert_allclose(rest.mean, everything.mean, rtol=0.0, atol=1e-3)
    assert np.sqrt(np.trace(rest.covariance[:2, :2])) == pytest.approx(
        np.sqrt(np.trace(everything.covariance[:2, :2])), rel=0.15
    )


def test_saturated_measurements_pull_and_do_not_bend() -> None:
    rows = walk(np.random.default_rng(3), 40, bearings=False, noise=0.0)
    rows[:, 3] += 20.0
    older = _joined(rows, truth(), ROBUST)
    assert not older.information.any()
    assert older.pull[2] == pytest.approx(40 * 1.5 / 0.5)  # to a larger range offset
    assert older.variability[2, 2] == pytest.approx(40 * (1.5 / 0.5) ** 2)


def _remembered(rows: Matrix, p: FilterParams, size: int) -> tuple[Matrix, OlderEvidence]:
    """A window run over a walk, expanding what leaves it about the estimate of that time."""
    window, solver = MeasurementWindow(size), WindowMap(p)
    older, mean = OlderEvidence.none(4), START
    for row in rows:
        dropped = window.add(row, (float(mean[0]), float(mean[1])))
        if len(dropped):
            solution = solver.solve(window.rows, mean, older)
            assert solution is not None
            mean = solution[0]
            older = older.joined(dropped, mean, p.thresholds, p.model)
    return window.rows, older


@pytest.mark.parametrize("p", [QUADRATIC, ROBUST], ids=["quadratic", "one-sided"])
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_small_window_with_its_past_is_nearly_as_good_as_all_of_it(
    p: FilterParams, share: float
) -> None:
    """A thousand white measurements through a window of 256 against the batch over all."""
    rng = np.random.default_rng(4)
    rows = reflected(rng, walk(rng, 1000), share if p is ROBUST else 0.0)
    held, older = _remembered(rows, p, 256)
    assert len(held) <= 256
    everything, window = _best(p, rows), _best(p, held, older)
    alone = _best(p, held)
    sigma_m = float(np.sqrt(np.trace(everything.covariance[:2, :2])))
    moved_m = float(np.linalg.norm(window.mean[:2] - everything.mean[:2]))
    assert moved_m < 0.35 * sigma_m
    assert abs(window.mean[2] - everything.mean[2]) < 0.35 * np.sqrt(everything.covariance[2, 2])
    assert np.sqrt(np.trace(window.covariance[:2, :2])) == pytest.approx(sigma_m, rel=0.2)
    assert np.sqrt(np.trace(alone.covariance[:2, :2])) > 1.4 * sigma_m


@pytest.mark.slow
def test_over_many_walks_it_is_as_accurate_and_as_honest_as_all_of_it() -> None:
    errors: dict[str, list[float]] = {"all": [], "window": [], "alone": []}
    covered = 0
    for seed in range(25):
        rows = walk(np.random.default_rng([6, seed]), 600)
        held, older = _remembered(rows, QUADRATIC, 128)
        window = _best(QUADRATIC, held, older)
        for name, optimum in (
            ("all", _best(QUADRATIC, rows)),
            ("window", window),
            ("alone", _best(QUADRATIC, held)),
        ):
            errors[name].append(float(np.sum((optimum.mean[:2] - TARGET) ** 2)))
        error = window.mean[:2] - TARGET
        covered += float(error @ np.linalg.solve(window.covariance[:2, :2], error)) < 5.991
    rmse = {name: float(np.sqrt(np.mean(squares))) for name, squares in errors.items()}
    assert rmse["window"] < 1.1 * rmse["all"]
    assert rmse["alone"] > 1.3 * rmse["window"]
    assert covered >= 21  # of 25
