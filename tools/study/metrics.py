"""Errors, convergence and consistency of many runs, and the Cramer-Rao bound next to them.

A measurement is y = (h_r(x) + delta_r, h_b(x) + delta_b) + e. One draw decides for range and
bearing together whether the path is obstructed, so the joint density of the errors is the mixture

    p(a, b) = (1 - p) N(a; 0, s_r^2) N(b; 0, s_b^2)
                  + p E(a; s_r, mu)  N(b; 0, s_b^2 + w^2)

with E the exponentially modified Gaussian of thermal noise and NLOS bias, and w the bend of an
obstructed path. The density is even in b, so the information about the location (h + delta) is

    J = diag( E[(d log p / da)^2], E[(d log p / db)^2] )

and that of a track about [east, north, delta_r, delta_b] is the sum of H^T J H. The offsets are
nuisance: the bound is the position block of the inverse; priors of the offsets count only where
they are drawn from them (van Trees). Bearings do not wrap and ranges are not cut at zero here, both
in favour of the bound.

Source: S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), ch. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaincinv, log_ndtr

from companion.estimation.target_estimate import MIN_AXIS_RATIO, r95_of_covariance_m
from companion.kernel import Matrix, Vector
from sim_link.world.environment import ChannelParams

SETTLED_STEP = 20
"""Honesty counts after this step."""
COVERAGE_BAND = (0.93, 0.97)
"""Coverage of a consistent R95 circle."""
SETTLED_M = 2.5
"""Error below which a run has settled. Paper: Time-to-Threshold."""
DIVERGED_M = SETTLED_M
"""Error beyond which a run has diverged: it has not settled in the paper's own sense. Its square
alone decides an RMSE over runs, so that such an RMSE is not comparable with another."""
R95_TABLE_SIZE = 513


def steps_to_settle(rmse_by_step_m: Vector, threshold_m: float = SETTLED_M) -> int | None:
    """Return one more than the last step (from 1) with an RMSE not below the threshold.

    None if the last step of all is not below it: the paper's ">500". Paper: "settle below".
    """
    above = np.flatnonzero(~(rmse_by_step_m < threshold_m))
    if not above.size:
        return 1
    return None if above[-1] + 1 == rmse_by_step_m.size else int(above[-1]) + 2


def nees(errors_enu_m: Matrix, covariances_m2: Matrix) -> Vector:
    """Return the normalised estimation errors squared e^T P^-1 e of the position, (...,).

    Errors are (..., 2), covariances (..., 3): the entries east-east, east-north, north-north.
    """
    e, n = errors_enu_m[..., 0], errors_enu_m[..., 1]
    ee, en, nn = (covariances_m2[..., index] for index in range(3))
    return np.asarray((e * e * nn - 2.0 * e * n * en + n * n * ee) / (ee * nn - en * en))


def nees_band(runs: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean NEES over independent runs of a consistent filter.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation (2001), section 5.4.
    """
    low, high = 2.0 * gammaincinv(runs, (0.025, 0.975)) / runs  # chi-square, 2 dimensions
    return float(low), float(high)


def r95_m(covariances_m2: Matrix) -> Vector:
    """Return the radius about the mean that holds 95 % of a 2-D Gaussian, (...,), metres.

    Covariances are (..., 3) as for `nees`. By interpolation in
    `companion.estimation.target_estimate.r95_of_covariance_m`, within 1e-5.
    """
    ee, en, nn = (covariances_m2[..., index] for index in range(3))
    half_trace, half_gap = 0.5 * (ee + nn), np.hypot(0.5 * (ee - nn), en)
    high = np.maximum(half_trace + half_gap, 0.0)
    low = np.maximum(half_trace - half_gap, 0.0)
    sharpness = np.sqrt(np.divide(low, high, out=np.ones_like(high), where=high > 0.0))
    return np.asarray(np.interp(sharpness, *_r95_table()) * np.sqrt(high))


@lru_cache(maxsize=1)
def _r95_table() -> tuple[Vector, Vector]:
    """Return axis ratios, and the R95 of each in units of the longer axis."""
    sharpness = np.linspace(np.sqrt(MIN_AXIS_RATIO), 1.0, R95_TABLE_SIZE)
    return sharpness, np.array([r95_of_covariance_m(np.diag([q * q, 1.0])) for q in sharpness])


TAIL_SIGMAS = 9.0
"""Gaussian tails are cut here."""
TAIL_MEANS = 40.0
"""Exponential tails are cut here, in means."""
NO_BIAS_SIGMAS = 1e-4
"""Mean bias below which an estimator counts as unbiased."""
MIN_SHARE = 1e-12
"""Share of the information with known offsets below which the rest is rounding."""
MIN_DISTANCE_M = 1e-3
"""Distance below which a direction has no meaning, and a measurement no information."""


@dataclass(frozen=True, slots=True)
class ChannelInformation:
    """Fisher information of one measurement about the centre of its error."""

    range_per_m2: float
    bearing_per_rad2: float


def channel_information(
    channel: ChannelParams, points_per_sigma: int = 12, *, is_joint: bool = True
) -> ChannelInformation:
    """Return the information J of a channel with thermal noise, or a ValueError, by quadrature.

    The trapezoidal rule has `points_per_sigma` nodes per thermal standard deviation. If not
    joint, each error has a draw of its own, independent of the other's obstruction.
    """
    if channel.range_sigma_m <= 0.0 or channel.bearing_sigma_deg <= 0.0:
        raise ValueError("a channel without thermal noise has no bound")
    information = _information if is_joint else _separate_information
    return information(channel, points_per_sigma)


