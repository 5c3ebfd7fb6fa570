"""Tests of the units of ranges and bearings, independent of any estimate.

Theory of operation. A range in the wrong unit is a plausible number: 60 m become 0.6. But ranges
must change as the distance to *some* position does when the vehicle moves. So the ranges of the
last seconds are explained twice: in metres, and in each larger unit that is confused with metres,

    z_i = factor (|p - s_i| + offset) + e_i

with the position p anywhere within the radio's reach. The cost is what remains unexplained, (n / 2)
log var(e) in the radio's own numbers for n independent ones, plus the prior of the offset; a long
offset costs nothing, because long ranges are reflections. The test assumes neither a noise level
nor an estimate, which might be derived from the same wrong numbers. A factor is accepted at odds of
a thousand to one, and dropped when metres are again more probable.

In a smaller unit the ranges, noise included, become absurdly long or scatter by hundreds of metres,
which no reflection does. Guidance does not use such ranges, whatever their unit.

Ranges in steps (`range_step_m`) hardly change within seconds in any unit. The variance of a step
always counts as unexplained, so that nothing is concluded from it.

Bearings. Their scatter shows whether they are in radians. In degrees most bearings exceed half a
turn, which is rejected, or turn at random, because two degrees of noise are then more than a
hundred. A bearing that was divided instead hardly leaves zero, whatever the vehicle flies past: a
direction finder with less scatter than its own noise measures nothing.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.domain import PositionEnu
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.hypotheses import RING_COUNT
from companion.estimation.window.sandwich import MIN_MEASUREMENTS
from companion.geometry.coordinates import wrap_pi
from companion.kernel import Matrix, Vector


class Sample(NamedTuple):
    """Value as a radio reported it."""

    time_s: float
    value: float
    """Value in metres or radians, if the radio's unit is the right one."""
    sensor_enu_m: PositionEnu
    """Position of the sensor."""
    sigma: float = 0.0
    """Standard deviation in use, of a bearing."""


class Sampling(NamedTuple):
    """Samples that a check takes."""

    span_s: float
    """Span of a check; older samples are dropped."""
    least: int
    """Minimum number of samples in a check, which are kept even if they are older."""
    most: int
    every: int
    """Samples between two checks."""


FACTORS = (1e-3, 1e-2, 1.0 / 57.29577951308232)
"""Reported over true range in kilometres, in hundreds of metres, and after a conversion from
degrees to radians that was applied to ranges as well."""
RANGES = Sampling(span_s=3.0, least=MIN_MEASUREMENTS, most=48, every=8)
"""A vehicle at 3 m/s moves by 9 m in that span."""
WILD_M = 100.0
"""Largest range excess by reflections: quartiles of 3 s are up to 20 m apart in the flights of the
field and 11 m on recorded walks, so that half or twice as much decides alike there."""
DECISION_LOG_ODDS = math.log(1000.0)
"""Log odds at which a hypothesis about the radio is accepted: a unit, or an antenna.

A wrong decision costs the whole search, a late one a few seconds: on 41 recorded walks ranges in
metres reach 4.7, and log(1e5) recognises another unit 0.9 s later, at 4.7 s.
"""


@dataclass(frozen=True, slots=True)
class _Window:
    """Recent ranges and the positions where they were measured, oldest first."""

    range_m: Vector
    """Ranges as reported by the radio, (n,)."""
    sensor_enu_m: Matrix
    """Positions where they were measured, (n, 3)."""


class _Moments:
    """Moments of ranges (n,) and of distances to positions (p, n) for a factor's cost."""

    def __init__(self, range_m: Vector, distances_m: Matrix) -> None:
        self.count = len(range_m)
        self.range_m = float(range_m.mean())
        """Mean of the ranges, as reported by the radio."""
        self.distance_m: Vector = np.asarray(distances_m.mean(axis=1))
        self._range_about_m = range_m - self.range_m
        self._distance_about_m = distances_m - self.distance_m[:, None]
        self._range2 = float(self._range_about_m @ self._range_about_m)
        self._distance2: Vector = np.einsum(
            "ij,ij->i", self._distance_about_m, self._distance_about_m
        )
        self._product: Vector = self._distance_about_m @ self._range_about_m

    def residual2(self, factor: Matrix) -> Matrix:
        """Return the sum of squares that factors on the distances leave at each position.

        Factors of all positions are (n, 1), of each position (p,), and so is the result.
        Rounding of the sums is a millionth of the finest resolution squared where ranges spread by
        up to 100 m; guidance does not use wider ones anyhow.
        """
        left = self._range2 + factor * (factor * self._distance2 - 2.0 * self._product)
        return np.asarray(np.maximum(left, 0.0))

    @property
    def independent(self) -> float:
        """Effective number of independent measurements, about the best linear fit."""
        slope = self._product / np.maximum(self._distance2, 1e-12)
        best = int(np.argmin(self.residual2(slope)))
        residual = self._range_about_m - slope[best] * self._distance_about_m[best]
        total = float(residual @ residual)
        if total <= 0.0:
            return float(self.count)
        rho = max(float(residual[1:] @ residual[:-1]) / total, 0.0)
        return max(self.count * (1.0 - rho) / (1.0 + rho), 1.0)


