"""What a tracker believes, as plain values that outlive it, and how it begins again from them.

A belief is the hypotheses as a mixture of Gaussians. It is not the measurements: after a restart
they cannot be weighed anew, so what was concluded from them is doubted instead. Covariances are
inflated, and grow with the age by a random walk, for a target or a local frame that drifted while
nobody measured. A belief that was wrong altogether is given up as any other one: the measurements
contradict it.

Nothing that was read from a disk is believed unseen, see `Belief.problem`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import OwnAccuracy
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.measurement_model import BEARING_OFFSET, RANGE_OFFSET
from companion.estimation.window.older_evidence import OlderEvidence
from companion.kernel import Matrix

DOUBT = 2.0
"""Factor on every variance of a belief that comes back."""
DRIFT_M_PER_SQRT_S = 0.1
"""Random walk of a place that nobody measured, per axis: 1 m after 100 s."""
MAX_PLACES = 32
MAX_COORDINATE_M = 1e5
MAX_VARIANCE = 1e8
ASYMMETRY = 1e-6
"""Relative; rounding leaves less."""


@dataclass(frozen=True, slots=True)
class BelievedPlace:
    """One hypothesis in plain values."""

    log_weight: float
    mean: tuple[float, ...]
    """(n,), see `measurement_model`."""
    covariance: tuple[tuple[float, ...], ...]
    """(n, n)"""


@dataclass(frozen=True, slots=True)
class Belief:
    """The hypotheses of one target."""

    emitter_id: int | None
    measurements: int
    places: tuple[BelievedPlace, ...]
    """Best first; empty before the first measurement."""
    own: OwnAccuracy | None = None
    """Of the vehicle's place, at the worst; None: nobody kept it."""
    raised_m: float = 0.0
    """By how much the vehicle's heights were moved since the heights here were true."""

    def problem(self, size: int) -> str | None:
        """Why nothing can begin from it in a tracker with a state of `size` components, or None."""
        if not 0 < len(self.places) <= MAX_PLACES:
            return f"{len(self.places)} places"
        if self.measurements < 0 or not 0 <= (self.emitter_id or 0) <= 0xFFFF:
            return "an impossible count or emitter"
        own = self.own
        if own is not None and not (0.0 < own.horizontal_m < math.inf > own.vertical_m >= 0.0):
            return "an impossible accuracy of the own place"
        if not abs(self.raised_m) <= MAX_COORDINATE_M:
            return "an impossible height"
        problems = (_problem(place, size) for place in self.places)
        return next((problem for problem in problems if problem is not None), None)


def belief_of(
    hypotheses: Sequence[Hypothesis],
    emitter_id: int | None,
    measurements: int,
    own: OwnAccuracy | None = None,
    raised_m: float = 0.0,
) -> Belief | None:
    """The belief in some hypotheses, best first; None without any."""
    if not hypotheses:
        return None
    best = hypotheses[0].log_weight
    places = tuple(
        BelievedPlace(
            float(hypothesis.log_weight - best),
            tuple(hypothesis.state.mean.tolist()),
            tuple(tuple(row) for row in _widest(hypothesis).tolist()),
        )
        for hypothesis in hypotheses[:MAX_PLACES]
    )
    return Belief(emitter_id, measurements, places, own, raised_m)


def hypotheses_of(
    belief: Belief, age_s: float, now_s: float, params: FilterParams
) -> tuple[Hypothesis, ...]:
    """The hypotheses of a belief that nobody renewed for a while."""
    walk = max(params.process_noise_m_per_sqrt_s, DRIFT_M_PER_SQRT_S)
    hypotheses = []
    for place in belief.places:
        P = DOUBT * np.array(place.covariance)
        P[:2, :2] += walk**2 * max(age_s, 0.0) * np.eye(2)
        state = FilterState.of(now_s, np.array(place.mean), P)
        hypotheses.append(Hypothesis(place.log_weight, state))
    return tuple(hypotheses)


def as_evidence(hypothesis: Hypothesis, params: FilterParams) -> OlderEvidence:
    """A hypothesis as a prior of the window, without what the window's own prior says already."""
    centre, sigmas = params.prior
    centre[RANGE_OFFSET : BEARING_OFFSET + 1] = 0.0
    own = np.diag((1.0 / sigmas) ** 2)
    own[:RANGE_OFFSET] = 0.0  # the window takes the position's prior to be flat
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


def _problem(place: BelievedPlace, size: int) -> str | None:
    if len(place.mean) != size or [len(row) for row in place.covariance] != [size] * size:
        return "a state of another size"
    values = (place.log_weight, *place.mean, *(v for row in place.covariance for v in row))
    if not all(math.isfinite(value) for value in values):
        return "a value that is no number"
    if max(abs(place.mean[0]), abs(place.mean[1])) > MAX_COORDINATE_M:
        return "a place beyond the horizon"
    P = np.array(place.covariance)
    scale = np.sqrt(np.abs(np.diag(P)))
    if np.abs(P - P.T).max() > ASYMMETRY * float(np.outer(scale, scale).max()):
        return "a covariance that is not symmetric"
    if np.diag(P).max() > MAX_VARIANCE or np.diag(P).min() <= 0.0:
        return "an impossible variance"
    normal = P / np.outer(scale, scale)
    return None if np.linalg.eigvalsh(normal)[0] > 0.0 else "a covariance that is not positive"
