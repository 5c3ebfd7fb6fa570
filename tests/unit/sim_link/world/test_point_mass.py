"""The true motion: limits, response, wind and ground."""

from __future__ import annotations

import math

import pytest

from companion.domain import PositionEnu
from sim_link.world.point_mass import (
    MulticopterParams,
    PointMass,
    WindParams,
    approach_velocity,
    limited_velocity,
)

STEP_S = 0.02
PARAMS = MulticopterParams()


def airborne(params: MulticopterParams = PARAMS, wind: WindParams | None = None) -> PointMass:
    return PointMass(params, wind or WindParams(), (0.0, 0.0, 50.0))


def fly(body: PointMass, command: PositionEnu | None, duration_s: float) -> None:
    for _ in range(round(duration_s / STEP_S)):
        body.step(command, None, STEP_S)


def test_velocity_responds_as_a_first_order_lag() -> None:
    body = airborne(MulticopterParams(velocity_time_constant_s=0.5))
    fly(body, (1.0, 0.0, 0.0), 0.5)
    assert body.velocity_enu_mps[0] == pytest.approx(1.0 - math.exp(-1.0), rel=1e-6)
    fly(body, (1.0, 0.0, 0.0), 0.5)
    assert body.velocity_enu_mps[0] == pytest.approx(1.0 - math.exp(-2.0), rel=1e-6)


@pytest.mark.parametrize(
    ("command", "settled"),
    [
        ((100.0, 0.0, 0.0), (10.0, 0.0, 0.0)),
        ((-30.0, 40.0, 0.0), (-6.0, 8.0, 0.0)),
        ((0.0, 0.0, 50.0), (0.0, 0.0, 3.0)),
        ((0.0, 0.0, -50.0), (0.0, 0.0, -1.5)),
    ],
)
def test_speeds_stay_within_the_limits(command: PositionEnu, settled: PositionEnu) -> None:
    body = airborne()
    for _ in range(500):
        body.step(command, None, STEP_S)
        east, north, up = body.velocity_enu_mps
        assert math.hypot(east, north) <= 10.0 + 1e-9
        assert -1.5 - 1e-9 <= up <= 3.0 + 1e-9
    assert body.velocity_enu_mps == pytest.approx(settled, abs=1e-3)


def test_acceleration_stays_within_its_limit_and_reaches_it() -> None:
    body = airborne()
    sizes = []
    for step in range(400):
        body.step((10.0 if step < 200 else -10.0, 5.0, 1.0), None, STEP_S)
        sizes.append(math.hypot(*body.acceleration_enu_mps2))
    assert max(sizes) == pytest.approx(4.0)


def test_position_is_the_integral_of_velocity() -> None:
    body = airborne()
    fly(body, (4.0, 0.0, 0.0), 10.0)
    start = body.position_enu_m[0]
    fly(body, (4.0, 0.0, 0.0), 5.0)
    assert body.position_enu_m[0] - start == pytest.approx(20.0, abs=1e-3)


def test_wind_drifts_a_flying_vehicle_by_the_share_let_through() -> None:
    body = airborne(wind=WindParams(east_mps=6.0, north_mps=-3.0, let_through=0.1))
    fly(body, (0.0, 0.0, 0.0), 10.0)
    assert body.velocity_enu_mps == pytest.approx((0.6, -0.3, 0.0), abs=1e-6)


def test_wind_does_not_move_a_vehicle_on_the_ground() -> None:
    body = PointMass(PARAMS, WindParams(east_mps=20.0, let_through=1.0), (1.0, 2.0, 0.0))
    fly(body, (0.0, 0.0, -1.0), 5.0)
    fly(body, None, 5.0)
    assert body.position_enu_m == (1.0, 2.0, 0.0)


@pytest.mark.parametrize("command", [(3.0, 0.0, -10.0), None])
def test_comes_down_to_the_ground_and_never_below(command: PositionEnu | None) -> None:
    body = PointMass(PARAMS, WindParams(), (0.0, 0.0, 7.0), ground_up_m=2.0)
    for _ in range(500):
        body.step(command, None, STEP_S)
        assert body.height_m >= 0.0
    assert body.is_on_ground
    assert body.velocity_enu_mps == (0.0, 0.0, 0.0)
    assert body.position_enu_m[2] == 2.0


def test_does_not_slide_on_the_ground_and_lifts_off_when_it_climbs() -> None:
    body = PointMass(PARAMS, WindParams(), (0.0, 0.0, 0.0))
    fly(body, (5.0, 0.0, 0.0), 2.0)
    assert body.position_enu_m == (0.0, 0.0, 0.0)
    fly(body, (0.0, 0.0, 1.0), 2.0)
    assert body.height_m > 1.0


def test_falls_when_the_motors_stop() -> None:
    body = airborne()
    fly(body, None, 1.0)
    assert body.velocity_enu_mps[2] == pytest.approx(-9.80665)
    assert body.position_enu_m[2] == pytest.approx(50.0 - 9.80665 / 2.0)


def test_yaw_turns_the_short_way_at_its_rate() -> None:
    body = airborne()
    body.yaw_ned_rad = math.radians(170.0)
    for _ in range(5):
        body.step((0.0, 0.0, 0.0), math.radians(-170.0), STEP_S)
    assert body.yaw_ned_rad == pytest.approx(math.radians(170.0) + 5 * 0.8 * STEP_S)
    fly(body, (0.0, 0.0, 0.0), 1.0)
    for _ in range(50):
        body.step((0.0, 0.0, 0.0), math.radians(-170.0), STEP_S)
    assert body.yaw_ned_rad == pytest.approx(math.radians(-170.0))


@pytest.mark.parametrize("distance_m", [0.5, 5.0, 30.0, 100.0])
def test_an_approach_arrives_without_much_overshoot(distance_m: float) -> None:
    body, goal = airborne(), (distance_m, 0.0, 50.0)
    farthest = 0.0
    for _ in range(2000):
        body.step(approach_velocity(body.position_enu_m, goal, PARAMS), None, STEP_S)
        farthest = max(farthest, body.position_enu_m[0])
    assert body.position_enu_m == pytest.approx(goal, abs=1e-3)
    assert farthest < distance_m * 1.01 + 0.2


def test_limits_keep_the_horizontal_direction() -> None:
    east, north, _ = limited_velocity((30.0, 60.0, 0.0), PARAMS)
    assert north / east == pytest.approx(2.0)
