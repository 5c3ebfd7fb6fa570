"""Trials of a system, bounds on the tracks they flew, and their sums in blocks.

One run of a system in a case: a pure function of case, system and seed.

The Cramer-Rao bound of a case on the tracks that were flown in it.

Many runs, in blocks that other processes may do, summed up so that it does not matter who did.

A block is a fixed range of a campaign's runs, and sums are joined in the order of the runs: the
figures of a campaign are the same bytes whatever the number of processes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import msgspec
import numpy as np

from companion.kernel import Matrix, Vector, kernel
from sim_link.lab.evaluation.case import (
    PLANNER,
    TRUTH,
    Case,
    RunSeed,
    RunTruth,
    channel_draws,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)
from sim_link.lab.evaluation.metrics import (
    ChannelInformation,
    channel_information,
    nees,
    position_bounds_m2,
    r95_m,
)
from sim_link.lab.evaluation.systems import (
    System,
    belief_of,
    estimator_of,
    flown,
    pilot_of,
    steering_of,
    track_of,
)
from sim_link.lab.evaluation.walk import (
    BEARING_OFFSET,
    RANGE_OFFSET,
    TARGET_EAST,
    TARGET_NORTH,
    VARIANCE_EAST,
    VARIANCE_NORTH,
    VEHICLE_EAST,
    VEHICLE_NORTH,
    walked,
)
from sim_link.world.environment import ChannelParams, ShadowParams
from sim_link.world.line_of_sight import Surroundings, is_blocked_in_space


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What happened in a run, after each of its steps."""

    truth: RunTruth
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
        return self.record[:, TARGET_EAST : TARGET_NORTH + 1]

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


Flight = Callable[[Matrix, Vector, RunTruth, Vector], TrialResult]
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

    def fly(draws: Matrix, picks: Vector, truth: RunTruth, start_enu_m: Vector) -> TrialResult:
        """Fly one draw."""
        record = walked(draws, picks, track, start_enu_m, truth, scene, belief, steering)
        return TrialResult(truth, record)

    return fly


def _object_flight(case: Case, system: System) -> Flight:
    """Flies runs over estimator and planner objects."""

    def fly(draws: Matrix, picks: Vector, truth: RunTruth, start_enu_m: Vector) -> TrialResult:
        """Fly one draw."""
        del picks
        return flown_trial(case, system, draws, truth, start_enu_m)

    return fly


def flown_trial(
    case: Case, system: System, draws: Matrix, truth: RunTruth, start_enu_m: Vector
) -> TrialResult:
    """A run over estimator and planner objects, whether or not there are kernels for it.

    Args:
        draws: (steps, 6) of the channel.
        start_enu_m: (2,) place of the first estimate; NaN: from the first measurement.
    """
    estimator, pilot = estimator_of(case, system, start_enu_m), pilot_of(case, system)
    record, radii = flown(draws, case.start_enu_m, truth, scene_of(case), estimator, pilot)
    return TrialResult(truth, record, radii)


def start_of(case: Case, rng: np.random.Generator) -> Vector:
    """Place of the first estimate, (2,), drawn over the area; NaN: from the first measurement."""
    drawn_enu_m = rng.random(2) * np.array(case.area_m)
    return drawn_enu_m if case.first_estimate == "uniform" else np.full(2, math.nan)


def bounds_m2(case: Case, trials: Sequence[TrialResult]) -> list[Vector]:
    """The bound on the squared error after every step of every run, (steps,) each, m^2.

    Behind obstacles it is known for shadows whose draws are new at every place. Detours, pulls and
    correlated draws tell of the place by themselves, so that no bound is given for them (NaN).
    """
    if case.obstacles and not is_memoryless(case.shadow):
        return [np.full(len(trial.record), math.nan) for trial in trials]
    clear = channel_information(case.channel, is_joint=case.nlos_draws == "joint")
    shaded = channel_information(shadow_channel(case)) if case.obstacles else clear
    target, surroundings = np.array(case.target_enu_m), scene_of(case).surroundings
    prior = np.zeros(2)
    if case.offsets == "prior":
        prior = 1.0 / case.belief.prior[1][2:4] ** 2
    bounds = []
    for trial in trials:
        track = np.ascontiguousarray(trial.track_enu_m)
        information = track_information(track, clear, shaded, surroundings)
        bounds.append(position_bounds_m2(track, target, *information, prior))
    return bounds


def track_information(
    track_enu_m: Matrix,
    clear: ChannelInformation,
    shaded: ChannelInformation,
    surroundings: Surroundings,
) -> tuple[Vector, Vector]:
    """Information of the range, 1/m^2, and the bearing, 1/rad^2, at every place, (steps,) each."""
    is_shaded = shaded_places(track_enu_m, surroundings)
    return (
        np.where(is_shaded, shaded.range_per_m2, clear.range_per_m2),
        np.where(is_shaded, shaded.bearing_per_rad2, clear.bearing_per_rad2),
    )


