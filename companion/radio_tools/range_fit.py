"""Offset, scale, noise and lag of the ranges that a radio reported at a known distance.

Theory of operation. `reported = offset + scale distance + excess + noise`. Within a cluster of
positions the excess is zero, or exponential; offset and noise are then those of the mixture, by
expectation-maximisation from the one-sided robust start, because a robust location alone would
settle on the long side. Clusters differ by the reflections that their ranges share: a second
one-sided robust fit goes over the clusters, each weighted by the scatter between clusters and its
own. A lag shifts ranges on the way out and on the way back to opposite sides of each cluster's
mean, so it is fitted within clusters, and does not affect offset and scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.radio_tools.clustered_fit import (
    MAD_TO_SIGMA,
    Figure,
    Labels,
    Matrix,
    PoseTrack,
    Seen,
    Vector,
    clusters_of,
    distances_of,
    linear_fit,
    mills,
    mirrored_sigma,
    ratio_figure,
    sigma_figure,
    solved,
    sums_of,
)

K_LONG = 1.5
"""Errors above this multiple of sigma count linearly, as in the estimator."""
K_CLUSTER = 2.5
"""Threshold for whole clusters; they are few, and the smaller one would pull their mean down."""
NLOS_SIGMAS = 3.0
CLUSTER_M = 3.0
"""Radius within which measurements are taken as from one position."""
REGION_M = 20.0
"""Radius within which clusters may share reflections; it widens intervals only."""
MIN_REGIONS = 6
MIN_PER_CLUSTER = 5
MIN_VALUES_TO_SPLIT = 20
MIN_SPEED_MPS = 0.5
MIN_SIGMA_M = 1e-3
HALF_FREEDOM = 0.37 / 3.5
"""Degrees of freedom of a mirrored deviation: of half the values, about a fitted mean."""


@dataclass(frozen=True, slots=True)
class RangeSamples:
    """Ranges as the radio reported them, (n,) each."""

    times_s: Vector
    """Times on the companion's clock, before any lag."""
    ranges_m: Vector


@dataclass(frozen=True, slots=True)
class RangeMixture:
    """Ranges less distance: a mean of each cluster, and the parameters they share."""

    means_m: Vector
    """Mean of each cluster, (clusters,)."""
    sigma_m: float
    free_share: Vector
    """Probability that each range is not reflected, (n,)."""


@dataclass(frozen=True, slots=True)
class RangeFit:
    """Result of fitting ranges."""

    offset_m: Figure
    scale: Figure
    is_scale_seen: bool
    """True if the distances separate a scale from an offset."""
    is_scale_used: bool
    """False if the offset is that at a scale of 1."""
    scatter_m: Figure
    """Standard deviation within a cluster."""
    between_m: float
    """Standard deviation of the error that a cluster shares."""
    sigma_m: Figure
    """Standard deviation of both together."""
    nlos_share: Figure
    nlos_excess_m: Figure | None
    distances_m: list[float]
    worst_m: tuple[float, float] | None
    """Distance and residual of a cluster that does not fit."""
    is_split: bool
    """True if ranges at the same position form two groups."""

    @property
    def effective_scale(self) -> float:
        """Scale that goes with the offset."""
        return self.scale.value if self.is_scale_used else 1.0


