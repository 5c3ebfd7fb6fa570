"""What figures show as plain numbers, the gradients of the FIM planner included.

What figures show, as plain numbers: taken from tallies, or flown with one seed.

How much the candidates of the FIM planner differ along a flight: why it stalls in a shadow.

Whatever flies, FIM's criterion is taken of its candidates and of staying before every step, in two
forms: with the information in the filter at that moment and the offsets as nuisance, as
`companion.planning.fim` has it, and as the paper prints it (`walk`). Its *gradient* is how
far the best is ahead of the worst, as a share of the best. Where it is flat, every candidate
promises the same. Paper: section "Robustness in Structured NLOS Environments" claims that it is
flat in the shadow; here it is measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.domain import TargetEstimate
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector
from companion.planning.fim import candidate_ring_m, worst_variance_m2
from sim_link.lab.evaluation.campaign import run_trial, start_of
from sim_link.lab.evaluation.case import (
    TRUTH,
    Case,
    RunSeed,
    channel_draws,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)
from sim_link.lab.evaluation.study import CellResult, ResultRow, StudyResult
from sim_link.lab.evaluation.systems import FixedPilot, System, estimator_of, flown
from sim_link.lab.evaluation.walk import information_gradient, printed_criteria
from sim_link.world.line_of_sight import is_blocked

FAR_M = 1e4
"""How far a shadow is drawn; any picture ends before that."""

COMPARED: tuple[System, ...] = (
    System("admm", "passive"),
    System("huber", "passive"),
    System("asymmetric_huber", "passive"),
    System("huber", "fim"),
    System("asymmetric_huber", "fim"),
    System("asymmetric_huber", "fim_printed"),
    System("asymmetric_huber", "reactive"),
    System("asymmetric_huber", "latched"),
    System("map", "latched"),
)
"""The systems of the paper's figures, and ours."""
BOUNDED: tuple[System, ...] = (System("asymmetric_huber", "passive"), System("map", "latched"))
"""Whose Cramer-Rao bound is drawn beside them."""
FLOWN: tuple[System, ...] = (
    System("asymmetric_huber", "passive"),
    System("asymmetric_huber", "reactive"),
    System("map", "latched"),
    System("asymmetric_huber", "fim"),
)
"""Whose tracks are drawn, and in the shadow of obstacles also those of FIM as printed."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One quantity of a system after every step."""

    system: System
    values: Vector
    """(steps,)"""
    is_bound: bool = False


@dataclass(frozen=True, slots=True)
class FlownTrack:
    """One run of a system, as it is drawn."""

    system: System
    track_enu_m: Matrix
    """(steps, 2)"""
    estimates_enu_m: Matrix
    """(steps, 2)"""
    final_error_m: float


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How a system's final RMSE follows a parameter."""

    system: System
    values: Vector
    """(k,) of the parameter."""
    ours_m: Vector
    """(k,)"""
    low_m: Vector
    """(k,) 95 % interval."""
    high_m: Vector
    """(k,)"""
    paper_m: Vector
    """(k,) NaN where the paper prints none."""
    bound_m: Vector
    """(k,)"""


def values_of(result: StudyResult) -> list[tuple[str, str]]:
    """Parameter and value of every case of a study, in its order."""
    return list(dict.fromkeys((cell.parameter, cell.value) for cell in result.cells))


def cells_at(result: StudyResult, parameter: str, value: str) -> dict[System, CellResult]:
    """The systems flown at one value, each once."""
    return {
        cell.system: cell
        for cell in reversed(result.cells)
        if (cell.parameter, cell.value) == (parameter, value)
    }


def rmse_curves(cells: dict[System, CellResult]) -> list[Curve]:
    """RMSE of the compared systems after every step, metres, and the bounds on two of them."""
    curves = [Curve(s, cells[s].tally.rmse_m) for s in COMPARED if s in cells]
    bounds = [Curve(s, cells[s].tally.rmse_bound_m, True) for s in BOUNDED if s in cells]
    return curves + bounds


