"""What comes out of a study: a tally for every cell, and the rows of its tables."""

from __future__ import annotations

from dataclasses import dataclass

from sim_link.evaluation.campaign import Tally
from sim_link.evaluation.case import Case
from sim_link.evaluation.study import Study
from sim_link.evaluation.systems import System


@dataclass(frozen=True, slots=True)
class CellResult:
    """One system in one case, and what its runs came to."""

    table: str
    parameter: str
    value: str
    """As tables have it, for example 0.5."""
    case: Case
    system: System
    tally: Tally


@dataclass(frozen=True, slots=True)
class StudyResult:
    """The cells of a study, in the order of its tables."""

    study: Study
    runs: int
    """Of every cell."""
    seed: int
    cells: tuple[CellResult, ...]

    def find(self, value: str, label: str, parameter: str | None = None) -> CellResult | None:
        """The first cell of that value and system.

        Args:
            value: As tables have it.
            label: Of the system, as tables have it.
            parameter: Of the sweep; None: of any.
        """
        for cell in self.cells:
            is_here = cell.value == value and cell.system.label == label
            if is_here and parameter in (None, cell.parameter):
                return cell
        return None


@dataclass(frozen=True, slots=True)
class ResultRow:
    """One row of results.csv, as it is written there; empty where there is nothing to say."""

    table: str
    parameter: str
    value: str
    system: str
    metric: str
    paper: str
    """What the paper prints."""
    ours: str
    ours_ci95: str
    """The 95 % interval, for example 0.012..0.019."""
    bound: str
    """What no estimator can beat, of the same metric; for NEES and coverage what an honest one
    stays within."""
