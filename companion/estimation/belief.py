"""Checkpoint of a tracker's belief as plain values, and the restart from it.

A belief is the set of hypotheses as a mixture of Gaussians. It does not contain the measurements:
after a restart they cannot be re-weighted, so the covariances are inflated instead, and grow with
the age of the checkpoint by a random walk, for a target or a local frame that drifted since then. A
belief that was wrong altogether is discarded like any other one: the measurements contradict it.

Everything that is read from a disk is validated first, see `Belief.problem`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import MAX_COORDINATE_M, PositionAccuracy
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.measurement_model import BEARING_OFFSET, RANGE_OFFSET
from companion.estimation.window.map_kernels import OlderEvidence
from companion.kernel import Matrix

RESTORED_VARIANCE_FACTOR = 2.0
"""Factor on every variance of a restored belief: standard deviations grow by 1.4.

Chosen: its measurements cannot be re-weighted; more would discard information.
"""
MAX_HYPOTHESES = 32
"""Maximum number of hypotheses in a checkpoint; a first range gives a ring of 24."""


@dataclass(frozen=True, slots=True)
class StoredHypothesis:
    """One hypothesis in plain values."""

    log_weight: float
    mean: tuple[float, ...]
    """State (n,), see `measurement_model`."""
    covariance: tuple[tuple[float, ...], ...]
    """Covariance of the state, (n, n)."""


@dataclass(frozen=True, slots=True)
class Belief:
    """Hypotheses of one target, as they are stored in a checkpoint."""

    emitter_id: int | None
    measurements: int
    places: tuple[StoredHypothesis, ...]
    """Best first; empty before the first measurement."""
    own: PositionAccuracy | None = None
    """Worst accuracy of the vehicle position while this was measured; None: not recorded."""
    raised_m: float = 0.0
    """Sum of the height steps of the vehicle's navigation since the heights stored here were
    valid."""

    def problem(self, size: int) -> str | None:
        """Return the reason why a state of `size` components cannot start from it, or None."""
        if not 0 < len(self.places) <= MAX_HYPOTHESES:
            return f"{len(self.places)} hypotheses"
        if self.measurements < 0 or not 0 <= (self.emitter_id or 0) <= 0xFFFF:
            return "an impossible count or emitter"
        own = self.own
        if own is not None and not (0.0 < own.horizontal_m < math.inf > own.vertical_m >= 0.0):
            return "an impossible position accuracy"
        if own is not None and not all(abs(m) <= MAX_COORDINATE_M for m in own.jumped_en_m):
            return "an impossible jump of the position"
        if not abs(self.raised_m) <= MAX_COORDINATE_M:
            return "an impossible height"
        problems = (_problem(stored, size) for stored in self.places)
        return next((problem for problem in problems if problem is not None), None)


def belief_of(
    hypotheses: Sequence[Hypothesis],
    emitter_id: int | None,
    measurements: int,
    own: PositionAccuracy | None = None,
    raised_m: float = 0.0,
) -> Belief | None:
    """Return the belief made of these hypotheses, best first; None without any."""
    if not hypotheses:
        return None
    best = hypotheses[0].log_weight
    stored = tuple(
        StoredHypothesis(
            float(hypothesis.log_weight - best),
            tuple(hypothesis.state.mean.tolist()),
            tuple(tuple(row) for row in _widest(hypothesis).tolist()),
        )
        for hypothesis in hypotheses[:MAX_HYPOTHESES]
    )
    return Belief(emitter_id, measurements, stored, own, raised_m)


def hypotheses_of(
    belief: Belief, age_s: float, now_s: float, params: FilterParams
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a belief of this age, with inflated covariances."""
    drift_m_per_sqrt_s = 0.1  # chosen: 1 m after 100 s, the drift of a local frame in that time
    walk = max(params.process_noise_m_per_sqrt_s, drift_m_per_sqrt_s)
    hypotheses = []
    for stored in belief.places:
        P = RESTORED_VARIANCE_FACTOR * np.array(stored.covariance)
        P[:2, :2] += walk**2 * max(age_s, 0.0) * np.eye(2)
        state = FilterState.of(now_s, np.array(stored.mean), P)
        hypotheses.append(Hypothesis(stored.log_weight, state))
    return tuple(hypotheses)


def as_evidence(hypothesis: Hypothesis, params: FilterParams) -> OlderEvidence:
    """Return a hypothesis as a prior of the window, less the prior that the window has already."""
    centre, sigmas = params.prior
    centre[RANGE_OFFSET : BEARING_OFFSET + 1] = 0.0
    own = np.diag((1.0 / sigmas) ** 2)
    own[:RANGE_OFFSET] = 0.0  # the window's position prior is flat
    held = np.linalg.inv(hypothesis.state.covariance)
    values, vectors = np.linalg.eigh(0.5 * (held + held.T) - own)
    information: Matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
    pull = held @ hypothesis.state.mean - own @ centre
    return OlderEvidence(information, pull, information)


def _widest(hypothesis: Hypothesis) -> Matrix:
    P = np.array(hypothesis.state.covariance)
    least = hypothesis.least_covariance_m2
    if least is None:
        return P
    return P * max(1.0, float(np.trace(least) / np.trace(P[:2, :2])))


def _problem(stored: StoredHypothesis, size: int) -> str | None:
    if len(stored.mean) != size or [len(row) for row in stored.covariance] != [size] * size:
        return "a state of another size"
    values = (stored.log_weight, *stored.mean, *(v for row in stored.covariance for v in row))
    if not all(math.isfinite(value) for value in values):
        return "a value that is not a number"
    if max(abs(stored.mean[0]), abs(stored.mean[1])) > MAX_COORDINATE_M:
        return "a position beyond the horizon"
    P = np.array(stored.covariance)
    scale = np.sqrt(np.abs(np.diag(P)))
    if np.abs(P - P.T).max() > 1e-6 * float(np.outer(scale, scale).max()):  # rounding leaves less
        return "a covariance that is not symmetric"
    if np.diag(P).max() > MAX_COORDINATE_M**2 or np.diag(P).min() <= 0.0:
        return "an impossible variance"
    normal = P / np.outer(scale, scale)
    return None if np.linalg.eigvalsh(normal)[0] > 0.0 else "a covariance that is not positive"