def offset_curves(cells: dict[System, CellResult], *, bearing: bool) -> list[Curve]:
    """Mean estimates of an offset after every step, metres or degrees."""
    curves: list[Curve] = []
    for system in COMPARED:
        if system in cells:
            tally = cells[system].tally
            sums = np.degrees(tally.bearing_offset_rad) if bearing else tally.range_offset_m
            curves.append(Curve(system, np.asarray(sums / tally.runs)))
    return curves


def flights_of(case: Case, seed: int, systems: Sequence[System] = FLOWN) -> list[FlownTrack]:
    """The first run of a study's seed, by each system."""
    flights: list[FlownTrack] = []
    extra = (System("asymmetric_huber", "fim_printed"),) if case.obstacles else ()
    for system in (*systems, *extra):
        trial = run_trial(case, system, run_seeds(seed, 1)[0])
        error_m = float(trial.errors_m[-1])
        flights.append(FlownTrack(system, trial.track_enu_m, trial.estimates_enu_m, error_m))
    return flights


def shadow_quads(corners: Sequence[Point], target_enu_m: Point) -> list[list[Point]]:
    """Polygons that together are the shadow of an obstacle, as cast by a target outside of it."""
    return [
        [a, b, _beyond(b, target_enu_m), _beyond(a, target_enu_m)]
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]


def sensitivities(
    result: StudyResult, rows: Sequence[ResultRow], parameter: str
) -> list[Sensitivity]:
    """Every system of a sweep that the paper prints, and ours, over a parameter of numbers."""
    found: list[Sensitivity] = []
    values = [value for name, value in values_of(result) if name == parameter]
    table = next(cell.table for cell in result.cells if cell.parameter == parameter)
    mine = {
        (row.system, row.value): row
        for row in rows
        if (row.table, row.parameter, row.metric) == (table, parameter, "final_rmse_m")
    }
    for system in dict.fromkeys(cell.system for cell in result.cells):
        own = [mine.get((system.label, value)) for value in values]
        kept = [row for row in own if row is not None]
        is_printed = any(row.paper for row in kept)
        if len(kept) == len(values) and (is_printed or system == System("map", "latched")):
            found.append(_sensitivity(system, values, kept))
    return found


def numbers(text: str) -> float:
    """A number of the results, NaN where there is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def interval(text: str) -> tuple[float, float]:
    """The ends of an interval of the results, NaN where there is none."""
    low, _, high = text.partition("..")
    return numbers(low), numbers(high)


def _sensitivity(system: System, values: list[str], rows: list[ResultRow]) -> Sensitivity:
    ends = np.array([interval(row.ours_ci95) for row in rows])
    return Sensitivity(
        system,
        np.array([numbers(value) for value in values]),
        np.array([numbers(row.ours) for row in rows]),
        ends[:, 0],
        ends[:, 1],
        np.array([numbers(row.paper) for row in rows]),
        np.array([numbers(row.bound) for row in rows]),
    )


def _beyond(corner: Point, target_enu_m: Point) -> Point:
    (ce, cn), (te, tn) = corner, target_enu_m
    scale = FAR_M / max(np.hypot(ce - te, cn - tn), 1e-6)
    return (float(ce + scale * (ce - te)), float(cn + scale * (cn - tn)))


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
class GradientWatch:
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
) -> list[GradientWatch]:
    """The first runs of a study's seed, watched."""
    short = msgspec.structs.replace(case, steps=min(steps, case.steps))
    return [_watch(short, system, run_seeds(seed, runs)) for system in WATCHED]


def _watch(case: Case, system: System, seeds: list[np.random.SeedSequence]) -> GradientWatch:
    edges = scene_of(case).surroundings.edges
    places = [run_trial(case, system, seed).track_enu_m for seed in seeds]
    pairs = [_gradients(case, system, s, track) for s, track in zip(seeds, places, strict=True)]
    before = np.array(places)[:, :-1]
    target = np.array(case.target_enu_m)
    shadows = [
        [float(is_blocked(*case.target_enu_m, e, n, edges)) for e, n in track.tolist()]
        for track in before
    ]
    return GradientWatch(
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
