"""Data of the figures: taken from tallies, or flown with one seed.

To show why FIM stalls in a shadow, its criterion is evaluated before every step at its candidates
and at staying, with the information in the filter (`companion.planning.fim`) and as the paper
prints it (`walk`). Its *gradient* is the lead of the best over the worst, as a share of the best.
Paper: section "Robustness in Structured NLOS Environments" claims that it is flat there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector
from companion.planning.fim import (
    ALL_AROUND,
    candidate_poses_m,
    candidate_ring_m,
    model_of,
    worst_variances_m2,
)
from sim_link.world.environment import NO_MEMORY
from sim_link.world.line_of_sight import is_blocked
from tools.study.case import Case, RunSeed, measured_in, run_inputs, run_seeds, scene_of
from tools.study.study import CellResult, ResultRow, StudyResult
from tools.study.systems import System, belief_of
from tools.study.trials import TrialResult, run_trial
from tools.study.walk import first_fix, information_gradient, printed_criteria, updated

FAR_M = 1e4
"""Length of a drawn shadow in m, beyond the edge of any picture."""

PASSIVE, REACTIVE = System("asymmetric_huber", "passive"), System("asymmetric_huber", "reactive")
FIM, FIM_PRINTED = System("asymmetric_huber", "fim"), System("asymmetric_huber", "fim_printed")
CROSSING, BEST = System("asymmetric_huber", "latched"), System("map", "latched")

COMPARED = (
    *(System("admm", "passive"), System("huber", "passive"), PASSIVE, System("huber", "fim")),
    *(FIM, FIM_PRINTED, REACTIVE, CROSSING, BEST),
)
"""Systems compared in the figures: the paper's, then ours."""
BOUNDED = (PASSIVE, BEST)
"""Systems whose Cramer-Rao bound is drawn."""
FLOWN = (PASSIVE, REACTIVE, BEST, FIM)
"""Systems whose tracks are drawn; in the shadow of obstacles also those of FIM as printed."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One quantity of a system after every step."""

    system: System
    values: Vector
    """Value after every step, (steps,)."""
    is_bound: bool = False


Flight = tuple[System, TrialResult]


Sensitivity = tuple[System, Matrix]
"""Final RMSE of a system over a parameter, (6, k): the values, ours, the paper's (NaN where it
prints none), the bound, and the low and high ends of our interval."""


def values_of(result: StudyResult) -> list[tuple[str, str]]:
    """Return parameter and value of every case of a study, in its order."""
    return list(dict.fromkeys((cell.parameter, cell.value) for cell in result.cells))


def cells_at(result: StudyResult, parameter: str, value: str) -> dict[System, CellResult]:
    """Return the systems flown at one value, each once."""
    return {
        cell.system: cell
        for cell in reversed(result.cells)
        if (cell.parameter, cell.value) == (parameter, value)
    }


def rmse_curves(cells: dict[System, CellResult]) -> list[Curve]:
    """Return the RMSE of the compared systems after every step, metres, and two bounds."""
    curves = [Curve(s, cells[s].tally.rmse_m) for s in COMPARED if s in cells]
    bounds = [Curve(s, cells[s].tally.rmse_bound_m, True) for s in BOUNDED if s in cells]
    return curves + bounds


def offset_curves(cells: dict[System, CellResult], *, bearing: bool) -> list[Curve]:
    """Return mean estimates of an offset after every step, metres or degrees."""
    curves: list[Curve] = []
    for system in COMPARED:
        if system in cells:
            tally = cells[system].tally
            sums = np.degrees(tally.bearing_offset_rad) if bearing else tally.range_offset_m
            curves.append(Curve(system, np.asarray(sums / tally.runs)))
    return curves


def flights_of(case: Case, seed: int) -> list[Flight]:
    """Return the first run of a study's seed, by each system."""
    extra = (FIM_PRINTED,) if case.obstacles else ()
    first = run_seeds(seed, 1)[0]
    return [(system, run_trial(case, system, first)) for system in (*FLOWN, *extra)]


def shadow_quads(corners: Sequence[Point], target_enu_m: Point) -> list[list[Point]]:
    """Return polygons that together are an obstacle's shadow, cast by a target outside of it."""
    target = np.array(target_enu_m)

    def beyond(corner: Point) -> Point:
        """Return the point far behind a corner, as seen from the target."""
        away = np.subtract(corner, target)
        east_m, north_m = corner + FAR_M / max(np.hypot(*away), 1e-6) * away
        return float(east_m), float(north_m)

    edges = zip(corners, [*corners[1:], corners[0]], strict=True)
    return [[a, b, beyond(b), beyond(a)] for a, b in edges]


