"""A frame whose origin creeps, and an autopilot that restarts: what a companion cannot know yet."""

from __future__ import annotations

import pytest

from companion.domain import PositionEnu
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.monitor.authority_invariants import OnlyWithAuthority
from sim_link.lab.monitor.message_invariants import FreshState, WithinEnvelope
from sim_link.lab.monitor.scene import SentSetpoint, TrueScene
from sim_link.lab.observer import Frame, Lane
from tests.loop.loop_helpers import AUTO
from tools.campaign.flights import Monitored, monitored_flight

TICK_S = 0.05
STEP_TICK = 10
SPEED_MPS = 3.0
LEAD_M = 4.0
"""A setpoint that is followed is farther away than one that begins may be."""
SETPOINT = mavlink.MAVLink_set_position_target_local_ned_message(
    0, 1, 1, 1, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)


@pytest.fixture
def around() -> Monitored:
    return monitored_flight(AUTO, Scenario(), 1)


def found(around: Monitored) -> list[str]:
    return [violation.what for violation in around.monitor.violations]


def followed_while_origin_moves(around: Monitored, origin_m: float, step_m: float) -> list[str]:
    """Return the violations of a setpoint that steps aside as the origin moves to the east."""
    scene = around.monitor.scene
    scene.observed.is_ours = True
    invariant = WithinEnvelope(scene)
    for tick in range(20):
        scene.now_s = tick * TICK_S
        if tick == STEP_TICK:
            scene.observed.origin_enu_m = (origin_m, 0.0, 0.0)
        east_m = SPEED_MPS * scene.now_s + (step_m if tick >= STEP_TICK else 0.0)
        vehicle_east_m = east_m if tick == 0 else east_m - LEAD_M  # the first is where it is
        scene.observed.position_enu_m = (vehicle_east_m, 30.0, 15.0)
        scene.observed.position_s = scene.now_s
        invariant.setpoint(SentSetpoint(scene.now_s, (east_m, 30.0, 15.0), SETPOINT))
    return found(around)


def test_a_setpoint_may_creep_along_with_the_origin(around: Monitored) -> None:
    assert followed_while_origin_moves(around, 0.9, 0.9) == []


def test_it_may_not_step_farther_than_that(around: Monitored) -> None:
    assert followed_while_origin_moves(around, 0.9, 1.5) == ["setpoint too fast"]


def test_a_setpoint_stays_in_place_when_the_origin_moves_farther(around: Monitored) -> None:
    assert followed_while_origin_moves(around, 9.0, 0.0) == []


def test_one_that_is_not_moved_along_with_the_origin_is_found(around: Monitored) -> None:
    what = followed_while_origin_moves(around, 9.0, 9.0)
    assert what == ["the first setpoint is not where the vehicle is"]


def position(boot_s: float, enu_m: PositionEnu, now_s: float) -> Frame:
    """A local position that arrives."""
    east_m, north_m, up_m = enu_m
    message = mavlink.MAVLink_local_position_ned_message(
        round(1000 * boot_s), north_m, east_m, -up_m, 0.0, 0.0, 0.0
    )
    return Frame(now_s, MavCodec(1, 1).encode(message), Lane.TO_COMPANION)


@pytest.mark.parametrize("invariant_type", [WithinEnvelope, OnlyWithAuthority])
@pytest.mark.parametrize(
    ("asked_s", "is_found"), [(0.1, False), (0.4, False), (0.6, True), (5.0, True)]
)
def test_before_a_restart_is_proved_the_vehicle_is_where_it_was(
    around: Monitored,
    invariant_type: type[WithinEnvelope | OnlyWithAuthority],
    asked_s: float,
    *,
    is_found: bool,
) -> None:
    scene, before, after = around.monitor.scene, (0.0, 7.0, 15.0), (0.0, 0.0, 15.0)
    scene.observe(position(42.0, before, now_s=42.0))
    scene.observe(position(0.3, after, now_s=42.05))
    scene.now_s = 42.0 + asked_s
    invariant_type(scene).setpoint(SentSetpoint(scene.now_s, before, SETPOINT))
    assert bool(found(around)) is is_found


def test_where_it_is_since_is_never_an_offence(around: Monitored) -> None:
    scene, after = around.monitor.scene, (0.0, 0.0, 15.0)
    scene.observe(position(42.0, (0.0, 7.0, 15.0), now_s=42.0))
    scene.observe(position(0.3, after, now_s=42.05))
    scene.now_s = 42.1
    WithinEnvelope(scene).setpoint(SentSetpoint(scene.now_s, after, SETPOINT))
    assert found(around) == []


def origin(scene: TrueScene, east_m: float, now_s: float) -> Frame:
    """An origin that arrives, so far to the east of the first."""
    assert scene.world_origin is not None
    lat_deg, lon_deg, alt_m = scene.world_origin.geodetic_from_enu((east_m, 0.0, 0.0))
    message = mavlink.MAVLink_gps_global_origin_message(
        round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
    )
    return Frame(now_s, MavCodec(1, 1).encode(message), Lane.TO_COMPANION)


@pytest.mark.parametrize("invariant_type", [WithinEnvelope, OnlyWithAuthority])
@pytest.mark.parametrize("is_of_new_frame", [False, True])
@pytest.mark.parametrize(("away_m", "is_found"), [(0.0, False), (5.0, True)])
def test_an_origin_says_where_the_last_position_was(
    around: Monitored,
    invariant_type: type[WithinEnvelope | OnlyWithAuthority],
    away_m: float,
    *,
    is_of_new_frame: bool,
    is_found: bool,
) -> None:
    """It is reported before the first position in its frame, or after it."""
    scene, truly = around.monitor.scene, (0.0, 7.0, 15.0)
    local = (truly[0] - 11.0 * is_of_new_frame, *truly[1:])
    scene.observe(position(42.0, local, now_s=42.0))
    scene.observe(origin(scene, 11.0, now_s=42.05))
    scene.now_s = 42.06
    moved = (truly[0], truly[1] + away_m, truly[2])
    invariant_type(scene).setpoint(SentSetpoint(scene.now_s, moved, SETPOINT))
    assert bool(found(around)) is is_found


def test_a_new_origin_leaves_a_position_as_fresh_as_it_is(around: Monitored) -> None:
    scene, invariant = around.monitor.scene, FreshState(around.monitor.scene)
    scene.observe(position(42.0, (0.0, 7.0, 15.0), now_s=42.0))
    scene.observe(origin(scene, 11.0, now_s=42.05))
    for now_s, north_m in ((42.06, 7.0), (42.4, 7.2), (42.7, 7.4)):
        scene.now_s = now_s
        assert found(around) == []
        invariant.setpoint(SentSetpoint(now_s, (0.0, north_m, 15.0), SETPOINT))
    assert found(around) == ["a setpoint moved on a stale position"]
