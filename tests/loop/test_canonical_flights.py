"""The canonical scenario, many seeds, decoded from the bytes and checked against the truth."""

from __future__ import annotations

import multiprocessing
import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import pytest

from companion.domain import FlightMode
from companion.guidance.phases import Phase
from tests.loop.loop_helpers import Loop, outside

pytestmark = pytest.mark.slow

SEEDS = range(8)
"""`make missions` flies twenty."""
FLIGHT_S, AFTER_S = 180.0, 5.0
FENCE_M, MARGIN_M = 150.0, 3.0
FLOAT32_M = 1e-4
"""Error that single precision on the wire may add."""


@dataclass(frozen=True, slots=True)
class Flight:
    seed: int
    phase: Phase
    mode: FlightMode
    results: int
    error_m: float
    setpoints: int
    setpoints_outside: int
    positions_outside: int


def fly(seed: int) -> Flight:
    loop = Loop(seed=seed)
    loop.run_until(lambda: bool(loop.notes.results), FLIGHT_S)
    loop.run(AFTER_S)
    return Flight(
        seed,
        loop.phase,
        loop.mode,
        len(loop.notes.results),
        loop.error_m,
        len(loop.setpoints),
        len(outside([s.position_enu_m for s in loop.setpoints], FENCE_M - MARGIN_M + FLOAT32_M)),
        len(outside(loop.true_positions, FENCE_M)),
    )


def test_every_seed_is_localised_inside_the_fence() -> None:
    workers = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=workers) as pool:
        flights = list(pool.map(fly, SEEDS))
    assert [f.seed for f in flights if f.results != 1] == []
    assert {(f.phase, f.mode) for f in flights} == {(Phase.FINISHED, FlightMode.HOLD)}
    errors_m = [f.error_m for f in flights]
    assert statistics.median(errors_m) <= 0.5
    assert max(errors_m) <= 1.5
    assert sum(f.setpoints_outside + f.positions_outside for f in flights) == 0
    assert min(f.setpoints for f in flights) > 100


def test_the_same_seed_gives_the_same_bytes() -> None:
    first, second = Loop(seed=3), Loop(seed=3)
    for loop in (first, second):
        loop.run(40.0)
    assert first.companion_bytes == second.companion_bytes
    assert first.vehicle_bytes == second.vehicle_bytes
    assert len(first.companion_bytes) > 10_000


def test_another_seed_gives_other_bytes() -> None:
    first, second = Loop(seed=3), Loop(seed=4)
    for loop in (first, second):
        loop.run(40.0)
    assert first.companion_bytes != second.companion_bytes