@kernel
def shaded_places(track_enu_m: Matrix, surroundings: Surroundings) -> Vector:
    """1 where an obstacle blocks the path to the target, otherwise 0, (steps,)."""
    is_shaded = np.zeros(track_enu_m.shape[0])
    for step in range(track_enu_m.shape[0]):
        if is_blocked_in_space(
            surroundings.east_m,
            surroundings.north_m,
            surroundings.up_m,
            track_enu_m[step, 0],
            track_enu_m[step, 1],
            0.0,
            surroundings.edges,
        ):
            is_shaded[step] = 1.0
    return is_shaded


def is_memoryless(shadow: ShadowParams) -> bool:
    """Whether draws in a shadow say nothing of the place they were made at."""
    return shadow.detour_share == shadow.pull_share == shadow.correlation_m == 0.0


def shadow_channel(case: Case) -> ChannelParams:
    """What a path suffers behind an obstacle, as a channel of its own."""
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
    """Runs of one system in one case."""

    case: Case
    system: System
    seed: int
    runs: int

    def blocks(self) -> list[Block]:
        """The ranges of runs, in order."""
        firsts = range(0, self.runs, BLOCK)
        return [Block(self, first, min(BLOCK, self.runs - first)) for first in firsts]


@dataclass(frozen=True, slots=True)
class Block:
    """A range of a campaign's runs."""

    campaign: RunSeries
    first: int
    runs: int


@dataclass(frozen=True, slots=True)
class RunTally:
    """What is kept of runs: sums over them after every step, and how each of them ended."""

    runs: int
    squared_m2: Vector
    """(steps,) sum of squared errors."""
    bound_m2: Vector
    """(steps,) sum of the Cramer-Rao bounds on them."""
    nees: Vector
    """(steps,) sum."""
    inside: Vector
    """(steps,) runs whose R95 circle contained the target."""
    range_offset_m: Vector
    """(steps,) sum of the estimates."""
    bearing_offset_rad: Vector
    """(steps,) sum of the estimates."""
    final_errors_m: Vector
    """(runs,)"""

    @property
    def rmse_m(self) -> Vector:
        """(steps,) of the position."""
        return np.asarray(np.sqrt(self.squared_m2 / self.runs))

    @property
    def rmse_bound_m(self) -> Vector:
        """(steps,) what no estimator can beat on these tracks."""
        return np.asarray(np.sqrt(self.bound_m2 / self.runs))

    @property
    def mean_nees(self) -> Vector:
        """(steps,) of the position."""
        return np.asarray(self.nees / self.runs)

    @property
    def coverage(self) -> Vector:
        """(steps,) share of runs whose R95 circle contained the target."""
        return np.asarray(self.inside / self.runs)

    def joined(self, later: RunTally) -> RunTally:
        """With the runs that follow these."""
        return RunTally(
            self.runs + later.runs,
            self.squared_m2 + later.squared_m2,
            self.bound_m2 + later.bound_m2,
            self.nees + later.nees,
            self.inside + later.inside,
            self.range_offset_m + later.range_offset_m,
            self.bearing_offset_rad + later.bearing_offset_rad,
            np.concatenate([self.final_errors_m, later.final_errors_m]),
        )

    def packed(self) -> bytes:
        """All of it in bytes, as `unpacked` reads them."""
        parts = [getattr(self, name) for name in RunTally.__slots__[1:]]
        head = [float(self.runs), float(self.squared_m2.size)]
        return np.concatenate([head, *parts]).astype("<f8").tobytes()


def unpacked(packed: bytes) -> RunTally:
    """The tally in bytes of `RunTally.packed`."""
    numbers = np.frombuffer(packed, dtype="<f8").astype(np.float64)
    runs, steps = int(numbers[0]), int(numbers[1])
    sums, final_errors_m = numbers[2 : 2 + 6 * steps], numbers[2 + 6 * steps :]
    squared_m2, bound_m2, nees, inside, range_offset_m, bearing_offset_rad = np.split(sums, 6)
    return RunTally(
        runs,
        squared_m2,
        bound_m2,
        nees,
        inside,
        range_offset_m,
        bearing_offset_rad,
        final_errors_m,
    )


def joined_in_order(tallies: Iterable[RunTally]) -> RunTally:
    """All runs of tallies whose blocks follow each other."""
    return reduce(RunTally.joined, tallies)


def tally_of(block: Block) -> RunTally:
    """Do the runs of a block."""
    campaign = block.campaign
    seeds = run_seeds(campaign.seed, block.runs, block.first)
    trials = run_block(campaign.case, campaign.system, seeds)
    errors = np.array([trial.errors_m for trial in trials])
    inside = [trial.errors_m <= trial.r95_m for trial in trials]
    return RunTally(
        runs=len(trials),
        squared_m2=np.sum(errors**2, axis=0),
        bound_m2=np.sum(bounds_m2(campaign.case, trials), axis=0),
        nees=np.sum([trial.nees for trial in trials], axis=0),
        inside=np.sum(inside, axis=0, dtype=np.float64),
        range_offset_m=np.sum([trial.range_offsets_m for trial in trials], axis=0),
        bearing_offset_rad=np.sum([trial.bearing_offsets_rad for trial in trials], axis=0),
        final_errors_m=errors[:, -1],
    )
