"""Lag of ranges, from ways out and back.

Theory of operation. A late range is the distance from where the vehicle was; it is too short on the
way out and too long on the way back. Within one cluster of positions everything else is the same
both ways, so the lag is fitted to the differences between the ranges of a cluster, and to nothing
else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.radio_tools.clustered_fit import (
    Figure,
    Labels,
    Matrix,
    PoseTrack,
    Vector,
    clusters_of,
    linear_fit,
    mirrored_sigma,
    solved,
)
from companion.radio_tools.range_fit import (
    CLUSTER_M,
    MIN_REGIONS,
    MIN_SIGMA_M,
    MIN_SPEED_MPS,
    REGION_M,
    RangeSamples,
    means_of,
    one_sided_weights,
)

MAX_LAG_S = 2.0
SCAN_S = 2.5
"""Margin scanned beyond the plausible lags, so that a lag at the edge is recognised as none."""
SCAN_STEP_S = 0.1
MIN_MOVING = 20
MIN_CONTRAST_MPS = 0.3
"""Minimum difference of the vehicle's speed towards the point at the same position."""
LAG_SIGMA_S = 0.15
"""Largest sigma of a determined lag."""


def scan_lag(samples: RangeSamples, track: PoseTrack) -> float | None:
    """Return the lag, to 0.1 s, at which ranges of a cluster agree best; None if it stood still."""
    lags = np.arange(-SCAN_S, SCAN_S + 1e-9, SCAN_STEP_S)
    moving = track.seen(samples.times_s).speed_mps > MIN_SPEED_MPS
    moving &= track.knows(samples.times_s - SCAN_S) & track.knows(samples.times_s + SCAN_S)
    if moving.sum() < MIN_MOVING:
        return None
    times, ranges = samples.times_s[moving], samples.ranges_m[moving]
    spreads = []
    for lag in lags:
        seen = track.seen(times - lag)
        _, labels = np.unique(np.round(seen.position_enu_m / 4.0), axis=0, return_inverse=True)
        labels = labels.reshape(-1).astype(np.int64)
        errors = ranges - seen.distance_m
        order = np.lexsort((errors, labels))
        counts = np.bincount(labels)
        middles = errors[order][np.cumsum(counts) - counts + (counts - 1) // 2]
        spreads.append(np.abs(errors - middles[labels])[counts[labels] > 3])
    width = max(min(float(np.median(s)) if len(s) else math.inf for s in spreads), MIN_SIGMA_M)
    costs = [
        float(np.mean(np.sqrt(1.0 + (s / width) ** 2))) if len(s) else math.inf for s in spreads
    ]
    return float(lags[int(np.argmin(costs))]) if math.isfinite(min(costs)) else None


@dataclass(frozen=True, slots=True)
class _OnTheWay:
    """Ranges under way at some lag, each less the mean of its cluster."""

    errors_m: Vector
    closing_mps: Vector
    """Negated closing speed, m/s: the range error per second of lag."""
    weights: Vector
    position_enu_m: Matrix
    labels: Labels


def _on_the_way(samples: RangeSamples, track: PoseTrack, lag_s: float) -> _OnTheWay | None:
    times = samples.times_s - lag_s
    moving = track.knows(times) & (track.seen(times).speed_mps > MIN_SPEED_MPS)
    if moving.sum() < MIN_MOVING:
        return None
    seen = track.seen(times[moving])
    labels = clusters_of(seen.position_enu_m, CLUSTER_M)
    errors = samples.ranges_m[moving] - seen.distance_m
    weights = np.ones(len(errors))
    for _ in range(8):
        residuals = errors - means_of(errors, weights, labels)[labels]
        sigma = max(mirrored_sigma(residuals), MIN_SIGMA_M)
        weights = one_sided_weights(residuals / sigma)
    closing = means_of(seen.closing_mps, weights, labels)[labels] - seen.closing_mps
    residuals = errors - means_of(errors, weights, labels)[labels]
    return _OnTheWay(residuals, closing, weights, seen.position_enu_m, labels)


def fit_lag(samples: RangeSamples, track: PoseTrack) -> Figure | None:
    """Return the lag from flights out and back; None if they do not determine it."""
    lag_s = scan_lag(samples, track)
    if lag_s is None:
        return None
    way: _OnTheWay | None = None
    for _ in range(6):
        way = _on_the_way(samples, track, lag_s)
        if way is None or float(np.std(way.closing_mps)) < MIN_CONTRAST_MPS:
            return None
        rows = way.closing_mps[:, None]
        step_s = float(np.clip(solved(rows, way.errors_m, way.weights)[0], -0.3, 0.3))
        lag_s += step_s
        if abs(step_s) < 1e-4 or abs(lag_s) > SCAN_S:
            break
    assert way is not None
    regions = clusters_of(way.position_enu_m, REGION_M)
    groups = [way.labels, regions] if int(regions.max()) + 1 >= MIN_REGIONS else [way.labels]
    fits = [linear_fit(rows, way.errors_m, way.weights, labels) for labels in groups]
    found = max((fit.figure(0) for fit in fits), key=lambda figure: figure.half_width)
    if not found.sigma < LAG_SIGMA_S:
        return None
    return Figure(lag_s, lag_s - found.half_width, lag_s + found.half_width)
