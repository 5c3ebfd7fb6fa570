"""The noise monitor: what it takes for white noise, and what it makes of everything else."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.innovations import (
    MAX_INFLATION,
    NOISE_FORGETTING,
    PRIOR_COUNT,
    NoiseMonitor,
)
from companion.estimation.window.sandwich import (
    MAX_CORRELATION,
    MIN_MEASUREMENTS,
    SIGNIFICANT_SIGMAS,
)

K = 1.5


def _monitor(
    innovations: Iterable[float], k_short: float = K, prior_inflation: float = 1.0
) -> NoiseMonitor:
    monitor = NoiseMonitor(prior_inflation)
    for u in innovations:
        monitor = monitor.after(float(u), K, k_short)
    return monitor


def _repeating(rng: np.random.Generator, rho: float, count: int) -> list[float]:
    """Gaussian noise of unit variance whose neighbours are correlated by `rho`."""
    values = [float(rng.normal())]
    for fresh in rng.normal(size=count - 1):
        values.append(rho * values[-1] + math.sqrt(1.0 - rho * rho) * float(fresh))
    return values


@pytest.mark.parametrize("inflation", [1.0, 4.0, 10.0])
def test_before_any_data_the_prior_is_believed(inflation: float) -> None:
    assert NoiseMonitor(inflation).inflation == pytest.approx(inflation)


@pytest.mark.parametrize("k_short", [K, math.inf])
def test_well_specified_white_noise_needs_no_inflation(k_short: float) -> None:
    found = [
        _monitor(np.random.default_rng(seed).normal(size=1500), k_short).inflation
        for seed in range(40)
    ]
    assert min(found) >= 1.0
    assert float(np.median(found)) < 1.05
    assert max(found) < 1.5  # chance is taken for a correlation once in twenty


def test_a_cautious_prior_is_forgotten() -> None:
    noise = np.random.default_rng(1).normal(size=2000)
    assert _monitor(noise[:4], prior_inflation=4.0).inflation > 2.0
    assert _monitor(noise[:20], prior_inflation=4.0).inflation > 1.3
    assert _monitor(noise, prior_inflation=4.0).inflation == pytest.approx(1.0, abs=0.1)


def test_it_is_the_sandwich_of_contaminated_noise() -> None:
    """The same moments computed at once, with the weights of forgetting and of the prior."""
    rng = np.random.default_rng(4)
    u = np.where(rng.random(900) < 0.7, rng.exponential(5.0, 900), 0.0) + rng.normal(size=900)
    psi = np.minimum(u, K)
    age = NOISE_FORGETTING ** np.arange(900)[::-1]
    count = age.sum()
    believed = count + PRIOR_COUNT
    mean_weight = ((age * psi / u).sum() + PRIOR_COUNT) / believed
    mean_psi2 = ((age * psi**2).sum() + PRIOR_COUNT * 3.0) / believed
    mean_slope = ((age * (u <= K)).sum() + PRIOR_COUNT) / believed
    sandwich = mean_weight * mean_psi2 / mean_slope**2
    assert sandwich > 1.5
    monitor = _monitor(u, math.inf, prior_inflation=3.0)
    assert monitor.inflation == pytest.approx(sandwich * monitor.repetition, rel=1e-9)
    assert monitor.influence_sum / monitor.count == pytest.approx((age * psi).sum() / count)
    assert monitor.bilateral_share == pytest.approx((age * (u <= K)).sum() / count, rel=1e-9)


def test_repetition_is_that_of_the_lag_one_correlation() -> None:
    psi = np.clip(_repeating(np.random.default_rng(4), 0.5, 900), -K, K)
    age = NOISE_FORGETTING ** np.arange(900)[::-1]
    mean_psi = (age * psi).sum() / age.sum()
    variance = (age * psi**2).sum() / age.sum() - mean_psi**2
    lag = (age[1:] * psi[1:] * psi[:-1]).sum() / age[1:].sum()
    rho = (lag - mean_psi**2) / variance
    assert rho > SIGNIFICANT_SIGMAS / math.sqrt(age[1:].sum())
    monitor = _monitor(psi)
    assert monitor.correlation == pytest.approx(rho, rel=1e-9)
    assert monitor.repetition == pytest.approx((1.0 + rho) / (1.0 - rho), rel=1e-9)


@pytest.mark.parametrize("count", [2, 5, MIN_MEASUREMENTS])
def test_few_neighbours_tell_nothing_of_correlation(count: int) -> None:
    assert _monitor([1.0, -1.0] * 3 + [1.4] * count).repetition == 1.0


def test_a_long_gap_between_pairs_is_no_correlation_lost() -> None:
    """Chains of two: every pair counts, and nothing across the gaps."""
    monitor = NoiseMonitor(1.0)
    for u in np.random.default_rng(3).normal(size=400):
        monitor = replace(monitor.after(float(u), K, K).after(float(u), K, K), previous=None)
    assert monitor.correlation > 0.9


def test_noise_that_is_larger_than_believed_is_noticed() -> None:
    """Quadratic loss: the sandwich is the variance itself."""
    monitor = NoiseMonitor(1.0)
    for u in 2.0 * np.random.default_rng(8).normal(size=3000):
        monitor = monitor.after(float(u), math.inf, math.inf)
    assert monitor.inflation == pytest.approx(4.0, rel=0.25)


def test_inflation_rises_with_the_correlation_of_neighbours() -> None:
    found = []
    for rho in (0.0, 0.5, 0.8, 0.95):
        monitors = [
            _monitor(_repeating(np.random.default_rng(seed), rho, 1500)) for seed in range(10)
        ]
        found.append(float(np.median([m.inflation for m in monitors])))
    assert found == sorted(found)
    assert found[1] > 2.0
    assert found[3] > 10.0


def test_neighbours_of_opposite_sign_do_not_shrink_it() -> None:
    assert _monitor([1.0, -1.0] * 500).correlation == 0.0
    assert _monitor([1.0, -1.0] * 500).inflation >= 1.0


def test_a_broken_chain_has_no_neighbours() -> None:
    """Each innovation follows a gap: nothing says that they repeat each other."""
    monitor = NoiseMonitor(1.0)
    for u in np.random.default_rng(3).normal(size=1000):
        monitor = replace(monitor.after(float(u), K, K), previous=None)
    assert monitor.correlation == 0.0
    assert monitor.inflation < 1.1


def test_it_never_runs_away() -> None:
    stuck = _monitor([50.0] * 2000, math.inf)
    assert stuck.inflation <= MAX_INFLATION
    drifting = _monitor([math.copysign(1.4, math.sin(i / 200.0)) for i in range(3000)])
    assert 0.9 < drifting.correlation <= MAX_CORRELATION


def test_silence_is_not_divided_by() -> None:
    monitor = _monitor([0.0] * 20_000)
    assert monitor.correlation == 0.0
    assert monitor.inflation == 1.0


def test_without_variance_there_is_no_correlation() -> None:
    assert _monitor([1.0] * 50).correlation == 0.0
