"""The noise mixtures against scipy: densities, posterior moments, maxima and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import log_ndtr
from scipy.stats import exponnorm, norm

from companion.kernel import Vector
from tools.study.noise_adaptation import AdaptationParams, RangeNoise
from tools.study.noise_mixtures import (
    TAIL,
    mean_map_bias,
    range_expectations,
    truncated_normal,
)
from tools.study.range_noise_fit import fit_range_noise, log_prior, summed_range_expectations

ARGUMENTS = [
    *(-np.logspace(8.0, -3.0, 45)),
    -TAIL - 1e-9,
    -TAIL,
    -TAIL + 1e-9,
    0.0,
    *np.logspace(-3.0, 8.0, 45),
]
NOISES = [
    RangeNoise(0.5, 8.0, 0.9),
    RangeNoise(1.5, 2.0, 0.3, offset_m=0.7),
    RangeNoise(2.5, 15.0, 0.6, offset_m=-3.0),
    RangeNoise(2.5, 0.5, 0.5),
]


def _moments_by_quadrature(z: float) -> tuple[float, float, float]:
    """Mean, second moment and mean - z of N(z, 1) cut off below 0."""
    if z < 0.0:
        unit = max(1.0, -z)  # the bias is of the order of 1 / |z| far in the tail

        def moment(power: int) -> float:
            def integrand(t: float) -> float:
                return (t / unit) ** power * math.exp(-0.5 * (t / unit) ** 2 + z * t / unit)

            return float(quad(integrand, 0.0, 60.0, epsabs=0.0, epsrel=1e-12, limit=200)[0])

        mass = moment(0)
        return moment(1) / mass, moment(2) / mass, moment(1) / mass - z

    def about_z(power: int) -> float:
        def integrand(d: float) -> float:
            return d**power * math.exp(-0.5 * d * d)

        low = max(-z, -12.0)
        return sum(float(quad(integrand, *side)[0]) for side in ((low, 0.0), (0.0, 12.0)))

    gain = about_z(1) / about_z(0)
    return z + gain, about_z(2) / about_z(0) + 2.0 * z * gain + z * z, gain


@pytest.mark.parametrize("z", ARGUMENTS)
def test_the_truncated_normal_is_right_for_any_argument(z: float) -> None:
    log_mass, mean, square, gain = truncated_normal(z)
    expected_mean, expected_square, expected_gain = _moments_by_quadrature(z)
    assert log_mass == pytest.approx(float(log_ndtr(z)), rel=1e-12, abs=1e-15)
    assert mean == pytest.approx(expected_mean, rel=1e-11)
    assert square == pytest.approx(expected_square, rel=1e-11)
    assert gain == pytest.approx(expected_gain, rel=1e-11, abs=1e-11)
    assert mean > 0.0
    assert square >= mean * mean


def test_the_moments_rise_with_the_argument_across_the_change_of_formula() -> None:
    grid = np.linspace(-TAIL - 1e-3, -TAIL + 1e-3, 201)
    moments = np.array([truncated_normal(float(z)) for z in grid])
    steps = np.diff(moments[:, :3], axis=0)
    assert np.all(steps > 0.0)
    assert np.all(np.abs(np.diff(steps, axis=0)) < 1e-9)


def _density(residual_m: float, noise: RangeNoise) -> float:
    from_offset = residual_m - noise.offset_m
    nlos = exponnorm.pdf(from_offset, noise.mean_bias_m / noise.sigma_m, scale=noise.sigma_m)
    los = norm.pdf(from_offset, scale=noise.sigma_m)
    return float((1.0 - noise.nlos_share) * los + noise.nlos_share * nlos)


def _expectations(residual_m: float, noise: RangeNoise) -> tuple[float, ...]:
    return range_expectations(
        residual_m, noise.sigma_m, noise.mean_bias_m, noise.nlos_share, noise.offset_m
    )


@pytest.mark.parametrize("noise", NOISES, ids=str)
def test_the_range_density_is_scipys(noise: RangeNoise) -> None:
    for u in (-8.0, -3.0, -0.5, 0.0, 0.1, 1.0, 4.0, 20.0):
        residual_m = noise.offset_m + u * noise.sigma_m
        density = math.exp(_expectations(residual_m, noise)[4])
        assert density == pytest.approx(_density(residual_m, noise), rel=1e-9)


@pytest.mark.parametrize("noise", NOISES, ids=str)
@pytest.mark.parametrize("u", [-6.0, -2.0, 0.0, 0.7, 2.5, 9.0])
def test_the_e_step_is_the_posterior_by_quadrature(noise: RangeNoise, u: float) -> None:
    residual_m = noise.offset_m + u * noise.sigma_m
    peak_m = max(0.0, u * noise.sigma_m - noise.sigma_m**2 / noise.mean_bias_m)

    def over_bias(power: int, noise_power: int) -> float:
        def integrand(bias_m: float) -> float:
            thermal = norm.pdf(residual_m - bias_m - noise.offset_m, scale=noise.sigma_m)
            prior = math.exp(-bias_m / noise.mean_bias_m) / noise.mean_bias_m
            factor = bias_m**power * (residual_m - bias_m) ** noise_power
            return float(noise.nlos_share * thermal * prior * factor)

        reach_m = 12.0 * noise.sigma_m
        pieces = ((max(0.0, peak_m - reach_m), peak_m), (peak_m, peak_m + reach_m))
        return sum(float(quad(integrand, *piece, epsabs=1e-14)[0]) for piece in pieces)

    los = (1.0 - noise.nlos_share) * float(
        norm.pdf(residual_m - noise.offset_m, scale=noise.sigma_m)
    )
    total = los + over_bias(0, 0)
    expected = (
        over_bias(0, 0) / total,
        over_bias(1, 0) / total,
        (los * residual_m + over_bias(0, 1)) / total,
        (los * residual_m**2 + over_bias(0, 2)) / total,
        math.log(total),
    )
    assert _expectations(residual_m, noise) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("residual_m", [-1e6, -1e3, 1e3, 1e6])
def test_the_e_step_is_sane_for_absurd_residuals(residual_m: float) -> None:
    noise = RangeNoise(0.02, 5.0, 0.5)
    nlos, bias_m, thermal_m, thermal2_m2, log_density = _expectations(residual_m, noise)
    assert 0.0 < nlos <= 1.0
    assert math.isfinite(log_density)
    if residual_m > 0.0:  # all of it is bias, but for lambda sigma^2
        assert bias_m == pytest.approx(residual_m - 0.02**2 / 5.0, rel=1e-9)
        assert thermal_m == pytest.approx(0.02**2 / 5.0, abs=1e-9)
        assert thermal2_m2 == pytest.approx(0.02**2, rel=1e-4)
    else:
        assert bias_m == pytest.approx(0.0, abs=1e-6)
        assert thermal_m == pytest.approx(residual_m, rel=1e-9)


@pytest.mark.parametrize("estimate_offset", [False, True])
def test_em_ends_at_the_maximum_that_scipy_finds(estimate_offset: bool) -> None:
    rng = np.random.default_rng(5)
    residuals_m = rng.normal(0.4, 1.5, 600) + (rng.random(600) < 0.6) * rng.exponential(8.0, 600)
    start = RangeNoise(1.0, 5.0, 0.5, offset_m=0.2)
    params = AdaptationParams(estimate_offset=estimate_offset)
    fit = fit_range_noise(residuals_m, start, params, max_iterations=3000, tolerance=1e-12)

    def cost(free: Vector) -> float:
        share = 1.0 / (1.0 + math.exp(-free[2]))
        offset_m = free[3] if estimate_offset else start.offset_m
        noise = RangeNoise(math.exp(free[0]), math.exp(free[1]), share, offset_m)
        sums = summed_range_expectations(
            residuals_m, noise.sigma_m, noise.mean_bias_m, noise.nlos_share, noise.offset_m
        )
        return -float(sums[4]) - log_prior(noise, start, params)

    guess = [0.0, 1.0, 0.0, 0.0][: 4 if estimate_offset else 3]
    best = minimize(cost, guess, method="BFGS", options={"gtol": 1e-3})
    assert math.log(fit.noise.sigma_m) == pytest.approx(best.x[0], abs=2e-3)
    assert math.log(fit.noise.mean_bias_m) == pytest.approx(best.x[1], abs=2e-3)
    odds = fit.noise.nlos_share / (1.0 - fit.noise.nlos_share)
    assert math.log(odds) == pytest.approx(best.x[2], abs=1e-2)
    assert fit.objectives[-1] == pytest.approx(-float(best.fun), abs=1e-4)


@pytest.mark.parametrize("k", [0.05, 0.5, 1.5, 4.0])
@pytest.mark.parametrize("threshold", [0.0, 0.3, 2.0, 8.0])
@pytest.mark.parametrize("nlos_share", [0.0, 0.3, 1.0])
def test_the_mean_map_bias_is_its_integral(k: float, threshold: float, nlos_share: float) -> None:
    def integrand(u: float) -> float:
        density = (1.0 - nlos_share) * norm.pdf(u) + nlos_share * exponnorm.pdf(u, 1.0 / k)
        return float((u - threshold) * density)

    middle, end = threshold + 10.0, threshold + 60.0 + 40.0 / k
    expected = float(quad(integrand, threshold, middle)[0]) + float(quad(integrand, middle, end)[0])
    assert mean_map_bias(threshold, k, nlos_share) == pytest.approx(expected, rel=1e-7, abs=1e-12)
