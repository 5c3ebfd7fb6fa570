"""The vehicle's own position or heading jumps in flight: held on, and the estimate moves along."""

from __future__ import annotations

import math

import pytest

from companion.domain import PositionEnu
from companion.estimation.refusal import Refusal
from companion.guidance.states import FLYING, Phase
from sim_link.campaign.flights import monitored
from tests.loop.loop_helpers import AUTO, Loop, outside

JUMPS: list[PositionEnu] = [(1.0, 0.0, 0.0), (-5.0, 5.0, 0.0), (30.0, -40.0, 0.0)]


def flying(after_s: float = 8.0) -> Loop:
    """In control and flying the plan, with an estimate."""
    loop = Loop()
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(after_s)
    return loop


def target_seen_m(loop: Loop, shift_enu_m: PositionEnu = (0.0, 0.0, 0.0)) -> float:
    """How far the estimate is from where the target is in the autopilot's terms."""
    estimate = loop.companion.session.estimate
    assert estimate is not None
    east, north = loop.flight.scenario.emitter.position_enu_m
    place = (east + shift_enu_m[0], north + shift_enu_m[1])
    return math.dist(estimate.position_enu_m, place)


@pytest.mark.parametrize("shift_enu_m", JUMPS)
def test_it_holds_until_the_position_is_steady_and_the_estimate_moves_along(
    shift_enu_m: PositionEnu,
) -> None:
    loop = flying()
    before_m = target_seen_m(loop)
    loop.sim.vehicle.estimator.jump(shift_enu_m, 0.0)
    jumped_s = loop.now_s
    place = loop.true_positions[-1]
    loop.run(0.3)
    assert loop.phase is Phase.HOLD
    assert target_seen_m(loop, shift_enu_m) <= before_m + 0.3
    loop.run(1.4)
    assert loop.phase is Phase.HOLD
    assert math.dist(loop.true_positions[-1][:2], place[:2]) <= 5.0  # it stops, it flies to nowhere
    assert loop.companion.session.tracker.refusals[Refusal.OWN_JUMP] >= 10
    assert loop.said("own position jumped by")
    loop.run_until(lambda: loop.phase in FLYING, 4.0)
    assert loop.now_s - jumped_s >= 2.0
    assert loop.companion.session.tracker.restarts == 0
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert target_seen_m(loop, shift_enu_m) <= 1.0
    assert outside(loop.true_positions, 150.0) == []


def test_a_heading_that_jumps_is_held_on_too() -> None:
    loop = flying()
    loop.sim.vehicle.estimator.jump((0.0, 0.0, 0.0), math.radians(30.0))
    loop.run(0.3)
    assert loop.phase is Phase.HOLD
    assert loop.said("own heading jumped by 30 deg")
    loop.run_until(lambda: loop.phase in FLYING, 4.0)
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert target_seen_m(loop) <= 1.0


def test_a_position_that_keeps_jumping_is_handed_back() -> None:
    loop = flying()
    for _ in range(8):
        loop.sim.vehicle.estimator.jump((1.5, 0.0, 0.0), 0.0)
        loop.run(1.0)
    assert loop.phase is Phase.YIELD
    assert loop.said("keeps jumping")


def test_a_flight_without_jumps_sees_none() -> None:
    around = monitored(AUTO, Loop().flight.scenario, 3)
    around.flight.run(60.0)
    assert around.flight.companion.session.tracker.refusals[Refusal.OWN_JUMP] == 0
