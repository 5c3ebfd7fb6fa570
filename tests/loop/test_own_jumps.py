"""The vehicle's own position or heading jumps in flight: held on, and the estimate moves along."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.domain import FlightMode, PositionEnu
from companion.estimation.screen import RejectReason
from companion.guidance.commands import SessionParams
from companion.guidance.phases import FLYING, Phase
from sim_link.autopilot.incidents import OriginShift
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.faulty_link import Injector
from tests.loop.loop_helpers import AUTO, Loop, flown_once, outside
from tools.campaign.flights import monitored_flight

JUMPS: list[PositionEnu] = [
    (1.0, 0.0, 0.0),
    (-5.0, 5.0, 0.0),
    (30.0, -40.0, 0.0),
    (0.0, 0.0, 4.0),
    (0.0, 0.0, -7.0),
]
OUT_OF_BOUNDS: list[PositionEnu] = [
    (50.0, 0.0, 0.0),
    (-50.0, 0.0, 0.0),
    (40.0, 60.0, 0.0),
    (0.0, 0.0, 50.0),
    (0.0, 0.0, 20.0),
    (0.0, 0.0, -30.0),
]
"""Jumps out of the small fence from anywhere at search altitude; 20 m reaches the ground."""
BRAKING_M = 4.0
"""It flew at no more than 5 m/s."""
SQUARE = ((-25.0, -25.0), (25.0, -25.0), (25.0, 25.0), (-25.0, 25.0))
SMALL = CompanionConfig(
    mission=SessionParams(engage="auto", stop_radius_m=0.3),
    limits=LimitsConfig(fence_enu_m=SQUARE),
)
"""A search that does not end in a small fence."""


@flown_once
def flying(after_s: float = 8.0) -> Loop:
    """Return a flight in control that follows the plan, with an estimate."""
    loop = Loop()
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(after_s)
    return loop


def target_seen_m(loop: Loop, shift_enu_m: PositionEnu = (0.0, 0.0, 0.0)) -> float:
    """Return the distance of the estimate from the target in the autopilot's shifted frame."""
    estimate = loop.companion.session.estimate
    assert estimate is not None
    east, north = loop.flight.scenario.emitter.position_enu_m
    position = (east + shift_enu_m[0], north + shift_enu_m[1])
    return math.dist(estimate.position_enu_m, position)


@pytest.mark.slow
@pytest.mark.parametrize("shift_enu_m", JUMPS)
def test_it_holds_until_the_position_is_steady_and_the_estimate_moves_along(
    shift_enu_m: PositionEnu,
) -> None:
    loop = flying()
    before_m = target_seen_m(loop)
    loop.sim.vehicle.estimator.jump(shift_enu_m, 0.0)
    jumped_s = loop.now_s
    position = loop.true_positions[-1]
    loop.run(0.3)
    assert loop.phase is Phase.HOLD
    assert target_seen_m(loop, shift_enu_m) <= before_m + 0.3
    loop.run(1.4)
    assert loop.phase is Phase.HOLD
    assert (
        math.dist(loop.true_positions[-1], position) <= BRAKING_M
    )  # it stops, it flies to nowhere
    assert loop.companion.session.tracker.rejected[RejectReason.OWN_JUMP] >= 10
    assert loop.said("vehicle position jumped by")
    loop.run_until(lambda: loop.phase in FLYING, 4.0)
    assert loop.now_s - jumped_s >= 2.0
    assert loop.companion.session.tracker.integrity.restarts == 0
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert target_seen_m(loop, shift_enu_m) <= 1.0
    assert outside(loop.true_positions, 150.0) == []


@flown_once
def searching(flavour: FlavourName = "px4") -> Loop:
    """Return a flight in control that searches in the small fence."""
    loop = Loop(SMALL, Scenario(autopilot=AutopilotParams(flavour=flavour)))
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(6.0)
    return loop


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize("shift_enu_m", OUT_OF_BOUNDS)
def test_a_jump_out_of_bounds_moves_nothing_and_is_handed_back(
    shift_enu_m: PositionEnu, flavour: FlavourName
) -> None:
    """It is unknown which of the two positions was right: the way back may be the way out."""
    loop = searching(flavour)
    loop.sim.vehicle.estimator.jump(shift_enu_m, 0.0)
    jumped_s, before = loop.now_s, len(loop.true_positions)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 4.0)
    assert loop.now_s - jumped_s >= 2.0
    assert loop.said("handing back: vehicle position jumped by")
    loop.run(10.0)
    position = loop.true_positions[before]
    assert all(math.dist(true, position) <= BRAKING_M for true in loop.true_positions[before:])