def fit_ranges(
    samples: RangeSamples, track: PoseTrack, lag_s: float, lag_half_s: float = 0.0
) -> RangeFit:
    """Fit offset and scale at a lag; half of its interval enters the offset's."""
    seen = track.seen(samples.times_s - lag_s)
    labels = clusters_of(seen.position_enu_m, CLUSTER_M)
    errors = samples.ranges_m - seen.distance_m
    ones = np.ones(len(errors))
    distances = means_of(seen.distance_m, ones, labels)
    centres = np.stack([means_of(column, ones, labels) for column in seen.position_enu_m.T], axis=1)
    start = _start(errors, distances, labels)
    slope = np.zeros(len(errors))
    for _ in range(2):  # a scale makes ranges differ within a cluster of finite width
        mixture = cluster_means(errors - slope, labels, start)
        start = mixture.means_m
        level = _level(mixture, distances, centres, labels)
        scale = level.scale if level.is_scale_observable else Figure(0.0, -math.inf, math.inf)
        slope = scale.value * (seen.distance_m - distances[labels])
    is_used = level.is_scale_observable and not scale.low <= 0.0 <= scale.high
    offset = level.offset_m if is_used else level.offset_alone_m
    if level.is_scale_observable and not is_used:  # at a scale of 1, which is as uncertain
        half = level.offset_m.half_width
        offset = Figure(offset.value, offset.value - half, offset.value + half)
    closing = float(np.mean(means_of(seen.closing_mps, ones, labels)))  # 0 with both ways
    half = math.hypot(offset.half_width, closing * lag_half_s)
    offset = Figure(offset.value, offset.value - half, offset.value + half)
    residuals = errors - offset.value - (scale.value * seen.distance_m if is_used else 0.0)
    scatter, total = _noise(errors - slope, residuals, mixture, seen, labels)
    between = math.sqrt(max(total.value**2 - scatter.value**2, 0.0))
    share, excess = _reflections(residuals, total.value, labels)
    return RangeFit(
        offset_m=offset,
        scale=Figure(1.0 + scale.value, 1.0 + scale.low, 1.0 + scale.high),
        is_scale_seen=level.is_scale_observable,
        is_scale_used=is_used,
        scatter_m=scatter,
        between_m=between,
        sigma_m=total,
        nlos_share=share,
        nlos_excess_m=excess,
        distances_m=distances_of(distances[np.bincount(labels) >= MIN_PER_CLUSTER]),
        worst_m=_worst(level, scatter.value, labels),
        is_split=is_split(errors - slope - mixture.means_m[labels], labels),
    )


def _start(errors: Vector, distances: Vector, labels: Labels) -> Vector:
    """Return initial means of the clusters: the Theil-Sen line through their lower quartiles."""
    order = np.argsort(labels, kind="stable")
    parts = np.split(errors[order], np.cumsum(np.bincount(labels))[:-1])
    quartiles = np.array([np.percentile(part, 25.0) for part in parts])
    first, second = np.triu_indices(len(quartiles), 1)
    apart = distances[second] - distances[first]
    used = np.abs(apart) > 1.0
    if not used.any():
        return quartiles
    slope = float(np.median((quartiles[second] - quartiles[first])[used] / apart[used]))
    line = slope * distances + np.median(quartiles - slope * distances)
    near_m = max(1.0, 3.0 * mirrored_sigma(quartiles - line))
    return np.asarray(np.clip(quartiles, line - near_m, line + near_m))


def means_of(values: Vector, weights: Vector, labels: Labels) -> Vector:
    """Return the weighted mean of each cluster."""
    means: Vector = sums_of(weights * values, labels) / np.maximum(sums_of(weights, labels), 1e-9)
    return means


def one_sided_weights(u: Vector, k_long: float = K_LONG) -> Vector:
    """Return weights of residuals in sigma: too long ones count linearly."""
    return np.where(u > k_long, k_long / np.maximum(u, k_long), 1.0)


def cluster_means(errors: Vector, labels: Labels, start: Vector) -> RangeMixture:
    """Return means of the clusters under a mixture of noise and exponential excess, by EM.

    Excess is distinguished from noise only if its mean is above two sigma.
    """
    means = start
    sigma = max(mirrored_sigma(errors - means[labels]), MIN_SIGMA_M)
    for _ in range(20):
        weights = one_sided_weights((errors - means[labels]) / sigma)
        means = means_of(errors, weights, labels)
        sigma = max(mirrored_sigma(errors - means[labels]), MIN_SIGMA_M)
    x = errors - means[labels]
    far = x[x > NLOS_SIGMAS * sigma]
    share = min(max(len(far) / len(x), 1e-3), 0.9)
    excess = max(float(far.mean()) if len(far) else 0.0, 2.0 * sigma)
    count, free = len(x), np.ones(len(x))
    for _ in range(80):
        u = np.clip((errors - means[labels]) / sigma, -50.0, 1e6)
        k = sigma / excess
        h = mills(u - k)
        log_odds = math.log(share * k / (1.0 - share)) - np.log(np.maximum(h, 1e-300))
        reflected = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0)))
        free = 1.0 - reflected
        bias = u - k + h
        noise = free * u + reflected * (k - h)
        square = free * u**2 + reflected * (u**2 - 2.0 * u * bias + 1.0 + (u - k) * bias)
        shift = means_of(noise, np.ones(count), labels)
        means = means + sigma * shift
        share = min(max(float(reflected.mean()), 1e-4), 0.95)
        mean_bias = float(np.sum(reflected * bias) / max(float(reflected.sum()), 1e-9))
        variance = float(np.mean(square) - np.mean(shift[labels] ** 2))
        old, sigma = sigma, sigma * math.sqrt(max(variance, 1e-6))
        excess = max(old * mean_bias, 2.0 * sigma)
        sigma = max(sigma, MIN_SIGMA_M)
        if abs(old - sigma) < 1e-5 * sigma and float(np.max(np.abs(shift))) < 1e-4:
            break
    clusters = int(labels.max()) + 1
    sigma *= math.sqrt(count / max(count - clusters, 1))
    return RangeMixture(means, sigma, free)