def sensitivities(
    result: StudyResult, rows: Sequence[ResultRow], parameter: str
) -> list[Sensitivity]:
    """Return the paper's systems, and the companion's, over a numeric parameter."""
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
        if len(kept) == len(values) and (is_printed or system == BEST):
            columns = [
                (*map(numbers, (value, row.ours, row.paper, row.bound)), *interval(row.ours_ci95))
                for value, row in zip(values, kept, strict=True)
            ]
            found.append((system, np.array(columns).T))
    return found


def numbers(text: str) -> float:
    """Return a number of the results, NaN if missing."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def interval(text: str) -> tuple[float, float]:
    """Return the ends of an interval of the results, NaN if missing."""
    low, _, high = text.partition("..")
    return numbers(low), numbers(high)


WATCHED = (FIM, FIM_PRINTED, REACTIVE, CROSSING)
WATCHED_RUNS = 15
WATCHED_STEPS = 60
"""Steps after which a vehicle that left the shadow is at the target."""


@dataclass(frozen=True, slots=True)
class GradientWatch:
    """FIM criterion of one system before every step of several runs, (runs, steps - 1) each."""

    system: System
    gradient: Matrix
    """Gradient with the filter's information."""
    printed_gradient: Matrix
    is_shadowed: Matrix
    """1 where the path to the target is blocked."""
    distance_m: Matrix


def watched(
    case: Case, seed: int, runs: int = WATCHED_RUNS, steps: int = WATCHED_STEPS
) -> list[GradientWatch]:
    """Return the first runs of a study's seed, watched."""
    short = msgspec.structs.replace(case, steps=min(steps, case.steps))
    return [_watch(short, system, run_seeds(seed, runs)) for system in WATCHED]


def _watch(case: Case, system: System, seeds: Sequence[RunSeed]) -> GradientWatch:
    edges = scene_of(case).surroundings.edges
    tracks = [run_trial(case, system, seed).track_enu_m for seed in seeds]
    gradients = np.array(
        [_gradients(case, system, seed, track) for seed, track in zip(seeds, tracks, strict=True)]
    )
    before = np.array(tracks)[:, :-1]
    shadows = [
        [float(is_blocked(*case.target_enu_m, e, n, edges)) for e, n in track.tolist()]
        for track in before
    ]
    away_m = np.hypot(*np.moveaxis(before - np.array(case.target_enu_m), -1, 0))
    return GradientWatch(system, gradients[:, :, 0], gradients[:, :, 1], np.array(shadows), away_m)


def _gradients(
    case: Case, system: System, seed: RunSeed, track_enu_m: Matrix
) -> list[tuple[float, float]]:
    """Return the information gradients along a run's track, with the filter and as printed."""
    draws, truth, start = run_inputs(case, seed)
    scene, belief, memory = scene_of(case), belief_of(case, system), NO_MEMORY
    ring_m = np.array(candidate_ring_m(case.step_m, case.fim_headings))
    poses_m = candidate_poses_m(case.step_m, case.fim_headings)
    sigma, model = np.array([*belief.sigma[:2], math.inf]), model_of(None, near_target_terms=True)
    found: list[tuple[float, float]] = []
    mean, joint = first_fix(0.0, 0.0, 1.0, 0.0, belief)
    mean[:2] = start
    for step, (east_m, north_m) in enumerate(track_enu_m[:-1].tolist()):
        r_m, b_rad, memory = measured_in(draws[step], east_m, north_m, truth, scene, memory)
        if math.isnan(mean[0]):
            mean, joint = first_fix(east_m, north_m, r_m, b_rad, belief)
        else:
            sensor, z = np.array([east_m, north_m, 0.0]), np.array([r_m, b_rad, math.nan])
            mean, joint = updated(mean, joint, sensor, z, belief)
        away = np.array([mean[0] - east_m, mean[1] - north_m, 0.0, 0.0])
        filtered = 1.0 / worst_variances_m2(joint, away, poses_m, sigma, ALL_AROUND, model)
        printed = printed_criteria(away[0], away[1], ring_m, sigma[0], sigma[1])
        found.append((information_gradient(filtered), information_gradient(printed)))
    return found
