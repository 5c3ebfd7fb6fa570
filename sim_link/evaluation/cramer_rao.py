"""What no estimator can beat: Fisher information of the true channel, and the bound on a track.

A measurement is y = (h_r(x) + delta_r, h_b(x) + delta_b) + e. One draw decides for range and
bearing together whether the path is obstructed, so the two errors are not independent, and their
joint density is the mixture

    p(a, b) = (1 - p) N(a; 0, s_r^2) N(b; 0, s_b^2)
                  + p E(a; s_r, mu)  N(b; 0, s_b^2 + w^2)

with E the exponentially modified Gaussian of thermal noise and NLOS bias, and w the bend of an
obstructed path. The information that one measurement has about its location (h + delta) is the
expectation of the score's square; the density is even in b, so range and bearing do not mix:

    J = diag( E[(d log p / da)^2], E[(d log p / db)^2] )

and that of a track about [east, north, delta_r, delta_b] is the sum of H^T J H. The offsets are
nuisance: the bound on the position is the position block of the inverse. For given offsets their
priors do not count; where they are drawn from them, they do (van Trees).

What is left out favours the bound: bearings do not wrap, and ranges are not cut at zero.

Source: S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), ch. 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import log_ndtr

from companion.geometry.arrays import Matrix, Vector
from sim_link.world.radio_channel import ChannelParams

TAIL_SIGMAS = 9.0
"""Gaussian tails are cut here."""
TAIL_MEANS = 40.0
"""Exponential tails are cut here, in means."""
NO_BIAS_SIGMAS = 1e-4
"""A mean bias smaller than this is none."""
LEAST_SHARE = 1e-12
"""Information below this share of what the known offsets would leave is rounding."""
MIN_DISTANCE_M = 1e-3
"""Nearer than this a direction has no meaning, and a measurement says nothing of the position."""


@dataclass(frozen=True, slots=True)
class ChannelInformation:
    """Fisher information of one measurement about where its error is centred."""

    range_per_m2: float
    bearing_per_rad2: float


def channel_information(channel: ChannelParams, points_per_sigma: int = 12) -> ChannelInformation:
    """The information J of a channel, by quadrature over both errors.

    Args:
        channel: The truth.
        points_per_sigma: Nodes of the trapezoidal rule per thermal standard deviation.

    Raises:
        ValueError: A channel without thermal noise: information without limit.
    """
    if channel.range_sigma_m <= 0.0 or channel.bearing_sigma_deg <= 0.0:
        raise ValueError("a channel without thermal noise has no bound")
    return _information(
        channel.range_sigma_m,
        math.radians(channel.bearing_sigma_deg),
        channel.p_nlos,
        channel.range_bias_mean_m,
        math.radians(channel.bearing_bias_sigma_deg),
        points_per_sigma,
    )


@lru_cache(maxsize=64)
def _information(
    range_sigma: float, bearing_sigma: float, p: float, mean_bias: float, bend: float, fineness: int
) -> ChannelInformation:
    """The trapezoidal rule converges faster than any power here: all is smooth and dies out."""
    wide = math.hypot(bearing_sigma, bend)
    da, db = range_sigma / fineness, bearing_sigma / fineness
    farthest = TAIL_SIGMAS * range_sigma + TAIL_MEANS * mean_bias
    a = np.arange(-TAIL_SIGMAS * range_sigma, farthest + da, da)
    b = np.arange(0.0, TAIL_SIGMAS * wide + db, db)
    weights = np.where(b == 0.0, da * db, 2.0 * da * db)  # even in b: half of the plane will do
    clear_a, clear_da = normal(a, range_sigma)
    blocked_a, blocked_da = modified_normal(a, range_sigma, mean_bias)
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


def normal(x: Vector, sigma: float) -> tuple[Vector, Vector]:
    """Density of a centred normal and its derivative."""
    density = np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
    return density, -x / sigma**2 * density


def modified_normal(x: Vector, sigma: float, mean: float) -> tuple[Vector, Vector]:
    """Density of a centred normal plus an exponential, and its derivative.

    Args:
        x: Where.
        sigma: Of the normal.
        mean: Of the exponential; 0: there is none.
    """
    if mean < NO_BIAS_SIGMAS * sigma:
        return normal(x, sigma)
    ratio = sigma / mean
    density = np.exp(0.5 * ratio**2 - x / mean + log_ndtr(x / sigma - ratio)) / mean
    return density, (normal(x, sigma)[0] - density) / mean


def track_information(
    track_enu_m: Matrix, target_enu_m: Vector, information: ChannelInformation
) -> Matrix:
    """Information after every place of a track, (steps, 4, 4), summed up.

    Args:
        track_enu_m: (steps, 2).
        target_enu_m: (2,).
        information: Of one measurement.
    """
    de, dn = (target_enu_m - track_enu_m).T
    distance = np.hypot(de, dn)
    inverse = np.divide(1.0, distance, out=np.zeros_like(distance), where=distance > MIN_DISTANCE_M)
    ue, un, zero, one = de * inverse, dn * inverse, np.zeros_like(de), np.ones_like(de)
    by_range = np.column_stack([ue, un, one, zero])
    by_bearing = np.column_stack([-un * inverse, ue * inverse, zero, one])
    steps = information.range_per_m2 * by_range[:, :, None] * by_range[:, None, :]
    steps += information.bearing_per_rad2 * by_bearing[:, :, None] * by_bearing[:, None, :]
    return np.asarray(np.cumsum(steps, axis=0))


def position_bound_m2(information: Matrix, offset_sigmas: Vector | None = None) -> Vector:
    """Least trace of the position's covariance, (...,), infinite where it cannot be known.

    Args:
        information: (..., 4, 4).
        offset_sigmas: (2,) priors of the offsets where they are drawn anew for each run, metres
            and radians; None: they are unknown constants.
    """
    prior = np.zeros((4, 4))
    if offset_sigmas is not None:
        prior[[2, 3], [2, 3]] = 1.0 / np.asarray(offset_sigmas) ** 2
    total = information + prior
    offsets = total[..., 2:, 2:]
    cross = total[..., :2, 2:]
    is_known = np.linalg.det(offsets) > 0.0
    offsets = np.where(is_known[..., None, None], offsets, np.eye(2))
    marginal = total[..., :2, :2] - cross @ np.linalg.solve(offsets, np.swapaxes(cross, -1, -2))
    trace = marginal[..., 0, 0] + marginal[..., 1, 1]
    det = marginal[..., 0, 0] * marginal[..., 1, 1] - marginal[..., 0, 1] * marginal[..., 1, 0]
    least = LEAST_SHARE * (total[..., 0, 0] + total[..., 1, 1])
    is_known &= (trace > least) & (det > least * trace)
    bound: Vector = np.divide(trace, det, out=np.full(trace.shape, np.inf), where=is_known)
    return bound


def rmse_bound_m(
    tracks_enu_m: Iterable[Matrix],
    target_enu_m: Vector,
    channel: ChannelParams,
    offset_sigmas: Vector | None = None,
) -> Vector:
    """The bound on the RMSE over runs after every step, (steps,), metres.

    Args:
        tracks_enu_m: (steps, 2) of each run.
        target_enu_m: (2,).
        channel: The truth.
        offset_sigmas: See `position_bound_m2`.
    """
    information = channel_information(channel)
    bounds = [
        position_bound_m2(track_information(track, target_enu_m, information), offset_sigmas)
        for track in tracks_enu_m
    ]
    return np.asarray(np.sqrt(np.mean(bounds, axis=0)))
