"""What is said of many runs: errors, convergence, and whether estimates are honest.

Errors are (runs, steps) unless said otherwise.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from companion.estimation.integrity.consistency import MIN_AXIS_RATIO, r95_of_covariance_m
from companion.kernel import Matrix, Vector

SETTLED_M = 2.5
"""Paper: Time-to-Threshold."""
DIVERGED_M = 1.0
"""A run that ends farther off than this counts as diverged."""
POSITION_DIMENSIONS = 2
R95_TABLE_SIZE = 513


def rmse_m(errors_m: Matrix) -> Vector:
    """Root mean square over runs after every step, (steps,)."""
    return np.asarray(np.sqrt(np.mean(np.square(errors_m), axis=0)))


def steps_to_settle(rmse_by_step_m: Vector, threshold_m: float = SETTLED_M) -> int | None:
    """One more than the last step (from 1) with an RMSE not below the threshold.

    None where the last step of all is not below it: the paper's ">500". Paper: "settle below".
    """
    above = np.flatnonzero(~(rmse_by_step_m < threshold_m))
    if not above.size:
        return 1
    return None if above[-1] + 1 == rmse_by_step_m.size else int(above[-1]) + 2


def diverged_count(final_errors_m: Vector, threshold_m: float = DIVERGED_M) -> int:
    """Runs that ended farther off, or nowhere."""
    return int(np.sum(~(final_errors_m <= threshold_m)))


def bootstrap_rmse_m(
    final_errors_m: Vector, rng: np.random.Generator, resamples: int = 2000
) -> tuple[float, float]:
    """The 95 % bootstrap percentile interval of the RMSE of (runs,) errors."""
    runs = len(final_errors_m)
    squares = np.square(final_errors_m)
    picked = rng.multinomial(runs, np.full(runs, 1.0 / runs), size=resamples)
    low, high = np.quantile(np.sqrt(picked @ squares / runs), (0.025, 0.975))
    return float(low), float(high)


def nees(errors_enu_m: Matrix, covariances_m2: Matrix) -> Vector:
    """Normalised estimation errors squared e^T P^-1 e of the position, (...,).

    Args:
        errors_enu_m: (..., 2).
        covariances_m2: (..., 3) the entries east-east, east-north, north-north.
    """
    e, n = errors_enu_m[..., 0], errors_enu_m[..., 1]
    ee, en, nn = (covariances_m2[..., index] for index in range(3))
    return np.asarray((e * e * nn - 2.0 * e * n * en + n * n * ee) / (ee * nn - en * en))


def nees_band(runs: int, dimensions: int = POSITION_DIMENSIONS) -> tuple[float, float]:
    """Where the mean NEES over independent runs is with a probability of 95 %, if honest.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation (2001), section 5.4.
    """
    low, high = 2.0 * gammaincinv(0.5 * dimensions * runs, (0.025, 0.975)) / runs  # chi-square
    return float(low), float(high)


def r95_m(covariances_m2: Matrix) -> Vector:
    """Radius of the circle about the mean that holds 95 % of a 2-D Gaussian, (...,), metres.

    Args:
        covariances_m2: (..., 3) the entries east-east, east-north, north-north.

    By interpolation in `companion.estimation.consistency.r95_of_covariance_m`, within 1e-5.
    """
    ee, en, nn = (covariances_m2[..., index] for index in range(3))
    half_trace, half_gap = 0.5 * (ee + nn), np.hypot(0.5 * (ee - nn), en)
    high = np.maximum(half_trace + half_gap, 0.0)
    low = np.maximum(half_trace - half_gap, 0.0)
    sharpness = np.sqrt(np.divide(low, high, out=np.ones_like(high), where=high > 0.0))
    return np.asarray(np.interp(sharpness, *_r95_table()) * np.sqrt(high))


def coverage(errors_m: Matrix, radii_m: Matrix) -> Vector:
    """Share of runs whose circle contains the target after every step, (steps,)."""
    is_inside: NDArray[np.bool_] = errors_m <= radii_m
    return np.asarray(np.mean(is_inside, axis=0))


@lru_cache(maxsize=1)
def _r95_table() -> tuple[Vector, Vector]:
    """Ratios of the axes, and R95 in units of the longer one."""
    sharpness = np.linspace(np.sqrt(MIN_AXIS_RATIO), 1.0, R95_TABLE_SIZE)
    return sharpness, np.array([r95_of_covariance_m(np.diag([q * q, 1.0])) for q in sharpness])
