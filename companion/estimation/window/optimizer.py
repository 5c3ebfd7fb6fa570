"""Periodic check and correction of the hypotheses by solving a window of measurements.

Every optimum replaces the hypotheses near it, because it contains all their measurements, and is
not linearised at former estimates. A prior of older evidence that contradicts the window was
expanded about a wrong position, and is discarded.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.domain import PositionEnu
from companion.estimation.belief import as_evidence
from companion.estimation.filters.target_filter import (
    FilterParams,
    FilterState,
    Inflation,
)
from companion.estimation.hypotheses import RAY_DISTANCES_M, Hypothesis, shift_rows
from companion.estimation.integrity import CONTRADICTION_COUNT
from companion.estimation.measurement_model import (
    BEARING,
    DB_PER_NEPER,
    POWER,
    RANGE,
    RANGE_OFFSET,
    target_height_m,
)
from companion.estimation.stepwise import Steps, Stepwise
from companion.estimation.window.antenna_check import rows_as
from companion.estimation.window.map_kernels import (
    COLUMNS,
    POWER_VALUE,
    POWER_WEIGHT,
    SEQUENCE,
    VALUES,
    OlderEvidence,
    argument_columns,
    columns_of,
    has_any,
)
from companion.estimation.window.rivals import (
    Observability,
    Optimum,
    mirrored,
    observability_of,
    weigh_optima,
)
from companion.estimation.window.sandwich import MIN_MEASUREMENTS, is_all_white
from companion.estimation.window.shadows import shadow_weights
from companion.estimation.window.shared_errors import (
    NO_ERRORS,
    SharedErrors,
    SharedSigmas,
    shared_errors,
)
from companion.estimation.window.window_map import (
    Minima,
    WindowMap,
    WindowParams,
)
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector

KEPT_SHARE = 0.95
"""Share to which a full window is thinned: less drops more, more thins more often. With 0.9 or
0.975 no R95 of recorded walks changes by more than 3 %."""


class MeasurementWindow:
    """Up to `size` measurements, spread over views of the target, in rows of `map_kernels`."""

    def __init__(self, size: int, columns: int = COLUMNS) -> None:
        self.rows: Matrix = np.empty((0, columns))
        """Measurements, (n, `columns`), oldest first."""
        self._size = size
        self._times_s: list[float] = []
        """Times of all measurements ever added, by sequence number; NaN: unknown."""

    @property
    def has_bearings(self) -> bool:
        """True if any measurement in the window is a bearing."""
        return not bool(np.isnan(self.rows[:, VALUES + BEARING]).all())

    @property
    def times_s(self) -> Vector:
        """Time of each measurement, (n,); unknown ones are set to the latest."""
        times_s = np.array(self._times_s)[self.rows[:, SEQUENCE].astype(int)]
        known = times_s[~np.isnan(times_s)]
        latest_s = float(known.max()) if known.size else 0.0
        return np.asarray(np.nan_to_num(times_s, nan=latest_s), dtype=np.float64)

    def add(self, row: Vector, target_enu_m: Point, time_s: float = math.nan) -> Matrix:
        """Add a measurement; return the rows evicted from a full window by thinning, (m, 10)."""
        dropped = self.rows[:0]
        if len(self.rows) == self._size:
            is_kept = kept_by_thinning(self.rows, int(KEPT_SHARE * self._size), target_enu_m)
            dropped, self.rows = self.rows[~is_kept], self.rows[is_kept]
        self.rows = np.concatenate([self.rows, row[None]])
        self.rows[-1, SEQUENCE] = len(self._times_s)
        self._times_s.append(time_s)
        return dropped


def kept_by_thinning(rows: Matrix, target: int, centre: Point) -> NDArray[np.bool_]:
    """Return which rows stay, (n,), at most `target`: fewer where sector and distance are alike."""
    east, north = rows[:, 0] - centre[0], rows[:, 1] - centre[1]
    sectors = 16  # with 8 or 32 no R95 of recorded walks changes by more than 3 %
    sector = np.floor((np.arctan2(north, east) / (2.0 * math.pi) + 0.5) * sectors) % sectors
    # the innermost ring is 1 m wide, each further one twice as far
    ring = np.floor(np.log2(np.maximum(np.hypot(east, north), 1.0)))
    _, view, counts = np.unique(ring * sectors + sector, return_inverse=True, return_counts=True)
    cap = int(counts.max())
    while cap > 1 and int(np.minimum(counts, cap).sum()) > target:
        cap -= 1
    keep = np.zeros(len(rows), dtype=bool)
    for index in range(len(counts)):
        members = np.flatnonzero(view == index)
        keep[members[_evenly_in_time(rows[members, SEQUENCE], cap)]] = True
    kept = np.flatnonzero(keep)
    if len(kept) > target:  # more views than may be kept: thin all of them evenly
        keep[:] = False
        keep[kept[np.linspace(0, len(kept) - 1, target).astype(int)]] = True
    return keep


def _evenly_in_time(sequence: Vector, count: int) -> NDArray[np.intp]:
    """Return at most `count` members, spread evenly in time: close neighbours are dropped first."""
    kept = np.arange(len(sequence))
    while len(kept) > max(count, 2):
        gaps = sequence[kept[2:]] - sequence[kept[:-2]]
        kept = np.delete(kept, 1 + int(np.argmin(gaps)))
    return kept[:count]


MAX_STARTS_KEPT = 4
"""Maximum number of hypotheses that start a solution of the window, each a descent; with 2 or 8 no
R95 of recorded walks changes by 1 %."""
SHARED_PASSES = 8
"""Passes over the measurements, as measured, for the effect of shared errors."""


def strongest(rows: Matrix) -> NDArray[np.intp]:
    """Return the indices of the tenth of the rows with the strongest signals, at least one."""
    powers = np.nan_to_num(rows[:, POWER_VALUE], nan=-math.inf)
    return np.argsort(-powers, kind="stable")[: max(1, len(rows) // 10)]


def start_around(rows: Matrix, direction_rad: float, spread: int, params: FilterParams) -> Vector:
    """Return a start off the middle of the path, at the median range or by `spread`.

    With power alone it is off the position where the signal was strongest.
    """
    east, north, up = rows[:, 0].mean(), rows[:, 1].mean(), rows[:, 2].mean()
    ranges = rows[:, VALUES + RANGE]
    ranges = ranges[~np.isnan(ranges)]
    distance_m = RAY_DISTANCES_M[spread % len(RAY_DISTANCES_M)]
    if ranges.size:
        rise_m = up - params.target_height_m
        distance_m = math.sqrt(max(float(np.median(ranges)) ** 2 - rise_m**2, 1.0))
    elif params.model.power_index >= 0 and has_any(rows, POWER):
        strong = strongest(rows)
        east, north = rows[strong, 0].mean(), rows[strong, 1].mean()
    start = np.array(params.prior[0])
    start[0] = east + distance_m * math.cos(direction_rad)
    start[1] = north + distance_m * math.sin(direction_rad)
    return start


class WindowOptimizer:
    """Window of one target, and the schedule and starts of its solutions."""

    def __init__(
        self,
        filter_params: FilterParams,
        params: WindowParams,
        storage_params: FilterParams | None = None,
    ) -> None:
        self._filter_params = filter_params
        self._is_antenna_configured = storage_params is None
        self.storage_params = storage_params or filter_params
        """Parameters of the rows in the window: those of a planar array until the antenna is
        identified."""
        self._params = params
        self.map = WindowMap(filter_params)
        self.latest: deque[Vector] = deque(maxlen=CONTRADICTION_COUNT)
        """Latest measurements, also those that did not enter the window."""
        self._turn = 0
        self._fresh_at = MIN_MEASUREMENTS
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self.latest.clear()
        self._begin(MIN_MEASUREMENTS)

    def _begin(self, due_at: int) -> None:
        """Start an empty window, to be solved after this number of measurements."""
        columns = columns_of(self.storage_params.model)
        self.window = MeasurementWindow(self._params.size, columns)
        self.noise: Inflation | None = None
        """Inflation over thermal noise of each modality at the best optimum; None: not solved
        yet."""
        self._older = OlderEvidence.none(self.map.size)
        self.due_at: float = due_at if self._params.enabled else math.inf

    @property
    def rows(self) -> Matrix:
        """Rows of the window as measured by the accepted antenna, oldest first."""
        if self._is_antenna_configured:
            return self.window.rows
        return rows_as(self.window.rows, self._filter_params.antenna.kind)

    def begin_from(self, hypothesis: Hypothesis) -> None:
        """Use a hypothesis as the evidence from before the first measurement."""
        self._older = as_evidence(hypothesis, self._filter_params)

    def move(self, shift_en_m: Point, step: Vector) -> None:
        """Shift all evidence with a jump of the vehicle's navigation."""
        self.latest.clear()
        self._older = self._older.moved(step)
        window = self.window
        window.rows = shift_rows(window.rows, shift_en_m, step, self.storage_params)

    def begin_with_latest(self) -> None:
        """Start again with the latest measurements only, after a track was discarded."""
        self._begin(0)
        self._fresh_at = 0
        for row in self.latest:
            self.window.add(row, (float(row[0]), float(row[1])))

    def switch_antenna(self, filter_params: FilterParams) -> None:
        """Reinterpret the measurements as those of another antenna."""
        self._filter_params = filter_params
        self.map = WindowMap(filter_params)
        self._older = OlderEvidence.none(self.map.size)

    def keep_evidence(self, dropped: Matrix, mean: Vector) -> None:
        """Keep rows that left the window, (m, 10), as older evidence, expanded about `mean` (k,).

        Not with several hypotheses, which have no common position to expand it about, nor where
        residuals are correlated: then the neighbours of these rows carry the same information.
        """
        params = self._filter_params
        if not self._is_antenna_configured:
            dropped = rows_as(dropped, params.antenna.kind)
        self._older = self._older.joined(dropped, mean, params.thresholds, params.model)

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
        """Solve the window and return the resulting hypotheses.

        `inflation` is the measured one, and `is_white` means that innovations are uncorrelated.
        `fresh_starts` are added to the hypotheses; None leaves their number to the evidence.
        """
        # early on, when by a tenth; half or twice as often moves R95 of recorded walks by up to 5 %
        grown = max(1, int(0.1 * accepted))
        if self._params.enabled:
            self.due_at = accepted + min(self._params.every, grown)
        if len(self.window.rows) < MIN_MEASUREMENTS or not hypotheses:
            return hypotheses
        if fresh_starts is None:
            fresh_starts = self._fresh_starts(len(hypotheses), accepted)
        if self._filter_params.model.power_index >= 0:
            self.window.rows[:, POWER_WEIGHT] = shadow_weights(self.window.rows)
        self.map.set_bearing_inflation(inflation)
        kept, starts = min(len(hypotheses), MAX_STARTS_KEPT), self._starts(hypotheses, fresh_starts)
        minima = yield from self.map.minima.steps(self.rows, starts, self._older)
        has_older = bool(minima) and not self._older.is_empty
        if has_older and (yield from self._is_contradicted.steps(minima[0][1])):
            self._older = OlderEvidence.none(self.map.size)
            starts = [*starts, minima[0][1]]
            minima = yield from self.map.minima.steps(self.rows, starts, self._older)
        optima = yield from self._optima.steps(minima, starts[:kept], is_white=is_white)
        if not optima:
            vague_m2 = self.map.vaguest_sigma_m**2 * np.eye(2)  # what an optimum has to beat
            return tuple(replace(h, least_covariance_m2=vague_m2) for h in hypotheses)
        self.noise = optima[0].noise
        following = []
        own_sigma_m = self._filter_params.model.own_sigma_m
        for log_weight, optimum in weigh_optima(optima, self.map.spatial_noise, own_sigma_m):
            state = FilterState.of(hypotheses[0].state.time_s, optimum.mean, optimum.covariance)
            # with correlated residuals the filter must not shrink below the window's covariance
            is_free = is_white and is_all_white(self.map.spatial_noise)
            least = None if is_free else np.array(optimum.covariance[:2, :2])
            following.append(Hypothesis(log_weight, state, least))
        return tuple(following)

    def shared(self, hypothesis: Hypothesis, sigmas: SharedSigmas) -> SharedErrors:
        """Return the effect of errors that all measurements share on the window's estimate."""
        rows, mean = self.rows, hypothesis.state.mean
        reception = self.map.reception(rows)
        if len(rows) < MIN_MEASUREMENTS:
            return NO_ERRORS._replace(reception=reception)
        spread_m2 = float(np.trace(hypothesis.state.covariance[:2, :2]))
        scores = self.map.scores(rows, mean, spread_m2)
        prior = self.map.prior_with(rows, self._older)[0]
        times_s, model = self.window.times_s, self._filter_params.model
        try:
            errors = shared_errors(rows, times_s, mean, scores, prior, model, sigmas)
        except np.linalg.LinAlgError:
            errors = NO_ERRORS
        return errors._replace(reception=reception)

    def widths(self, mean: Vector, *, is_white: bool) -> list[tuple[str, Matrix]]:
        """Return the terms that widen the estimate at `mean` (k,), as `WindowMap.widths` does."""
        if len(self.window.rows) < MIN_MEASUREMENTS:
            return []
        try:
            return self.map.widths(self.rows, mean, self._older, is_white=is_white)
        except np.linalg.LinAlgError:
            return []

    def latest_sigmas(self, mean: Vector, inflation: Inflation) -> tuple[float, float, float]:
        """Return sigmas of a range, m, a direction cosine, and a power as a share of the range.

        Those of range and power are infinite if there was none lately; the range's has the position
        error. `mean` (k,) has the path-loss exponent, by which a power is a logarithm of the range.
        """
        params = self._filter_params
        index, missing = params.model.power_index, {RANGE, BEARING}
        _, values, noise = argument_columns(params.model)
        sigmas = {RANGE: math.inf, BEARING: math.radians(params.bearing_sigma_deg)}
        if index >= 0:
            missing.add(POWER)
            sigmas[POWER] = math.inf
        for row in reversed(self.latest):
            for kind in [kind for kind in missing if not math.isnan(row[values[kind]])]:
                sigmas[kind] = float(row[noise[kind]])
                missing.discard(kind)
            if not missing:
                break
        inflated = {row: math.sqrt(inflation[row]) * sigma for row, sigma in sigmas.items()}
        range_m = math.hypot(inflated[RANGE], params.own_position_sigma_m)
        share = math.inf
        if index >= 0:
            share = inflated[POWER] / (DB_PER_NEPER * float(mean[index + 1]))
        return range_m, inflated[BEARING], share

    def joint_covariance(self, state: FilterState, sensor_enu_m: PositionEnu) -> Matrix:
        """Return the covariance (4, 4) of [east, north, range offset, bearing offset], m and rad.

        Where power replaces ranges, the power at 1 m is an offset of ranges, too: of those from the
        antenna at this position.
        """
        order, scales, model = list(range(4)), np.ones(4), self._filter_params.model
        if self._has_power_alone:
            index, (east, north) = model.power_index, state.mean[:2].tolist()
            slant_m = math.dist(sensor_enu_m, (east, north, target_height_m(state.mean, model)))
            order[RANGE_OFFSET] = index
            scales[RANGE_OFFSET] = -slant_m / (DB_PER_NEPER * float(state.mean[index + 1]))
        return np.asarray(scales[:, None] * state.covariance[np.ix_(order, order)] * scales)

    @property
    def _has_power_alone(self) -> bool:
        """True if the latest measurements have a power and no range."""
        if self._filter_params.model.power_index < 0 or not self.latest:
            return False
        latest = np.array(self.latest)
        return has_any(latest, POWER) and not has_any(latest, RANGE)

    def observability(self, mean: Vector) -> Observability | None:
        """Return the observability of a target at `mean`; None before the first measurement."""
        if not len(self.window.rows):
            return None
        rows = self.rows
        return observability_of(rows, self.map.scores(rows, mean))

    def _fresh_starts(self, hypotheses: int, accepted: int) -> int:
        """Return how many fresh starts are due; early solutions in between have none."""
        if accepted < self._fresh_at:
            return 0
        self._fresh_at = accepted + self._params.every
        # 300 are 12 full solutions of 25 measurements, with 48 starts: every direction four times
        is_settled = hypotheses == 1 and accepted > 300
        return 1 if is_settled else 4

    def _starts(self, hypotheses: Sequence[Hypothesis], fresh: int) -> list[Vector]:
        """Return the hypotheses, the best one's mirror image, and positions around the path."""
        rows, directions = self.rows, self._params.starts
        starts = [h.state.mean for h in hypotheses[:MAX_STARTS_KEPT]]
        if fresh or not self.window.has_bearings:
            starts.append(mirrored(starts[0], rows[:, :2]))
        for _ in range(fresh):
            direction_rad = 2.0 * math.pi * self._turn / directions
            spread = self._turn // directions + self._turn
            starts.append(start_around(rows, direction_rad, spread, self._filter_params))
            self._turn += 1
        return starts

    @Stepwise
    def _optima(
        self, minima: Minima, starts: Sequence[Vector], *, is_white: bool
    ) -> Steps[list[Optimum]]:
        """Return the optima without gross errors, which even a linear loss cannot outweigh."""
        kept = self.map.without_gross(self.rows, minima[0][1]) if minima else None
        if kept is not None:
            starts = [*(mean for _, mean in minima), *starts]
            optima = yield from self.map.optima.steps(kept, starts, self._older, is_white=is_white)
            if optima:
                return optima
        optima_at = self.map.optima_at
        return (yield from optima_at.steps(self.rows, minima, self._older, is_white=is_white))

    @Stepwise
    def _is_contradicted(self, best: Vector) -> Steps[bool]:
        """Return True if the window, once full enough, contradicts the older evidence."""
        # of less than a half the solution alone is too vague to contradict anything
        if len(self.window.rows) < 0.5 * self._params.size:
            return False
        alone = yield from self.map.optima.steps(self.rows, [best])
        if not alone:
            return False
        difference = alone[0].mean[:2] - best[:2]
        spread = alone[0].covariance[:2, :2]
        return float(difference @ np.linalg.solve(spread, difference)) > 4.0**2  # 4 sigma