@pytest.mark.slow
def test_a_position_that_jumps_out_and_back_is_flown_on_by() -> None:
    loop = searching()
    before = len(loop.true_positions)
    for east_m in (50.0, -50.0):
        loop.sim.vehicle.estimator.jump((east_m, 0.0, 0.0), 0.0)
        loop.run(1.0)
    position = loop.true_positions[before]
    assert all(math.dist(true, position) <= BRAKING_M for true in loop.true_positions[before:])
    loop.run_until(lambda: loop.phase in FLYING, 4.0)


@pytest.mark.slow
def test_a_small_jump_does_not_keep_a_vehicle_outside_that_was_flown_there() -> None:
    beside = tuple((east - 40.0, north) for east, north in SQUARE)
    loop = Loop(CompanionConfig(limits=LimitsConfig(fence_enu_m=beside)))
    loop.take_off(20.0)
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 20.0)
    loop.sim.vehicle.estimator.jump((1.0, 0.0, 0.0), 0.0)
    loop.run(0.3)
    assert loop.phase is Phase.HOLD
    loop.run(20.0)
    assert loop.phase in FLYING
    assert loop.true_positions[-1][0] < -15.0


@pytest.mark.slow
def test_a_heading_that_jumps_is_held_on_too() -> None:
    loop = flying()
    loop.sim.vehicle.estimator.jump((0.0, 0.0, 0.0), math.radians(30.0))
    loop.run(0.3)
    assert loop.phase is Phase.HOLD
    assert loop.said("vehicle heading jumped by 30 deg")
    loop.run_until(lambda: loop.phase in FLYING, 4.0)
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert target_seen_m(loop) <= 1.0


@pytest.mark.slow
def test_a_position_that_keeps_jumping_is_handed_back() -> None:
    loop = flying()
    for _ in range(8):
        loop.sim.vehicle.estimator.jump((1.5, 0.0, 0.0), 0.0)
        loop.run(1.0)
    assert loop.phase is Phase.YIELD
    assert loop.said("keeps jumping")


@pytest.mark.slow
def test_a_flight_without_jumps_sees_none() -> None:
    around = monitored_flight(AUTO, Loop().flight.scenario, 3)
    around.flight.run(60.0)
    assert around.flight.companion.session.tracker.rejected[RejectReason.OWN_JUMP] == 0


def test_a_jump_that_stays_is_in_the_absolute_radius_until_the_position_is_back() -> None:
    loop = flying()

    def radii_m() -> tuple[float, float]:
        estimate = loop.companion.session.estimate
        assert estimate is not None
        return estimate.r95_m, estimate.absolute_r95_m

    relative_m, absolute_m = radii_m()
    for shift_enu_m in ((15.0, -20.0, 0.0), (-15.0, 20.0, 0.0)):
        loop.sim.vehicle.estimator.jump(shift_enu_m, 0.0)
        loop.run(0.5)
        jumped_m = radii_m()
        loop.run(6.0)
        if shift_enu_m[0] > 0.0:
            assert 25.0 < jumped_m[1] < 25.0 + 2.0 * absolute_m
            assert 25.0 < radii_m()[1] < 25.0 + 2.0 * absolute_m
            assert radii_m()[0] < 1.5 * relative_m
    assert radii_m()[1] < 1.5 * absolute_m
    assert loop.phase in FLYING


def test_an_origin_that_moves_leaves_no_doubt_about_the_position() -> None:
    loop = flying()
    before = loop.companion.session.estimate
    Injector(loop.flight, loop.wire, loop.operator).add(OriginShift(east_m=10.0))
    loop.run_until(lambda: loop.said("local origin moved 10 m"), 20.0)
    after = loop.companion.session.estimate
    assert before is not None
    assert after is not None
    assert after.own.jumped_en_m == pytest.approx((0.0, 0.0), abs=0.5)
    assert after.absolute_r95_m < 1.5 * before.absolute_r95_m
