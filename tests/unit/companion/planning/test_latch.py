"""The kernels of latched crossing against the class, which chooses by them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, TargetEstimate
from companion.geometry.polygons import Point
from companion.planning.crossing import LatchedCrossing, LatchedCrossingParams
from companion.planning.planner import PlanRequest
from companion.planning.views import (
    NO_LATCH,
    Latch,
    altitude_offset_m,
    direction,
    overshoot_m,
    turned,
)
from tools.study.walk import latched_step

PARAMS = LatchedCrossingParams()
PLANNER = LatchedCrossing(PARAMS)
WIDE = ((-1e4, -1e4), (1e4, -1e4), (1e4, 1e4), (-1e4, 1e4))

positions = st.tuples(st.floats(-200.0, 200.0), st.floats(-200.0, 200.0))


def _estimate(position: Point, variance_m2: float) -> TargetEstimate:
    covariance = ((variance_m2, 0.3 * variance_m2), (0.3 * variance_m2, 0.5 * variance_m2))
    return TargetEstimate(0.0, EstimateState.SEARCHING, position, covariance, 5.0, 0.0, 0.0, 1)


@settings(max_examples=60, deadline=None)
@given(
    positions,
    st.lists(
        st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.0, 100.0)),
        min_size=1,
        max_size=30,
    ),
    st.booleans(),
)
def test_stepped_by_the_kernel_it_flies_as_the_class_does(
    start: Point, drift: list[tuple[float, float, float]], has_fence: bool
) -> None:
    rule, latch = PARAMS.rule(), NO_LATCH
    memory: Latch | None = None
    vehicle, target = start, (0.0, 0.0)
    for east, north, variance_m2 in drift:
        target = (target[0] + east, target[1] + north)
        estimate = _estimate(target, variance_m2)
        request = PlanRequest(vehicle, estimate, WIDE if has_fence else None)
        plan = PLANNER.plan(request, memory)
        memory = plan.memory
        over_m = overshoot_m(variance_m2, 0.3 * variance_m2, 0.5 * variance_m2, 0.0, rule)
        latch = latched_step(latch, vehicle, target, over_m, True, rule)
        point = latch.point_enu_m
        assert memory == latch
        assert plan.waypoint.position_enu_m == point
        to_go = math.dist(vehicle, point)
        share = min(1.0, 5.0 / to_go) if to_go else 1.0
        vehicle = (
            vehicle[0] + share * (point[0] - vehicle[0]),
            vehicle[1] + share * (point[1] - vehicle[1]),
        )


def test_a_kept_latch_is_the_same() -> None:
    rule = PARAMS.rule()
    first = latched_step(NO_LATCH, (-30.0, 0.0), (0.0, 0.0), 6.0, True, rule)
    assert latched_step(first, (-25.0, 0.0), (0.0, 0.0), 6.0, True, rule) == first


@settings(deadline=None)
@given(st.floats(0.0, 400.0), st.floats(0.0, 400.0), st.floats(-1.0, 1.0))
def test_the_overshoot_is_that_of_the_largest_eigenvalue(a: float, c: float, rho: float) -> None:
    b = rho * math.sqrt(a * c)
    largest = float(np.linalg.eigvalsh(np.array([[a, b], [b, c]]))[-1])
    expected = min(max(3.0 * math.sqrt(max(largest, 0.0)), 2.0), 20.0)
    assert overshoot_m(a, b, c, 0.0, PARAMS.rule()) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_crossings_alternate_in_height() -> None:
    assert [altitude_offset_m(k, 4.0) for k in range(4)] == [4.0, -4.0, 4.0, -4.0]
    assert math.copysign(1.0, altitude_offset_m(1, 0.0)) == 1.0


def test_directions() -> None:
    assert direction((1.0, 1.0), (4.0, 5.0)) == pytest.approx((0.6, 0.8))
    assert direction((1.0, 1.0), (1.0, 1.0)) == (1.0, 0.0)
    assert turned((1.0, 0.0), 0.5 * math.pi) == pytest.approx((0.0, 1.0))


@pytest.mark.skipif(not hasattr(latched_step, "py_func"), reason="numba is not installed")
def test_compiled_and_plain_agree() -> None:
    plain = latched_step.py_func  # type: ignore[attr-defined]
    rule, rng = PARAMS.rule(), np.random.default_rng(2)
    one = other = NO_LATCH
    for _ in range(200):
        e, n, target_e, target_n, over_m = rng.uniform(-20.0, 20.0, 5).tolist()
        one = latched_step(one, (e, n), (target_e, target_n), over_m, True, rule)
        other = plain(other, (e, n), (target_e, target_n), over_m, True, rule)
        assert np.hstack(one) == pytest.approx(np.hstack(other), abs=1e-12)
