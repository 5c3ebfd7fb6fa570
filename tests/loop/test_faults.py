"""Cut, lossy and late links, a reboot, silence of the radio: both endpoints, bytes between them."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import AUTO, LinkFaults, Loop, flown_once, outside

SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
REQUEST_MESSAGE = mavlink.MAV_CMD_REQUEST_MESSAGE
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


HOLDS = Scenario(autopilot=AutopilotParams(offboard_loss_action="hold"))


@flown_once
def in_control(config: CompanionConfig = AUTO, scenario: Scenario | None = None) -> Loop:
    loop = Loop(config, scenario)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(2.0)
    return loop


@pytest.mark.slow
@pytest.mark.parametrize(
    "faults",
    [
        LinkFaults(loss=0.3),
        LinkFaults(delay_s=0.1),
        LinkFaults(loss=0.1, delay_s=0.02, jitter_s=0.2),
    ],
    ids=["30 % lost", "100 ms late", "reordered"],
)
def test_a_bad_link_still_localises(faults: LinkFaults) -> None:
    loop = Loop(faults=faults)
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.error_m <= 1.5
    assert not loop.said("control lost")
    loop.run_until(lambda: loop.mode is FlightMode.HOLD, 5.0)


@pytest.mark.slow
def test_a_short_cut_is_survived() -> None:
    loop = in_control()
    loop.is_link_up = False
    loop.run(2.5)  # back between two HEARTBEATs: setpoints arrive before the failsafe is heard
    assert loop.phase is Phase.HOLD
    assert loop.mode is FlightMode.POSITION  # the autopilot's own failsafe: it sinks
    loop.is_link_up = True
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5
    assert [command for _, command in loop.commands].count(SET_MODE) == 1


@pytest.mark.slow
def test_a_long_cut_leaves_the_vehicle_to_its_failsafe() -> None:
    loop = in_control(scenario=HOLDS)
    loop.is_link_up = False
    cut_s = loop.now_s
    loop.run(30.0)
    sent = loop.setpoints_since(cut_s)
    assert max(s.time_s for s in sent) == pytest.approx(cut_s + 10.0, abs=1.1)
    loop.is_link_up = True
    back_s = loop.now_s
    loop.run(10.0)
    assert loop.setpoints_since(back_s) == []
    assert loop.mode is FlightMode.HOLD
    assert loop.phase is Phase.YIELD


@pytest.mark.slow
def test_control_can_be_given_back_after_a_long_cut() -> None:
    loop = in_control(scenario=HOLDS)
    loop.is_link_up = False
    loop.run(30.0)
    loop.is_link_up = True
    loop.run(3.0)
    loop.grant()
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5


@pytest.mark.slow
def test_without_ranging_it_holds_and_goes_on_when_the_radio_is_back() -> None:
    loop = in_control()
    loop.is_ranging_up = False
    assert loop.run_until(lambda: loop.phase is Phase.HOLD, 6.0) <= 5.1
    loop.run(2.0)
    held = loop.setpoints_since(loop.now_s - 1.0)
    assert len({s.position_enu_m for s in held}) == 1
    assert len(held) == 20
    loop.is_ranging_up = True
    assert loop.run_until(lambda: loop.phase is Phase.NORMAL, 2.0) <= 0.6
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5


@pytest.mark.slow
def test_a_reboot_in_flight_ends_control_and_nothing_is_launched_again() -> None:
    loop = in_control()
    loop.reboot()
    rebooted_s, asked = loop.now_s, len(loop.commands)
    loop.run(30.0)
    assert loop.said("autopilot restarted")
    assert loop.phase is Phase.STANDBY
    assert not loop.sim.vehicle.flavour.is_armed
    later = [command for _, command in loop.commands[asked:]]
    assert SET_MODE not in later
    assert ARM not in later
    assert loop.companion.session.estimate is None
    assert loop.companion.session.vehicle.origin == loop.sim.vehicle.origin
    near = loop.setpoints_since(rebooted_s + 1.0)
    assert all(s.position_enu_m[:2] == pytest.approx((10.0, 10.0), abs=0.01) for s in near)
    loop.take_off()
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5


@pytest.mark.slow
def test_an_origin_that_moves_in_flight_is_held_on_and_the_estimate_moves_along() -> None:
    loop = in_control()
    loop.run(4.0)
    vehicle = loop.sim.vehicle
    lat, lon, alt = vehicle.origin.geodetic_from_enu((0.0, 12.0, 0.0))
    vehicle.aircraft.set_origin(round(lat * 1e7), round(lon * 1e7), round(alt * 1e3))
    loop.is_ranging_up = False
    before = loop.companion.session.estimate
    loop.command(REQUEST_MESSAGE, float(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN))
    loop.run(2.0)
    assert loop.said("local origin moved 12 m: fence kept in place, estimate shifted with it")
    assert loop.phase is Phase.HOLD
    after = loop.companion.session.estimate
    assert before is not None
    assert after is not None
    east_m, north_m = before.position_enu_m
    assert after.position_enu_m == pytest.approx((east_m, north_m - 12.0), abs=0.5)
    assert after.measurements >= before.measurements
    held = loop.setpoints_since(loop.now_s - 1.0)
    assert len(held) == 20
    assert len({s.position_enu_m for s in held}) == 1
    loop.is_ranging_up = True
    assert loop.run_until(lambda: loop.phase is Phase.NORMAL, 2.0) <= 0.6


@pytest.mark.slow
def test_a_target_by_the_fence_never_draws_the_vehicle_over_it() -> None:
    limits = LimitsConfig(
        fence_enu_m=((-5.0, -5.0), (60.0, -5.0), (60.0, 60.0), (-5.0, 60.0)), fence_margin_m=3.0
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"), limits=limits)
    loop = Loop(config, Scenario(emitter=EmitterParams(position_enu_m=(58.0, 50.0))))
    loop.run(120.0)
    assert max(max(s.position_enu_m[:2]) for s in loop.setpoints) <= 57.0 + 1e-4
    assert outside(loop.true_positions, 60.0) == []
    assert max(p[0] for p in loop.true_positions) > 50.0


@pytest.mark.slow
def test_setpoints_keep_the_altitude_band_and_the_speed_limit() -> None:
    loop = in_control()
    loop.run(40.0)
    ups = [s.position_enu_m[2] for s in loop.setpoints]
    assert min(ups) >= 5.0 - 1e-4
    assert max(ups) <= 60.0 + 1e-4
