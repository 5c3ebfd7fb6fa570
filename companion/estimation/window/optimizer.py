"""Checks and corrects the hypotheses by solving a window of measurements now and then.

Every optimum replaces the hypotheses near it, because it holds all that they have seen, and is not
linearised where they stood at the time. A prior of older evidence that the window contradicts was
expanded about a wrong place, and is forgotten.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.estimation.belief import as_evidence
from companion.estimation.filters.target_filter import FilterParams, FilterState, Inflation
from companion.estimation.hypotheses import Hypothesis, shift_rows
from companion.estimation.integrity.track_integrity import CONTRADICTION_COUNT
from companion.estimation.measurement_model import AZIMUTH, BEARING, RANGE
from companion.estimation.stepwise import Steps, Stepwise
from companion.estimation.window.antenna_check import rows_as
from companion.estimation.window.map_kernels import (
    ARRAY_COLUMNS,
    COLUMNS,
    SEQUENCE,
    SIGMAS,
    VALUES,
    Row,
    row_vector,
)
from companion.estimation.window.older_evidence import OlderEvidence
from companion.estimation.window.sandwich import (
    ALL_WHITE,
    Observability,
    Optimum,
    mirrored,
    observability_of,
    weigh_optima,
)
from companion.estimation.window.shared_errors import (
    NO_ERRORS,
    SharedErrors,
    SharedSigmas,
    shared_errors,
)
from companion.estimation.window.window_map import (
    MAX_POSITION_SIGMA_M,
    MIN_MEASUREMENTS,
    Minima,
    WindowMap,
    WindowParams,
)
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector

SECTORS = 16
"""Directions that the target is seen from, for thinning."""
NEAREST_RING_M = 1.0
"""Views from closer than this are in the innermost ring; each further ring is twice as far."""
KEPT_SHARE = 0.95
"""What a full window is thinned to."""


class MeasurementWindow:
    """Up to `size` measurements, spread over views of the target, in the rows of `map_kernels`."""

    def __init__(self, size: int, columns: int = COLUMNS) -> None:
        self.rows: Matrix = np.empty((0, columns))
        """The measurements, (n, `columns`), oldest first."""
        self._size = size
        self._times_s: list[float] = []
        """Of all that was taken in, by sequence number; NaN: not told."""

    @property
    def has_bearings(self) -> bool:
        """Whether any measurement held is a bearing."""
        return not bool(np.isnan(self.rows[:, VALUES + BEARING]).all())

    @property
    def times_s(self) -> Vector:
        """When each of them was measured, (n,); what nobody told is the latest."""
        times_s = np.array(self._times_s)[self.rows[:, SEQUENCE].astype(int)]
        known = times_s[~np.isnan(times_s)]
        latest_s = float(known.max()) if known.size else 0.0
        return np.asarray(np.nan_to_num(times_s, nan=latest_s), dtype=np.float64)

    def add(self, row: Row, target_enu_m: Point, time_s: float = math.nan) -> Matrix:
        """Take in a measurement; what a full window, thinned first, lets go, (m, 10), or none."""
        dropped = self.rows[:0]
        if len(self.rows) == self._size:
            is_kept = kept_by_thinning(self.rows, int(KEPT_SHARE * self._size), target_enu_m)
            dropped, self.rows = self.rows[~is_kept], self.rows[is_kept]
        self.rows = np.concatenate([self.rows, row_vector(row, len(self._times_s))[None]])
        self._times_s.append(time_s)
        return dropped


def kept_by_thinning(rows: Matrix, target: int, centre: Point) -> NDArray[np.bool_]:
    """Which rows stay, (n,), at most `target`: fewer where sector and distance are alike."""
    east, north = rows[:, 0] - centre[0], rows[:, 1] - centre[1]
    sector = np.floor((np.arctan2(north, east) / (2.0 * math.pi) + 0.5) * SECTORS) % SECTORS
    ring = np.floor(np.log2(np.maximum(np.hypot(east, north) / NEAREST_RING_M, 1.0)))
    _, view, counts = np.unique(ring * SECTORS + sector, return_inverse=True, return_counts=True)
    cap = int(counts.max())
    while cap > 1 and int(np.minimum(counts, cap).sum()) > target:
        cap -= 1
    keep = np.zeros(len(rows), dtype=bool)
    for index in range(len(counts)):
        members = np.flatnonzero(view == index)
        keep[members[_evenly_in_time(rows[members, SEQUENCE], cap)]] = True
    kept = np.flatnonzero(keep)
    if len(kept) > target:  # more views than may be kept: every one loses alike
        keep[:] = False
        keep[kept[np.linspace(0, len(kept) - 1, target).astype(int)]] = True
    return keep


def _evenly_in_time(sequence: Vector, count: int) -> NDArray[np.intp]:
    """At most `count` members, evenly over their time: those with near neighbours go first."""
    kept = np.arange(len(sequence))
    while len(kept) > max(count, 2):
        gaps = sequence[kept[2:]] - sequence[kept[:-2]]
        kept = np.delete(kept, 1 + int(np.argmin(gaps)))
    return kept[:count]


MAX_STARTS_KEPT = 4
"""Hypotheses that start a solution of the window each time."""
UNSETTLED_STARTS, SETTLED_STARTS = 4, 1
"""Fresh starts per solution, before and after there is one hypothesis and much evidence."""
SETTLED_COUNT = 300
EARLY_SHARE = 0.1
"""Early on the window is solved whenever it has grown by this share."""
VAGUE_COVARIANCE_M2 = MAX_POSITION_SIGMA_M**2 * np.eye(2)
"""What is believed of a hypothesis while the window finds no place at all."""
SHARED_PASSES = 8
"""Over the measurements, measured, for what errors that all of them share make of the place."""
CONTRADICTING_SHARE = 0.5
"""Of a full window, before it may contradict older evidence."""
CONTRADICTED_DISTANCE2 = 16.0
"""Mahalanobis, squared, between solutions with and without the older evidence: it was wrong."""


class WindowOptimizer:
    """The window of one target, and when and how it is solved."""

    def __init__(
        self,
        filter_params: FilterParams,
        params: WindowParams,
        kept_as: FilterParams | None = None,
    ) -> None:
        self._filter_params = filter_params
        self._is_antenna_told = kept_as is None
        self.kept_as = kept_as or filter_params
        """Whose rows the window keeps: where the antenna is yet to be found, a planar array's."""
        self._params = params
        self.map = WindowMap(filter_params)
        self.latest: deque[Row] = deque(maxlen=CONTRADICTION_COUNT)
        """The measurements of late, those included that were no part of the window."""
        self._turn = 0
        self._fresh_at = MIN_MEASUREMENTS
        self.clear()

    def clear(self) -> None:
        """Forget everything measured."""
        self.latest.clear()
        self._begin(MIN_MEASUREMENTS)

    def _begin(self, due_at: int) -> None:
        """An empty window, to be solved after so many measurements."""
        columns = COLUMNS if self.kept_as.model.antenna == AZIMUTH else ARRAY_COLUMNS
        self.window = MeasurementWindow(self._params.size, columns)
        self.noise: Inflation | None = None
        """How much worse than thermal the best optimum found each modality; None: not solved."""
        self._older = OlderEvidence.none(self.map.size)
        self._due_at = due_at

    @property
    def rows(self) -> Matrix:
        """The window as the antenna that is believed in measured it, oldest first."""
        if self._is_antenna_told:
            return self.window.rows
        return rows_as(self.window.rows, self._filter_params.antenna.kind)

    def begin_from(self, hypothesis: Hypothesis) -> None:
        """Take a hypothesis for what was measured before the first measurement."""
        self._older = as_evidence(hypothesis, self._filter_params)

    def move(self, shift_en_m: Point, step: Vector) -> None:
        """Move all evidence along with the vehicle's navigation, which jumped."""
        self.latest.clear()
        self._older = self._older.moved(step)
        window = self.window
        window.rows = shift_rows(window.rows, shift_en_m, step, self.kept_as)

    def begin_with_latest(self) -> None:
        """Forget what led to an estimate that was given up, all but the latest measurements."""
        self._begin(0)
        self._fresh_at = 0
        for row in self.latest:
            self.window.add(row, (row[0][0], row[0][1]))

    def believe(self, filter_params: FilterParams) -> None:
        """Take what was measured for that of another antenna."""
        self._filter_params = filter_params
        self.map = WindowMap(filter_params)
        self._older = OlderEvidence.none(self.map.size)

    def retune(self, filter_params: FilterParams) -> None:
        """Believe in other noise and thresholds, for what was measured already, too."""
        self._filter_params = self.kept_as = filter_params
        self.map = WindowMap(filter_params)
        rows = self.window.rows
        rows[:, SIGMAS + RANGE] = filter_params.range_sigma_m
        rows[:, SIGMAS + BEARING] = math.radians(filter_params.bearing_sigma_deg)

    def add(
        self,
        row: Row,
        hypotheses: Sequence[Hypothesis],
        *,
        is_white: bool,
        time_s: float = math.nan,
    ) -> None:
        """Take in a measurement; what must leave the window becomes older evidence.

        While there are several hypotheses there is no place to expand it about, and where residuals
        repeat each other its neighbours have said the same: then it is let go.
        """
        place: Point = (row[0][0], row[0][1])
        if hypotheses:
            mean = hypotheses[0].state.mean
            place = (float(mean[0]), float(mean[1]))
        dropped = self.window.add(row, place, time_s)
        if len(dropped) and len(hypotheses) == 1 and is_white:
            mean, params = hypotheses[0].state.mean, self._filter_params
            if not self._is_antenna_told:
                dropped = rows_as(dropped, params.antenna.kind)
            self._older = self._older.joined(dropped, mean, params.thresholds, params.model)

    def is_due(self, accepted: int) -> bool:
        """Whether the window should be solved after this many measurements."""
        return self._params.enabled and accepted >= self._due_at

    @Stepwise
    def optimize(
        self,
        hypotheses: tuple[Hypothesis, ...],
        accepted: int,
        inflation: Inflation,
        *,
        is_white: bool,
        fresh_starts: int | None,
    ) -> Steps[tuple[Hypothesis, ...]]:
        """The hypotheses after the window was solved, with the inflation that the run has shown.

        `is_white`: innovations know nothing of each other. Of `fresh_starts` besides the hypotheses
        there are, if None, as many as the evidence calls for.
        """
        grown = max(1, int(EARLY_SHARE * accepted))
        self._due_at = accepted + min(self._params.every, grown)
        if len(self.window.rows) < MIN_MEASUREMENTS or not hypotheses:
            return hypotheses
        if fresh_starts is None:
            fresh_starts = self._fresh_starts(len(hypotheses), accepted)
        self.map.expect(inflation)
        kept, starts = min(len(hypotheses), MAX_STARTS_KEPT), self._starts(hypotheses, fresh_starts)
        minima = yield from self.map.minima.steps(self.rows, starts, self._older)
        has_older = bool(minima) and not self._older.is_empty
        if has_older and (yield from self._is_contradicted.steps(minima[0][1])):
            self._older = OlderEvidence.none(self.map.size)
            starts = [*starts, minima[0][1]]
            minima = yield from self.map.minima.steps(self.rows, starts, self._older)
        optima = yield from self._optima.steps(minima, starts[:kept], is_white=is_white)
        if not optima:
            return tuple(replace(h, least_covariance_m2=VAGUE_COVARIANCE_M2) for h in hypotheses)
        self.noise = optima[0].noise
        following = []
        for log_weight, optimum in weigh_optima(optima, self.map.fields):
            state = FilterState.of(hypotheses[0].state.time_s, optimum.mean, optimum.covariance)
            # where residuals repeat each other, so does the filter until the next solution
            is_free = is_white and self.map.fields == ALL_WHITE
            least = None if is_free else np.array(optimum.covariance[:2, :2])
            following.append(Hypothesis(log_weight, state, least))
        return tuple(following)

    def shared(self, hypothesis: Hypothesis, sigmas: SharedSigmas) -> SharedErrors:
        """What errors that all measurements share make of a place that the window names."""
        rows, mean = self.rows, hypothesis.state.mean
        heard = self.map.heard(rows)
        if len(rows) < MIN_MEASUREMENTS:
            return NO_ERRORS._replace(heard=heard)
        spread_m2 = float(np.trace(hypothesis.state.covariance[:2, :2]))
        scores = self.map.scores(rows, mean, spread_m2)
        prior = self.map.prior_with(rows, self._older)[0]
        times_s, model = self.window.times_s, self._filter_params.model
        try:
            errors = shared_errors(rows, times_s, mean, scores, prior, model, sigmas)
        except np.linalg.LinAlgError:
            errors = NO_ERRORS
        return errors._replace(heard=heard)

    def widths(self, mean: Vector, *, is_white: bool) -> list[tuple[str, Matrix]]:
        """Return what widens the place at `mean` (k,), as in `WindowMap.widths`; maybe nothing."""
        if len(self.window.rows) < MIN_MEASUREMENTS:
            return []
        try:
            return self.map.widths(self.rows, mean, self._older, is_white=is_white)
        except np.linalg.LinAlgError:
            return []

    def observability(self, mean: Vector) -> Observability | None:
        """What the window can tell about a target at `mean`; None before the first measurement."""
        if not len(self.window.rows):
            return None
        rows = self.rows
        return observability_of(rows, self.map.scores(rows, mean))

    def _fresh_starts(self, hypotheses: int, accepted: int) -> int:
        """How many fresh starts are due; early solutions in between have none."""
        if accepted < self._fresh_at:
            return 0
        self._fresh_at = accepted + self._params.every
        is_settled = hypotheses == 1 and accepted > SETTLED_COUNT
        return SETTLED_STARTS if is_settled else UNSETTLED_STARTS

    def _starts(self, hypotheses: Sequence[Hypothesis], fresh: int) -> list[Vector]:
        """The hypotheses, the best one's mirror image, and places around the path."""
        rows, directions = self.rows, self._params.starts
        starts = [h.state.mean for h in hypotheses[:MAX_STARTS_KEPT]]
        if fresh or not self.window.has_bearings:
            starts.append(mirrored(starts[0], rows[:, :2]))
        for _ in range(fresh):
            direction_rad = 2.0 * math.pi * self._turn / directions
            spread = self._turn // directions + self._turn
            starts.append(self.map.start_around(rows, direction_rad, spread))
            self._turn += 1
        return starts

    @Stepwise
    def _optima(
        self, minima: Minima, starts: Sequence[Vector], *, is_white: bool
    ) -> Steps[list[Optimum]]:
        """The optima without gross errors, if any: not even a linear loss outvotes many."""
        kept = self.map.without_gross(self.rows, minima[0][1]) if minima else None
        if kept is not None:
            starts = [*(mean for _, mean in minima), *starts]
            optima = yield from self.map.optima.steps(kept, starts, self._older, is_white=is_white)
            if optima:
                return optima
        judged = self.map.judged
        return (yield from judged.steps(self.rows, minima, self._older, is_white=is_white))

    @Stepwise
    def _is_contradicted(self, best: Vector) -> Steps[bool]:
        """Whether the window, if full enough to know, leads elsewhere than with older evidence."""
        if len(self.window.rows) < CONTRADICTING_SHARE * self._params.size:
            return False
        alone = yield from self.map.optima.steps(self.rows, [best])
        if not alone:
            return False
        difference = alone[0].mean[:2] - best[:2]
        spread = alone[0].covariance[:2, :2]
        return float(difference @ np.linalg.solve(spread, difference)) > CONTRADICTED_DISTANCE2