class UnitCheck:
    """Monitor of the unit of one emitter's ranges."""

    def __init__(self, params: FilterParams, max_range_m: float) -> None:
        self._params = params
        self._noise2_m2 = max(1e-3, params.step_sigma_m) ** 2
        """Minimum unexplained variance, in the radio's own numbers: no radio resolves
        a thousandth."""
        angles = 2.0 * math.pi * np.arange(RING_COUNT) / RING_COUNT
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        count = 20  # each ring is 1.5 times as wide as the one before, to 2 km
        rings = np.geomspace(1.0, max_range_m, count)[:, None, None] * around
        self._around_m: Matrix = rings.reshape(-1, 2)
        """Trial positions relative to the vehicle, (p, 2)."""
        self._rejected_s = 0.0
        self._rejected_m = 0.0
        self.factor: float | None = None
        """Factor that the ranges seem to be multiplied by; None: no evidence for another than 1."""
        self.is_scattered = False
        """True if ranges scatter by more than guidance may use."""
        self.is_rejected = False
        """True if ranges must not be used, for either of the two reasons."""

    def judge(self, samples: Sequence[Sample]) -> None:
        """Test ranges, finite and positive, oldest first."""
        now_s, raw_m = samples[-1].time_s, [sample.value for sample in samples]
        middle_m = statistics.median(raw_m)
        sensor_enu_m = np.array([sample.sensor_enu_m for sample in samples])
        window = _Window(_clipped(raw_m, middle_m), sensor_enu_m)
        if not self.is_rejected:
            factor, log_ratio = self._likeliest(window, FACTORS, DECISION_LOG_ODDS)
            if log_ratio >= DECISION_LOG_ODDS:
                self.factor = factor
            self.is_scattered = self._is_scattered(window)
            self._rejected_s, self._rejected_m = now_s, middle_m
        elif samples[0].time_s > self._rejected_s:
            self._reconsider(window, middle_m)
        self.is_rejected = self.factor is not None or self.is_scattered

    def _reconsider(self, window: _Window, middle_m: float) -> None:
        """Accept ranges again when metres are more probable, or when their size has changed."""
        if self.factor is not None:
            _, log_ratio = self._likeliest(window, (self.factor,), 0.0)
            if log_ratio <= 0.0:
                self.factor = None
        # half way, as a ratio, to the largest ranges of another unit
        if self.is_scattered and middle_m < self._rejected_m * math.sqrt(max(FACTORS)):
            self.is_scattered = self._is_scattered(window)

    def _likeliest(
        self, window: _Window, factors: tuple[float, ...], limit: float
    ) -> tuple[float, float]:
        """Return the likeliest of some factors, and the log of its likelihood ratio to 1."""
        positions = self._around_m + window.sensor_enu_m[:, :2].mean(axis=0)
        tried = _Moments(window.range_m, self._distances_m(positions, window.sensor_enu_m))
        count = tried.independent
        *by_factor, in_metres = self._costs(tried, (*factors, 1.0), count)
        costs = [float(each.min()) for each in by_factor]
        best = int(np.argmin(costs))
        log_ratio = float(in_metres.min()) - costs[best]
        if log_ratio < limit:
            return factors[best], log_ratio
        # metres get the benefit of positions between the grid points; this only lowers the ratio
        start = positions[[int(np.argmin(in_metres))]]
        distances_m = self._distances_m(self._refined(start, window), window.sensor_enu_m)
        refined = _Moments(window.range_m, distances_m)
        best_in_metres = float(self._costs(refined, (1.0,), count).min())
        return factors[best], min(log_ratio, best_in_metres - costs[best])

    def _distances_m(self, positions_enu_m: Matrix, sensor_enu_m: Matrix) -> Matrix:
        """Return the distances of trial positions from the measuring positions, (p, n)."""
        up = sensor_enu_m[:, 2] - self._params.target_height_m
        ground2 = (positions_enu_m[:, :1] - sensor_enu_m[:, 0]) ** 2
        ground2 += (positions_enu_m[:, 1:] - sensor_enu_m[:, 1]) ** 2
        distances: Matrix = np.sqrt(ground2 + up**2)
        return distances

    def _refined(self, positions_enu_m: Matrix, window: _Window) -> Matrix:
        """Return the positions after Gauss-Newton steps with a free offset, (p, 2)."""
        refined = np.array(positions_enu_m)
        for _ in range(5):  # from within a cell of the grid; two steps decide alike on 41 walks
            distances_m = self._distances_m(refined, window.sensor_enu_m)
            for position, distance_m in zip(refined, distances_m, strict=True):
                partials = (position - window.sensor_enu_m[:, :2]) / np.maximum(distance_m, 1e-3)[
                    :, None
                ]
                H = np.column_stack([partials, np.ones(len(distance_m))])
                damped = H.T @ H + 1e-6 * len(distance_m) * np.eye(3)
                step = np.linalg.solve(damped, H.T @ (window.range_m - distance_m))[:2]
                limit_m = 0.5 * float(distance_m.mean())
                position += step * min(1.0, limit_m / max(float(np.hypot(*step)), 1e-9))
        return refined

    def _costs(self, tried: _Moments, factors: tuple[float, ...], count: float) -> Matrix:
        """Return the negative log-likelihood of each factor at each position, (factors, p)."""
        factor = np.array(factors)[:, None]
        residual2 = tried.residual2(factor) / tried.count
        cost: Matrix = 0.5 * count * np.log(residual2 + self._noise2_m2)
        cost += self._offset_cost(tried.range_m / factor - tried.distance_m)
        # m; without this limit 1 of 44 flights of the field held again and again for a wrong unit
        is_too_noisy = np.sqrt(residual2) / factor > 40.0
        cost[is_too_noisy & (factor != 1.0)] = math.inf
        return cost

    def _offset_cost(self, offset_m: Matrix) -> Matrix:
        """Return the negative log-prior of range offsets, reflections included."""
        p = self._params
        low_m = 0.0 if p.range_offset_min_m is None else min(p.range_offset_min_m, 0.0)
        high_m = p.range_offset_max_m or 0.0
        sigma_m = p.range_offset_sigma_m if p.range_offset_min_m is None else p.range_sigma_m
        below = np.minimum(offset_m - low_m, 0.0) / sigma_m
        above = np.maximum(offset_m - high_m - WILD_M, 0.0) / p.range_offset_sigma_m
        cost: Matrix = 0.5 * (below**2 + above**2)
        return cost

    def _is_scattered(self, window: _Window) -> bool:
        """Return True if the quartiles are farther apart than the vehicle's motion explains."""
        most_m = WILD_M + self._params.range_step_m
        if float(np.ptp(window.range_m)) <= most_m:
            return False
        low_m, high_m = np.quantile(window.range_m, [0.25, 0.75])
        path_m = float(np.sum(np.linalg.norm(np.diff(window.sensor_enu_m, axis=0), axis=1)))
        return float(high_m - low_m) - path_m > most_m


