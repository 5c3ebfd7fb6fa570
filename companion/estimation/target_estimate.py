"""Estimate of a set of hypotheses: the reported position, its R95, and the state.

R95 is the radius about the estimate that holds 95 % of the probability of all hypotheses. The
relative one, in the vehicle's own frame, decides about the state. The absolute one includes the
error of the vehicle position on the Earth, which all hypotheses share: its variance is added to
both axes of each covariance.

That error drifts, so that the frame of a search's mean is not the one that the vehicle flies in at
its end (`shared_errors`). No measurement reveals the drift, so it counts in both radii, but not in
the one that a search waits for.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence

import numpy as np

from companion.domain import EstimateState, TargetEstimate
from companion.estimation.hypotheses import AMBIGUOUS_PROBABILITY, Hypothesis, probabilities
from companion.estimation.measurement_model import BEARING_OFFSET, RANGE_OFFSET, RangingModel
from companion.estimation.window.shared_errors import NO_ERRORS, SharedErrors
from companion.kernel import Matrix, Vector, frozen, kernel

GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
"""Angle between neighbours on a spiral that covers a disc evenly."""

MIN_AXIS_RATIO = 4e-3
"""Lower limit of an ellipse's variance ratio; R95 differs by under 0.1 %."""
LOG_OUTSIDE = math.log(0.05)
"""Log of the probability outside R95."""
_COS2, _SIN2 = (ratio((np.arange(64) + 0.5) * (math.pi / 128.0)) ** 2 for ratio in (np.cos, np.sin))
"""Squared cosines and sines at the midpoints of 64 equal parts of a quarter turn, which hold by
symmetry for the whole turn."""

MAX_AMBIGUOUS = 3
"""Maximum number of distinct positions of an ambiguous state; with more it is searching.

Chosen: fewer call a search what a detour would resolve, more call a ring of positions ambiguous.
"""


def estimate_of(
    hypotheses: Sequence[Hypothesis],
    model: RangingModel,
    localised_r95_m: float,
    measurements: int,
    now_s: float,
    *,
    is_diverged: bool,
    shared: SharedErrors = NO_ERRORS,
) -> TargetEstimate:
    """Return the estimate of hypotheses, best first; `is_diverged`: the filter was reset lately."""
    weights, best, own = probabilities(hypotheses), hypotheses[0], shared.own
    own_sigma_m = shared.settled_own_m(model.own_sigma_m)
    covariances = [
        shared.within_reach(
            position_covariance_m2(h, own_sigma_m) + shared.lasting, h.position_enu_m
        )
        for h in hypotheses
    ]
    places = [h.state.mean[:2] for h in hypotheses]
    settled_m = r95_m = _r95_m(places, weights, covariances)
    if shared.wander.any():
        drift = shared.drift_m2(model.own_sigma_m)
        covariances = [
            shared.within_reach(covariance + drift, h.position_enu_m)
            for covariance, h in zip(covariances, hypotheses, strict=True)
        ]
        r95_m = max(settled_m, _r95_m(places, weights, covariances))
    state = EstimateState.DIVERGED if is_diverged else _state(weights, settled_m, localised_r95_m)
    is_ambiguous = state is EstimateState.AMBIGUOUS
    mean, P = best.state.mean, best.state.covariance
    height, scale = model.height_index, model.scale_index
    (a, b), (_, c) = covariances[0].tolist()
    on_earth = [covariance + own.effective_m**2 * np.eye(2) for covariance in covariances]
    if any(own.jumped_en_m):  # the position before may be the right one, just as the one after
        places += [place - np.array(own.jumped_en_m) for place in places]
        weights, on_earth = 0.5 * np.tile(weights, 2), 2 * on_earth
    return TargetEstimate(
        time_s=now_s,
        state=state,
        position_enu_m=best.position_enu_m,
        covariance_m2=((a, b), (b, c)),
        r95_m=r95_m,
        range_offset_m=float(mean[RANGE_OFFSET]),
        bearing_offset_rad=float(mean[BEARING_OFFSET]),
        measurements=measurements,
        alternative_enu_m=hypotheses[1].position_enu_m if is_ambiguous else None,
        height_m=float(mean[height]) if height >= 0 else model.height_m,
        height_sigma_m=math.sqrt(P[height, height]) if height >= 0 else None,
        range_scale=float(mean[scale]) if scale >= 0 else 0.0,
        own=own,
        # a blurred rival may come nearer, which must not make the absolute radius the smaller one
        absolute_r95_m=max(r95_m, _r95_m(places, weights, on_earth)),
        settled_r95_m=settled_m,
    )


class KeptEstimate:
    """Cache of the latest estimate, valid while all of its inputs are the same objects.

    A radius over several hypotheses takes a millisecond, and logs, ground stations and views
    request the estimate of every emitter far more often than a measurement changes it.
    """

    def __init__(self) -> None:
        self._made_of: tuple[object, ...] = ()
        self._estimate: TargetEstimate | None = None

    def get(self, make: Callable[[], TargetEstimate], *made_of: object) -> TargetEstimate:
        """Return the estimate, from `make` if one of the inputs `made_of` is another object."""
        is_same = len(made_of) == len(self._made_of) and all(
            map(operator.is_, made_of, self._made_of)
        )
        if self._estimate is None or not is_same:
            self._made_of, self._estimate = made_of, make()
        return self._estimate


