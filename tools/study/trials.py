"""Trials of a system, bounds on the tracks they flew, and their sums in blocks.

A trial is a pure function of case, system and seed. A block is a fixed range of runs; sums are
joined in the order of runs, so that figures are the same bytes whatever the number of processes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import msgspec
import numpy as np

from companion.kernel import Matrix, Vector, kernel
from sim_link.world.environment import ChannelParams
from sim_link.world.line_of_sight import Surroundings, is_blocked_in_space
from tools.study import case as cases
from tools.study import metrics, systems, walk
from tools.study.case import Case, RunSeed, RunTruth
from tools.study.systems import System


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Truth and estimates of a run, after each of its steps."""

    truth: RunTruth
    record: Matrix
    """Record of the run, (steps, 9), see `walk`."""
    stated_r95_m: Vector | None = None
    """Stated R95, (steps,), of a system whose R95 is not that of its covariance alone."""

    @property
    def track_enu_m(self) -> Matrix:
        """Positions of the measurements, (steps, 2)."""
        return self.record[:, walk.VEHICLE_EAST : walk.VEHICLE_NORTH + 1]

    @property
    def estimates_enu_m(self) -> Matrix:
        """Estimated positions, (steps, 2)."""
        return self.record[:, walk.TARGET_EAST : walk.TARGET_NORTH + 1]

    @property
    def errors_m(self) -> Vector:
        """Distance between estimate and target, (steps,)."""
        return np.asarray(np.hypot(*self._misses_enu_m.T))

    @property
    def nees(self) -> Vector:
        """NEES of the position, (steps,)."""
        return metrics.nees(self._misses_enu_m, self.covariances_m2)

    @property
    def r95_m(self) -> Vector:
        """Radius about the estimate that holds the target with 95 %, (steps,)."""
        stated_m = self.stated_r95_m
        return metrics.r95_m(self.covariances_m2) if stated_m is None else stated_m

    @property
    def covariances_m2(self) -> Matrix:
        """Entries east-east, east-north, north-north, (steps, 3)."""
        return self.record[:, walk.VARIANCE_EAST : walk.VARIANCE_NORTH + 1]

    @property
    def _misses_enu_m(self) -> Matrix:
        return np.asarray(self.estimates_enu_m - np.array([self.truth.east_m, self.truth.north_m]))


def run_trial(case: Case, system: System, seed: RunSeed) -> TrialResult:
    """Do one run; the same truth and the same draws for every system of the same seed."""
    return run_block(case, system, [seed])[0]


def run_block(case: Case, system: System, seeds: Iterable[RunSeed]) -> list[TrialResult]:
    """Do a run for each seed, in one compiled loop each if there is one."""
    if not system.is_compiled:
        return [flown_trial(case, system, seed) for seed in seeds]
    track, scene = cases.track_of(case), cases.scene_of(case)
    belief, steering = systems.belief_of(case, system), systems.steering_of(case, system)
    trials = []
    for seed in seeds:
        draws, truth, start = cases.run_inputs(case, seed)
        picks = cases.stream(seed, cases.PLANNER).random(case.steps)
        record = walk.walked(draws, picks, track, start, truth, scene, belief, steering)
        trials.append(TrialResult(truth, record))
    return trials


def flown_trial(case: Case, system: System, seed: RunSeed) -> TrialResult:
    """Do a run over estimator and planner objects, whether or not there are kernels for it."""
    draws, truth, start = cases.run_inputs(case, seed)
    fuse, steer = systems.estimator_of(case, system, start), systems.pilot_of(case, system)
    scene = cases.scene_of(case)
    record, radii = systems.flown(draws, case.start_enu_m, truth, scene, fuse, steer)
    return TrialResult(truth, record, radii)


def bounds_m2(case: Case, trials: Sequence[TrialResult]) -> list[Vector]:
    """Return the bound on the squared error after every step of every run, (steps,) each, m^2.

    Behind obstacles it is known for shadows whose draws are new at every position. Detours, pulls
    and correlated draws carry information on it, so that no bound is given for them (NaN).
    """
    shadow = case.shadow
    is_memoryless = shadow.detour_share == shadow.pull_share == shadow.correlation_m == 0.0
    if case.obstacles and not is_memoryless:
        return [np.full(len(trial.record), math.nan) for trial in trials]
    clear = metrics.channel_information(case.channel, is_joint=case.nlos_draws == "joint")
    shaded = metrics.channel_information(shadow_channel(case)) if case.obstacles else clear
    target, surroundings = np.array(case.target_enu_m), cases.scene_of(case).surroundings
    prior = np.zeros(2)
    if case.offsets == "prior":
        prior = 1.0 / case.belief.prior[1][2:4] ** 2
    bounds = []
    for trial in trials:
        track = np.ascontiguousarray(trial.track_enu_m)
        is_shaded = shaded_steps(track, surroundings)
        by_range = np.where(is_shaded, shaded.range_per_m2, clear.range_per_m2)
        by_bearing = np.where(is_shaded, shaded.bearing_per_rad2, clear.bearing_per_rad2)
        bounds.append(metrics.position_bounds_m2(track, target, by_range, by_bearing, prior))
    return bounds


