"""Notices that a target walks although it is believed to lie still.

Theory of operation. A walk makes residuals larger, and the noise that the run has shown grows along
with them, so that every test of their size stays in its band. But it also gives them an order. The
measurements of the last seconds are fitted twice: by a target that lies still, and by one that
walks evenly, whose partials by the velocity are those by the place times the age. The velocity v
is judged by the sandwich covariance C of the second fit, in which whatever the walk explains is no
noise any more: v^T C^-1 v is chi-square with 2 degrees of freedom, if the target lies still. The
more careful of the white and the correlated covariance counts, because a reflection that comes and
goes with the place is correlated; and the fall of the cost must say the same, because a fit that
ended in another valley does not lower it.

The estimate stays as it is, and the operator is told: a reflection that changes with the vehicle's
place, behind a building for example, looks the same from one side, and no threshold parts the two
(flights behind the block of `obstacle.yaml` reach 188, walks of 0.3 m/s 120 to 140).

Source: P. J. Huber, Robust Statistics (1981), chapter 6, for the sandwich; the statistic is Wald's.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.hypotheses import shift_rows
from companion.estimation.stepwise import Steps, Stepwise, passes
from companion.estimation.window.map_kernels import SEQUENCE, Row, hold_at_bounds, row_vector
from companion.estimation.window.sandwich import (
    Scores,
    correlated_variability,
    covariance_of,
    curvature,
    pooled_variability,
)
from companion.estimation.window.window_map import WindowMap
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector

SPANS_S = (10.0, 20.0, 40.0)
"""What is looked at: a short span for whoever turns soon, a long one for whoever walks slowly."""
LEAST_SPAN_S = 8.0
"""Less than this tells nothing."""
MIN_COUNT, MAX_COUNT = 20, 512
"""Fewer measurements tell nothing; more are not kept."""
EVERY_S, EVERY_COUNT = 1.0, 5
"""At least so much time and so many measurements are between two looks: fewer say nothing new."""
CALM_EVERY_COUNT = 10
"""The same while nothing speaks for a walk."""
NEAR = 3.0
"""A place is asked for while R95 is at most so many times what counts as localised."""
SIGNIFICANT = 60.0
"""Ten times what a statistic of this law reaches by chance once in 20: errors that repeat
themselves for half a minute, or change with the place, reach 55 now and then."""
LOST_SIGNIFICANT = 180.0
"""The same of a target whose place was known and is no more: reflections can do that as well."""
IN_A_ROW = 2
"""It must be so often in a row."""
CALM = 18.4
"""Below this, 1 in 1e4, nothing speaks for a walk any more."""
CALM_COUNT = 10
"""It must be so often in a row."""
WORTH_A_LOOK = 9.2
"""Where a first step says less than this, 1 in 100, nobody walks."""
MAX_SPEED_MPS = 3.0
"""Standard deviation of each component of the velocity before anything is measured."""
MAX_ITERATIONS = 12
MAX_HALVINGS = 6
STEP_TOLERANCE_M = 5e-3
SCORES_PASSES, COVARIANCE_PASSES = 2, 10
"""Over the measurements, measured: for the problem linearised once, and for a covariance."""


@dataclass(frozen=True, slots=True)
class TargetMotion:
    """A target that walks evenly, as the last seconds have it."""

    velocity_mps: Vector
    significance: float
    """Chi-square with 2 degrees of freedom, if the target lies still."""

    @property
    def speed_mps(self) -> float:
        """How fast it walks."""
        return math.hypot(*self.velocity_mps.tolist())


class MotionWatch:
    """Keeps the measurements of the last seconds, and asks them now and then."""

    def __init__(self, filter_params: FilterParams, localised_r95_m: float) -> None:
        self._is_wanted = filter_params.process_noise_m_per_sqrt_s == 0.0
        self._near_m = NEAR * localised_r95_m
        self._rows: deque[Vector] = deque(maxlen=MAX_COUNT)
        self._due_s = -math.inf
        self._left = 0
        """Measurements until the next look."""
        self._was_near = False
        """Whether the target's place was known once."""
        self._reset()

    @property
    def motion(self) -> TargetMotion | None:
        """How the target walks, once that was seen twice in a row; None: it lies still."""
        return self.suspected if self._is_seen else None

    def clear(self) -> None:
        """Forget everything."""
        self._rows.clear()
        self._was_near = False
        self._reset()

    def _reset(self) -> None:
        self._significant = self._calm = 0
        self._is_seen = False
        self.suspected: TargetMotion | None = None
        """How the target seems to walk, since the first look that says so; None: it lies still."""

    def add(self, time_s: float, row: Row) -> None:
        """Take in a measurement."""
        if self._is_wanted:
            self._rows.append(row_vector(row, time_s))
            self._left -= 1

    def move(self, shift_en_m: Point, step: Vector, params: FilterParams) -> None:
        """Move all along with the vehicle's navigation, which jumped; see `hypotheses`."""
        if self._rows:
            rows = shift_rows(np.array(self._rows), shift_en_m, step, params)
            self._rows = deque(rows, maxlen=MAX_COUNT)

    def is_due(self, now_s: float) -> bool:
        """Whether it is time to look again."""
        is_time = not now_s < self._due_s <= now_s + EVERY_S
        return bool(self._rows) and self._left <= 0 and is_time

    @Stepwise
    def look(self, window_map: WindowMap, mean: Vector, r95_m: float, now_s: float) -> Steps[None]:
        """Look whether the target walks, where it matters: not of one that may be anywhere.

        One whose place was known, and is lost, may have walked on.
        """
        self._due_s, self._left = now_s + EVERY_S, EVERY_COUNT
        is_near = r95_m <= self._near_m
        self._was_near = self._was_near or is_near
        if self.suspected is None and not self._was_near:
            return
        found = yield from self._likeliest_motion.steps(window_map, mean)
        least = SIGNIFICANT if is_near or self.suspected is not None else LOST_SIGNIFICANT
        if found is not None and found.significance >= least:
            self.suspected = found
            self._significant += 1
            self._calm = 0
            self._is_seen = self._is_seen or self._significant >= IN_A_ROW
            return
        is_calm = found is None or found.significance < CALM
        self._left = CALM_EVERY_COUNT if is_calm else EVERY_COUNT
        self._calm = self._calm + 1 if is_calm else 0
        self._significant = 0
        if not self._is_seen or self._calm >= CALM_COUNT:
            self._reset()

    def _spans(self) -> list[Matrix]:
        """Measurements in order of time, (n, 10) each; spans that hold too little are left out."""
        rows = np.array(self._rows)
        rows = rows[np.argsort(rows[:, SEQUENCE], kind="stable")]
        times_s = rows[:, SEQUENCE]
        begins = np.searchsorted(times_s, times_s[-1] - np.array(SPANS_S)).tolist()
        return [
            rows[begin:]
            for begin in sorted(set(begins), reverse=True)
            if len(rows) - begin >= MIN_COUNT and times_s[-1] - times_s[begin] >= LEAST_SPAN_S
        ]

    @Stepwise
    def _likeliest_motion(self, window_map: WindowMap, mean: Vector) -> Steps[TargetMotion | None]:
        """The motion of the shortest span in which it is significant, or the most significant."""
        best: TargetMotion | None = None
        for rows in self._spans():
            motion = yield from motion_of(window_map, rows, mean)
            if motion is None:
                continue
            if best is None or motion.significance > best.significance:
                best = motion
            if best.significance >= SIGNIFICANT:
                break
        return best


