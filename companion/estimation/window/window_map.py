"""Bounded-window MAP: the paper's objective over a thinned history, re-linearised.

A recursive filter linearises every measurement once, at the estimate of that time; started from a
ring of hypotheses it may converge next to the optimum with too small a covariance. The window keeps
up to N measurements that are spread over different views of the target, represents evicted ones as
a Gaussian prior (`OlderEvidence`), and solves

    min over x, offsets of  sum rho(u_i) + range_offset^2 / 2 s_r^2 + bearing_offset^2 / 2 s_b^2

by damped, re-weighted Gauss-Newton from the filter's own hypotheses and from fresh starts, which
rotate around the path from call to call: the cost of a call is bounded by N, and every optimum is
found in the end. Each optimum has a sandwich covariance.

A bearing from far away or a range from nearly one position leaves a valley that is steep at the
optimum and flat beyond it, where the curvature is too optimistic. Ranges from a line on which the
target lies leave one without curvature across, in which the cost rises all the same. So the cost is
evaluated along the most uncertain direction, out to the edge of the 95 % circle. Where it rises by
less than half of what the curvature predicts, the deviation is stretched to where it does; where it
rises by more than twice what the noise explains, the deviation shrinks to where it no longer does.

Paper: eq. (9). Deviation: when the window is full, it is thinned where the vehicle stayed longest
instead of dropping the oldest, because old measurements often hold the only view from the other
side, and a thousand from one position add little to a hundred.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Annotated

import msgspec
import numpy as np
import numpy.ma  # the first np.median would load it: 30 ms that a flight must not wait

from companion.domain import MAX_COORDINATE_M, Params
from companion.estimation.filters.target_filter import FilterParams, Inflation
from companion.estimation.innovations import GATE_SIGMAS
from companion.estimation.measurement_model import (
    BEARING,
    BEARING_OFFSET,
    COSINES,
    ELEVATION,
    POSSIBLE_SIDE,
    POWER,
    RANGE,
    RANGE_OFFSET,
    RangingModel,
    add_second_order,
    sight_of,
)
from companion.estimation.stepwise import Steps, Stepwise, passes
from companion.estimation.window.map_kernels import (
    DAMPING_START,
    MAX_ITERATIONS,
    POWER_WEIGHT,
    OlderEvidence,
    clipped,
    map_cost,
    map_descent,
    measured_innovations,
    normaliser,
    poses_of,
    row_partials,
    row_residuals,
    row_sigmas,
    values_of,
    without_values,
)
from companion.estimation.window.rivals import IMPROBABLE_LOG_RATIO, Optimum, log_ratio_of
from companion.estimation.window.sandwich import (
    Scores,
    SpatialNoises,
    Valley,
    correlated_variability,
    covariance_of,
    curvature,
    fit_covariance,
    is_all_white,
    pooled_variability,
    shares_of,
    spatial_variability,
    thermal_moment,
)
from companion.estimation.window.shadows import spatial_noises
from companion.estimation.window.shared_errors import ReceptionPath
from companion.kernel import Matrix, Vector

MAX_POSITION_SIGMA_M = 200.0
"""Standard deviation of a position above which an optimum is rejected, unless the radio reaches
farther, and that of a target within the reach of an unknown radio, m: of radios that reach some
hundred metres. With 100 or 400 m R95 of recorded walks stays, and that of a flight by ranges of a
phone is 3 to 4 % smaller."""
STEP_ITERATIONS = 4
"""Iterations between two interruptions of a solution, which do not change its result: fewer return
sooner and cost more."""
SAME_OPTIMUM_M = 0.3
"""Distance below which two optima are the same: far below any R95, far above the solver's
tolerance."""

Minima = list[tuple[float, Vector]]
"""Costs and states (k,) of local minima, the least first."""


class WindowParams(Params, frozen=True):
    """Size of the window and schedule of its solutions."""

    enabled: bool = True
    """True: the filter is checked and corrected by the window."""
    size: Annotated[int, msgspec.Meta(ge=32, le=4096)] = 512
    every: Annotated[int, msgspec.Meta(ge=1)] = 25
    starts: Annotated[int, msgspec.Meta(ge=1, le=64)] = 12
    """Directions of the fresh starts around the path."""


class WindowMap:
    """Solver of the window."""

    def __init__(self, filter_params: FilterParams) -> None:
        self._p = filter_params
        self._model = filter_params.model
        self._thresholds = filter_params.thresholds
        both = (BEARING, ELEVATION)
        self._directions = both if self._model.antenna == COSINES else (BEARING,)
        """Rows that are accepted or rejected together as one direction."""
        self.bounds = filter_params.bounds
        """Lower and upper bounds of the state, (2, k)."""
        self.vaguest_sigma_m = max(MAX_POSITION_SIGMA_M, filter_params.reach_m or 0.0)
        """Standard deviation above which an optimum is rejected, m."""
        self._thermal = tuple(thermal_moment(*pair) for pair in self._thresholds.tolist())
        mean, sigmas = filter_params.prior
        weights = (1.0 / sigmas) ** 2
        weights[:RANGE_OFFSET] = 0.0  # the position's prior is flat (paper, section IV-A)
        centre = np.array(mean)
        centre[RANGE_OFFSET] = filter_params.range_offset_m
        centre[BEARING_OFFSET] = 0.0
        self.prior: tuple[Matrix, Vector] = (np.diag(weights), weights * centre)
        """Information (k, k) of the state's Gaussian prior, and its pull, (k,)."""
        self.size = len(weights)
        self._has_spatial_errors = any(filter_params.spatial_sigmas)
        """True if the radio is known for spatially correlated errors."""
        self._reception: tuple[Matrix, ReceptionPath] | None = None
        """Cached reception path of the latest rows."""
        self._linearised: tuple[Matrix, Vector, RangingModel, Scores] | None = None
        """Rows, mean and model of the latest scores without a spread, and the scores."""
        self.spatial_noise: SpatialNoises = (None,) * len(self._thresholds)
        """Spatially correlated errors found by the latest solution."""

    def set_bearing_inflation(self, inflation: Inflation) -> None:
        """Set the inflation of bearings, against which the vehicle's position error is weighed."""
        self._model = self._model._replace(bearing_inflation=inflation[BEARING])

    def _update_weights(self, spatial_noise: SpatialNoises) -> bool:
        """Set the weights of measurements from their spatial noise; return True if they changed."""
        shares = shares_of(spatial_noise)
        before = (self._model.range_share, self._model.direction_share)
        self.spatial_noise = spatial_noise
        self._model = self._model._replace(
            range_share=shares[RANGE], direction_share=shares[BEARING]
        )
        return any(
            # by less the minimum hardly moves: with 0 to 0.7 R95 of recorded walks by at most 3 %
            abs(math.log(now / then)) > 0.2
            for now, then in zip(shares[:2], before, strict=True)
        )

    def _spatial_noise_at(self, rows: Matrix, mean: Vector) -> SpatialNoises:
        """Return the spatial noise by the residuals at `mean` (k,) and the radio's parameters."""
        prior = self.prior_with(rows, None)[0]
        return spatial_noises(rows, self.scores(rows, mean), self._p, prior)

    @Stepwise
    def optima(
        self,
        rows: Matrix,
        starts: Iterable[Vector],
        older: OlderEvidence | None = None,
        *,
        is_white: bool = False,
    ) -> Steps[list[Optimum]]:
        """Return the optima of `optima_at` from the minima reached from these states (k,)."""
        minima = yield from self.minima.steps(rows, starts, older)
        return (yield from self.optima_at.steps(rows, minima, older, is_white=is_white))

    @Stepwise
    def optima_at(
        self, rows: Matrix, minima: Minima, older: OlderEvidence | None, *, is_white: bool
    ) -> Steps[list[Optimum]]:
        """Return the acceptable minima as optima, best first, without the improbable ones.

        The window is solved again if the spatial noise differs from what was assumed.
        """
        if minima and self._update_weights(self._spatial_noise_at(rows, minima[0][1])):
            minima = yield from self.minima.steps(rows, [mean for _, mean in minima], older)
        optima: list[Optimum] = []
        for cost, mean in minima:
            scores = self.scores(rows, mean)
            best = optima[0] if optima else None
            noises, own_m = self.spatial_noise, self._model.own_sigma_m
            if best and log_ratio_of(cost, scores, best, noises, own_m) <= IMPROBABLE_LOG_RATIO:
                continue
            optimum = yield from self._optimum.steps(rows, mean, cost, scores, older, is_white)
            optima += [] if optimum is None else [optimum]
        return optima

    @Stepwise
    def minima(
        self, rows: Matrix, starts: Iterable[Vector], older: OlderEvidence | None
    ) -> Steps[Minima]:
        """Return the distinct minima reached from states (k,), best first."""
        found: Minima = []
        for start in starts:
            solution = yield from self.solve.steps(rows, start, older)
            if solution is None:
                continue
            mean, cost = solution
            if all(math.dist(mean[:2], other[:2]) > SAME_OPTIMUM_M for _, other in found):
                found.append((cost, mean))
        found.sort(key=lambda pair: pair[0])
        return found

    @Stepwise
    def solve(
        self, rows: Matrix, start: Vector, older: OlderEvidence | None = None
    ) -> Steps[tuple[Vector, float] | None]:
        """Return the minimum that a start leads to, with its cost; None if it diverges."""
        information, pull = self.prior_with(rows, older)
        prior = (self._thresholds, self.bounds, information, pull, self._model)
        mean, damping = np.array(start, dtype=np.float64), DAMPING_START
        for made in range(0, MAX_ITERATIONS, STEP_ITERATIONS):
            most = min(STEP_ITERATIONS, MAX_ITERATIONS - made)
            try:
                with np.errstate(all="ignore"):
                    mean, damping, count, is_over = map_descent(rows, mean, damping, most, *prior)
            except np.linalg.LinAlgError:
                return None
            yield passes(count, len(rows))
            if is_over:
                break
        # no radio reaches beyond: it has diverged, as with parallel bearings
        if not np.isfinite(mean).all() or np.abs(mean[:2]).max() > MAX_COORDINATE_M:
            return None
        cost = self._cost(rows, mean, older)
        return (mean, cost) if math.isfinite(cost) else None

    def scores(self, rows: Matrix, mean: Vector, spread_m2: float = 0.0) -> Scores:
        """Return the problem linearised at `mean` (k,), for curvature and covariance.

        `spread_m2` is the trace of the position covariance: nearer to the target than its root, a
        bearing is not a linear function of the position, and loses information accordingly.
        """
        last = self._linearised if spread_m2 == 0.0 else None
        if last is not None and last[0] is rows and last[1] is mean and last[2] == self._model:
            return last[3]
        with np.errstate(all="ignore"):
            at = np.array(mean)  # a writable copy, for which the kernels are compiled
            sigmas = row_sigmas(rows, at, self._model)
            if spread_m2 > 0.0:
                bent, poses = np.zeros_like(sigmas), poses_of(rows, self._model)
                sight = sight_of(at, poses, self._model)
                add_second_order(bent, spread_m2, spread_m2, sight, at, poses, self._model)
                for row in self._directions:
                    added = bent[row] / self._model.bearing_inflation
                    sigmas[row] = np.sqrt(sigmas[row] ** 2 + added)
            u = row_residuals(rows, at, sigmas, self._model)
            H = row_partials(rows, at, sigmas, self._model)
            is_measured = ~np.isnan(values_of(rows, len(u)))
        scores = Scores(u, clipped(u, self._thresholds), H, is_measured, self._thermal)
        if len(u) > POWER:
            scores = scores.weighed(rows[:, POWER_WEIGHT])
        if spread_m2 == 0.0:
            self._linearised = rows, mean, self._model, scores
        return scores

    def without_gross(self, rows: Matrix, mean: Vector) -> Matrix | None:
        """Return the rows with NaN for gross errors about a target at `mean` (k,).

        None: there are none, or they are more than a half.
        """
        scores = self.scores(rows, mean)
        u = scores.u
        impossible = {
            row: side * u[row] < -GATE_SIGMAS for row, side in POSSIBLE_SIDE.items() if row < len(u)
        }
        is_off = np.zeros(len(rows), dtype=bool)
        for row in self._directions:
            # a variance; of 16 recorded walks one R95 is 8 % smaller with 2, one 22 % larger with 8
            noise = min(max(1.0, scores.inflation(row, len(mean))), 4.0)
            is_off |= np.abs(u[row]) > GATE_SIGMAS * math.sqrt(noise)
        count = int(np.sum(np.any([*impossible.values(), is_off], axis=0)))
        if not 0 < count <= len(rows) // 2:
            return None
        gross = impossible | dict.fromkeys(self._directions, is_off)
        return without_values(rows, gross)

    def _profiled_cost(
        self, rows: Matrix, optimum: Vector, at: Vector, older: OlderEvidence | None
    ) -> Steps[float]:
        """Return the least cost at the distance of `at` from an optimum, in that direction.

        The other states, and the position across, are solved again, with a stiff prior along the
        direction.
        """
        away = at[:2] - optimum[:2]
        axis = np.zeros(self.size)
        axis[:2] = away / max(float(np.hypot(*away)), 1e-9)
        stiff = OlderEvidence.none(self.size)
        held = 1e6 * np.outer(axis, axis)  # 1/m^2: it stays within a millimetre
        if older is not None:
            stiff = older
        stiff = replace(stiff, information=stiff.information + held, pull=stiff.pull + held @ at)
        solution = yield from self.solve.steps(rows, at, stiff)
        return self._cost(rows, at if solution is None else solution[0], older)

    def _cost(self, rows: Matrix, mean: Vector, older: OlderEvidence | None) -> float:
        information, pull = self.prior_with(rows, older)
        with np.errstate(all="ignore"):
            sigmas = row_sigmas(rows, mean, self._model)
            innovations = measured_innovations(rows, mean, self._model)
            cost = map_cost(
                rows, innovations, mean, sigmas, self._thresholds, information, pull, self._model
            )
            return float(cost) + normaliser(rows, sigmas, self._model)

    def prior_with(self, rows: Matrix, older: OlderEvidence | None) -> tuple[Matrix, Vector]:
        """Return information and pull of all but the rows, the radio's reach included."""
        information, pull = self.prior
        if older is not None:
            information, pull = information + older.information, pull + older.pull
        if self._p.reach_m is None:
            return information, pull
        reception = self.reception(rows)
        near, towards = np.zeros((self.size, self.size)), np.zeros(self.size)
        weight = reception.sigma_m**-2
        near[[0, 1], [0, 1]], towards[:2] = weight, weight * np.array(reception.centre_enu_m)
        return information + near, pull + towards

    def reception(self, rows: Matrix) -> ReceptionPath:
        """Return the path of the rows (n, >= 2), and the spread of targets within radio reach."""
        if self._reception is None or self._reception[0] is not rows:
            positions = rows[:, :2]
            east_m, north_m = positions.mean(axis=0).tolist()
            reach_m = self._p.reach_m or MAX_POSITION_SIGMA_M
            sigma_m = math.sqrt(reach_m**2 + 0.5 * float(positions.var(axis=0).sum()))
            self._reception = rows, ReceptionPath((east_m, north_m), sigma_m)
        return self._reception[1]

    @Stepwise
    def _optimum(
        self,
        rows: Matrix,
        mean: Vector,
        cost: float,
        scores: Scores,
        older: OlderEvidence | None,
        is_white: bool,
    ) -> Steps[Optimum | None]:
        """Return the optimum with its covariance, or None if the position is unobservable.

        The larger of the white and the correlated covariance is used, unless residuals are known to
        be white: where correlation in a short window seems to improve an estimate, it is chance.
        """
        pass_count = 4  # for one covariance: scores, curvature and variabilities
        try:
            covariance, A, B = self._sandwich(rows, scores, older, is_white)
            ratios = np.linalg.eigvals(np.linalg.solve(A, B)).real
            inflation, noise = max(1.0, float(ratios.mean())), float(ratios.max())
            spread_m2 = float(np.trace(covariance[:2, :2]))
            has_directions = any(scores.counts[row] for row in self._directions)
            # each costs a covariance; with 3 or 12, R95 of recorded walks changes by at most 3 %
            for _ in range(6 if has_directions else 0):
                yield passes(pass_count, len(rows))
                bent = self.scores(rows, mean, spread_m2)
                covariance, A, _ = self._sandwich(rows, bent, older, is_white)
                before_m2, spread_m2 = spread_m2, float(np.trace(covariance[:2, :2]))
                if spread_m2 <= 1.1 * before_m2:  # a sigma by less than 5 %
                    break
        except np.linalg.LinAlgError:
            return None
        if np.linalg.matrix_rank(A, hermitian=True) < len(A):  # its inverse is rounding alone
            return None
        valley = Valley(
            partial(self._cost, rows, older=older),
            partial(self._profiled_cost, rows, mean, older=older),
            noise,
            is_all_white(self.spatial_noise),
            worth=passes(2, len(rows)),
        )
        yield passes(pass_count, len(rows))
        covariance = yield from fit_covariance(covariance, A, mean, valley)
        if math.sqrt(float(np.trace(covariance[:2, :2]))) > self.vaguest_sigma_m:
            return None
        noises = [max(1.0, scores.inflation(m, len(mean))) for m in range(len(scores.u))]
        return Optimum(mean, cost, covariance, inflation, scores, tuple(noises))

    def widths(
        self, rows: Matrix, mean: Vector, older: OlderEvidence | None, *, is_white: bool
    ) -> list[tuple[str, Matrix]]:
        """Return the terms that widen the position at `mean` (k,), with covariances (2, 2) so far.

        The rows may be more than those of the latest solution, whose weights stay as they are.

        Raises `LinAlgError` if the position is unobservable.
        """
        fitted = copy.copy(self)
        fitted._update_weights(fitted._spatial_noise_at(rows, mean))
        return fitted._widths(rows, mean, older, is_white)

    def _widths(
        self, rows: Matrix, mean: Vector, older: OlderEvidence | None, is_white: bool
    ) -> list[tuple[str, Matrix]]:
        scores = self.scores(rows, mean)
        A = curvature(scores) + self.prior_with(rows, older)[0]
        A_inverse = np.asarray(np.linalg.inv(A))
        fixed = self.prior_with(rows, None)[0] + (0.0 if older is None else older.variability)
        white = pooled_variability(scores, A_inverse, np.ones(len(scores.u))) + fixed
        widths = [
            ("thermal noise", np.linalg.inv(A[:2, :2])),
            ("offsets that are estimated", A_inverse[:2, :2]),
            ("noise as measured", covariance_of(A, white)[:2, :2]),
            ("errors that repeat", self._sandwich(rows, scores, older, is_white)[0][:2, :2]),
        ]
        optimum = self._optimum(rows, mean, 0.0, scores, older, is_white)
        if optimum is not None:
            widths.append(("curved and flat valleys", optimum.covariance[:2, :2]))
        return widths

    def _sandwich(
        self, rows: Matrix, scores: Scores, older: OlderEvidence | None, is_white: bool
    ) -> tuple[Matrix, Matrix, Matrix]:
        """Return covariance, curvature and variability of an optimum, each (k, k)."""
        A = curvature(scores, shares_of(self.spatial_noise)) + self.prior_with(rows, older)[0]
        fixed = self.prior_with(rows, None)[0] + (0.0 if older is None else older.variability)
        A_inverse = np.asarray(np.linalg.inv(A))
        shares, repetition = shares_of(self.spatial_noise), scores.repetition
        variabilities = []
        if not is_all_white(self.spatial_noise):
            variabilities.append(spatial_variability(scores, self.spatial_noise, A_inverse) + fixed)
        is_known = self._has_spatial_errors or scores.measured == [POWER]
        if not (is_known and variabilities):
            counted = repetition * np.square(shares)
            variabilities.append(pooled_variability(scores, A_inverse, counted) + fixed)
            if not is_white or (repetition > 1.0).any():
                variabilities.append(correlated_variability(scores, shares) + fixed)
        pairs = [(covariance_of(A, B), A, B) for B in variabilities]
        return max(pairs, key=lambda pair: float(np.trace(pair[0][:2, :2])))