@lru_cache(maxsize=64)
def _information(channel: ChannelParams, fineness: int) -> ChannelInformation:
    """Integrate by the trapezoidal rule, which converges fast for smooth, decaying integrands."""
    p, (bearing_sigma, wide) = channel.p_nlos, _bearing_sigmas(channel)
    db = bearing_sigma / fineness
    da, (clear_a, clear_da), (blocked_a, blocked_da) = _ranges(channel, fineness)
    b = np.arange(0.0, TAIL_SIGMAS * wide + db, db)
    weights = np.where(b == 0.0, da * db, 2.0 * da * db)  # even in b: half of the plane will do
    clear_b, clear_db = normal(b, bearing_sigma)
    blocked_b, blocked_db = normal(b, wide)
    by_range = by_bearing = 0.0
    for index, weight in enumerate(weights.tolist()):
        clear, blocked = (1.0 - p) * clear_b[index], p * blocked_b[index]
        density = clear * clear_a + blocked * blocked_a
        by_a = clear * clear_da + blocked * blocked_da
        by_b = (1.0 - p) * clear_db[index] * clear_a + p * blocked_db[index] * blocked_a
        inverse = np.divide(1.0, density, out=np.zeros_like(density), where=density > 1e-290)
        by_range += weight * float(np.sum(by_a * by_a * inverse))
        by_bearing += weight * float(np.sum(by_b * by_b * inverse))
    return ChannelInformation(by_range, by_bearing)


@lru_cache(maxsize=64)
def _separate_information(channel: ChannelParams, fineness: int) -> ChannelInformation:
    """Return the information of each of the two mixtures by itself."""
    p, (bearing_sigma, wide) = channel.p_nlos, _bearing_sigmas(channel)
    db = bearing_sigma / fineness
    b = np.arange(-TAIL_SIGMAS * wide, TAIL_SIGMAS * wide + db, db)
    da, clear_a, blocked_a = _ranges(channel, fineness)
    found = []
    for (clear, clear_slope), (blocked, blocked_slope), width in (
        (clear_a, blocked_a, da),
        (normal(b, bearing_sigma), normal(b, wide), db),
    ):
        density = (1.0 - p) * clear + p * blocked
        slope = (1.0 - p) * clear_slope + p * blocked_slope
        inverse = np.divide(1.0, density, out=np.zeros_like(density), where=density > 1e-290)
        found.append(width * float(np.sum(slope * slope * inverse)))
    return ChannelInformation(*found)


Density = tuple[Vector, Vector]
"""Density and its derivative."""


def _bearing_sigmas(channel: ChannelParams) -> tuple[float, float]:
    """Return the sigmas of thermal noise alone, and with the bend of an obstructed path, rad."""
    sigma = math.radians(channel.bearing_sigma_deg)
    return sigma, math.hypot(sigma, math.radians(channel.bearing_bias_sigma_deg))


def _ranges(channel: ChannelParams, fineness: int) -> tuple[float, Density, Density]:
    """Return the step between range errors, and the densities on clear and blocked paths."""
    sigma, mean_bias = channel.range_sigma_m, channel.range_bias_mean_m
    da = sigma / fineness
    farthest = TAIL_SIGMAS * sigma + TAIL_MEANS * mean_bias
    a = np.arange(-TAIL_SIGMAS * sigma, farthest + da, da)
    return da, normal(a, sigma), modified_normal(a, sigma, mean_bias)


def normal(x: Vector, sigma: float) -> tuple[Vector, Vector]:
    """Return the density of a centred normal and its derivative."""
    density = np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
    return density, -x / sigma**2 * density


def modified_normal(x: Vector, sigma: float, mean: float) -> tuple[Vector, Vector]:
    """Return the density of a centred normal plus an exponential of a mean, and its derivative."""
    if mean < NO_BIAS_SIGMAS * sigma:
        return normal(x, sigma)
    ratio = sigma / mean
    density = np.exp(0.5 * ratio**2 - x / mean + log_ndtr(x / sigma - ratio)) / mean
    return density, (normal(x, sigma)[0] - density) / mean


def position_bounds_m2(
    track_enu_m: Matrix,
    target_enu_m: Vector,
    range_per_m2: Vector,
    bearing_per_rad2: Vector,
    prior: Vector,
) -> Vector:
    """Return the smallest trace of the position's covariance after every step of a track, m^2.

    The track is (steps, 2); the bound is infinite where the position is unobservable. The offsets
    do not mix, so that the position's marginal information is found without a matrix inverse. Of
    each measurement the information is (steps,), of the offsets before the first (2,), 1/m^2 and
    1/rad^2: zeros if they are unknown constants.
    """
    away = target_enu_m - track_enu_m
    distance = np.hypot(*away.T)
    inverse = np.divide(1.0, distance, out=np.zeros_like(distance), where=distance > MIN_DISTANCE_M)
    ue, un = away.T * inverse
    total = marginal = np.zeros((3, len(track_enu_m)))
    with np.errstate(divide="ignore", invalid="ignore"):
        for weight, known, (e, n) in (
            (range_per_m2, prior[0], (ue, un)),
            (bearing_per_rad2, prior[1], (-un * inverse, ue * inverse)),
        ):
            own = np.cumsum(weight * np.array((e * e, e * n, n * n)), axis=1)
            with_e, with_n = np.cumsum(weight * np.array((e, n)), axis=1)
            mixed = np.array((with_e * with_e, with_e * with_n, with_n * with_n))
            total, marginal = total + own, marginal + own - mixed / (known + np.cumsum(weight))
        trace, det = marginal[0] + marginal[2], marginal[0] * marginal[2] - marginal[1] ** 2
        least = MIN_SHARE * (total[0] + total[2])
        return np.where((trace > least) & (det > least * trace), trace / det, np.inf)