@dataclass(frozen=True, slots=True)
class _Level:
    """Linear fit over the clusters, whose ranges share an error each."""

    offset_alone_m: Figure
    """Offset at a scale of 1."""
    offset_m: Figure
    scale: Figure
    """Scale less 1."""
    is_scale_observable: bool
    between_m: float
    residuals_m: Vector
    """Residuals of the clusters, metres."""
    distances_m: Vector


def _level(mixture: RangeMixture, distances: Vector, centres: Matrix, labels: Labels) -> _Level:
    used = np.bincount(labels) >= MIN_PER_CLUSTER
    if used.sum() < 2:
        used = np.ones(len(distances), dtype=np.bool_)
    counts = sums_of(mixture.free_share, labels)[used]
    means, distances = mixture.means_m[used], distances[used]
    own = mixture.sigma_m**2 / np.maximum(counts, 1.0)
    regions = clusters_of(centres[used], REGION_M)
    ones = np.ones(len(means))
    rows = np.stack([ones, distances], axis=1)
    alone, between_alone = _robust_level(rows[:, :1], means, own)
    both, between = _robust_level(rows, means, own)
    is_observable = is_scale_observable(distances, math.hypot(mixture.sigma_m, math.sqrt(between)))
    fit = both if is_observable else alone
    return _Level(
        offset_alone_m=_widest(rows[:, :1], means, alone, regions, 0),
        offset_m=_widest(rows, means, both, regions, 0),
        scale=_widest(rows, means, both, regions, 1),
        is_scale_observable=is_observable,
        between_m=math.sqrt(between if is_observable else between_alone),
        residuals_m=means - rows[:, : len(fit.beta)] @ fit.beta,
        distances_m=distances,
    )


@dataclass(frozen=True, slots=True)
class _WeightedFit:
    beta: Vector
    weights: Vector


def _widest(rows: Matrix, means: Vector, fit: _WeightedFit, regions: Labels, index: int) -> Figure:
    """Return a parameter by clusters or by regions, the one with the wider interval."""
    each = np.arange(len(means), dtype=np.int64)
    groups = [each, regions] if int(regions.max()) + 1 >= MIN_REGIONS else [each]
    found = [linear_fit(rows, means, fit.weights, labels).figure(index) for labels in groups]
    return max(found, key=lambda figure: figure.half_width)


def _robust_level(rows: Matrix, means: Vector, own: Vector) -> tuple[_WeightedFit, float]:
    """Return the one-sided robust line through the clusters, and the variance between them."""
    count, parameters = rows.shape
    between = max(float(MAD_TO_SIGMA * np.median(np.abs(means - np.median(means)))) ** 2, 1e-8)
    weights = 1.0 / (own + between)
    for _ in range(30):
        beta = solved(rows, means, weights)
        residuals = means - rows @ beta
        robust = one_sided_weights(residuals / np.sqrt(own + between), K_CLUSTER)
        if count > parameters:
            excess = float((robust * residuals**2 - own).sum())
            between = max(excess / (count - parameters), 1e-8)
        weights = robust / (own + between)
    return _WeightedFit(beta, weights), between


