"""The companion flies an ArduPilot, GUIDED instead of offboard, over both endpoints' bytes."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.phases import Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.control_inputs import LocalTarget
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from tests.loop.loop_helpers import AUTO, LinkFaults, Loop, flown_once

COPTER = Scenario(autopilot=AutopilotParams(flavour="ardupilot"))
OPERATOR = CompanionConfig()
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
PAUSE = mavlink.MAV_CMD_DO_PAUSE_CONTINUE
TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF


def copter(config: CompanionConfig = AUTO, seed: int = 1) -> Loop:
    return Loop(config, COPTER, seed)


@flown_once
def flying(seed: int = 1) -> Loop:
    """A flight in mid-search."""
    loop = copter(seed=seed)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    loop.run(2.0)
    return loop


@flown_once
def climbing(height_m: float = 20.0) -> Loop:
    """The operator has armed in GUIDED and commanded a take-off."""
    loop = copter(OPERATOR)
    loop.run(3.0)
    loop.choose(FlightMode.OFFBOARD)
    loop.command(ARM, 1.0)
    loop.command(TAKEOFF, *[0.0] * 6, height_m)
    loop.run(2.0)
    assert loop.sim.vehicle.body.height_m > 1.0
    return loop


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(2, 5))]
)
def test_takes_off_in_guided_finds_the_emitter_and_brakes(seed: int) -> None:
    loop = copter(seed=seed)
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.0
    loop.run_until(lambda: loop.mode is FlightMode.HOLD, 2.0)
    assert loop.sim.vehicle.flavour.heartbeat_state(loop.now_s).custom_mode == 17
    assert [number for _, number in loop.commands if number in (ARM, TAKEOFF)] == [ARM, TAKEOFF]


@pytest.mark.slow
def test_finds_the_emitter_over_a_lossy_slow_link_too() -> None:
    loop = Loop(scenario=COPTER, faults=LinkFaults(loss=0.1, delay_s=0.05, jitter_s=0.1))
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.error_m <= 1.5


@pytest.mark.slow
def test_a_launch_survives_a_take_off_whose_answer_was_lost() -> None:
    """The repeated take-off is refused, because the vehicle climbs already.

    Of six realisations of the losses each must launch; every second one loses a take-off or its
    answer on average, so that one of them at least repeats it.
    """

    def take_offs(seed: int) -> int:
        loop = Loop(scenario=COPTER, seed=seed, faults=LinkFaults(loss=0.3, delay_s=0.25))
        loop.run_until(lambda: loop.phase is Phase.NORMAL, 40.0)
        return [number for _, number in loop.commands].count(TAKEOFF)

    assert max(take_offs(seed) for seed in range(6)) > 1


@pytest.mark.parametrize("action", [1, 4])
def test_a_fence_action_of_the_autopilot_takes_a_grant(action: int) -> None:
    """FENCE_ACTION 1 returns and 4 brakes; neither is CRITICAL in HEARTBEAT."""
    loop = flying()
    fence = {"FENCE_TYPE": 1, "FENCE_ALT_MAX": 10.0, "FENCE_ACTION": action, "FENCE_ENABLE": 1}
    for name, value in fence.items():
        loop.sim.vehicle.flavour.parameters.set(name, float(value))
    loop.run_until(lambda: loop.mode is not FlightMode.OFFBOARD, 1.0)
    lost_s = loop.now_s
    loop.run(15.0)
    assert loop.said("grant needed, failsafe")
    assert loop.phase is Phase.YIELD
    assert loop.setpoints_since(lost_s + 1.1) == []  # a HEARTBEAT later
    loop.choose(FlightMode.OFFBOARD)
    loop.run(3.0)
    assert loop.phase is Phase.YIELD


def test_a_pause_is_announced_once_and_again_after_it_has_moved() -> None:
    loop, text = flying(), "vehicle does not follow: paused? reselect the mode"

    def count() -> int:
        return sum(said == text for _, said in loop.notes.texts)

    loop.command(PAUSE, 0.0)
    loop.run(45.0)
    assert (count(), loop.mode) == (1, FlightMode.OFFBOARD)
    loop.command(PAUSE, 1.0)
    loop.run(8.0)
    assert count() == 1
    loop.command(PAUSE, 0.0)
    loop.run(15.0)
    assert count() == 2


@pytest.mark.slow
def test_texts_speak_of_guided_and_never_of_offboard() -> None:
    loop = copter()
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.said("in control: autopilot is in GUIDED")
    assert not loop.said("offboard")


def test_no_setpoint_disturbs_the_take_off() -> None:
    loop = copter()
    loop.run_until(lambda: loop.phase is Phase.HOLD, 30.0)
    assert loop.setpoints == []
    assert loop.sim.vehicle.body.height_m >= 0.9 * AUTO.mission.altitude_m


def test_an_operators_take_off_is_taken_over_once_it_is_in_the_air() -> None:
    loop = climbing()
    assert loop.setpoints == []
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    assert loop.sim.vehicle.body.height_m == pytest.approx(20.0, abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND])
@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(2, 5))]
)
def test_the_stream_ends_with_the_first_foreign_mode(mode: FlightMode, seed: int) -> None:
    loop = flying(seed)
    loop.choose(mode)
    overridden_s = loop.now_s
    asked = len(loop.commands)
    loop.run(10.0)
    assert loop.setpoints_since(overridden_s - 1e-9) == []
    assert SET_MODE not in [number for _, number in loop.commands[asked:]]
    assert loop.phase in (Phase.YIELD, Phase.WAITING, Phase.STANDBY)


@pytest.mark.slow
def test_guided_given_again_after_a_while_gives_control_back() -> None:
    loop = flying()
    loop.choose(FlightMode.HOLD)
    loop.run(5.0)
    rest = loop.sim.vehicle.body.position_enu_m
    loop.choose(FlightMode.OFFBOARD)
    assert math.dist(loop.sim.vehicle.body.position_enu_m, rest) < 0.1
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_a_stop_is_commanded_because_no_target_ever_times_out(seed: int) -> None:
    loop = flying(seed)
    loop.companion.request_stop(loop.now_s)
    loop.run_until(lambda: loop.companion.is_finished, 2.0)
    assert loop.mode is FlightMode.HOLD
    assert loop.said("requesting BRAKE")
    at_stop = loop.sim.vehicle.body.position_enu_m
    loop.run(20.0)
    assert math.dist(loop.sim.vehicle.body.position_enu_m, at_stop) < 10.0
    assert loop.sim.vehicle.body.velocity_enu_mps == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_a_companion_that_dies_leaves_the_vehicle_at_its_last_target() -> None:
    loop = flying()
    loop.is_link_up = False
    target = loop.setpoints[-1].position_enu_m
    loop.run(30.0)
    assert loop.mode is FlightMode.OFFBOARD
    assert math.dist(loop.sim.vehicle.body.position_enu_m, target) < 1.0


@pytest.mark.slow
def test_a_stopped_heartbeat_is_requested_and_a_pilots_mode_is_seen() -> None:
    loop = flying()
    stop = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 0.0, -1.0, 0, 0, 0, 0, 0
    )
    loop.sim.receive(Chunk(0, MavCodec(255, 190).encode(stop), None), loop.now_s)
    begun = len(loop.vehicle_bytes)
    loop.run(12.0)
    heard = MavCodec(255, 190).decode(bytes(loop.vehicle_bytes[begun:]))
    shown = [m for m in heard if m.get_type() == "HEARTBEAT" and m.get_srcComponent() == 1]
    assert 3 <= len(shown) <= 6
    assert loop.phase is Phase.NORMAL
    loop.choose(FlightMode.POSITION)
    loop.run(0.5)
    left_s = loop.now_s
    loop.run(5.0)
    assert loop.setpoints_since(left_s) == []
    assert loop.mode is FlightMode.POSITION


@pytest.mark.slow
def test_everything_that_is_sent_would_be_sane_on_an_autopilot_that_checks_nothing() -> None:
    """The real one obeys 0/0, infinite heights, foreign frames and a take-off to NaN."""
    loop = copter()
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    sent = MavCodec(1, 1).decode(bytes(loop.companion_bytes))
    setpoints = [m for m in sent if isinstance(m, LocalTarget)]
    assert {(m.coordinate_frame, m.type_mask) for m in setpoints} <= {(1, 0xDF8), (1, 0x9F8)}
    assert all(math.isfinite(value) for m in setpoints for value in (m.x, m.y, m.z, m.yaw))
    assert max(math.hypot(m.x, m.y) for m in setpoints) < 200.0
    assert all(-60.0 <= m.z < -2.0 for m in setpoints)
    commands = [m for m in sent if isinstance(m, mavlink.MAVLink_command_long_message)]
    asked = [m for m in commands if m.command == TAKEOFF]
    assert asked
    assert all(3.0 <= m.param7 <= 60.0 for m in asked)