def motion_of(window_map: WindowMap, rows: Matrix, mean: Vector) -> Steps[TargetMotion | None]:
    """How a target believed to lie at `mean` (k,) walks, if it does; rows end with their time."""
    still, walk = (yield from window_map.solve.steps(rows, mean)), _Walk(window_map, rows)
    if still is None:
        return None
    place = np.concatenate([still[0], np.zeros(2)])
    try:
        with np.errstate(all="ignore"):
            may_begin = walk.may_begin(place)
        yield passes(COVARIANCE_PASSES, len(rows))
        if not may_begin:
            return None
        walking = yield from walk.minimum(np.concatenate([mean, np.zeros(2)]))
        with np.errstate(all="ignore"):
            covariance, inflation = walk.covariance(walking)
            velocity = walking[-2:]
            significance = float(velocity @ np.linalg.solve(covariance[-2:, -2:], velocity))
            fall = 2.0 * (walk.cost(place) - walk.cost(walking)) / inflation
    except np.linalg.LinAlgError:
        return None
    if not math.isfinite(fall + significance):
        return None
    return TargetMotion(velocity_mps=velocity, significance=min(fall, significance))


class _Place(NamedTuple):
    """A state, the problem linearised there, and its cost."""

    state: Vector
    scores: Scores
    cost: float


