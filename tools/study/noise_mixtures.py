"""Densities and posterior moments of the noise mixtures that `noise_adaptation` fits, as kernels.

Theory of operation. The posterior of a bias given its residual is a unit normal N(z, 1) truncated
below 0. With phi and Phi of the standard normal and h = phi(z) / Phi(z),

    mass Phi(z)        mean z + h        second moment 1 + z (z + h)

which cancel far in the tail. There, with x = -z, the continued fraction of the inverse Mills ratio
h = x + 1/(x + 2/(x + 3/...)) gives mean = 1/C and second moment = (C - x) / C with C = x + 2/(x +
3/...), where nothing cancels.

Source: M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions (1964), eq. 26.2.14.
"""

from __future__ import annotations

import math

from companion.kernel import kernel

HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
"""Negative log of the standard normal density at 0."""
TAIL = 4.0
"""Distance below 0 from which the continued fraction is used."""
TAIL_TERMS = 30
"""Terms of the continued fraction: full precision from `TAIL` on."""


@kernel
def normal_density(z: float) -> float:
    """Return the density of the standard normal."""
    return math.exp(-0.5 * z * z - HALF_LOG_2_PI)


@kernel
def normal_cdf(z: float) -> float:
    """Return the distribution function of the standard normal."""
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


@kernel
def truncated_normal(z: float) -> tuple[float, float, float, float]:
    """Return log Phi(z), mean, second moment and mean - z of N(z, 1) truncated below 0."""
    if z >= -TAIL:
        mass = normal_cdf(z)
        gain = normal_density(z) / mass
        return math.log(mass), z + gain, 1.0 + z * (z + gain), gain
    x, rest = -z, 0.0
    for term in range(TAIL_TERMS, 1, -1):
        rest = term / (x + rest)
    mean = 1.0 / (x + rest)
    log_mass = -0.5 * x * x - HALF_LOG_2_PI - math.log(x + mean)
    return log_mass, mean, rest * mean, x + mean


@kernel
def range_expectations(
    residual_m: float, sigma_m: float, mean_bias_m: float, nlos_share: float, offset_m: float
) -> tuple[float, float, float, float, float]:
    """Return the E-step of one range residual, given the parameters.

    The bias of a reflection, of probability `nlos_share` in (0, 1), has the mean 1/lambda;
    `offset_m` is the location mu of the thermal noise. The result is the probability of a
    reflection, expected bias (m), expected noise residual - bias (m), its expected square (m^2),
    and log density (1/m).
    """
    u, k = (residual_m - offset_m) / sigma_m, sigma_m / mean_bias_m
    z = u - k
    log_mass, mean, square, gain = truncated_normal(z)
    # of two equivalent forms the one with less cancellation
    if z < 0.0:
        log_mills = -math.log(gain)
        noise, noise2 = u - mean, u * u - 2.0 * u * mean + square
    else:
        log_mills = log_mass + 0.5 * z * z + HALF_LOG_2_PI
        noise, noise2 = k - gain, k * k - 2.0 * k * gain + 1.0 - z * gain
    log_odds = math.log(nlos_share * k) - math.log1p(-nlos_share) + log_mills
    rarer = math.exp(-abs(log_odds))
    if log_odds < 0.0:
        los, nlos = 1.0 / (1.0 + rarer), rarer / (1.0 + rarer)
        log_density = math.log1p(-nlos_share) - 0.5 * u * u - HALF_LOG_2_PI
    else:
        los, nlos = rarer / (1.0 + rarer), 1.0 / (1.0 + rarer)
        log_density = math.log(nlos_share * k) + k * (0.5 * k - u) + log_mass
    log_density += math.log1p(rarer) - math.log(sigma_m)
    noise, noise2 = los * u + nlos * noise, los * u * u + nlos * noise2
    noise2_m2 = offset_m * offset_m + sigma_m * (2.0 * offset_m * noise + sigma_m * noise2)
    bias_m = nlos * sigma_m * mean
    return nlos, bias_m, offset_m + sigma_m * noise, noise2_m2, log_density


@kernel
def mean_map_bias(threshold: float, k: float, nlos_share: float) -> float:
    """Return E[max(0, u - threshold)] of a residual of the range mixture, everything in sigma.

    Both parts integrate in closed form: the normal's is phi(t) - t Phi(-t), a reflection's adds the
    mass of its bias beyond t, (Phi(-t) + exp(k^2/2 - k t) Phi(t - k)) / k.
    """
    t = threshold
    thermal = normal_density(t) - t * normal_cdf(-t)
    beyond = normal_cdf(-t) + math.exp(k * (0.5 * k - t) + truncated_normal(t - k)[0])
    return thermal + nlos_share * beyond / k