def is_scale_observable(distances_m: Vector, sigma_m: float) -> bool:
    """Return True if offset and scale can be determined separately."""
    least, most = float(distances_m.min()), float(distances_m.max())
    return most >= 4.0 * least and most - least >= 10.0 * sigma_m and len(distances_m) > 3


def _noise(
    errors: Vector, residuals: Vector, mixture: RangeMixture, seen: Seen, labels: Labels
) -> tuple[Figure, Figure]:
    """Return the scatter while standing, and the noise at any position, by mirrored residuals.

    For the second every metre of the path has the same weight, however long the vehicle was there.
    """
    standing = seen.speed_mps < MIN_SPEED_MPS
    within = errors - mixture.means_m[labels]
    stays = clusters_of(seen.position_enu_m[standing], 0.3 * CLUSTER_M)
    if len(stays) > 20 * (int(stays.max(initial=-1)) + 1) > 0:
        own = cluster_means(errors[standing], stays, _medians(errors[standing], stays))
        within = errors[standing] - own.means_m[stays]
    cells = np.unique(np.round(seen.position_enu_m), axis=0, return_inverse=True)[1].reshape(-1)
    each = 1.0 / np.bincount(cells)[cells]
    scatter = max(mirrored_sigma(within), MIN_SIGMA_M)
    total = max(mirrored_sigma(residuals, each), scatter)
    shared = 1.0 - (scatter / total) ** 2
    clusters = int(labels.max()) + 1
    inner = HALF_FREEDOM * len(within)
    outer = HALF_FREEDOM * max(clusters - 2.0, 1.0)
    freedom = 1.0 / (shared**2 / outer + (1.0 - shared) ** 2 / (HALF_FREEDOM * float(each.sum())))
    return sigma_figure(scatter, inner), sigma_figure(total, freedom)


def _medians(errors: Vector, labels: Labels) -> Vector:
    return np.array([np.median(errors[labels == p]) for p in range(int(labels.max()) + 1)])


def _reflections(residuals: Vector, sigma_m: float, labels: Labels) -> tuple[Figure, Figure | None]:
    """Return the share of ranges longer by three sigma, and their mean excess, or None."""
    is_long = (residuals > NLOS_SIGMAS * sigma_m).astype(float)
    share = ratio_figure(sums_of(is_long, labels), sums_of(np.ones(len(residuals)), labels))
    share = Figure(share.value, max(share.low, 0.0), min(share.high, 1.0))
    if not is_long.any():
        return share, None
    return share, ratio_figure(sums_of(is_long * residuals, labels), sums_of(is_long, labels))


def _worst(level: _Level, scatter_m: float, labels: Labels) -> tuple[float, float] | None:
    """Return distance and residual of the worst cluster, m; None if it fits within the noise."""
    worst = int(np.argmax(np.abs(level.residuals_m)))
    far_m = float(level.residuals_m[worst])
    own_m = scatter_m / math.sqrt(float(np.bincount(labels).mean()))
    if abs(far_m) <= max(2.0 * level.between_m, 3.0 * own_m):
        return None
    return float(level.distances_m[worst]), far_m


def is_split(within: Vector, labels: Labels) -> bool:
    """Return True if most clusters have two groups of ranges more than 2 m apart.

    Reflections do not form clusters: an exponential excess is as wide as its mean.
    """
    split = clusters = 0
    for cluster in range(int(labels.max()) + 1):
        values = np.sort(within[labels == cluster])
        if len(values) < MIN_VALUES_TO_SPLIT:
            continue
        clusters += 1
        cut = 0.5 * float(values[0] + values[-1])
        for _ in range(20):
            is_far = values > cut
            if not 0.15 <= float(np.mean(is_far)) <= 0.85:
                break
            near, far = float(np.median(values[~is_far])), float(np.median(values[is_far]))
            cut, before = 0.5 * (near + far), cut
            if cut == before:
                break
        share = float(np.mean(is_far))
        if not 0.15 <= share <= 0.85:
            continue
        parts = (values[~is_far], values[is_far])
        widest = max(float(np.subtract(*np.percentile(part, [75.0, 25.0]))) for part in parts)
        apart = float(np.median(parts[1]) - np.median(parts[0]))
        split += apart > 2.0 and widest < apart / 3.0
    return split >= 2 and 2 * split > clusters
