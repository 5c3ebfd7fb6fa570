"""Notices an estimate whose innovations are larger than it says, and counts how often it failed.

The contradiction needs forty measurements that all say the same. An estimate may fail more gently,
for instance because the target moves: innovations are merely larger than they should be, until the
measured inflation has grown to hide them. So the NIS of the last seconds is held against its band.
The median is taken, because outliers are the gate's task, and a range that is taken for a
reflection says nothing of the estimate.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from companion.estimation.base import Inflation, ModalityReport, UpdateReport
from companion.estimation.chi_square import mean_band

WINDOW_S = 3.0
WINDOW_COUNT = 30
"""The window holds at least so much time and so many measurements."""
OUT_OF_BAND_S = 3.0
OUT_OF_BAND_COUNT = 10
"""The NIS must be above its band for at least so long and so many measurements in a row."""
NEWEST_COUNT = 5
"""So many of the newest say whether it still is."""
RESTART_MEMORY_S = 60.0
MAX_RESTARTS = 2
"""An estimate that was started anew this often within that time is not flown on."""


class NisWindow:
    """The normalised innovations squared of the last seconds, per degree of freedom."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float, int]] = deque()
        self._dof = 0
        """Degrees of freedom of all of them."""
        self._above_since_s: float | None = None
        self._above_count = 0

    def clear(self) -> None:
        """Forget everything, because the estimate is another one."""
        self._values.clear()
        self._dof = 0
        self._above_since_s = None
        self._above_count = 0

    def add(self, report: UpdateReport, inflation: Inflation, time_s: float) -> bool:
        """Take in an update; whether the NIS has been above its band for too long.

        Args:
            report: Of the update.
            inflation: Variance inflation of range, bearing and elevation that the run has shown,
                whether or not the filter was told.
            time_s: When it was measured.
        """
        shares = [_normalised2(row, c) for row, c in _telling(report, inflation)]
        if not shares:
            return False
        self._values.append((time_s, statistics.fmean(shares), len(shares)))
        self._dof += len(shares)
        while len(self._values) > WINDOW_COUNT and self._values[0][0] < time_s - WINDOW_S:
            self._dof -= self._values.popleft()[2]
        band = self._band()
        if self._median(len(self._values)) <= band:
            self._above_since_s = None
            self._above_count = 0
            return False
        if self._above_since_s is None:
            self._above_since_s = time_s
        self._above_count += 1
        has_lasted = time_s - self._above_since_s >= OUT_OF_BAND_S
        is_over = self._median(NEWEST_COUNT) <= band  # the window is slow to see that
        return has_lasted and self._above_count >= OUT_OF_BAND_COUNT and not is_over

    def _median(self, newest: int) -> float:
        values = [value for _, value, _ in self._values]
        return statistics.median(values[-newest:])

    def _band(self) -> float:
        """What the mean of consistent values stays below; infinite while there are too few."""
        count = len(self._values)
        if count < WINDOW_COUNT:
            return math.inf
        dof = self._dof / count
        return mean_band(dof, count)[1] / dof


def _telling(report: UpdateReport, inflation: Inflation) -> list[tuple[ModalityReport, float]]:
    """What was measured, each with its inflation, without a range taken for a reflection."""
    rows = [
        (row, c) for row, c in zip(report.modalities, inflation, strict=True) if row is not None
    ]
    if report.range is not None and report.range.weight < 1.0 and report.range.innovation > 0.0:
        rows.pop(0)
    return rows


def _normalised2(row: ModalityReport, inflation: float) -> float:
    """The innovation squared over its variance under that inflation."""
    return row.whitened_innovation**2 / (inflation / row.weight + row.prior_share)


class RestartCounter:
    """How often the estimate was started anew lately."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=MAX_RESTARTS)

    def add(self, time_s: float) -> None:
        """Count a restart."""
        self._times_s.append(time_s)

    def is_too_many(self, now_s: float) -> bool:
        """Whether there were `MAX_RESTARTS` within `RESTART_MEMORY_S`."""
        return len(self._times_s) == MAX_RESTARTS and now_s - self._times_s[0] <= RESTART_MEMORY_S
