"""Detector of motion of a target that is assumed stationary.

Theory of operation. Motion of the target makes residuals larger, and the measured noise grows with
them, so that every test of their size stays in its band. But it also gives them an order. The
measurements of the last seconds are fitted twice: with a stationary target, and with one of
constant velocity, whose partials by the velocity are those by the position times the age. The
velocity v is tested with the sandwich covariance C of the second fit, in which the motion is no
longer noise: v^T C^-1 v is chi-square with 2 degrees of freedom for a stationary target. The larger
of the white and the correlated covariance is used, because reflections that change with the
vehicle's position are correlated; and the decrease of the cost must be as significant, because a
fit that ended in another minimum does not lower it. The vehicle position drifts within its
reported accuracy, and the target seems to move with it: the variance of that is added to C.

The estimate stays unchanged, and the operator is informed: a reflection that changes with the
vehicle's position, behind a building for example, looks the same from one side, and no threshold
separates the two (flights behind the block of `obstacle.yaml` reach 188, targets at 0.3 m/s 120 to
140).

Source: P. J. Huber, Robust Statistics (1981), chapter 6, for the sandwich; the statistic is Wald's.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.domain import PositionAccuracy
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.hypotheses import shift_rows
from companion.estimation.stepwise import Steps, Stepwise, passes
from companion.estimation.window.map_kernels import SEQUENCE, SIGMAS, VALUES, hold_at_bounds
from companion.estimation.window.rivals import IMPROBABLE_LOG_RATIO
from companion.estimation.window.sandwich import (
    Scores,
    correlated_variability,
    covariance_of,
    curvature,
    pooled_variability,
)
from companion.estimation.window.shared_errors import TIME_CONSTANT_S
from companion.estimation.window.window_map import WindowMap
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector

SPANS_S = (10.0, 20.0, 40.0)
"""Spans that are tested, s: short ones for a target that turns soon, long ones for a slow one."""
EVERY_S = 1.0
"""Minimum time between two tests, s: less costs more, more reports a motion later."""
IDLE_EVERY_COUNT = 10
"""Measurements between two tests while nothing indicates motion; else they are half as many. Fewer
cost more, more suspect a motion later; with 5 or 20 the walking targets of the tests are found."""
SIGNIFICANT_CHI2 = 60.0
"""Statistic of a significant motion: ten times the 95 % quantile of chi-square with 2 degrees of
freedom, because errors that persist for half a minute or depend on the position occasionally reach
55."""
CLEAR_CHI2 = -2.0 * IMPROBABLE_LOG_RATIO
"""Statistic below which there is no sign of motion: the quantile of chi-square with 2 degrees of
freedom that a stationary target exceeds as rarely as a dropped rival is right."""
CONFIRMING_TESTS = 2
"""Consecutive significant tests that confirm a motion: of 4,051 tests on recorded walks, whose
targets are stationary, 6 are significant, and 1 of 49 targets is reported."""
CLEARED_COUNT = 10
"""Consecutive tests without any sign of motion that end a reported one: fewer end it while the
target pauses, more keep it when it has stopped, for as many seconds at least."""


@dataclass(frozen=True, slots=True)
class TargetMotion:
    """Motion of a target at constant velocity during the last seconds."""

    velocity_mps: Vector
    significance: float
    """Chi-square with 2 degrees of freedom for a stationary target."""

    @property
    def speed_mps(self) -> float:
        """Ground speed."""
        return math.hypot(*self.velocity_mps.tolist())


class MotionWatch:
    """Monitor that keeps the measurements of the last seconds and tests them periodically."""

    def __init__(self, filter_params: FilterParams, localised_r95_m: float) -> None:
        self._is_enabled = filter_params.process_noise_m_per_sqrt_s == 0.0
        self._near_m = 3.0 * localised_r95_m
        """Largest R95 at which the target is tested; a larger one reveals no motion."""
        most = 512  # a longest span of 40 s at 12 Hz, and as many as a window has
        self.fresh: deque[Vector] = deque(maxlen=most)
        """Measurements since the test was last due by time, in rows of `map_kernels` that have
        their time in place of the sequence number."""
        self._rows: deque[Vector] = deque(maxlen=most)
        self.due_s = -math.inf
        """Time of the next test, if enough measurements were made until then."""
        self._left = 0
        """Measurements until the next test."""
        self._was_near = False
        """True once the target's position was known."""
        self._reset()

    @property
    def motion(self) -> TargetMotion | None:
        """Motion of the target, confirmed by two consecutive tests; None: stationary."""
        return self.suspected if self._is_confirmed else None

    def clear(self) -> None:
        """Forget everything."""
        self.fresh.clear()
        self._rows.clear()
        self._was_near = False
        self._reset()

    def _reset(self) -> None:
        self._significant = self._cleared = 0
        self._is_confirmed = False
        self.suspected: TargetMotion | None = None
        """Motion that the latest tests indicate, confirmed or not; None: stationary."""

    def _take_fresh(self) -> None:
        """Add the fresh measurements; one of power alone shows no motion, but shadows."""
        for row in self.fresh if self._is_enabled else ():
            if not np.isnan(row[VALUES:SIGMAS]).all():
                self._rows.append(row)
                self._left -= 1
        self.fresh.clear()

    def move(self, shift_en_m: Point, step: Vector, params: FilterParams) -> None:
        """Shift all measurements with a jump of the vehicle's navigation; see `hypotheses`."""
        self._take_fresh()
        if self._rows:
            rows = shift_rows(np.array(self._rows), shift_en_m, step, params)
            self._rows = deque(rows, maxlen=self._rows.maxlen)

    def is_due(self, now_s: float) -> bool:
        """Return True if the next test is due."""
        if now_s < self.due_s <= now_s + EVERY_S:
            return False
        self._take_fresh()
        return bool(self._rows) and self._left <= 0

    @Stepwise
    def look(
        self, window_map: WindowMap, mean: Vector, r95_m: float, own: PositionAccuracy, now_s: float
    ) -> Steps[None]:
        """Test for motion, unless the target's position is unknown.

        A target whose position was known, and is lost, may have moved. `own` is the accuracy of
        the vehicle position, whose drift looks like a motion of the target.
        """
        every_count = IDLE_EVERY_COUNT // 2
        self.due_s, self._left = now_s + EVERY_S, every_count
        is_near = r95_m <= self._near_m
        self._was_near = self._was_near or is_near
        if self.suspected is None and not self._was_near:
            return
        own_m = own.horizontal_m if own.is_reported else 0.0
        found = yield from self._likeliest_motion.steps(window_map, mean, own_m)
        # a position that was known may be lost because of reflections as well
        is_sure = is_near or self.suspected is not None
        least = (1.0 if is_sure else 3.0) * SIGNIFICANT_CHI2
        if found is not None and found.significance >= least:
            self.suspected = found
            self._significant += 1
            self._cleared = 0
            self._is_confirmed = self._is_confirmed or self._significant >= CONFIRMING_TESTS
            return
        is_clear = found is None or found.significance < CLEAR_CHI2
        self._left = IDLE_EVERY_COUNT if is_clear else every_count
        self._cleared = self._cleared + 1 if is_clear else 0
        self._significant = 0
        if not self._is_confirmed or self._cleared >= CLEARED_COUNT:
            self._reset()

    def _spans(self) -> list[Matrix]:
        """Return the measurements of each span in order of time, (n, 10), without short ones."""
        rows = np.array(self._rows)
        rows = rows[np.argsort(rows[:, SEQUENCE], kind="stable")]
        times_s = rows[:, SEQUENCE]
        begins = np.searchsorted(times_s, times_s[-1] - np.array(SPANS_S)).tolist()
        # of fewer, or in less time, an order of errors is chance; the tests pass with 10 and 40
        least, least_s = 20, 8.0
        return [
            rows[begin:]
            for begin in sorted(set(begins), reverse=True)
            if len(rows) - begin >= least and times_s[-1] - times_s[begin] >= least_s
        ]

    @Stepwise
    def _likeliest_motion(
        self, window_map: WindowMap, mean: Vector, own_m: float
    ) -> Steps[TargetMotion | None]:
        """Return the motion of the shortest significant span, else the likeliest, or None."""
        best: TargetMotion | None = None
        for rows in self._spans():
            motion = yield from motion_of(window_map, rows, mean, own_m)
            if motion is None:
                continue
            if best is None or motion.significance > best.significance:
                best = motion
            if best.significance >= SIGNIFICANT_CHI2:
                break
        return best


