"""The companion's EKF against filterpy's, both behind the same protocol."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import Ekf
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.kernel import Vector
from tests.oracle.filterpy_ekf import FilterpyEkf

PLANE = FilterParams(own_position_sigma_m=0.0)
LAYOUTS = {
    "plane": PLANE,
    "as printed": msgspec.structs.replace(PLANE, near_target_terms=False),
    "space": FilterParams(target_height_m=2.0, target_height_sigma_m=4.0),
    "scaled": FilterParams(range_scale_sigma=0.05, target_height_sigma_m=4.0),
    "bounded": FilterParams(range_offset_min_m=0.0, range_offset_max_m=3.0),
    "moving": FilterParams(process_noise_m_per_sqrt_s=0.4, target_height_sigma_m=1.0),
}
ROWS = {
    "all": (True, True, True),
    "range and bearing": (True, True, False),
    "range": (True, False, False),
    "bearing": (False, True, False),
    "elevation": (False, False, True),
    "nothing": (False, False, False),
}


def _state(params: FilterParams, rng: np.random.Generator) -> FilterState:
    mean, sigmas = params.prior
    root = np.eye(mean.size) + 0.3 * rng.normal(size=(mean.size, mean.size))
    covariance = root @ root.T * np.outer(sigmas, sigmas) * 0.05
    return FilterState.of(0.0, mean + 0.2 * sigmas * rng.normal(size=mean.size), covariance)


def _seen(time_s: float, z: Vector, rows: tuple[bool, bool, bool]) -> RangingMeasurement:
    ranged, borne, elevated = (float(v) if on else None for v, on in zip(z, rows, strict=True))
    return RangingMeasurement(
        1, time_s, range_m=ranged, bearing_enu_rad=borne, elevation_rad=elevated
    )


def _view(rng: np.random.Generator) -> tuple[PositionEnu, Vector]:
    """Return a position about a target at the origin, and noisy measurements there."""
    angle, ground, up = rng.uniform(-math.pi, math.pi), rng.uniform(8.0, 80.0), rng.uniform(5, 30)
    position = (ground * math.cos(angle), ground * math.sin(angle), float(up))
    z = np.array([math.hypot(ground, up), angle - math.pi, -math.atan2(up, ground)])
    z += rng.normal(size=3) * [1.5, 0.04, 0.1]
    z[1] = math.remainder(z[1], 2.0 * math.pi)
    return position, z


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
@pytest.mark.parametrize("params", LAYOUTS.values(), ids=LAYOUTS)
def test_states_and_reports_agree(params: FilterParams, rows: tuple[bool, bool, bool]) -> None:
    ours, theirs = Ekf(params), FilterpyEkf(params)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        state, time_s = _state(params, rng), 0.0
        for _ in range(15):
            time_s += rng.uniform(0.0, 2.0)
            position, z = _view(rng)
            measurement = _seen(time_s - rng.choice([0.0, 0.6]), z, rows)
            inflation = (float(rng.uniform(1.0, 4.0)), 1.0, 2.0)
            predicted, theirs_predicted = ours.predict(state, time_s), theirs.predict(state, time_s)
            _assert_same(predicted, theirs_predicted)
            one = ours.update(predicted, measurement, position, inflation)
            two = theirs.update(predicted, measurement, position, inflation)
            _assert_same(one.state, two.state)
            assert two.nis == pytest.approx(one.nis, rel=1e-7, abs=1e-9)
            for ours_row, theirs_row in zip(one.modalities, two.modalities, strict=True):
                assert (ours_row is None) is (theirs_row is None)
                if ours_row is not None and theirs_row is not None:
                    np.testing.assert_allclose(
                        [getattr(theirs_row, name) for name in ours_row.__slots__],
                        [getattr(ours_row, name) for name in ours_row.__slots__],
                        rtol=1e-7,
                        atol=1e-9,
                    )
            state = one.state


def _assert_same(one: FilterState, other: FilterState) -> None:
    assert one.time_s == other.time_s
    np.testing.assert_allclose(other.mean, one.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-9, atol=1e-9)


def test_a_covariance_that_is_lost_leaves_the_state() -> None:
    state = FilterState.of(0.0, np.array([5.0, 5.0, 0.0, 0.0]), np.diag([1.0, 1.0, 1.0, -1.0]))
    report = FilterpyEkf(PLANE).update(
        state, _seen(0.0, np.array([7.0, 0.8, 0.0]), (True, False, False)), (0.0, 0.0, 0.0)
    )
    assert not report.is_positive_definite
    assert report.state is state


def test_it_never_looks_back() -> None:
    state = FilterState.of(3.0, np.zeros(5), np.eye(5))
    assert FilterpyEkf(LAYOUTS["moving"]).predict(state, 1.0).time_s == 3.0
