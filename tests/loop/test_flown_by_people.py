"""The operator engages, overrides, gives back and stops, over the bytes of both endpoints."""

from __future__ import annotations

import random

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.control_authority import REGAIN_QUIET_S
from companion.guidance.phases import IN_CONTROL, Phase
from companion.mav.dialect import mavlink
from tests.loop.loop_helpers import Loop, flown_once

OPERATOR = CompanionConfig()
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
HEARTBEAT_PERIOD_S = 1.0
"""PX4 reports a new mode by its next HEARTBEAT."""
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF


@flown_once
def flying(config: CompanionConfig | None = None, seed: int = 1) -> Loop:
    """A flight in mid-search."""
    loop = Loop(seed=seed) if config is None else Loop(config, seed=seed)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    loop.run(2.0)
    return loop


@pytest.mark.slow
def test_the_operator_arms_takes_off_and_hands_over_by_the_mode_switch() -> None:
    loop = Loop(OPERATOR)
    loop.take_off()
    assert loop.phase is Phase.STANDBY
    assert all(command not in (ARM, TAKEOFF, SET_MODE) for _, command in loop.commands)
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5
    loop.run_until(lambda: loop.mode is FlightMode.HOLD, 2.0)


@pytest.mark.slow
def test_without_the_mode_switch_the_vehicle_stays_where_it_is() -> None:
    loop = Loop(OPERATOR)
    loop.take_off()
    before = loop.sim.vehicle.body.position_enu_m
    loop.run(20.0)
    assert loop.sim.vehicle.body.position_enu_m == pytest.approx(before, abs=0.3)
    assert loop.mode is FlightMode.HOLD


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed",
    [0, 1, 2, 3, 4, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(5, 30))],
)
def test_after_an_override_not_one_setpoint_and_not_one_mode_request(seed: int) -> None:
    rng = random.Random(seed)
    loop = Loop(seed=seed)
    loop.run_until(lambda: loop.mode is FlightMode.OFFBOARD, 30.0)
    loop.run(rng.uniform(0.05, 20.0))
    assert loop.mode is FlightMode.OFFBOARD
    asked = len(loop.commands)
    mode = rng.choice([FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND])
    is_reported_at_once = seed % 2 == 1
    loop.choose(mode, is_reported_at_once=is_reported_at_once)
    chosen_s = loop.now_s
    reported_s = chosen_s if is_reported_at_once else chosen_s + HEARTBEAT_PERIOD_S
    loop.run(15.0)
    sent = loop.setpoints_since(reported_s - 1e-9)
    assert all(each.time_s >= chosen_s + REGAIN_QUIET_S for each in sent)
    assert loop.phase not in IN_CONTROL
    assert SET_MODE not in [command for _, command in loop.commands[asked:]]
    assert loop.mode in (mode, FlightMode.HOLD)


@pytest.mark.slow
@pytest.mark.parametrize("is_granted", [False, True])
def test_control_comes_back_by_the_mode_switch_or_sooner_by_a_grant(is_granted: bool) -> None:
    loop = flying()
    loop.choose(FlightMode.HOLD)
    loop.run(1.2 if is_granted else 5.0)
    if is_granted:
        loop.grant()
        loop.run(0.2)
    assert loop.phase is Phase.STANDBY
    loop.run(1.0)
    assert loop.mode is FlightMode.HOLD
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: bool(loop.notes.results), 60.0)
    assert loop.error_m <= 1.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_stop_in_flight_ends_in_hold_within_two_seconds(seed: int) -> None:
    loop = flying(seed=seed)
    loop.run(random.Random(seed).uniform(0.0, 10.0))
    loop.companion.request_stop(loop.now_s)
    asked_s = loop.now_s
    took_s = loop.run_until(lambda: loop.companion.is_finished, 2.0)
    assert loop.mode is FlightMode.HOLD
    assert loop.sim.vehicle.flavour.is_failsafe is False
    assert took_s <= 0.2
    assert len(loop.setpoints_since(asked_s)) >= 1
    finished_s = loop.now_s
    loop.run(3.0)
    assert loop.setpoints_since(finished_s) == []


@pytest.mark.slow
def test_a_stop_on_a_dead_link_still_ends_in_time() -> None:
    loop = flying()
    loop.is_link_up = False
    loop.companion.request_stop(loop.now_s)
    assert loop.run_until(lambda: loop.companion.is_finished, 2.0) <= 1.5


def test_a_stop_before_take_off_ends_at_once_and_asks_for_nothing() -> None:
    loop = Loop(OPERATOR)
    loop.run(3.0)
    loop.companion.request_stop(loop.now_s)
    assert loop.companion.is_finished
    loop.run(1.0)
    assert SET_MODE not in [command for _, command in loop.commands]
