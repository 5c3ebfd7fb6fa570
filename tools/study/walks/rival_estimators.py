"""Estimators of other projects on a recorded walk, configured like the tracker's preset.

All estimate the target's position, range offset, range scale and bearing offset from one batch of
measurements, with the preset's noise, thresholds and priors, and return samples of the position:

    least_squares  scipy.optimize.least_squares, quadratic loss, several starting points
    huber          GTSAM factor graph, Huber loss on both sides
    cauchy         GTSAM factor graph, its asymmetric Cauchy loss: only ranges that are too long
    particles      Stone-Soup's particle filter, in the order of the measurements

Sources: gtsam.org (noiseModel.mEstimator); Stone-Soup 1.x (ParticleUpdater, SystematicResampler).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import approx_fprime
from scipy.optimize import least_squares as solve
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.linear import (
    CombinedLinearGaussianTransitionModel,
    RandomWalk,
)
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from companion.estimation.filters.target_filter import FilterParams
from companion.kernel import Matrix, Vector
from companion.replay.walk_replay import WalkRow

EAST, NORTH, OFFSET, SCALE, TURN = range(5)
STARTS = 8
"""Starting points on a ring about the middle of the path, at the median range."""
SAMPLES = 2000
"""Samples of a Gaussian, and particles."""
UNLIMITED_M = 1e3
"""Prior standard deviation of a position where the radio's reach is not configured."""
LEAST = 1e-6
"""Standard deviation of a value that is not estimated."""
DRIFT_M = 0.01
"""Random walk of the particles a root second, without which resampling leaves one of them."""
HUBER_K, CAUCHY_K = 1.345, 1.0
"""Thresholds of GTSAM's examples where the preset has none, in sigma."""


@dataclass(frozen=True, slots=True)
class Batch:
    """One target's measurements and the priors of the preset."""

    time_s: Vector
    agent_enu_m: Matrix
    """Positions of the antenna, (n, 3)."""
    ranges_m: Vector
    """NaN: not measured."""
    bearings_rad: Vector
    """Counter-clockwise from east; NaN: not measured."""
    range_sigma_m: Vector
    bearing_sigma_rad: Vector
    prior_mean: Vector
    prior_sigma: Vector
    height_m: float
    range_k: float
    bearing_k: float

    @classmethod
    def of(cls, rows: Sequence[WalkRow], params: FilterParams) -> Batch:
        """Return the measurements of one target with the preset's assumptions."""
        measured = [row.measurement for row in rows]
        agent = np.array([row.agent_enu_m for row in rows])
        ranges = np.array([m.range_m for m in measured], dtype=float)
        own = np.array(
            [params.own_position_sigma_m if r.own is None else r.own.effective_m for r in rows]
        )
        near_m = np.where(np.isfinite(ranges), np.maximum(ranges, 1.0), 1.0)
        sigma_rad = math.radians(params.bearing_sigma_deg)
        if not np.isfinite(ranges).any():  # the lever arm of an own error is about the reach
            near_m = np.full(len(rows), params.reach_m or 10.0)
        middle = agent[:, :2].mean(axis=0)
        spread_m = params.reach_m or UNLIMITED_M
        turn = math.radians(params.bearing_offset_sigma_deg)
        return cls(
            time_s=np.array([m.measured_at_s for m in measured]),
            agent_enu_m=agent,
            ranges_m=ranges,
            bearings_rad=np.array([m.bearing_enu_rad for m in measured], dtype=float),
            range_sigma_m=np.hypot(params.range_sigma_m, own),
            bearing_sigma_rad=np.hypot(sigma_rad, own / near_m),
            prior_mean=np.array([*middle, params.range_offset_m, 0.0, 0.0]),
            prior_sigma=np.array(
                [
                    *(spread_m, spread_m, params.range_offset_sigma_m),
                    *(max(params.range_scale_sigma, LEAST), turn),
                ]
            ),
            height_m=params.target_height_m,
            range_k=params.range_k_long or HUBER_K,
            bearing_k=params.bearing_k or HUBER_K,
        )

    def predicted(self, state: Vector, agent: Matrix) -> tuple[Vector, Vector]:
        """Return ranges and bearings of states (5, ...) from positions (n, 3)."""
        east, north = state[EAST] - agent[..., 0], state[NORTH] - agent[..., 1]
        up = self.height_m - agent[..., 2]
        distance = np.sqrt(east**2 + north**2 + up**2)
        ranges = (1.0 + state[SCALE]) * distance + state[OFFSET]
        return ranges, np.arctan2(north, east) + state[TURN]

    def residuals(self, state: Vector) -> tuple[Vector, Vector]:
        """Return measured minus predicted in sigma: of the ranges, of the bearings."""
        ranges, bearings = self.predicted(state, self.agent_enu_m)
        far = (self.ranges_m - ranges) / self.range_sigma_m
        apart = np.angle(np.exp(1j * (self.bearings_rad - bearings))) / self.bearing_sigma_rad
        return far[np.isfinite(far)], apart[np.isfinite(apart)]

    def starts(self) -> list[Vector]:
        """Return the starting points."""
        radius_m = float(np.nanmedian(self.ranges_m)) if np.isfinite(self.ranges_m).any() else 5.0
        courses = np.arange(STARTS) * 2.0 * math.pi / STARTS
        starts = np.tile(self.prior_mean, (STARTS, 1))
        starts[:, :2] += radius_m * np.stack([np.cos(courses), np.sin(courses)], axis=1)
        return list(starts)


