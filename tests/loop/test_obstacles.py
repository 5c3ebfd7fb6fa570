"""Behind a block: ranges that show the way around it, bearings pulled to its edges."""

from __future__ import annotations

import multiprocessing
import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import msgspec
import pytest

from companion.geometry.polygons import depth_m
from companion.guidance.phases import Phase
from sim_link.fleet import load_scenario
from sim_link.world.line_of_sight import is_blocked_in_space
from tests.loop.loop_helpers import AUTO, Loop

pytestmark = pytest.mark.slow

SCENARIO = Path(__file__).parents[2] / "configs" / "scenarios" / "obstacle.yaml"
SEEDS = range(3)
FLIGHT_S, AFTER_S = 150.0, 5.0


@dataclass(frozen=True, slots=True)
class Flight:
    seed: int
    phase: Phase
    results: int
    error_m: float
    r95_m: float
    restarts: int
    hidden_share: float
    """Figures over the positions that it flew through."""
    depth_m: float
    """Largest depth in the block of the flight; negative: it stayed outside."""


def fly(seed: int) -> Flight:
    scenario = load_scenario(SCENARIO)
    block = scenario.obstacles[0].corners_enu_m
    limits = msgspec.structs.replace(AUTO.limits, keep_out_enu_m=(block,))
    loop = Loop(config=msgspec.structs.replace(AUTO, limits=limits), scenario=scenario, seed=seed)
    loop.run_until(lambda: bool(loop.notes.results), FLIGHT_S)
    loop.run(AFTER_S)
    assert scenario.environment is not None
    edges, target = scenario.environment.edges, (*scenario.emitter.position_enu_m, 0.0)
    flown = [position for position in loop.true_positions if position[2] > 3.0][::25]
    return Flight(
        seed,
        loop.phase,
        len(loop.notes.results),
        loop.error_m,
        max((result.estimate.r95_m for _, result in loop.notes.results), default=0.0),
        sum("diverged" in text for _, text in loop.notes.texts),
        statistics.mean(is_blocked_in_space(*target, *position, edges) for position in flown),
        max(depth_m(block, position[:2]) for position in loop.true_positions),
    )


def test_the_emitter_behind_the_block_is_found() -> None:
    workers = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=workers) as pool:
        flights = list(pool.map(fly, SEEDS))
    assert [f.seed for f in flights if f.results != 1] == []
    assert {f.phase for f in flights} == {Phase.FINISHED}
    assert statistics.median(f.error_m for f in flights) <= 0.3
    assert max(f.error_m for f in flights) <= 1.0
    assert [f.seed for f in flights if f.error_m > f.r95_m] == []
    assert max(f.r95_m for f in flights) <= 1.0  # what came around an edge hid no antenna
    assert [f.seed for f in flights if f.restarts] == []  # a right one is flown on, out of a shadow
    assert min(f.hidden_share for f in flights) > 0.05  # it was not for nothing
    assert max(f.depth_m for f in flights) < 0.0
