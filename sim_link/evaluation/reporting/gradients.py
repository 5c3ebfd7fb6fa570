"""How much the candidates of the FIM planner differ along a flight: why it stalls in a shadow.

Whatever flies, FIM's criterion is taken of its candidates and of staying before every step, in two
forms: with the information in the filter at that moment and the offsets as nuisance, as
`companion.planning.fim` has it, and as the paper prints it (`printed_fim`). Its *gradient* is how
far the best is ahead of the worst, as a share of the best. Where it is flat, every candidate
promises the same. Paper: section "Robustness in Structured NLOS Environments" claims that it is
flat in the shadow; here it is measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.domain import Point, TargetEstimate
from companion.kernel import Matrix, Vector
from companion.planning.fim import candidate_ring_m, worst_variance_m2
from sim_link.evaluation.case import Case
from sim_link.evaluation.noise import (
    TRUTH,
    RunSeed,
    channel_draws,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)
from sim_link.evaluation.objects import FixedPilot, flown
from sim_link.evaluation.printed_fim import information_gradient, printed_criteria
from sim_link.evaluation.systems import System, estimator_of
from sim_link.evaluation.trial import run_trial, start_of
from sim_link.world.line_of_sight import is_blocked

WATCHED: tuple[System, ...] = (
    System("asymmetric_huber", "fim"),
    System("asymmetric_huber", "fim_printed"),
    System("asymmetric_huber", "reactive"),
    System("asymmetric_huber", "latched"),
)
WATCHED_RUNS = 15
WATCHED_STEPS = 60
"""By then whoever left the shadow is at the target."""


@dataclass(frozen=True, slots=True)
class Watch:
    """What was seen of several runs of one system, before every step but the first."""

    system: System
    gradient: Matrix
    """(runs, steps - 1) with what the filter knows."""
    printed_gradient: Matrix
    """(runs, steps - 1) of the printed criterion."""
    is_shadowed: Matrix
    """(runs, steps - 1) 1 where the path to the target is blocked."""
    distance_m: Matrix
    """(runs, steps - 1) from the vehicle to the target."""

    @property
    def steps_in_shadow(self) -> Vector:
        """(runs,) how many measurements were made there."""
        return np.asarray(self.is_shadowed.sum(axis=1))


class WatchingPilot:
    """Flies a given track, and takes down what FIM's candidates promise along it.

    Args:
        track_enu_m: (steps, 2).
        case: The cell.
    """

    def __init__(self, track_enu_m: Matrix, case: Case) -> None:
        self.gradients: list[tuple[float, float]] = []
        """With what the filter knows, and as printed."""
        self._pilot = FixedPilot(track_enu_m)
        self._ring_m = np.array(candidate_ring_m(case.step_m, case.fim_headings))
        self._sigmas = (case.belief.range_sigma_m, math.radians(case.belief.bearing_sigma_deg))

    def next_place(
        self, step: int, place_enu_m: Point, estimate: TargetEstimate | None, joint: Matrix
    ) -> Point:
        """The next place of the track."""
        assert estimate is not None  # there is one after the first measurement
        target = estimate.position_enu_m
        way_m = (target[0] - place_enu_m[0], target[1] - place_enu_m[1])
        filtered = self._criteria(joint, *way_m)
        printed = printed_criteria(*way_m, self._ring_m, *self._sigmas)
        self.gradients.append((information_gradient(filtered), information_gradient(printed)))
        return self._pilot.next_place(step, place_enu_m, estimate, joint)

    def _criteria(self, covariance: Matrix, de_m: float, dn_m: float) -> Vector:
        """Smallest eigenvalue of the marginal information, (k + 1,), 1/m^2; last: staying."""
        range_sigma_m, bearing_sigma_rad = self._sigmas
        noise = (range_sigma_m**2, bearing_sigma_rad**2)
        moves = [*self._ring_m.tolist(), (0.0, 0.0)]
        variances = [
            worst_variance_m2(covariance, de_m - east, dn_m - north, 0.0, *noise, True)
            for east, north in moves
        ]
        return 1.0 / np.array(variances)


def watched(
    case: Case, seed: int, runs: int = WATCHED_RUNS, steps: int = WATCHED_STEPS
) -> list[Watch]:
    """The first runs of a study's seed, watched.

    Args:
        case: The cell.
        seed: Of the study.
        runs: How many.
        steps: Of each run.
    """
    short = msgspec.structs.replace(case, steps=min(steps, case.steps))
    return [_watch(short, system, run_seeds(seed, runs)) for system in WATCHED]


def _watch(case: Case, system: System, seeds: list[np.random.SeedSequence]) -> Watch:
    edges = scene_of(case).surroundings.edges
    places = [run_trial(case, system, seed).track_enu_m for seed in seeds]
    pairs = [_gradients(case, system, s, track) for s, track in zip(seeds, places, strict=True)]
    before = np.array(places)[:, :-1]
    target = np.array(case.target_enu_m)
    shadows = [
        [float(is_blocked(*case.target_enu_m, e, n, edges)) for e, n in track.tolist()]
        for track in before
    ]
    return Watch(
        system,
        np.array(pairs)[:, :, 0],
        np.array(pairs)[:, :, 1],
        np.array(shadows),
        np.hypot(*np.moveaxis(before - target, -1, 0)),
    )


def _gradients(
    case: Case, system: System, seed: RunSeed, track_enu_m: Matrix
) -> list[tuple[float, float]]:
    """What the candidates promised along a run's track, before its steps."""
    rng = stream(seed, TRUTH)
    truth = truth_of(case, rng)
    filtered = System(system.filter, "passive")
    estimator = estimator_of(case, filtered, start_of(case, rng))
    pilot = WatchingPilot(track_enu_m, case)
    draws = channel_draws(case, seed)
    flown(draws, case.start_enu_m, truth, scene_of(case), estimator, pilot)
    return pilot.gradients
