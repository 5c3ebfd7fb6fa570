"""Runs that are gone through again: the same measurements from the same places.

Where the run went is where filter and planner fly again, so that a retraced run costs what the two
of them cost, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.kernel import Matrix, Vector, kernel
from companion.planning.crossing_kernels import LATCH_SIZE
from sim_link.evaluation.bench import SEED, Walk
from sim_link.evaluation.case import Case
from sim_link.evaluation.noise import PLANNER, channel_draws, measured, stream
from sim_link.evaluation.systems import System, belief_of, steering_of
from sim_link.evaluation.trial import run_trial
from sim_link.evaluation.walk import FIXED, Belief, Steering, first_fix, next_place, updated


class Beliefs(NamedTuple):
    """What a recursive filter believed after every measurement of a run."""

    means: Matrix
    """(steps, n)"""
    covariances: Matrix
    """(steps, n, n)"""


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run of a system, as it is retraced."""

    system: System
    walk: Walk
    steering: Steering
    beliefs: Beliefs
    picks: Vector
    """(steps,) draws of the planner."""


def recorded_run(case: Case, system: System) -> RecordedRun:
    """One run of a system in a case, with all that it is retraced from.

    Raises:
        ValueError: There are no kernels for the system's filter.
    """
    belief, steering = belief_of(case, system), steering_of(case, system)
    trial = run_trial(case, system, SEED)
    draws = channel_draws(case, SEED)
    z = np.full((case.steps, 3), np.nan)
    for step, (east_m, north_m) in enumerate(trial.track_enu_m.tolist()):
        z[step, :2] = measured(draws[step], east_m, north_m, trial.truth)
    walk = Walk(case, np.ascontiguousarray(trial.track_enu_m), z, belief)
    beliefs, picks = believed(walk.track_enu_m, z, belief), stream(SEED, PLANNER).random(case.steps)
    return RecordedRun(system, walk, steering, beliefs, picks)


@kernel
def believed(track_enu_m: Matrix, z: Matrix, belief: Belief) -> Beliefs:
    """What the recursive filter believes after every measurement of a run.

    Args:
        track_enu_m: (steps, 2).
        z: (steps, 3).
        belief: What it believes before.
    """
    mean, covariance = first_fix(track_enu_m[0, 0], track_enu_m[0, 1], z[0, 0], z[0, 1], belief)
    steps, n = z.shape[0], mean.size
    means, covariances = np.empty((steps, n)), np.empty((steps, n, n))
    sensor = np.zeros(3)
    means[0], covariances[0] = mean, covariance
    for step in range(1, steps):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
        means[step], covariances[step] = mean, covariance
    return Beliefs(means, covariances)


@kernel
def retraced(
    track_enu_m: Matrix, z: Matrix, picks: Vector, belief: Belief, steering: Steering
) -> Matrix:
    """Where filter and planner fly after every measurement but the first, (steps - 1, 2).

    Args:
        track_enu_m: (steps, 2) places of the run.
        z: (steps, 3) its measurements.
        picks: (steps,) draws of its planner.
        belief: What the filter believes.
        steering: Where it flies.
    """
    places = track_enu_m[1:].copy()
    sensor, latch = np.zeros(3), np.zeros(LATCH_SIZE)
    sensor[:2] = track_enu_m[0]
    mean, covariance = first_fix(sensor[0], sensor[1], z[0, 0], z[0, 1], belief)
    if steering.planner != FIXED:
        _, _, latch = next_place(sensor, mean, covariance, picks[0], latch, belief, steering)
    for step in range(1, z.shape[0]):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
        if steering.planner != FIXED:
            places[step - 1, 0], places[step - 1, 1], latch = next_place(
                sensor, mean, covariance, picks[step], latch, belief, steering
            )
    return places


@kernel
def decided(
    track_enu_m: Matrix,
    beliefs: Beliefs,
    picks: Vector,
    belief: Belief,
    steering: Steering,
    passes: int,
) -> Matrix:
    """Where a planner flies from every estimate of a run but the last, (steps - 1, 2).

    Args:
        track_enu_m: (steps, 2) places of the run.
        beliefs: The estimates.
        picks: (steps,) draws of its planner.
        belief: What the filter believes before.
        steering: Of a planner that follows the estimate.
        passes: How often to go through the run.
    """
    places = np.empty((track_enu_m.shape[0] - 1, 2))
    sensor = np.zeros(3)
    for _ in range(passes):
        latch = np.zeros(LATCH_SIZE)
        for step in range(places.shape[0]):
            sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
            places[step, 0], places[step, 1], latch = next_place(
                sensor,
                beliefs.means[step],
                beliefs.covariances[step],
                picks[step],
                latch,
                belief,
                steering,
            )
    return places