def motion_of(
    window_map: WindowMap, rows: Matrix, mean: Vector, own_m: float = 0.0
) -> Steps[TargetMotion | None]:
    """Return the motion of a target near `mean` (k,), or None. Rows end with their time.

    `own_m` is the standard deviation of the vehicle position per axis, a first-order Gauss-Markov
    process as in `shared_errors`.
    """
    still, fit = (yield from window_map.solve.steps(rows, mean)), _MotionFit(window_map, rows)
    if still is None:
        return None
    at_rest = np.concatenate([still[0], np.zeros(2)])
    try:
        with np.errstate(all="ignore"):
            is_promising = fit.is_promising(at_rest)
        yield passes(10, len(rows))  # as measured, for a covariance
        if not is_promising:
            return None
        moving = yield from fit.minimum(np.concatenate([mean, np.zeros(2)]))
        with np.errstate(all="ignore"):
            covariance, inflation = fit.covariance(moving)
            velocity = moving[-2:]
            drift = drift_variance_m2ps2(own_m, float(np.ptp(rows[:, SEQUENCE])))
            spread = covariance[-2:, -2:] + drift * np.eye(2)
            significance = float(velocity @ np.linalg.solve(spread, velocity))
            fall = 2.0 * (fit.cost(at_rest) - fit.cost(moving)) / inflation
    except np.linalg.LinAlgError:
        return None
    if not math.isfinite(fall + significance):
        return None
    return TargetMotion(velocity_mps=velocity, significance=min(fall, significance))


