"""Searching for an emitter that is out of reach at first, around keep-outs, over both endpoints."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import (
    CompanionConfig,
    LimitsConfig,
    PatternConfig,
    PatternKind,
    PlannerConfig,
)
from companion.geometry.polygons import Point, depth_m
from companion.guard.limits import Fence
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.planning.crossing import LatchedCrossingParams
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import Loop

AUTO = SessionParams(engage="auto")
FENCE = ((-5.0, -5.0), (125.0, -5.0), (125.0, 125.0), (-5.0, 125.0))
HOUSE = ((30.0, 20.0), (60.0, 20.0), (60.0, 40.0), (30.0, 40.0))
MARGIN_M = 3.0
LIMITS = LimitsConfig(fence_enu_m=FENCE, fence_margin_m=MARGIN_M, keep_out_enu_m=(HOUSE,))
ALLOWED = Fence(FENCE, MARGIN_M - 1e-3, (HOUSE,))
"""With what single precision on the wire may take of the margin."""
EMITTER = EmitterParams(position_enu_m=(90.0, 100.0))
REACH_M = 45.0


def _config(search: PatternKind | None = "lawnmower", **planner: object) -> CompanionConfig:
    chosen = PlannerConfig(
        search=search,
        lost_after_s=10.0,
        pattern=PatternConfig(spacing_m=30.0, datum_enu_m=(60.0, 60.0)),
        **planner,  # type: ignore[arg-type]
    )
    return CompanionConfig(mission=AUTO, limits=LIMITS, planner=chosen)


def _loop(config: CompanionConfig, reach_m: float = REACH_M) -> Loop:
    return Loop(config, Scenario(emitter=EMITTER, payload=PayloadParams(max_range_m=reach_m)))


def _check_positions(loop: Loop) -> None:
    """No setpoint where none may be; the vehicle cuts corners by less than the margin."""
    # Before control is given, "stay here" is sent from where the vehicle stands.
    assert [s for s in loop.setpoints if not ALLOWED.allows(s.position_enu_m[:2])] == []
    assert min(-depth_m(HOUSE, position[:2]) for position in loop.true_positions) > 0.0
    assert min(depth_m(FENCE, position[:2]) for position in loop.true_positions) > 0.0


def _reasons(loop: Loop) -> list[str]:
    return [str(fields["reason"]) for _, kind, fields in loop.notes.records if kind == "waypoint"]


def _distance_m(loop: Loop) -> float:
    position: Point = loop.sim.vehicle.body.position_enu_m[:2]
    return math.dist(position, EMITTER.position_enu_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    "search",
    [
        "sector",
        pytest.param("lawnmower", marks=pytest.mark.slow),
        pytest.param("expanding_square", marks=pytest.mark.slow),
    ],
)
def test_an_emitter_out_of_reach_is_searched_for_and_found(search: PatternKind) -> None:
    loop = _loop(_config(search))
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    assert loop.companion.session.estimate is None
    assert loop.said("no contact yet: flying the search pattern")
    loop.run_until(lambda: _reasons(loop)[-1] == "approach", 250.0)
    assert set(_reasons(loop)[:-1]) <= {"search", "detour"}
    assert _distance_m(loop) <= REACH_M
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.said("contact: flying to the target")
    assert loop.error_m <= 1.5
    _check_positions(loop)


def test_without_a_search_the_same_flight_waits() -> None:
    loop = _loop(_config(None))
    loop.run(30.0)
    assert loop.phase is Phase.HOLD
    assert loop.said("hold: waiting for ranging")


@pytest.mark.slow
def test_contact_that_is_lost_leads_back_to_the_search_and_may_come_again() -> None:
    loop = _loop(_config())
    loop.run_until(lambda: loop.companion.session.estimate is not None, 150.0)
    loop.run(2.0)
    left = loop.sim.vehicle.body.position_enu_m[:2]
    loop.is_ranging_up = False
    loop.run_until(lambda: loop.phase is Phase.HOLD, 6.0)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 6.0)
    assert loop.said("no contact for 10 s: back to the search pattern")
    assert "resuming on" in loop.companion.session.status(loop.now_s).detail
    loop.run(30.0)
    assert not loop.notes.results
    assert math.dist(left, loop.sim.vehicle.body.position_enu_m[:2]) > 20.0
    loop.is_ranging_up = True
    loop.run_until(lambda: bool(loop.notes.results), 250.0)
    assert loop.error_m <= 1.5
    _check_positions(loop)


@pytest.mark.slow
def test_a_pattern_alone_is_flown_over_the_emitter() -> None:
    loop = _loop(_config("lawnmower", kind="survey"), reach_m=500.0)
    loop.run(150.0)
    assert set(_reasons(loop)) <= {"search", "detour"}
    assert loop.error_m <= 3.0
    _check_positions(loop)


@pytest.mark.slow
def test_the_information_planner_finds_the_emitter_too() -> None:
    loop = _loop(_config(None, kind="fim"), reach_m=500.0)
    loop.run_until(lambda: bool(loop.notes.results), 240.0)
    assert loop.error_m <= 1.5
    assert "information" in _reasons(loop)
    _check_positions(loop)


@pytest.mark.slow
def test_crossings_in_three_dimensions_find_the_emitter() -> None:
    swinging = LatchedCrossingParams(altitude_swing_m=8.0)
    loop = _loop(_config(None, latched_crossing=swinging), reach_m=500.0)
    loop.run_until(lambda: bool(loop.notes.results), 240.0)
    assert loop.error_m <= 1.5
    ups = [s.position_enu_m[2] for s in loop.setpoints]
    assert max(ups) == pytest.approx(28.0, abs=0.5)
    assert min(up for s, up in zip(loop.setpoints, ups, strict=True) if s.time_s > 40.0) < 17.0


@pytest.mark.slow
def test_an_emitter_in_a_keep_out_is_found_from_around_it() -> None:
    scenario = Scenario(emitter=EmitterParams(position_enu_m=(38.0, 30.0)))
    mission = SessionParams(engage="auto", stop_radius_m=2.0)
    loop = Loop(CompanionConfig(mission=mission, limits=LIMITS), scenario)
    loop.run_until(lambda: bool(loop.notes.results), 240.0)
    assert loop.said("estimate in a keep-out")
    assert loop.error_m <= 2.0
    _check_positions(loop)
