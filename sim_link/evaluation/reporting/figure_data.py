"""What figures show, as plain numbers: taken from tallies, or flown with one seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import Point
from companion.kernel import Matrix, Vector
from sim_link.evaluation.case import Case
from sim_link.evaluation.noise import run_seeds
from sim_link.evaluation.results import CellResult, ResultRow, StudyResult
from sim_link.evaluation.systems import System
from sim_link.evaluation.trial import run_trial

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
class Flight:
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


def flights_of(case: Case, seed: int, systems: Sequence[System] = FLOWN) -> list[Flight]:
    """The first run of a study's seed, by each system."""
    flights: list[Flight] = []
    extra = (System("asymmetric_huber", "fim_printed"),) if case.obstacles else ()
    for system in (*systems, *extra):
        trial = run_trial(case, system, run_seeds(seed, 1)[0])
        error_m = float(trial.errors_m[-1])
        flights.append(Flight(system, trial.track_enu_m, trial.estimates_enu_m, error_m))
    return flights


def shadow_quads(corners: Sequence[Point], target_enu_m: Point) -> list[list[Point]]:
    """Polygons that together are the shadow of an obstacle, as cast by a target outside of it.

    Args:
        corners: Of the obstacle.
        target_enu_m: Where the light is.
    """
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