def drift_variance_m2ps2(own_m: float, span_s: float) -> float:
    """Return the variance per axis, m^2/s^2, of the mean drift of the vehicle position in a span.

    The difference of a Gauss-Markov process over T has 2 sigma^2 (1 - exp(-T / tau)).
    """
    return -2.0 * own_m**2 * math.expm1(-span_s / TIME_CONSTANT_S) / span_s**2


class _Linearised(NamedTuple):
    """State, the problem linearised there, and its cost."""

    state: Vector
    scores: Scores
    cost: float


class _MotionFit:
    """Problem of the window with the state [..., east velocity, north velocity] at the end."""

    def __init__(self, window_map: WindowMap, rows: Matrix) -> None:
        self._map = window_map
        self._rows = rows
        self._age_s = rows[:, SEQUENCE] - rows[:, SEQUENCE].max()
        information, pull = window_map.prior
        size = len(pull)
        sigma_mps = 3.0  # of each component of the velocity: up to a run
        self._information = np.diag(np.full(size + 2, sigma_mps**-2))
        self._information[:size, :size] = information
        self._pull = np.concatenate([pull, np.zeros(2)])
        free = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        self._bounds = np.hstack([window_map.bounds, free])

    def scores(self, state: Vector) -> Scores:
        """Return the linearised problem: the target's motion is seen as motion of the sensor."""
        rows = np.array(self._rows)
        rows[:, :2] -= self._age_s[:, None] * state[-2:]
        scores = self._map.scores(rows, state[:-2])
        by_velocity = scores.H[:, :2] * np.tile(self._age_s, len(scores.u))[:, None]
        H = np.concatenate([scores.H, by_velocity], axis=1)
        return Scores(scores.u, scores.psi, H, scores.is_measured, scores.thermal)

    def cost(self, state: Vector) -> float:
        """Return the objective at a state."""
        return self._cost(self.scores(state), state)

    def _cost(self, scores: Scores, state: Vector) -> float:
        losses = float(np.sum(scores.psi * (scores.u - 0.5 * scores.psi)))
        return losses + float(state @ (0.5 * self._information @ state - self._pull))

    def minimum(self, state: Vector) -> Steps[Vector]:
        """Return the minimum that damped re-weighted Gauss-Newton steps reach."""
        with np.errstate(all="ignore"):
            at, damping = self._at(state), 1e-3
        for _ in range(12):  # few: it starts at the optimum of the stationary target
            with np.errstate(all="ignore"):
                moved, damping, tries = self._moved(at, damping)
            yield passes(2 * tries, len(self._rows))  # as measured, for a linearisation
            if moved is None:
                break
            step_m = math.dist(moved.state[:2], at.state[:2])
            at = moved
            if step_m < 5e-3:  # far below any R95
                break
        return at.state

    def _at(self, state: Vector) -> _Linearised:
        scores = self.scores(state)
        return _Linearised(state, scores, self._cost(scores, state))

    def _moved(self, at: _Linearised, damping: float) -> tuple[_Linearised | None, float, int]:
        """Return a state of lower cost, if any, the next damping, and the number of tries."""
        A, descent = self._system(at.scores, at.state)
        hold_at_bounds(A, descent, at.state, self._bounds)
        scale = np.diag(np.diag(A) + 1e-9)
        most = 6  # dampings, each eight times the one before and a linearisation: to 262 times
        for tries in range(1, most + 1):
            step = np.linalg.solve(A + damping * scale, descent)
            moved = self._at(
                np.minimum(np.maximum(at.state + step, self._bounds[0]), self._bounds[1])
            )
            if moved.cost < at.cost:
                return moved, max(damping / 4.0, 1e-9), tries
            damping *= 8.0
        return None, damping, most

    def _system(self, scores: Scores, state: Vector) -> tuple[Matrix, Vector]:
        u, psi = scores.u.reshape(-1), scores.psi.reshape(-1)
        weight = np.where(u == psi, 1.0, psi / np.where(u == psi, 1.0, u))
        A = (scores.H.T * weight) @ scores.H + self._information
        return A, self._descent(scores, state)

    def _descent(self, scores: Scores, state: Vector) -> Vector:
        descent: Vector = scores.H.T @ scores.psi.reshape(-1) + self._pull
        return descent - self._information @ state

    def is_promising(self, still: Vector) -> bool:
        """Return True if a first step from rest, under white noise, justifies the second fit."""
        scores = self.scores(still)
        A_inverse = np.asarray(np.linalg.inv(curvature(scores) + self._information))
        last = A_inverse[-2:]
        velocity = last @ self._descent(scores, still)

        def is_significant(variability: Matrix) -> bool:
            """Return True if the velocity is significant at this variability of the residuals."""
            covariance = last @ (variability + self._information) @ last.T
            chi2 = float(velocity @ np.linalg.solve(covariance, velocity))
            return chi2 >= 9.2  # 0.01 for a stationary target

        # this lower bound nearly always suffices to decline, at half the cost
        if not is_significant(least_variability(scores)):
            return False
        return is_significant(pooled_variability(scores, A_inverse, np.ones(len(scores.u))))

    def covariance(self, state: Vector) -> tuple[Matrix, float]:
        """Return the state's covariance, (k + 2, k + 2), and the inflation over thermal noise."""
        scores = self.scores(state)
        A = curvature(scores) + self._information
        A_inverse = np.asarray(np.linalg.inv(A))
        pooled = pooled_variability(scores, A_inverse, scores.repetition) + self._information
        correlated = correlated_variability(scores) + self._information
        inflation = max(1.0, float(np.trace(pooled @ A_inverse)) / len(state))
        pairs = [covariance_of(A, B) for B in (pooled, correlated)]
        return max(pairs, key=lambda pair: float(np.trace(pair[-2:, -2:]))), inflation


def least_variability(scores: Scores) -> Matrix:
    """Return a lower bound of `pooled_variability`, (k, k)."""
    k = scores.H.shape[1]
    parts = [(scores.moment(m, k), scores.part(m)) for m in scores.measured]
    B: Matrix = sum((moment * (H.T @ H) for moment, H in parts), np.zeros((k, k)))
    return B