def _drawn(mean: Vector, covariance: Matrix, rng: np.random.Generator) -> Matrix:
    return rng.multivariate_normal(mean[:2], covariance[:2, :2], SAMPLES)


def least_squares(batch: Batch, rng: np.random.Generator) -> Matrix:
    """Return samples (SAMPLES, 2) of the best quadratic fit."""

    def values(state: Vector) -> Vector:
        """Return all residuals and those of the priors."""
        prior = (state - batch.prior_mean) / batch.prior_sigma
        return np.concatenate([*batch.residuals(state), prior])

    scale = np.minimum(batch.prior_sigma, 1e2)
    fits = [solve(values, start, x_scale=scale) for start in batch.starts()]
    best = min(fits, key=lambda fit: float(fit.cost))
    return _drawn(best.x, np.linalg.inv(best.jac.T @ best.jac), rng)


def factor_graph(batch: Batch, rng: np.random.Generator, *, is_one_sided: bool) -> Matrix:
    """Return samples (SAMPLES, 2) of GTSAM's fit with a robust loss."""
    kinds = gtsam.noiseModel.mEstimator
    scalar = kinds.Base.ReweightScheme.Scalar
    one_sided = kinds.AsymmetricCauchy.Create(CAUCHY_K, scalar)
    losses = [
        one_sided if is_one_sided else kinds.Huber.Create(batch.range_k, scalar),
        kinds.Huber.Create(batch.bearing_k, scalar),
    ]
    graph = gtsam.NonlinearFactorGraph()
    prior = gtsam.noiseModel.Diagonal.Sigmas(batch.prior_sigma)
    graph.add(gtsam.PriorFactorVector(0, batch.prior_mean, prior))
    for which, loss in enumerate(losses):
        size = len(batch.residuals(batch.prior_mean)[which])
        if size:
            noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Unit.Create(size))
            graph.add(gtsam.CustomFactor(noise, [0], _factor(batch, which)))
    fits = []
    for start in batch.starts():
        values = gtsam.Values()
        values.insert(0, start)
        fits.append(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())
    best = min(fits, key=graph.error)
    covariance = gtsam.Marginals(graph, best).marginalCovariance(0)
    return _drawn(best.atVector(0), covariance, rng)


def _factor(batch: Batch, which: int) -> Callable[[Any, Any, Any], Vector]:
    def error(_: Any, values: Any, jacobians: Any) -> Vector:
        """Return predicted minus measured in sigma, as GTSAM does, and fill in the Jacobian."""
        state = np.asarray(values.atVector(0), dtype=float)
        if jacobians is not None:
            jacobians[0] = -approx_fprime(state, lambda at: batch.residuals(at)[which])
        return -batch.residuals(state)[which]

    return error