class _Walk:
    """The window's problem for states [..., east velocity, north velocity], placed at the end."""

    def __init__(self, window_map: WindowMap, rows: Matrix) -> None:
        self._map = window_map
        self._rows = rows
        self._age_s = rows[:, SEQUENCE] - rows[:, SEQUENCE].max()
        information, pull = window_map.prior
        size = len(pull)
        self._information = np.diag(np.full(size + 2, MAX_SPEED_MPS**-2))
        self._information[:size, :size] = information
        self._pull = np.concatenate([pull, np.zeros(2)])
        free = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        self._bounds = np.hstack([window_map.bounds, free])

    def scores(self, state: Vector) -> Scores:
        """The problem linearised at a state: seen from a target that walks, the sensor does."""
        rows = np.array(self._rows)
        rows[:, :2] -= self._age_s[:, None] * state[-2:]
        scores = self._map.scores(rows, state[:-2])
        by_velocity = scores.H[:, :2] * np.tile(self._age_s, 3)[:, None]
        H = np.concatenate([scores.H, by_velocity], axis=1)
        return Scores(scores.u, scores.psi, H, scores.is_measured, scores.thermal)

    def cost(self, state: Vector) -> float:
        """The objective at a state."""
        return self._cost(self.scores(state), state)

    def _cost(self, scores: Scores, state: Vector) -> float:
        losses = float(np.sum(scores.psi * (scores.u - 0.5 * scores.psi)))
        return losses + float(state @ (0.5 * self._information @ state - self._pull))

    def minimum(self, state: Vector) -> Steps[Vector]:
        """Where damped re-weighted Gauss-Newton steps lead."""
        with np.errstate(all="ignore"):
            at, damping = self._at(state), 1e-3
        for _ in range(MAX_ITERATIONS):
            with np.errstate(all="ignore"):
                moved, damping, tries = self._moved(at, damping)
            yield passes(SCORES_PASSES * tries, len(self._rows))
            if moved is None:
                break
            step_m = math.dist(moved.state[:2], at.state[:2])
            at = moved
            if step_m < STEP_TOLERANCE_M:
                break
        return at.state

    def _at(self, state: Vector) -> _Place:
        scores = self.scores(state)
        return _Place(state, scores, self._cost(scores, state))

    def _moved(self, at: _Place, damping: float) -> tuple[_Place | None, float, int]:
        """A place of lower cost, None if there is none; the next damping; how many were tried."""
        A, descent = self._system(at.scores, at.state)
        hold_at_bounds(A, descent, at.state, self._bounds)
        scale = np.diag(np.diag(A) + 1e-9)
        for tries in range(1, MAX_HALVINGS + 1):
            step = np.linalg.solve(A + damping * scale, descent)
            moved = self._at(
                np.minimum(np.maximum(at.state + step, self._bounds[0]), self._bounds[1])
            )
            if moved.cost < at.cost:
                return moved, max(damping / 4.0, 1e-9), tries
            damping *= 8.0
        return None, damping, MAX_HALVINGS

    def _system(self, scores: Scores, state: Vector) -> tuple[Matrix, Vector]:
        u, psi = scores.u.reshape(-1), scores.psi.reshape(-1)
        weight = np.where(u == psi, 1.0, psi / np.where(u == psi, 1.0, u))
        A = (scores.H.T * weight) @ scores.H + self._information
        return A, self._descent(scores, state)

    def _descent(self, scores: Scores, state: Vector) -> Vector:
        descent: Vector = scores.H.T @ scores.psi.reshape(-1) + self._pull
        return descent - self._information @ state

    def may_begin(self, still: Vector) -> bool:
        """Whether a first step away from lying still, with white noise, is worth the second fit."""
        scores = self.scores(still)
        A_inverse = np.asarray(np.linalg.inv(curvature(scores) + self._information))
        last = A_inverse[-2:]
        velocity = last @ self._descent(scores, still)

        def is_worth(variability: Matrix) -> bool:
            covariance = last @ (variability + self._information) @ last.T
            return float(velocity @ np.linalg.solve(covariance, velocity)) >= WORTH_A_LOOK

        # what is nearly always enough to say no takes half the time
        if not is_worth(least_variability(scores)):
            return False
        return is_worth(pooled_variability(scores, A_inverse, np.ones(3)))

    def covariance(self, state: Vector) -> tuple[Matrix, float]:
        """Of the state, (k + 2, k + 2), and how much less is measured than thermal noise says."""
        scores = self.scores(state)
        A = curvature(scores) + self._information
        A_inverse = np.asarray(np.linalg.inv(A))
        pooled = pooled_variability(scores, A_inverse, scores.repetition) + self._information
        correlated = correlated_variability(scores) + self._information
        inflation = max(1.0, float(np.trace(pooled @ A_inverse)) / len(state))
        pairs = [covariance_of(A, B) for B in (pooled, correlated)]
        return max(pairs, key=lambda pair: float(np.trace(pair[-2:, -2:]))), inflation


def least_variability(scores: Scores) -> Matrix:
    """What `pooled_variability` never is below, (k, k)."""
    k = scores.H.shape[1]
    parts = [(scores.moment(m, k), scores.part(m)) for m in scores.measured]
    B: Matrix = sum((moment * (H.T @ H) for moment, H in parts), np.zeros((k, k)))
    return B
