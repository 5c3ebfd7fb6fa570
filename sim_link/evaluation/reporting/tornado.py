"""How far each assumption moves the result: one row for each, one bar for each system."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sim_link.evaluation.results import CellResult, StudyResult
from sim_link.evaluation.systems import System

TABLE = "assumptions"
LEAST_SPAN = 2.0
MOST_SPAN = 10.0
"""Factors at the ends of the bars' axis; beyond it a bar is cut."""


@dataclass(frozen=True, slots=True)
class Swing:
    """What the values of an assumption make of one system's final RMSE."""

    factors: tuple[tuple[str, float], ...]
    """Value, and final RMSE by that of our choice."""
    left_percent: float
    """Where the bar begins, of the width of the axis."""
    width_percent: float

    @property
    def low(self) -> float:
        """Least factor."""
        return min(factor for _, factor in self.factors)

    @property
    def high(self) -> float:
        """Largest factor."""
        return max(factor for _, factor in self.factors)

    @property
    def is_cut(self) -> bool:
        """Whether the bar goes on beyond the axis."""
        return self.left_percent <= 0.0 or self.left_percent + self.width_percent >= 100.0


@dataclass(frozen=True, slots=True)
class Assumption:
    """One open point, varied alone."""

    parameter: str
    chosen: str
    others: tuple[str, ...]
    swings: tuple[Swing | None, ...]
    """For each system of the tornado; None: not flown."""


@dataclass(frozen=True, slots=True)
class Tornado:
    """All assumptions, those that move most first."""

    systems: tuple[str, ...]
    assumptions: tuple[Assumption, ...]
    span: float
    """Factor at the right end of the axis; its inverse is at the left."""


def tornado_of(results: Iterable[StudyResult]) -> Tornado | None:
    """The tornado of the assumptions study; None if it is not among the results.

    The first value of each sweep is our choice.
    """
    cells = [cell for result in results for cell in result.cells if cell.table == TABLE]
    if not cells:
        return None
    systems = tuple(dict.fromkeys(cell.system for cell in cells))
    by_parameter = {
        parameter: [cell for cell in cells if cell.parameter == parameter]
        for parameter in dict.fromkeys(cell.parameter for cell in cells)
    }
    factors = {
        (parameter, system): _factors(own, system)
        for parameter, own in by_parameter.items()
        for system in systems
    }
    reach = max((abs(math.log(f)) for found in factors.values() for _, f in found), default=0.0)
    span = min(max(math.exp(reach), LEAST_SPAN), MOST_SPAN)
    rows = [
        _assumption(parameter, own, [factors[parameter, system] for system in systems], span)
        for parameter, own in by_parameter.items()
    ]
    rows.sort(key=_reach, reverse=True)
    return Tornado(tuple(system.label for system in systems), tuple(rows), span)


def _factors(cells: Sequence[CellResult], system: System) -> list[tuple[str, float]]:
    """Values and factors of one system, our choice left out."""
    own = [cell for cell in cells if cell.system == system]
    if not own or not float(own[0].tally.rmse_m[-1]) > 0.0:
        return []
    chosen_m = float(own[0].tally.rmse_m[-1])
    found = [(cell.value, float(cell.tally.rmse_m[-1]) / chosen_m) for cell in own[1:]]
    return [(value, factor) for value, factor in found if 0.0 < factor < math.inf]


def _assumption(
    parameter: str,
    cells: Sequence[CellResult],
    factors: Sequence[Sequence[tuple[str, float]]],
    span: float,
) -> Assumption:
    values = list(dict.fromkeys(cell.value for cell in cells))
    swings = tuple(_swing(found, span) if found else None for found in factors)
    return Assumption(parameter.replace("_", " "), values[0], tuple(values[1:]), swings)


def _swing(factors: Sequence[tuple[str, float]], span: float) -> Swing:
    """The bar from the least to the largest factor; our choice, 1, is always in it."""
    low = min(1.0, *(factor for _, factor in factors))
    high = max(1.0, *(factor for _, factor in factors))
    left, right = _share(low, span), _share(high, span)
    return Swing(tuple(factors), 100.0 * left, 100.0 * (right - left))


def _share(factor: float, span: float) -> float:
    """Where a factor is on the axis, logarithmic, from 0 to 1."""
    return min(max(0.5 + 0.5 * math.log(factor) / math.log(span), 0.0), 1.0)


def _reach(row: Assumption) -> float:
    return max(
        (abs(math.log(f)) for swing in row.swings if swing for _, f in swing.factors), default=0.0
    )