@kernel
def shaded_steps(track_enu_m: Matrix, surroundings: Surroundings) -> Vector:
    """Return 1 where an obstacle blocks the path to the target, otherwise 0, (steps,)."""
    is_shaded = np.zeros(track_enu_m.shape[0])
    east, north, up = surroundings.east_m, surroundings.north_m, surroundings.up_m
    for step in range(track_enu_m.shape[0]):
        if is_blocked_in_space(
            east, north, up, track_enu_m[step, 0], track_enu_m[step, 1], 0.0, surroundings.edges
        ):
            is_shaded[step] = 1.0
    return is_shaded


def shadow_channel(case: Case) -> ChannelParams:
    """Return the channel parameters of a path behind an obstacle."""
    return msgspec.structs.replace(
        case.channel,
        p_nlos=1.0,
        range_bias_mean_m=case.shadow.extra_bias_mean_m,
        bearing_bias_sigma_deg=case.shadow.bearing_bias_sigma_deg,
    )


BLOCK = 50
"""Runs that are done in one go; another number rounds sums differently."""


@dataclass(frozen=True, slots=True)
class RunSeries:
    """Consecutive runs of one system in one case."""

    case: Case
    system: System
    seed: int
    runs: int
    first: int = 0

    def blocks(self) -> list[RunSeries]:
        """Return its parts that are done in one go, in order."""
        firsts = range(self.first, self.first + self.runs, BLOCK)
        end = self.first + self.runs
        return [replace(self, first=first, runs=min(BLOCK, end - first)) for first in firsts]


class RunTally(NamedTuple):
    """Outcomes of runs, and sums over them after every step.

    Sums, (steps,) each, are of squared errors, of the Cramer-Rao bounds on them, of NEES, of runs
    whose R95 circle contained the target, and of the estimated offsets.
    """

    runs: int
    squared_m2: Vector
    bound_m2: Vector
    nees: Vector
    inside: Vector
    range_offset_m: Vector
    bearing_offset_rad: Vector
    final_errors_m: Vector

    @property
    def rmse_m(self) -> Vector:
        """RMSE of the position, (steps,)."""
        return np.asarray(np.sqrt(self.squared_m2 / self.runs))

    @property
    def rmse_bound_m(self) -> Vector:
        """Cramer-Rao bound of the RMSE on these tracks, (steps,)."""
        return np.asarray(np.sqrt(self.bound_m2 / self.runs))

    @property
    def mean_nees(self) -> Vector:
        """Mean NEES of the position, (steps,)."""
        return np.asarray(self.nees / self.runs)

    @property
    def coverage(self) -> Vector:
        """Share of runs whose R95 circle contained the target, (steps,)."""
        return np.asarray(self.inside / self.runs)

    @property
    def final_m(self) -> float:
        """RMSE after the last step."""
        return float(self.rmse_m[-1])

    @property
    def worst_m(self) -> float:
        """Error of the worst run after the last step."""
        return float(np.max(self.final_errors_m))

    @property
    def median_m(self) -> float:
        """Median error after the last step; a run that ended nowhere counts as farthest off."""
        return float(
            np.median(np.where(np.isnan(self.final_errors_m), np.inf, self.final_errors_m))
        )

    def diverged(self, threshold_m: float = metrics.DIVERGED_M) -> int:
        """Return the number of runs that ended beyond the threshold, or nowhere."""
        return int(np.sum(~(self.final_errors_m <= threshold_m)))

    def packed(self) -> bytes:
        """Return all of it in bytes, as `unpacked` reads them."""
        _, *arrays = self
        head = [float(self.runs), float(self.squared_m2.size)]
        return np.concatenate([head, *arrays]).astype("<f8").tobytes()


def unpacked(packed: bytes) -> RunTally:
    """Return the tally in bytes of `RunTally.packed`."""
    numbers = np.frombuffer(packed, dtype="<f8").astype(np.float64)
    runs, end = int(numbers[0]), 2 + 6 * int(numbers[1])
    return RunTally(runs, *[*np.split(numbers[2:end], 6), numbers[end:]])


def joined_in_order(tallies: Iterable[RunTally]) -> RunTally:
    """Return all runs of tallies whose blocks follow each other."""
    runs, *sums, finals = (list[Any](values) for values in zip(*tallies, strict=True))
    return RunTally(sum(runs), *[*(sum(own) for own in sums), np.concatenate(finals)])


def tally_of(block: RunSeries) -> RunTally:
    """Do the runs of a block."""
    seeds = cases.run_seeds(block.seed, block.runs, block.first)
    trials = run_block(block.case, block.system, seeds)
    errors = np.array([trial.errors_m for trial in trials])
    inside = [trial.errors_m <= trial.r95_m for trial in trials]
    range_offsets_m = [trial.record[:, walk.RANGE_OFFSET] for trial in trials]
    bearing_offsets_rad = [trial.record[:, walk.BEARING_OFFSET] for trial in trials]
    return RunTally(
        runs=len(trials),
        squared_m2=np.sum(errors**2, axis=0),
        bound_m2=np.sum(bounds_m2(block.case, trials), axis=0),
        nees=np.sum([trial.nees for trial in trials], axis=0),
        inside=np.sum(inside, axis=0, dtype=np.float64),
        range_offset_m=np.sum(range_offsets_m, axis=0),
        bearing_offset_rad=np.sum(bearing_offsets_rad, axis=0),
        final_errors_m=errors[:, -1],
    )