def _clipped(range_m: Sequence[float], middle_m: float) -> Vector:
    deviation_m = statistics.median([abs(each - middle_m) for each in range_m])
    most_m = middle_m + 4.0 * deviation_m  # 2.7 sigma of normal errors
    clipped: Vector = np.minimum(np.array(range_m), most_m)
    return clipped


BEARINGS = Sampling(span_s=4.0, least=MIN_MEASUREMENTS, most=96, every=4)
"""Their span is that of the bearings that are tested for being random, at up to 24 Hz."""


class BearingCheck:
    """Monitor of one emitter's bearings: quiet or random ones are in a wrong unit."""

    def __init__(self) -> None:
        self.is_quiet = False
        """True if bearings scatter less than their noise while the vehicle moves."""
        self.is_random = False
        """True if consecutive bearings are unrelated."""
        self.is_rejected = False
        """True if bearings must not be used, for either of the two reasons."""

    def judge(self, samples: Sequence[Sample]) -> None:
        """Test bearings as reported, oldest first."""
        self.is_random = _looks_random([sample.value for sample in samples])
        self._judge_quiet(samples)
        self.is_rejected = self.is_quiet or self.is_random

    def _judge_quiet(self, samples: Sequence[Sample]) -> None:
        bearings = [sample.value for sample in samples]
        sigma_rad = statistics.median([sample.sigma for sample in samples])
        middle = math.atan2(math.fsum(map(math.sin, bearings)), math.fsum(map(math.cos, bearings)))
        off = [wrap_pi(bearing - middle) for bearing in bearings]
        low, *_, high = statistics.quantiles(off, n=10, method="inclusive")
        # noise alone makes 2.6 sigma, and bearings of flights and recorded walks 2.0 at the least
        if high - low >= (1.0 / 6.0) * sigma_rad:
            self.is_quiet = False
            return
        path_m = 5.0  # at 30 m its end is 10 degrees off: more than any noise of the presets
        path_enu_m = [sample.sensor_enu_m for sample in samples]
        if sum(math.dist(before, after) for before, after in pairwise(path_enu_m)) >= path_m:
            self.is_quiet = True


def _looks_random(bearings: Sequence[float]) -> bool:
    if len(bearings) <= 32:  # the mean of so many cosines of random turns is known to 0.125
        return False
    cosines = [math.cos(after - before) for before, after in pairwise(bearings)]
    return statistics.fmean(cosines) < 0.1  # 0 if random; 0.36 with two outliers among five
