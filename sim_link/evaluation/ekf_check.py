"""Whether the EKF of the tables is filterpy's: both on the same measurements from the same places.

The compiled EKF flies. On its way, filterpy's filter takes in each measurement from the state that
the EKF was in, and the two results are compared. It is given the state each time, because an EKF
that has lost its target, and hovers where it believes it, multiplies a difference of rounding by
ten every 40 steps: two copies of filterpy's filter on two machines would part as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from companion.kernel import Matrix, Vector, kernel
from sim_link.evaluation.case import Case
from sim_link.evaluation.filterpy_ekf import FilterpyEkf
from sim_link.evaluation.noise import (
    TRUTH,
    RunSeed,
    Scene,
    Truth,
    channel_draws,
    measured_in,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)
from sim_link.evaluation.systems import System, belief_of
from sim_link.evaluation.trial import run_trial, start_of
from sim_link.evaluation.walk import EAST, RANGE_OFFSET, Belief, first_fix, updated
from sim_link.world.environment import NO_MEMORY

CHECKED_RUNS = 2
"""Of every cell, from the first."""
LARGEST_DIFFERENCE_M = 1e-6


@dataclass(frozen=True, slots=True)
class EkfCheck:
    """The first runs of an EKF cell, for filterpy to repeat."""

    case: Case
    system: System
    seed: int
    runs: int


class Replay(NamedTuple):
    """What a run's filter saw and believed, one row for each step."""

    z: Matrix
    """(steps, 3)"""
    means: Matrix
    """(steps + 1, 4) before the first measurement and after each."""
    covariances: Matrix
    """(steps + 1, 4, 4) the same."""


@kernel
def replayed(
    draws: Matrix, track_enu_m: Matrix, start_enu_m: Vector, truth: Truth, scene: Scene, b: Belief
) -> Replay:
    """A run of a recursive filter along a given track.

    Args:
        draws: (steps, 6) of the channel.
        track_enu_m: (steps, 2).
        start_enu_m: (2,) place of the first estimate; NaN: from the first measurement.
        truth: What is true.
        scene: What stands in the way.
        b: What the filter believes.
    """
    steps, memory, sensor = draws.shape[0], NO_MEMORY, np.zeros(3)
    z, means = np.full((steps, 3), np.nan), np.empty((steps + 1, 4))
    covariances = np.empty((steps + 1, 4, 4))
    means[0], covariances[0] = first_fix(0.0, 0.0, 1.0, 0.0, b)
    means[0, :2] = start_enu_m
    for step in range(steps):
        sensor[:2] = track_enu_m[step]
        z[step, 0], z[step, 1], memory = measured_in(
            draws[step], sensor[0], sensor[1], truth, scene, memory
        )
        if math.isnan(means[step, 0]):
            fixed = first_fix(sensor[0], sensor[1], z[step, 0], z[step, 1], b)
            means[step + 1], covariances[step + 1] = fixed
        else:
            moved = updated(means[step], covariances[step], sensor, z[step], b)
            means[step + 1], covariances[step + 1] = moved
    return Replay(z, means, covariances)


def largest_difference_m(check: EkfCheck) -> float:
    """The largest difference of a coordinate or range offset after any step of the runs, metres."""
    seeds = run_seeds(check.seed, check.runs)
    return max(_difference_m(check.case, check.system, seed) for seed in seeds)


def _difference_m(case: Case, system: System, seed: RunSeed) -> float:
    """Between the two filters, or between the one that was compared and the one that flew."""
    ours = run_trial(case, system, seed)
    rng = stream(seed, TRUTH)
    truth, start, track = truth_of(case, rng), start_of(case, rng), ours.track_enu_m
    draws, scene, belief = channel_draws(case, seed), scene_of(case), belief_of(case, system)
    replay = replayed(draws, np.ascontiguousarray(track), start, truth, scene, belief)
    columns = slice(EAST, RANGE_OFFSET + 1)
    of_replay = _largest(replay.means[1:, :3] - ours.record[:, columns])
    return max(of_replay, _largest(replay.means[1:, :3] - _theirs(case, track, replay)))


def _theirs(case: Case, track_enu_m: Matrix, replay: Replay) -> Matrix:
    """Coordinates and range offset of filterpy's filter after each measurement, (steps, 3)."""
    ekf = FilterpyEkf(case.belief)
    after = replay.means[1:, :3].copy()
    for step, (east_m, north_m) in enumerate(track_enu_m.tolist()):
        if math.isnan(replay.means[step, 0]):
            continue  # the first fix is no update
        range_m, bearing_rad = replay.z[step, :2].tolist()
        seen = RangingMeasurement(1, 0.0, range_m=range_m, bearing_enu_rad=bearing_rad)
        before = FilterState.of(0.0, replay.means[step], replay.covariances[step])
        after[step] = ekf.update(before, seen, (east_m, north_m, 0.0)).state.mean[:3]
    return after


def _largest(gaps: Matrix) -> float:
    return float(np.max(np.abs(gaps))) if np.isfinite(gaps).all() else math.inf
