"""The paper's FIM planner to the letter: what one expected measurement says of the position.

    s* = argmax over s of lambda_min( H_p(s)^T R^-1 H_p(s) )

H_p is the position's part of the partials, R the thermal variances. There is no prior information
in it, and the offsets are taken for known. The partials of range and bearing are orthogonal, so the
eigenvalues are theirs,

    lambda_min = min( 1 / sigma_r^2,  1 / (distance sigma_theta)^2 ),

and nearer to the estimate than sigma_r / sigma_theta (43 m in the canonical scenario) the criterion
is flat: every candidate is as good as every other. One of the best is picked at random, as rounding
does in an eigenvalue routine. The planner that flies, `companion.planning.fim`, asks for what the
measurement adds to the information in the filter instead.

Paper: eq. (FIM planning objective). Deviation: the paper leaves candidates and ties open; the
candidates are those of `companion.planning.fim`.
"""

from __future__ import annotations

import math

import numpy as np

from companion.kernel import Matrix, Vector, kernel
from companion.planning.fim import MIN_DISTANCE_M, STAY

FLAT_SHARE = 1e-9
"""Candidates within this share of the best are as good."""


@kernel
def printed_criteria(
    de_m: float, dn_m: float, ring_m: Matrix, range_sigma_m: float, bearing_sigma_rad: float
) -> Vector:
    """Smaller eigenvalue of the information at every candidate, (k + 1,), 1/m^2; last: staying.

    Args:
        de_m: From the vehicle to the estimate, east.
        dn_m: The same, north.
        ring_m: (k, 2) steps of the candidates.
        range_sigma_m: Thermal noise.
        bearing_sigma_rad: Thermal noise.
    """
    moves = ring_m.shape[0]
    criteria = np.empty(moves + 1)
    for index in range(moves + 1):
        e_m, n_m = de_m, dn_m
        if index < moves:
            e_m -= ring_m[index, 0]
            n_m -= ring_m[index, 1]
        distance_m = max(math.hypot(e_m, n_m), MIN_DISTANCE_M)
        worst_m = max(range_sigma_m, distance_m * bearing_sigma_rad)
        criteria[index] = 1.0 / (worst_m * worst_m)
    return criteria


@kernel
def printed_candidate(criteria: Vector, pick: float) -> int:
    """Index of one of the best candidates: a row of the ring, or `STAY`.

    Args:
        criteria: (k + 1,) see `printed_criteria`.
        pick: In [0, 1): which of them.
    """
    is_best = criteria >= criteria.max() * (1.0 - FLAT_SHARE)
    left = int(pick * is_best.sum())
    for index in range(criteria.size):
        if is_best[index]:
            if left == 0:
                return index if index < criteria.size - 1 else STAY
            left -= 1
    return STAY


def information_gradient(criteria: Vector) -> float:
    """How much the best candidate is ahead of the worst, as a share of the best."""
    best = float(criteria.max())
    return (best - float(criteria.min())) / best
