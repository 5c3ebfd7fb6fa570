from __future__ import annotations

import math

import numpy as np
import pytest

from companion.planning.fim import STAY, candidate_ring_m
from tools.study.walk import information_gradient, printed_candidate, printed_criteria

RING_M = np.array(candidate_ring_m(5.0))
RANGE_SIGMA_M, BEARING_SIGMA_RAD = 1.5, math.radians(2.0)
FLAT_M = RANGE_SIGMA_M / BEARING_SIGMA_RAD
"""Nearer than this the range has the smaller eigenvalue, wherever it is taken from."""


def _criteria(de_m: float, dn_m: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return printed_criteria(de_m, dn_m, RING_M, RANGE_SIGMA_M, BEARING_SIGMA_RAD)


@pytest.mark.parametrize("position", [(60.0, 20.0), (-3.0, 4.0), (0.0, 0.5)])
def test_it_is_the_smaller_eigenvalue_of_the_positions_information(
    position: tuple[float, float],
) -> None:
    e, n = position
    r2 = e * e + n * n
    H = np.array([[e, n], [-n / math.sqrt(r2), e / math.sqrt(r2)]]) / math.sqrt(r2)
    information = H.T @ np.diag([RANGE_SIGMA_M**-2, BEARING_SIGMA_RAD**-2]) @ H
    assert _criteria(e, n)[-1] == pytest.approx(np.linalg.eigvalsh(information)[0], rel=1e-9)


def test_far_from_the_estimate_it_flies_there() -> None:
    criteria = _criteria(80.0, 0.0)
    assert printed_candidate(criteria, 0.7) == 0
    assert information_gradient(criteria) > 0.1


def test_near_the_estimate_every_candidate_is_as_good_and_chance_decides() -> None:
    criteria = _criteria(0.5 * FLAT_M, 0.0)
    assert information_gradient(criteria) == 0.0
    picks = {printed_candidate(criteria, (index + 0.5) / 17.0) for index in range(17)}
    assert picks == {STAY, *range(16)}


def test_among_equals_only_the_best_are_picked() -> None:
    criteria = _criteria(FLAT_M + 2.0, 0.0)
    best = set(np.flatnonzero(criteria == criteria.max()).tolist())
    assert 1 < len(best) < 16
    assert {printed_candidate(criteria, pick) for pick in np.linspace(0.0, 0.999, 50)} == best
