"""One run of a system in a case: a pure function of case, system and seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from companion.kernel import Matrix, Vector
from sim_link.evaluation.case import Case
from sim_link.evaluation.metrics import nees, r95_m
from sim_link.evaluation.noise import (
    PLANNER,
    TRUTH,
    RunSeed,
    Truth,
    channel_draws,
    scene_of,
    stream,
    truth_of,
)
from sim_link.evaluation.objects import flown
from sim_link.evaluation.systems import (
    System,
    belief_of,
    estimator_of,
    pilot_of,
    steering_of,
    track_of,
    window_of_system,
)
from sim_link.evaluation.walk import (
    BEARING_OFFSET,
    EAST,
    NORTH,
    RANGE_OFFSET,
    VARIANCE_EAST,
    VARIANCE_NORTH,
    VEHICLE_EAST,
    VEHICLE_NORTH,
    walked,
)


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What happened in a run, after each of its steps."""

    truth: Truth
    record: Matrix
    """(steps, 9), see `walk`."""
    stated_r95_m: Vector | None = None
    """(steps,) where the system says more of it than its covariance does."""

    @property
    def track_enu_m(self) -> Matrix:
        """(steps, 2) where the measurements were made."""
        return self.record[:, VEHICLE_EAST : VEHICLE_NORTH + 1]

    @property
    def estimates_enu_m(self) -> Matrix:
        """(steps, 2)."""
        return self.record[:, EAST : NORTH + 1]

    @property
    def errors_m(self) -> Vector:
        """(steps,) distance between estimate and target."""
        return np.asarray(np.hypot(*self._misses_enu_m.T))

    @property
    def range_offsets_m(self) -> Vector:
        """(steps,) estimates."""
        return self.record[:, RANGE_OFFSET]

    @property
    def bearing_offsets_rad(self) -> Vector:
        """(steps,) estimates."""
        return self.record[:, BEARING_OFFSET]

    @property
    def covariances_m2(self) -> Matrix:
        """(steps, 3) the entries east-east, east-north, north-north."""
        return self.record[:, VARIANCE_EAST : VARIANCE_NORTH + 1]

    @property
    def nees(self) -> Vector:
        """(steps,) of the position."""
        return nees(self._misses_enu_m, self.covariances_m2)

    @property
    def r95_m(self) -> Vector:
        """(steps,) radius about the estimate that is said to hold the target with 95 %."""
        return r95_m(self.covariances_m2) if self.stated_r95_m is None else self.stated_r95_m

    @property
    def _misses_enu_m(self) -> Matrix:
        target = np.array([self.truth.east_m, self.truth.north_m])
        return np.asarray(self.estimates_enu_m - target)


Flight = Callable[[Matrix, Vector, Truth, Vector], TrialResult]
"""A run from what channel and planner draw, what is true and the place of the first estimate."""


def run_trial(case: Case, system: System, seed: RunSeed) -> TrialResult:
    """One run; the same truth and the same draws for every system of the same seed."""
    return next(iter(_trials(case, system, [seed])))


def run_block(case: Case, system: System, seeds: Iterable[RunSeed]) -> list[TrialResult]:
    """A run for each seed."""
    return list(_trials(case, system, seeds))


def _trials(case: Case, system: System, seeds: Iterable[RunSeed]) -> Iterable[TrialResult]:
    flies = _compiled_flight(case, system) if system.is_compiled else _object_flight(case, system)
    for seed in seeds:
        truth_rng = stream(seed, TRUTH)
        truth = truth_of(case, truth_rng)
        start = start_of(case, truth_rng)
        picks = stream(seed, PLANNER).random(case.steps)
        yield flies(channel_draws(case, seed), picks, truth, start)


def _compiled_flight(case: Case, system: System) -> Flight:
    """Flies runs in one compiled loop each; what is the same for all is made here, once."""
    track, scene = track_of(case), scene_of(case)
    belief, steering = belief_of(case, system), steering_of(case, system)
    window = window_of_system(case, system)

    def fly(draws: Matrix, picks: Vector, truth: Truth, start_enu_m: Vector) -> TrialResult:
        """Fly one draw."""
        record = walked(draws, picks, track, start_enu_m, truth, scene, belief, window, steering)
        return TrialResult(truth, record)

    return fly


def _object_flight(case: Case, system: System) -> Flight:
    """Flies runs over estimator and planner objects."""

    def fly(draws: Matrix, picks: Vector, truth: Truth, start_enu_m: Vector) -> TrialResult:
        """Fly one draw."""
        del picks
        return flown_trial(case, system, draws, truth, start_enu_m)

    return fly


def flown_trial(
    case: Case, system: System, draws: Matrix, truth: Truth, start_enu_m: Vector
) -> TrialResult:
    """A run over estimator and planner objects, whether or not there are kernels for it.

    Args:
        case: The cell.
        system: What flies.
        draws: (steps, 6) of the channel.
        truth: What is true.
        start_enu_m: (2,) place of the first estimate; NaN: from the first measurement.
    """
    estimator, pilot = estimator_of(case, system, start_enu_m), pilot_of(case, system)
    record, radii = flown(draws, case.start_enu_m, truth, scene_of(case), estimator, pilot)
    return TrialResult(truth, record, radii)


def start_of(case: Case, rng: np.random.Generator) -> Vector:
    """Place of the first estimate, (2,), drawn over the area; NaN: from the first measurement."""
    drawn_enu_m = rng.random(2) * np.array(case.area_m)
    return drawn_enu_m if case.first_estimate == "uniform" else np.full(2, math.nan)
