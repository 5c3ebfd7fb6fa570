"""MAVSDK 4 flies both simulated autopilots: parameters, rates, flights, missions and fences."""

from __future__ import annotations

import itertools
import math
import statistics
from typing import Any

import pytest
from mavsdk.asyncio.plugins.geofence import (
    FenceType,
    GeofenceAsync,
    GeofenceData,
    Point,
    Polygon,
)
from mavsdk.asyncio.plugins.mission import MissionAsync, MissionItem, MissionPlan
from mavsdk.asyncio.plugins.mission_raw import MissionItem as RawItem
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.offboard import PositionNedYaw, VelocityNedYaw
from mavsdk.asyncio.plugins.param import ParamError
from mavsdk.asyncio.plugins.telemetry import FlightMode

from tests.e2e.mavsdk_rigs import Client, fly, heard_from_now, until

BOTH = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
HOME = (47.397832, 8.545727)
RATE_HZ = 10.0


def is_near(state: Any, north_m: float, east_m: float, down_m: float) -> bool:
    position = state.position
    return (
        math.dist((position.north_m, position.east_m, position.down_m), (north_m, east_m, down_m))
        < 0.8
    )


async def read_and_set_parameters(client: Client) -> None:
    name = "MIS_TAKEOFF_ALT"
    assert await client.param.get_param_float(name) == pytest.approx(2.5)
    await client.param.set_param_float(name, 6.5)
    assert await client.param.get_param_float(name) == pytest.approx(6.5)
    await client.param.set_param_int("COM_OBL_RC_ACT", 3)
    assert await client.param.get_param_int("COM_OBL_RC_ACT") == 3
    with pytest.raises(ParamError):
        await client.param.get_param_int("NO_SUCH_PARAM")
    listed = await client.param.get_all_params()
    names = [p.name for p in listed.float_params] + [p.name for p in listed.int_params]
    assert name in names
    assert len(set(names)) == len(names) > 50


async def read_and_set_parameters_of_ardupilot(client: Client) -> None:
    await client.param.set_param_float("GUID_TIMEOUT", 2.0)
    assert await client.param.get_param_float("GUID_TIMEOUT") == pytest.approx(2.0)
    await client.param.set_param_int("RTL_ALT", 1200)
    assert await client.param.get_param_int("RTL_ALT") == 1200
    listed = await client.param.get_all_params()
    assert len(listed.float_params) + len(listed.int_params) > 50


@pytest.mark.slow
def test_mavsdk_reads_and_sets_parameters_of_a_px4() -> None:
    fly("px4", read_and_set_parameters)


@pytest.mark.slow
def test_mavsdk_reads_and_sets_parameters_of_an_ardupilot() -> None:
    fly("ardupilot", read_and_set_parameters_of_ardupilot)


async def measure_a_rate(client: Client) -> None:
    """Measure a rate by the vehicle's own clock, on which this machine's load has no effect."""
    await client.get_ready()
    await client.telemetry.set_rate_attitude_euler(RATE_HZ)
    async with heard_from_now(client.telemetry.subscribe_attitude_euler()) as attitudes:
        times_us = [(await attitudes.until(lambda _: True)).timestamp_us for _ in range(120)]
    period_s = statistics.median(b - a for a, b in itertools.pairwise(times_us)) / 1e6
    assert period_s == pytest.approx(1.0 / RATE_HZ, rel=0.1)


@pytest.mark.slow
@BOTH
def test_mavsdk_gets_the_rate_that_it_asks_for(flavour: str) -> None:
    fly(flavour, measure_a_rate)


async def go_to_and_return(client: Client) -> None:
    health_ok = client.telemetry.subscribe_health()
    await client.take_off()
    assert await until(health_ok, lambda health: health.is_global_position_ok)
    await until(client.telemetry.subscribe_flight_mode(), lambda mode: mode != FlightMode.TAKEOFF)
    lat, lon = HOME[0] + 0.0001, HOME[1] + 0.0001
    await client.action.goto_location(lat, lon, 500.0, 90.0)
    await until(
        client.telemetry.subscribe_position(),
        lambda position: (
            abs(position.latitude_deg - lat) < 6e-6
            and abs(position.longitude_deg - lon) < 8e-6
            and abs(position.absolute_altitude_m - 500.0) < 0.6
        ),
    )
    await client.action.return_to_launch()
    await client.await_ground()
    position = await until(client.telemetry.subscribe_position(), lambda _: True)
    assert position.latitude_deg == pytest.approx(HOME[0], abs=1e-5)


@pytest.mark.slow
@BOTH
def test_mavsdk_takes_off_goes_to_a_place_and_returns(flavour: str) -> None:
    fly(flavour, go_to_and_return)


async def fly_offboard(client: Client) -> None:
    await client.take_off()
    await until(client.telemetry.subscribe_flight_mode(), lambda mode: mode != FlightMode.TAKEOFF)
    await client.offboard.set_position_ned(PositionNedYaw(15.0, 12.0, -6.0, 0.0))
    await client.offboard.start()
    await until(client.telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.OFFBOARD)
    await until(
        client.telemetry.subscribe_position_velocity_ned(),
        lambda state: is_near(state, 15.0, 12.0, -6.0),
    )
    await client.offboard.set_velocity_ned(VelocityNedYaw(0.0, 2.0, 0.0, 90.0))
    await until(
        client.telemetry.subscribe_position_velocity_ned(),
        lambda state: (
            abs(state.velocity.east_m_s - 2.0) < 0.3 and abs(state.velocity.north_m_s) < 0.3
        ),
    )
    await client.offboard.stop()
    await client.action.land()
    await client.await_ground()


