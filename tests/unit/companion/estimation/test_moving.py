"""An estimate moves along with navigation that jumps, as if positions had always been so."""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.estimation.antenna import AntennaParams
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.kernel import Matrix
from tests.unit.companion.estimation.walks import measurement_of, params, walk

SHIFT = (12.0, -7.0, 3.0)
TURN_RAD = math.radians(30.0)


def fed(
    tracker: TargetTracker,
    rows: Matrix,
    first: int,
    shift: PositionEnu = (0.0, 0.0, 0.0),
    turn_rad: float = 0.0,
) -> TargetTracker:
    """Return the tracker after these rows, seen from shifted positions and turned."""
    for index, row in enumerate(rows, first):
        seen, position = measurement_of(row, 0.1 * index)
        if seen.bearing_enu_rad is not None:
            turned_rad = math.remainder(seen.bearing_enu_rad + turn_rad, 2.0 * math.pi)
            seen = replace(seen, bearing_enu_rad=turned_rad, bearing_body_rad=turned_rad)
        moved = (position[0] + shift[0], position[1] + shift[1], position[2] + shift[2])
        tracker.fuse(seen, moved, 0.1 * index)
    return tracker


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 60, pytest.param(700, marks=pytest.mark.slow)])
def test_after_a_jump_it_is_as_if_it_had_always_been_there(count: int) -> None:
    """With 700 of them some are no longer in the window."""
    believed = TrackerParams(filter=params(target_height_sigma_m=5.0))
    rows = walk(np.random.default_rng(1), count + 120, elevations=True)
    jumped = fed(TargetTracker(believed), rows[:count], 0)
    jumped.move(SHIFT, 0.0)
    fed(jumped, rows[count:], count, SHIFT)
    higher = msgspec.structs.replace(believed.filter, target_height_m=SHIFT[2])
    always = fed(TargetTracker(TrackerParams(filter=higher)), rows, 0, SHIFT)
    jumped.optimize(jumped.params.window.starts)
    always.optimize(always.params.window.starts)
    assert jumped.integrity.restarts == 0
    one, other = jumped.estimate(1e3), always.estimate(1e3)
    assert one is not None
    assert other is not None
    assert one.position_enu_m == pytest.approx(other.position_enu_m, abs=0.05)
    assert one.height_m == pytest.approx(other.height_m, abs=0.05)
    assert one.r95_m == pytest.approx(other.r95_m, rel=0.1)


@functools.cache
def walked(kind: Literal["azimuth", "auto"]) -> tuple[Matrix, TargetTracker, TargetTracker]:
    """Rows of a walk, the tracker after half of them, and after all."""
    antenna = AntennaParams(kind=kind)
    believed = TrackerParams(filter=msgspec.structs.replace(params(), antenna=antenna))
    rows = walk(np.random.default_rng(4), 400)
    half = fed(TargetTracker(believed), rows[:200], 0)
    return rows, half, fed(copy.deepcopy(half), rows[200:], 200)


@pytest.mark.parametrize("step_m", [4.0, -4.0, 9.0])
@pytest.mark.parametrize("kind", ["azimuth", "auto"])
def test_a_known_height_of_the_target_moves_with_those_of_the_vehicle(
    kind: Literal["azimuth", "auto"], step_m: float
) -> None:
    """R95 became 18.6 m and the filter diverged where heights stepped by 4 m and nothing else."""
    rows, half, still = walked(kind)
    jumped = copy.deepcopy(half)
    jumped.move((0.0, 0.0, step_m), 0.0, 0.1)
    fed(jumped, rows[200:], 200, (0.0, 0.0, step_m))
    one, other = jumped.estimate(1e3), still.estimate(1e3)
    assert one is not None
    assert other is not None
    assert one.position_enu_m == pytest.approx(other.position_enu_m, abs=1e-6)
    assert one.r95_m == pytest.approx(other.r95_m, rel=1e-6)
    assert one.height_m == pytest.approx(other.height_m + step_m)
    assert jumped.target_height_m == step_m
    assert jumped.baseline_m(20.0 + step_m) == pytest.approx(still.baseline_m(20.0))
    assert jumped.belief is not None
    resumed = TargetTracker(half.params)
    assert resumed.resume(jumped.belief, 0.0, 40.0) is None
    assert resumed.raised_m == step_m


def test_bearings_from_a_heading_turn_with_it() -> None:
    rows = walk(np.random.default_rng(2), 200)
    tracker = fed(TargetTracker(TrackerParams(filter=params())), rows[:100], 0)
    before = tracker.hypotheses[0].state
    tracker.move((0.0, 0.0, 0.0), TURN_RAD)
    after = tracker.hypotheses[0].state
    assert after.mean[3] - before.mean[3] == pytest.approx(TURN_RAD)
    assert after.mean[:3] == pytest.approx(before.mean[:3])
    assert after.covariance[3, 3] > before.covariance[3, 3]
    fed(tracker, rows[100:], 100, turn_rad=TURN_RAD)
    assert tracker.integrity.restarts == 0
    assert not tracker.rejected
    assert math.dist(tracker.hypotheses[0].position_enu_m, before.mean[:2]) < 1.0


def test_of_a_radio_that_knows_north_they_do_not() -> None:
    tracker = TargetTracker(TrackerParams(filter=params()))
    for index, row in enumerate(walk(np.random.default_rng(2), 50)):
        tracker.fuse(*measurement_of(row, 0.1 * index), 0.1 * index)
    before = tracker.hypotheses[0].state.mean
    tracker.move((0.0, 0.0, 0.0), TURN_RAD)
    assert tracker.hypotheses[0].state.mean == pytest.approx(before)


@pytest.mark.parametrize("sigma_m", [0.0, 0.1])
def test_the_place_is_doubted_by_what_is_not_known_of_the_shift(sigma_m: float) -> None:
    tracker = fed(TargetTracker(TrackerParams(filter=params())), walk(np.random.default_rng(3)), 0)
    before = tracker.hypotheses[0].state
    tracker.move(SHIFT, 0.0, sigma_m)
    after = tracker.hypotheses[0].state
    assert after.mean - before.mean == pytest.approx([*SHIFT[:2], 0.0, 0.0])
    grown = np.diag(after.covariance - before.covariance)
    assert grown == pytest.approx([sigma_m**2, sigma_m**2, 0.0, 0.0])


def test_without_an_estimate_there_is_nothing_to_move() -> None:
    tracker = TargetTracker(TrackerParams())
    tracker.move(SHIFT, TURN_RAD)
    assert tracker.hypotheses == ()