def aside_of_m(estimate: TargetEstimate) -> float | None:
    """Return how far off its line the sensor should go to resolve an ambiguity; None without one.

    Mirror images are equally far from every point of the line. At a quarter of their distance to
    the side, one is nearer than the other by more than the errors of ranges.
    """
    other = estimate.alternative_enu_m
    if other is None:
        return None
    least_m = 10.0  # chosen: the errors of ranges hide the difference of a shorter way
    return max(least_m, 0.25 * math.dist(estimate.position_enu_m, other))


def position_covariance_m2(hypothesis: Hypothesis, own_sigma_m: float) -> Matrix:
    """Return the covariance of the target in the vehicle's frame, (2, 2), m^2.

    It is the filter's or, if wider, the window's, plus the error of the vehicle position.
    """
    covariance = hypothesis.state.covariance[:2, :2]
    least = hypothesis.least_covariance_m2
    if least is not None and least[0, 0] + least[1, 1] > covariance[0, 0] + covariance[1, 1]:
        covariance = least
    total: Matrix = covariance + own_sigma_m * own_sigma_m * np.eye(2)
    return total


def budget_of(
    estimate: TargetEstimate,
    best: Hypothesis,
    widths: Sequence[tuple[str, Matrix]],
    shared: SharedErrors,
    own_sigma_m: float,
) -> dict[str, float]:
    """Return R95 in metres after each term that widens it; the last one is the absolute R95.

    `widths` are the window's terms for the best hypothesis, with covariances (2, 2) so far.
    """
    present_m2 = position_covariance_m2(best, shared.settled_own_m(own_sigma_m))
    lasting_m2 = shared.within_reach(present_m2 + shared.lasting, best.position_enu_m)
    terms = [*widths, ("since the last solution", present_m2), ("height and stamps", lasting_m2)]
    return {name: r95_of_covariance_m(covariance_m2) for name, covariance_m2 in terms} | {
        "rival places": estimate.settled_r95_m,
        "vehicle position during the search": estimate.r95_m,
        "vehicle position on the Earth": estimate.absolute_r95_m,
    }


def _r95_m(places: Sequence[Vector], weights: Vector, covariances: Sequence[Matrix]) -> float:
    """Return R95 about the first place, of places (2,) with covariances (2, 2), metres."""
    if len(places) == 1:
        return r95_of_covariance_m(covariances[0])
    return r95_of_mixture_m(
        places[0], list(zip(weights.tolist(), places, covariances, strict=True))
    )


def _state(weights: Vector, r95_m: float, localised_r95_m: float) -> EstimateState:
    likely = sum(weight >= AMBIGUOUS_PROBABILITY for weight in weights.tolist())
    if 1 < likely <= MAX_AMBIGUOUS:
        return EstimateState.AMBIGUOUS
    if likely == 1 and r95_m <= localised_r95_m:
        return EstimateState.LOCALISED
    return EstimateState.SEARCHING


def r95_of_covariance_m(covariance_m2: Matrix) -> float:
    """Return the radius of the circle about the mean that holds 95 % of a 2-D Gaussian, metres.

    The probability outside radius R is the mean over directions of exp(-R^2 q / 2) / (q sqrt(det))
    with q the inverse variance in that direction. Its logarithm is convex in R^2 / 2, so Newton's
    method from below converges without overshoot.
    """
    (a, b), (_, c) = covariance_m2.tolist()
    middle, away = 0.5 * (a + c), math.hypot(0.5 * (a - c), b)
    high = middle + away
    if high <= 0.0:
        return 0.0
    return _radius_m(max((middle - away) / high, MIN_AXIS_RATIO), high)


@kernel
def _radius_m(ratio: float, high: float) -> float:
    """Return R95 of an ellipse whose variances are `high`, m^2, and `ratio` times that."""
    q = _COS2 + _SIN2 / ratio
    share = 1.0 / q
    share /= share.sum()
    half_square = 0.5 * 1.9**2  # below that of the narrowest ellipse, 1.96 sigma
    for _ in range(20):  # at most; four suffice for every ellipse
        outside = share * np.exp(-half_square * q)
        total = outside.sum()
        step = (math.log(total) - LOG_OUTSIDE) * total / (outside * q).sum()
        half_square += step
        if step < 1e-12:  # in units of the larger variance: rounding
            break
    return math.sqrt(2.0 * half_square * high)


@functools.cache
def _spiral(count: int) -> Matrix:
    """Return `count` equally probable points of a standard normal, (2, count)."""
    order = np.arange(count)
    radii = np.sqrt(-2.0 * np.log1p(-(order + 0.5) / count))
    turn_rad = GOLDEN_ANGLE_RAD * order
    return frozen(radii * np.stack([np.cos(turn_rad), np.sin(turn_rad)]))


def r95_of_mixture_m(
    centre_m: Vector, components: Sequence[tuple[float, Vector, Matrix]], rings: int = 24
) -> float:
    """Return the radius about `centre_m` (2,) that holds 95 % of a mixture of 2-D Gaussians.

    The radius is in metres. Components are (probability, mean (2,), covariance (2, 2)),
    probabilities summing to 1; each is represented by `2 * rings**2` equally probable points along
    a spiral, so that no two share a radius.
    """
    normal = _spiral(2 * rings**2)
    distances, weights = [], []
    for probability, mean, covariance in components:
        values, vectors = np.linalg.eigh(covariance)
        points = mean[:, None] + vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * normal)
        distances.append(np.hypot(*(points - centre_m[:, None])))
        weights.append(np.full(normal.shape[1], probability / normal.shape[1]))
    distance, weight = np.concatenate(distances), np.concatenate(weights)
    nearest_first = np.argsort(distance)
    reached = np.searchsorted(np.cumsum(weight[nearest_first]), 0.95)
    return float(distance[nearest_first][min(int(reached), distance.size - 1)])
