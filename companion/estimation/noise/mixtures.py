"""Densities and posterior moments of the noise mixtures that `adaptation` fits, as kernels.

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
def bearing_expectations(
    residual_rad: float, sigma_rad: float, wide_sigma_rad: float, wide_share: float
) -> tuple[float, float]:
    """Return the probability that a bearing residual is of the wide normal, and its log density.

    The density is per radian.
    """
    narrow, wide = residual_rad / sigma_rad, residual_rad / wide_sigma_rad
    log_narrow = math.log1p(-wide_share) - math.log(sigma_rad) - 0.5 * narrow * narrow
    log_wide = math.log(wide_share) - math.log(wide_sigma_rad) - 0.5 * wide * wide
    log_density = max(log_narrow, log_wide) + math.log1p(math.exp(-abs(log_wide - log_narrow)))
    return math.exp(log_wide - log_density), log_density - HALF_LOG_2_PI


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


@kernel
def one_sided_huber_variance(knot: float, k: float, nlos_share: float) -> tuple[float, float]:
    """Return n times the variance of the one-sided Huber location, and its threshold, in sigma.

    Residuals of the range mixture have their influence clipped at `knot`. The location converges to
    the mean of min(u, knot), which the filter's range offset absorbs; the threshold is knot -
    location.

    The moments of (knot - u)+ follow from those of u and of (u - knot)+; for a reflection the
    second moment of the latter is the normal's plus 2 / k times its first.
    """
    t, p = knot, nlos_share
    over = mean_map_bias(t, k, p)
    reflected_over = mean_map_bias(t, k, 1.0)
    over2 = (1.0 + t * t) * normal_cdf(-t) - t * normal_density(t) + 2.0 * p / k * reflected_over
    below = t - p / k + over
    below2 = 1.0 + 2.0 * p / (k * k) - 2.0 * t * p / k + t * t - over2
    slope = normal_cdf(t) - p * math.exp(k * (0.5 * k - t) + truncated_normal(t - k)[0])
    return (below2 - below * below) / (slope * slope), below


@kernel
def least_variance_k_long(k: float, nlos_share: float) -> float:
    """Return the one-sided threshold, in sigma, of about least variance under the range mixture."""
    best, least = 0.0, math.inf
    for step in range(61):
        variance, threshold = one_sided_huber_variance(-1.0 + 0.1 * step, k, nlos_share)
        if variance < least:
            best, least = threshold, variance
    return best


@kernel
def huber_variance(k: float, wide_ratio: float, wide_share: float) -> float:
    """Return n times the variance of Huber's location estimate, E psi^2 / E[psi']^2.

    In squares of the narrow sigma: 1 is what least squares has without the wide normal of the
    mixture, which is `wide_ratio` as wide. The threshold k is on both sides, in narrow sigma.
    """
    slope, square = 0.0, 0.0
    for scale, share in ((1.0, 1.0 - wide_share), (wide_ratio, wide_share)):
        a = k / scale
        inside = 2.0 * normal_cdf(a) - 1.0
        slope += share * inside
        quadratic = scale * scale * (inside - 2.0 * a * normal_density(a))
        square += share * (quadratic + 2.0 * k * k * normal_cdf(-a))
    return square / (slope * slope)


@kernel
def least_variance_k(wide_ratio: float, wide_share: float, k_min: float, k_max: float) -> float:
    """Return the threshold in [k_min, k_max] of least `huber_variance`, to about 5 %."""
    best, least, steps = k_max, huber_variance(k_max, wide_ratio, wide_share), 40
    for step in range(steps):
        k = k_min * (k_max / k_min) ** (step / steps)
        variance = huber_variance(k, wide_ratio, wide_share)
        if variance < least:
            best, least = k, variance
    return best