class _WalkMeasurement(NonLinearGaussianMeasurement):  # type: ignore[misc]  # it has no types
    """Range, bearing or both at one time, as Stone-Soup requires."""

    batch: Any = None
    row: int = 0
    is_measured: Any = None

    @property
    def ndim_meas(self) -> int:
        """Return the number of measured values."""
        return int(np.sum(self.is_measured))

    def function(self, state: Any, *_: Any, **__: Any) -> Any:
        """Return the prediction of every particle."""
        at = np.asarray(state.state_vector, dtype=float)
        values = np.stack(self.batch.predicted(at, self.batch.agent_enu_m[self.row]))
        values[1] = self.batch.bearings_rad[self.row] - np.angle(
            np.exp(1j * (self.batch.bearings_rad[self.row] - values[1]))
        )
        return StateVectors(values[self.is_measured])


def particles(batch: Batch, rng: np.random.Generator) -> Matrix:
    """Return the particles' positions (SAMPLES, 2) after the last measurement."""
    began = datetime(2000, 1, 1)  # noqa: DTZ001  Stone-Soup compares naive times
    walk = [RandomWalk(DRIFT_M**2)] * 2 + [RandomWalk(1e-8)] * 3
    predictor = ParticlePredictor(CombinedLinearGaussianTransitionModel(walk))
    updater = ParticleUpdater(None, ESSResampler())
    drawn = _first_particles(batch, rng)
    state = ParticleState(
        StateVectors(drawn), weight=np.full(SAMPLES, 1.0 / SAMPLES), timestamp=began
    )
    for row, time_s in enumerate((batch.time_s - batch.time_s[0]).tolist()):
        values = np.array([batch.ranges_m[row], batch.bearings_rad[row]])
        is_measured = np.isfinite(values)
        variances = np.array([batch.range_sigma_m[row], batch.bearing_sigma_rad[row]])[is_measured]
        model = _WalkMeasurement(5, tuple(range(5)), np.diag(variances**2))
        model.batch, model.row, model.is_measured = batch, row, is_measured
        at = began + timedelta(seconds=time_s)
        detection = Detection(
            StateVector(values[is_measured]), timestamp=at, measurement_model=model
        )
        predicted = predictor.predict(state, timestamp=at)
        state = updater.update(SingleHypothesis(predicted, detection))
    weights = np.asarray(state.weight, dtype=float)
    chosen = rng.choice(SAMPLES, SAMPLES, p=weights / weights.sum())
    found: Matrix = np.asarray(state.state_vector, dtype=float)[:2, chosen].T
    return found


def _first_particles(batch: Batch, rng: np.random.Generator) -> Matrix:
    """Return particles (5, SAMPLES) of the prior, on a ring about the first measured range."""
    drawn = batch.prior_mean[:, None] + batch.prior_sigma[:, None] * rng.standard_normal(
        (5, SAMPLES)
    )
    measured = np.flatnonzero(np.isfinite(batch.ranges_m))
    if len(measured):
        first = measured[0]
        noise = batch.range_sigma_m[first] * rng.standard_normal(SAMPLES)
        distance = (batch.ranges_m[first] - drawn[OFFSET] + noise) / (1.0 + drawn[SCALE])
        course = rng.uniform(0.0, 2.0 * math.pi, SAMPLES)
        ring = np.maximum(distance, 0.0) * np.stack([np.cos(course), np.sin(course)])
        drawn[:2] = batch.agent_enu_m[first, :2, None] + ring
    return drawn


RIVALS: dict[str, Callable[[Batch, np.random.Generator], Matrix]] = {
    "least squares": least_squares,
    "GTSAM, Huber": partial(factor_graph, is_one_sided=False),
    "GTSAM, asymmetric Cauchy": partial(factor_graph, is_one_sided=True),
    "Stone-Soup, particles": particles,
}
"""Estimators of others by name."""
