"""Notices when a confident estimate cannot explain what is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.estimation.base import Inflation, ModalityReport, UpdateReport
from companion.estimation.gate import OPEN, Gate

CONTRADICTION_COUNT = 40
"""How many measurements in a row must contradict the estimate before it is given up."""
CONTRADICTION_U = 3.0
"""Whitened innovation that contradicts: a bearing off to the same side, a range too short."""

BEHIND = 3.0
"""A bearing that is off to neither side (+-1), but points the other way."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How many measurements in a row contradicted in the same way.

    Ranges and bearings are counted apart, because they may come one by one.
    """

    bearings: int = 0
    side: float = 0.0
    """Where those bearings are off to: +-1 or `BEHIND`."""
    ranges: int = 0
    """Ranges that are too short; too long ones say nothing, because that is what reflections do."""
    refused_ranges: int = 0
    """Ranges that did not pass the gate: a run of them is no run of outliers."""
    refused_bearings: int = 0

    @property
    def is_conclusive(self) -> bool:
        """Whether the estimate should be given up."""
        counts = (self.bearings, self.ranges, self.refused_ranges, self.refused_bearings)
        return max(counts) >= CONTRADICTION_COUNT

    def after(self, report: UpdateReport, inflation: Inflation, gate: Gate = OPEN) -> Contradiction:
        """The counts after one more update.

        Args:
            report: Of the update with all that was measured.
            inflation: In force at the update.
            gate: What of it was fused.
        """
        bearings, side, ranges = self.bearings, self.side, self.ranges
        refused_ranges, refused_bearings = self.refused_ranges, self.refused_bearings
        if report.bearing is not None:
            side = _side(report.bearing, inflation[1])
            bearings = 0 if side == 0.0 else (bearings + 1 if side == self.side else 1)
            refused_bearings = 0 if gate.passes_bearing else refused_bearings + 1
        if report.range is not None:
            is_too_short = _whitened(report.range, inflation[0]) < -CONTRADICTION_U
            ranges = ranges + 1 if is_too_short else 0
            refused_ranges = 0 if gate.passes_range else refused_ranges + 1
        return Contradiction(bearings, side, ranges, refused_ranges, refused_bearings)


def _side(report: ModalityReport, inflation: float) -> float:
    u = _whitened(report, inflation)
    if abs(u) <= CONTRADICTION_U:
        return 0.0
    is_behind = abs(report.innovation) > 0.5 * math.pi
    return BEHIND if is_behind else math.copysign(1.0, u)


def _whitened(report: ModalityReport, inflation: float) -> float:
    """The innovation in standard deviations; 0 where the state's own uncertainty dominates."""
    if report.prior_share >= 1.0:
        return 0.0
    return report.whitened_innovation / math.sqrt(inflation)
