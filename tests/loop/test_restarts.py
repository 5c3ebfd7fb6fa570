"""The companion's process is killed in flight and started again, on PX4 and ArduPilot."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.domain import EstimateState, FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import VehicleReboot
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import AUTO, Loop, flown_once
from tools.campaign.checkpointing import Checkpointing

MANUAL = CompanionConfig()
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKE_OFF = mavlink.MAV_CMD_NAV_TAKEOFF
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
slow = pytest.mark.slow


@flown_once
def in_control(
    config: CompanionConfig = MANUAL, scenario: Scenario | None = None
) -> tuple[Loop, Checkpointing]:
    """Return a flight in control, and the checkpoints that its process writes."""
    loop = Loop(config, scenario)
    checkpointing = Checkpointing(loop.flight)
    if config.mission.engage == "operator":
        loop.take_off(20.0)
        loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 90.0)
    return loop, checkpointing


def kill_for(loop: Loop, duration_s: float) -> None:
    loop.flight.kill_companion()
    loop.run(duration_s)
    loop.flight.start_companion()


def is_localised(loop: Loop) -> Callable[[], bool]:
    def check() -> bool:
        estimate = loop.companion.session.estimate
        return estimate is not None and estimate.state is EstimateState.LOCALISED

    return check


def engage_again(loop: Loop) -> None:
    loop.choose(FlightMode.HOLD)
    loop.run_until(lambda: loop.phase is Phase.STANDBY, 10.0)
    loop.run(1.5)
    loop.choose(FlightMode.OFFBOARD)


@pytest.mark.slow
def test_an_estimate_survives_a_kill_and_is_localised_long_before_a_cold_one() -> None:
    took_s = {}
    for is_kept in (True, False):
        loop, checkpointing = in_control()
        loop.run_until(is_localised(loop), 120.0)
        loop.run(4.0)
        if not is_kept:
            checkpointing.store.discard()
        kill_for(loop, 5.0)
        engage_again(loop)
        engaged_s = loop.now_s
        loop.run_until(is_localised(loop), 120.0)
        took_s[is_kept] = loop.now_s - engaged_s
        assert loop.said("estimate resumed") is is_kept
        if is_kept:
            assert loop.error_m < 1.0
        estimate = loop.companion.session.estimate
        assert estimate is not None
        assert loop.error_m <= max(estimate.r95_m, 0.5)  # where a cold one says localised it is
    assert took_s[True] < 0.5 * took_s[False], took_s


def test_a_jump_before_a_kill_stays_in_the_absolute_radius() -> None:
    loop, _ = in_control()
    loop.run(8.0)
    loop.sim.vehicle.estimator.jump((15.0, -20.0, 0.0), 0.0)
    loop.run(6.0)
    kill_for(loop, 5.0)
    loop.run_until(lambda: loop.said("estimate resumed"), 20.0)
    for after_s in (0.0, 5.0):
        loop.run(after_s)
        estimate = loop.companion.session.estimate
        assert estimate is not None
        assert estimate.own.jumped_en_m == pytest.approx((15.0, -20.0), abs=1.0)
        assert estimate.absolute_r95_m > 25.0


@pytest.mark.parametrize(
    ("killed_after_s", "flavour"),
    [
        pytest.param(0.0, "px4", marks=slow),
        pytest.param(0.0, "ardupilot", marks=slow),
        pytest.param(0.7, "px4", marks=slow),
        (0.7, "ardupilot"),
        (3.1, "px4"),
        pytest.param(3.1, "ardupilot", marks=slow),
        pytest.param(11.0, "px4", marks=slow),
        pytest.param(11.0, "ardupilot", marks=slow),
    ],
)
def test_a_companion_killed_in_control_never_engages_by_itself(
    killed_after_s: float, flavour: str
) -> None:
    autopilot = AutopilotParams(flavour=flavour, offboard_loss_action="hold")  # type: ignore[arg-type]
    loop, _ = in_control(AUTO, Scenario(autopilot=autopilot))
    loop.run(killed_after_s)
    loop.flight.kill_companion()
    loop.run(2.0)
    commands, setpoints = len(loop.commands), len(loop.setpoints)
    loop.flight.start_companion()
    loop.run(15.0)
    asked = {number for _, number in loop.commands[commands:]}
    assert not asked & {ARM, TAKE_OFF, SET_MODE}
    assert loop.phase in (Phase.WAITING, Phase.STANDBY)
    for sent in loop.setpoints[setpoints:]:
        drift_m = max(
            abs(a - b) for a, b in zip(sent.position_enu_m, sent.vehicle_enu_m, strict=True)
        )
        assert drift_m < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "at_s", [pytest.param(3.0, marks=slow), 8.0, *(pytest.param(s, marks=slow) for s in (20, 30))]
)
def test_a_companion_killed_while_it_launches_launches_no_second_time(at_s: float) -> None:
    loop = Loop(AUTO)
    Checkpointing(loop.flight)
    loop.run(at_s)
    kill_for(loop, 1.0)
    commands = len(loop.commands)
    loop.run(30.0)
    asked = {number for _, number in loop.commands[commands:]}
    assert not asked & {ARM, TAKE_OFF, SET_MODE}


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        pytest.param(lambda data: bytes(len(data)), marks=slow),
        pytest.param(lambda _: b"", marks=slow),
    ],
)
def test_damaged_checkpoints_mean_a_cold_start_that_engages_nothing(
    damage: Callable[[bytes], bytes],
) -> None:
    loop, checkpointing = in_control(AUTO)
    loop.run(5.0)
    loop.flight.kill_companion()
    slots = checkpointing.store.slots
    for number, data in slots.items():
        slots[number] = damage(data)
    loop.run(3.0)
    commands = len(loop.commands)
    loop.flight.start_companion()
    loop.run(1.0)
    assert loop.companion.session.estimate is None or (
        loop.companion.session.estimate.measurements < 20
    )
    loop.run(10.0)
    assert not {number for _, number in loop.commands[commands:]} & {ARM, TAKE_OFF, SET_MODE}


def test_a_yield_survives_a_kill() -> None:
    loop, _ = in_control()
    loop.run(5.0)
    loop.choose(FlightMode.HOLD)
    loop.run(2.0)
    assert loop.phase is Phase.YIELD, loop.notes.texts
    setpoints = len(loop.setpoints)
    kill_for(loop, 3.0)
    loop.run(10.0)
    assert loop.companion.session.phase is Phase.YIELD
    assert len(loop.setpoints) == setpoints
    loop.grant()
    loop.run(1.0)
    assert loop.companion.session.authority.phase is Phase.STANDBY


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        CompanionConfig(limits=LimitsConfig(speed_mps=4.0)),
        pytest.param(CompanionConfig(mission=SessionParams(altitude_m=25.0)), marks=slow),
    ],
)
def test_another_fence_or_mission_is_no_place_for_an_old_estimate(config: CompanionConfig) -> None:
    loop, _ = in_control()
    loop.run(5.0)
    loop.flight.config = config
    kill_for(loop, 3.0)
    loop.run(5.0)
    assert loop.said("starting a new mission, no automatic engagement")
    assert not loop.said("estimate resumed")


@pytest.mark.slow
def test_a_memory_that_is_too_old_is_none() -> None:
    loop = Loop(MANUAL)
    Checkpointing(loop.flight, max_age_s=10.0)
    loop.take_off(20.0)
    loop.run(10.0)
    kill_for(loop, 11.0)
    loop.run(5.0)
    assert not loop.said("resumed after")


@pytest.mark.parametrize(
    ("is_rebooted", "least_s", "most_s"), [(False, 0.0, 1.2), (True, 2.9, 4.5)]
)
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_the_vehicle_of_before_is_bound_again_without_listening_for_others(
    flavour: FlavourName, is_rebooted: bool, least_s: float, most_s: float
) -> None:
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    loop = Loop(MANUAL, scenario, listens=True)
    Checkpointing(loop.flight)
    loop.run(10.0)
    loop.flight.kill_companion()
    if is_rebooted:
        loop.flight.apply_incident(VehicleReboot())
    loop.run(5.0)
    loop.flight.start_companion()
    took_s = loop.run_until(lambda: loop.companion.binding.is_bound, 10.0)
    assert least_s <= took_s <= most_s
    loop.run(3.0)
    assert loop.companion.binding.problem is None
    assert loop.said("resumed after")


@pytest.mark.slow
def test_a_mission_that_was_stopped_in_the_air_can_be_taken_up_again() -> None:
    loop, checkpointing = in_control()
    loop.run(5.0)
    loop.flight.stop_companion()
    loop.run_until(lambda: not loop.flight.is_companion_up, 2.0)
    assert checkpointing.store.slots
    loop.flight.start_companion()
    loop.run(5.0)
    assert loop.said("estimate resumed")


def test_a_companion_that_ends_on_the_ground_leaves_nothing() -> None:
    loop = Loop(MANUAL)
    checkpointing = Checkpointing(loop.flight)
    loop.run(10.0)
    assert checkpointing.store.slots
    loop.flight.stop_companion()
    loop.run(1.0)
    assert not loop.flight.is_companion_up
    assert not checkpointing.store.slots