@pytest.mark.slow
@BOTH
def test_mavsdk_flies_offboard_by_position_and_velocity(flavour: str) -> None:
    fly(flavour, fly_offboard)


def plan() -> MissionPlan:
    """Three waypoints; at the second it waits, turns gimbal and nose, and takes a photo."""
    positions = ((0.0001, 0.0, 8.0), (0.0001, 0.0001, 10.0), (0.0, 0.0001, 8.0))
    items = [
        MissionItem(
            latitude_deg=HOME[0] + north,
            longitude_deg=HOME[1] + east,
            relative_altitude_m=height_m,
            speed_m_s=6.0,
            is_fly_through=True,
            acceptance_radius_m=1.0,
        )
        for north, east, height_m in positions
    ]
    items[1].is_fly_through = False
    items[1].loiter_time_s = 2.0
    items[1].yaw_deg = 90.0
    items[1].gimbal_pitch_deg, items[1].gimbal_yaw_deg = -30.0, 20.0
    items[1].camera_action = MissionItem.CameraAction.TAKE_PHOTO
    return MissionPlan(items)


async def fly_a_mission(client: Client) -> None:
    mission = MissionAsync(client.system)
    await mission.upload_mission(plan())
    stored = await mission.download_mission()
    assert [item.relative_altitude_m for item in stored.mission_items] == [8.0, 10.0, 8.0]
    second = stored.mission_items[1]
    assert second.latitude_deg == pytest.approx(HOME[0] + 0.0001, abs=1e-7)
    assert (second.loiter_time_s, second.yaw_deg, second.gimbal_pitch_deg) == (2.0, 90.0, -30.0)
    assert second.camera_action == MissionItem.CameraAction.TAKE_PHOTO
    await client.take_off()
    async with (
        heard_from_now(client.telemetry.subscribe_flight_mode()) as modes,
        heard_from_now(mission.subscribe_mission_progress()) as updates,
    ):
        await mission.start_mission()
        await modes.until(lambda mode: mode == FlightMode.MISSION)
        progress = await updates.until(lambda done: done.current == done.total)
    assert progress.total == 3
    assert await mission.is_mission_finished()
    await mission.clear_mission()
    await client.action.land()
    await client.await_ground()


@pytest.mark.slow
def test_mavsdk_uploads_flies_and_downloads_a_mission_of_a_px4() -> None:
    fly("px4", fly_a_mission)


def raw_plan() -> list[RawItem]:
    """Return a mission of ArduPilot: item 0 is home, which MAVSDK's own format does not have."""
    positions = ((0, 0.0, 0.0, 0.0), (3, 0.0001, 0.0, 8.0), (3, 0.0001, 0.0001, 10.0))
    return [
        RawItem(
            seq=number,
            frame=frame,
            command=16,
            current=int(number == 0),
            autocontinue=1,
            param1=0.0,
            param2=0.0,
            param3=0.0,
            param4=0.0,
            x=round(1e7 * (HOME[0] + north)),
            y=round(1e7 * (HOME[1] + east)),
            z=height_m,
            mission_type=0,
        )
        for number, (frame, north, east, height_m) in enumerate(positions)
    ]


async def fly_a_raw_mission(client: Client) -> None:
    mission = MissionRawAsync(client.system)
    await mission.upload_mission(raw_plan())
    stored = await mission.download_mission()
    assert [item.z for item in stored[1:]] == [8.0, 10.0]
    await client.take_off()
    async with (
        heard_from_now(client.telemetry.subscribe_flight_mode()) as modes,
        heard_from_now(mission.subscribe_mission_progress()) as updates,
    ):
        await mission.start_mission()
        await modes.until(lambda mode: mode == FlightMode.MISSION)
        await updates.until(lambda done: done.current >= done.total - 1)
    await mission.clear_mission()
    await client.action.land()
    await client.await_ground()


@pytest.mark.slow
def test_mavsdk_uploads_flies_and_downloads_a_mission_of_an_ardupilot() -> None:
    fly("ardupilot", fly_a_raw_mission)


async def upload_a_fence(client: Client) -> None:
    await client.get_ready()
    fence = GeofenceAsync(client.system)
    corners = ((-0.001, -0.001), (0.001, -0.001), (0.001, 0.001), (-0.001, 0.001))
    points = [Point(HOME[0] + north, HOME[1] + east) for north, east in corners]
    await fence.upload_geofence(GeofenceData([Polygon(points, FenceType.INCLUSION)], []))
    stored = await fence.download_geofence()
    assert [len(polygon.points) for polygon in stored.polygons] == [4]
    assert stored.polygons[0].points[0].latitude_deg == pytest.approx(HOME[0] - 0.001, abs=1e-6)
    await fence.clear_geofence()


@pytest.mark.slow
@BOTH
def test_mavsdk_uploads_a_fence(flavour: str) -> None:
    fly(flavour, upload_a_fence)
