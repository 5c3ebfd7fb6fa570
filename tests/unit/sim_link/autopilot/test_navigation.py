"""The error of a vehicle's own position: its statistics, its changes, and its report."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.geometry.coordinates import LocalOrigin
from sim_link.autopilot.estimator import (
    EstimatedMotion,
    Estimator,
    FixChange,
    GpsParams,
    NavigationError,
    NavigationParams,
)
from sim_link.world.point_mass import MulticopterParams, PointMass, WindParams

ORIGIN = LocalOrigin(47.4, 8.5, 488.0)
WANDERS = NavigationParams(
    sigma_m=1.5, time_constant_s=60.0, height_sigma_m=3.0, height_time_constant_s=20.0
)


def errors_m(params: NavigationParams, seed: int, count: int, dt_s: float) -> list[PositionEnu]:
    error = NavigationError(params, np.random.default_rng(seed))
    found = []
    for index in range(count):
        error.step(index * dt_s, dt_s)
        found.append(error.enu_m)
    return found


def test_it_is_as_large_from_the_start_as_later() -> None:
    starts = np.array([errors_m(WANDERS, seed, 1, 0.0)[0] for seed in range(2000)])
    assert starts.std(axis=0) == pytest.approx((1.5, 1.5, 3.0), rel=0.06)
    later = np.array(errors_m(WANDERS, 1, 20_000, 200.0))
    assert later.std(axis=0) == pytest.approx((1.5, 1.5, 3.0), rel=0.04)
    assert later.mean(axis=0) == pytest.approx((0.0, 0.0, 0.0), abs=0.15)


def test_it_forgets_itself_over_its_time_constant_each_axis_by_itself() -> None:
    found = np.array(errors_m(WANDERS, 2, 100_000, 10.0))
    for axis, tau_s in ((0, 60.0), (1, 60.0), (2, 20.0)):
        correlation = np.corrcoef(found[:-2, axis], found[2:, axis])[0, 1]
        assert correlation == pytest.approx(math.exp(-20.0 / tau_s), abs=0.03)
    assert abs(np.corrcoef(found[:, 0], found[:, 1])[0, 1]) < 0.05


def test_the_size_of_steps_does_not_matter() -> None:
    fine = np.array(errors_m(WANDERS, 3, 40_000, 0.5))
    moved = fine[120:, 0] - fine[:-120, 0]  # over one time constant
    assert moved.std() == pytest.approx(1.5 * math.sqrt(2.0 * (1.0 - math.exp(-1.0))), rel=0.1)


def test_a_change_of_the_fix_is_a_jump_to_an_error_of_another_size() -> None:
    changes = (
        FixChange(at_s=20.0, fix="3d", sigma_m=3.0, height_sigma_m=5.0),
        FixChange(at_s=10.0, fix="rtk_float", sigma_m=0.3),
    )
    params = NavigationParams(
        fix="rtk_fixed", sigma_m=0.02, height_sigma_m=0.04, time_constant_s=1e6, fix_changes=changes
    )
    after = []
    for seed in range(500):
        error = NavigationError(params, np.random.default_rng(seed))
        seen = []
        for now_s in (9.9, 10.0, 30.0):
            error.step(now_s, 0.1)
            seen.append((error.fix, error.sigma_m, error.height_sigma_m))
        assert seen == [("rtk_fixed", 0.02, 0.04), ("rtk_float", 0.3, 0.04), ("3d", 3.0, 5.0)]
        after.append(error.enu_m)
    assert np.std(after, axis=0) == pytest.approx((3.0, 3.0, 5.0), rel=0.1)


def test_without_sizes_there_is_no_error_and_nothing_is_drawn() -> None:
    rng, untouched = np.random.default_rng(1), np.random.default_rng(1)
    estimator = Estimator(ORIGIN, GpsParams(), 0.0, rng)
    estimator.step(0.0, (1.0, 2.0, 3.0), 0.02)
    assert estimator.error is None
    assert estimator.reported_enu_m == (1.0, 2.0, 3.0)
    assert rng.standard_normal() == untouched.standard_normal()
    assert not NavigationParams(compass_error_deg=5.0).errs_in_position


@pytest.mark.parametrize(
    ("noise_m", "changes", "expected_m"),
    [
        (0.0, {}, (0.02, 0.04)),
        (0.3, {}, (math.hypot(0.02, 0.3), math.hypot(0.04, 0.3))),
        (0.0, {"reported_ratio": 0.5}, (0.01, 0.02)),
        (0.3, {"reports_accuracy": False}, (0.0, 0.0)),
    ],
)
def test_without_an_error_it_is_a_receiver_with_rtk(
    noise_m: float, changes: dict[str, float], expected_m: tuple[float, float]
) -> None:
    params = NavigationParams(**changes)  # type: ignore[arg-type]
    estimator = Estimator(ORIGIN, GpsParams(), noise_m, np.random.default_rng(1), params)
    assert estimator.reported_accuracy_m == pytest.approx(expected_m)
    assert estimator.fix == "rtk_fixed"


@pytest.mark.parametrize(
    ("changes", "expected_m"),
    [
        ({}, (1.5, 3.0)),
        ({"reported_ratio": 0.4}, (0.6, 1.2)),
        ({"reports_accuracy": False}, (0.0, 0.0)),
    ],
)
def test_what_it_tells_of_itself(
    changes: dict[str, float], expected_m: tuple[float, float]
) -> None:
    params = NavigationParams(sigma_m=1.5, height_sigma_m=3.0, **changes)  # type: ignore[arg-type]
    estimator = Estimator(ORIGIN, GpsParams(), 0.0, np.random.default_rng(1), params)
    assert estimator.reported_accuracy_m == pytest.approx(expected_m)


def test_the_bias_is_all_that_the_report_is_off_by() -> None:
    estimator = Estimator(ORIGIN, GpsParams(), 0.0, np.random.default_rng(1), WANDERS)
    estimator.jump((5.0, 0.0, 0.0), 0.0)
    estimator.step(1.0, (1.0, 2.0, 3.0), 0.02)
    off = [b - a for a, b in zip((1.0, 2.0, 3.0), estimator.reported_enu_m, strict=True)]
    assert estimator.bias_enu_m == pytest.approx(off)
    assert estimator.error is not None
    assert off[0] == pytest.approx(5.0 + estimator.error.enu_m[0])


def test_a_target_goes_to_the_frame_that_is_steered_by() -> None:
    """The navigation's error is in the motion, so only the jump comes off a target."""
    estimator = Estimator(ORIGIN, GpsParams(), 0.0, np.random.default_rng(1), WANDERS)
    estimator.jump((5.0, 0.0, 0.0), 0.0)
    assert estimator.world_from_local((10.0, 10.0, 10.0)) == pytest.approx((5.0, 10.0, 10.0))
    assert estimator.shown_from_world((5.0, 10.0, 10.0)) == pytest.approx((10.0, 10.0, 10.0))


def test_the_estimated_motion_is_the_true_one_displaced_ground_and_all() -> None:
    body = PointMass(MulticopterParams(), WindParams(), (10.0, 20.0, 0.0))
    error = NavigationError(WANDERS, np.random.default_rng(1))
    estimated = EstimatedMotion(body, error)
    off = [b - a for a, b in zip(body.position_enu_m, estimated.position_enu_m, strict=True)]
    assert off == pytest.approx(error.enu_m)
    assert estimated.ground_up_m == pytest.approx(estimated.position_enu_m[2])
    assert estimated.is_on_ground
    assert (estimated.height_m, estimated.drift_mps, estimated.yaw_ned_rad) == (0.0, 0.0, 0.0)
    assert estimated.velocity_enu_mps == body.velocity_enu_mps
