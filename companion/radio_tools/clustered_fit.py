"""Fits whose errors are correlated within a cluster, and the poses and tests of a calibration.

Theory of operation of the fits. Reflections and the antenna's orientation give all values of one
position the same error, so a thousand values at five positions have the information of five.
Variances are therefore those of the delete-one-cluster jackknife (CR3: G. W. Imbens and M. Kolesar,
Review of Economics and Statistics 98, 2016), and intervals are Student's with clusters less
parameters as degrees of freedom.

Theory of operation of the poses. Poses are functions of time, so that a lag is a shift of time.
Positions and roll and pitch are interpolated, yaw along its shorter way. The tests are recognised
by yaw and distance: a turn changes yaw without moving, a circle moves about the point without a
change of distance, a line has several distances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.domain import PositionEnu
from companion.io.radio_recording import TimedPose

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Labels = NDArray[np.int64]
Flags = NDArray[np.bool_]
NORMAL_975 = 1.959963984540054
MAD_TO_SIGMA = 1.4826
MAX_CONDITION = 1e10


@dataclass(frozen=True, slots=True)
class Figure:
    """Fitted figure with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return 0.5 * (self.high - self.low)

    @property
    def sigma(self) -> float:
        """Standard deviation of a normal distribution with this interval."""
        return self.half_width / NORMAL_975

    def times(self, factor: float) -> Figure:
        """Return the figure in another unit."""
        return Figure(factor * self.value, factor * self.low, factor * self.high)


def figure(value: float, sigma: float, freedom: float) -> Figure:
    """Return a figure with the interval of Student's t."""
    half = student_975(freedom) * sigma
    return Figure(value, value - half, value + half)


def student_975(freedom: float) -> float:
    """Return the 97.5 % quantile of Student's t (Abramowitz and Stegun, eq. 26.7.5)."""
    n, z = max(freedom, 1.0), NORMAL_975
    if n < 3.0:  # the series is inaccurate there
        exact = (12.706, 4.303, 3.182)
        return float(np.interp(n, (1.0, 2.0, 3.0), exact))
    terms = (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
    return z + sum(term / n**power for power, term in enumerate(terms, start=1))


def sigma_figure(sigma: float, freedom: float) -> Figure:
    """Return a standard deviation by chi-square (quantiles of Wilson and Hilferty, 1931)."""
    n = max(freedom, 1.0)
    spread = NORMAL_975 * math.sqrt(2.0 / (9.0 * n))
    high, low = (max(1.0 - 2.0 / (9.0 * n) + sign * spread, 0.05) ** 1.5 for sign in (1, -1))
    return Figure(sigma, sigma / high, sigma / low)


def clusters_of(points_m: Matrix, radius_m: float) -> Labels:
    """Return numbers from 0, (n,), of clusters of points (n, 3), by radius, then by nearest."""
    centres: list[Vector] = []
    last = points_m[:0].sum(axis=0) + math.inf
    for point in points_m:
        if float(np.dot(point - last, point - last)) <= radius_m**2:
            continue
        squares = [float(np.dot(point - centre, point - centre)) for centre in centres]
        if squares and min(squares) <= radius_m**2:
            last = centres[int(np.argmin(squares))]
        else:
            centres.append(point)
            last = point
    squares_m2 = [np.sum((points_m - centre) ** 2, axis=1) for centre in centres]
    nearest = np.argmin(np.array(squares_m2).reshape(len(centres), -1), axis=0)
    return numbered(nearest)


def numbered(values: Vector | Labels) -> Labels:
    """Return numbers from 0 that are equal where the values are."""
    _, labels = np.unique(values, return_inverse=True)
    return labels.reshape(-1).astype(np.int64)


def sums_of(values: Vector, labels: Labels) -> Vector:
    """Return the sum of each cluster."""
    count = int(labels.max(initial=-1)) + 1
    return np.asarray(np.bincount(labels, weights=values, minlength=count), dtype=np.float64)


def ratio_figure(parts: Vector, weights: Vector) -> Figure:
    """Return sum of parts over sum of weights, one of each per cluster, by the jackknife.

    If a few clusters have most of the variance, they are its degrees of freedom (F. E.
    Satterthwaite, Biometrics Bulletin 2, 1946).
    """
    used = weights > 0.0
    parts, weights = parts[used], weights[used]
    total, weight = float(parts.sum()), float(weights.sum())
    value, count = total / weight, len(parts)
    if count < 2:
        return Figure(value, -math.inf, math.inf)
    squares = ((total - parts) / np.maximum(weight - weights, 1e-12) - value) ** 2
    variance = (count - 1.0) / count * float(np.sum(squares))
    effective_count = float(np.sum(squares)) ** 2 / max(float(np.sum(squares**2)), 1e-300)
    return figure(value, math.sqrt(variance), min(count - 1.0, effective_count))


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Weighted least squares: values, covariance by clusters, and degrees of freedom."""

    beta: Vector
    covariance: Matrix
    freedom: float

    def figure(self, index: int) -> Figure:
        """Return one of the parameters."""
        sigma = math.sqrt(max(float(self.covariance[index, index]), 0.0))
        return figure(float(self.beta[index]), sigma, self.freedom)


def solved(rows: Matrix, values: Vector, weights: Vector) -> Vector:
    """Return the weighted least squares solution, (p,); of undetermined ones that of least norm."""
    scale = np.sqrt(np.maximum(np.mean(rows**2, axis=0), 1e-300))
    scaled = rows / scale
    weighted = scaled * weights[:, None]
    beta = np.linalg.lstsq(weighted.T @ scaled, weighted.T @ values, rcond=1e-10)[0]
    return np.asarray(beta / scale)


def linear_fit(rows: Matrix, values: Vector, weights: Vector, labels: Labels) -> LinearFit:
    """Fit values (n,) by rows (n, p), jackknifed by clusters; undetermined: infinite variance."""
    parameters = rows.shape[1]
    count = int(labels.max(initial=-1)) + 1
    scale = np.sqrt(np.maximum(np.average(rows**2, axis=0, weights=weights), 1e-300))
    scaled = rows / scale
    information = np.zeros((count, parameters, parameters))
    scores = np.zeros((count, parameters))
    for first in range(parameters):
        scores[:, first] = sums_of(weights * values * scaled[:, first], labels)
        for second in range(parameters):
            products = weights * scaled[:, first] * scaled[:, second]
            information[:, first, second] = sums_of(products, labels)
    total, score = information.sum(axis=0), scores.sum(axis=0)
    freedom = max(float(count - parameters), 1.0)
    undetermined = np.full((parameters, parameters), math.inf)
    if count <= parameters or np.linalg.cond(total) > MAX_CONDITION:
        beta = np.linalg.lstsq(total, score, rcond=1e-10)[0] / scale
        return LinearFit(beta, undetermined, freedom)
    beta = np.linalg.solve(total, score)
    rest = total - information
    if float(np.max(np.linalg.cond(rest))) > MAX_CONDITION:
        return LinearFit(beta / scale, undetermined, freedom)
    moved = np.linalg.solve(rest, (score - scores)[:, :, None])[:, :, 0] - beta
    covariance = (count - 1.0) / count * (moved.T @ moved) / np.outer(scale, scale)
    return LinearFit(beta / scale, covariance, freedom)


def mirrored_sigma(residuals: Vector, weights: Vector | None = None) -> float:
    """Return the standard deviation from residuals below zero; above are reflections, too."""
    is_below = residuals < 0.0
    below = -residuals[is_below]
    if not len(below):
        return 0.0
    if weights is None:
        return MAD_TO_SIGMA * float(np.median(below))
    order = np.argsort(below)
    reached = np.cumsum(weights[is_below][order])
    return MAD_TO_SIGMA * float(below[order][np.searchsorted(reached, 0.5 * reached[-1])])


def mills(z: Vector) -> Vector:
    """Return the inverse Mills ratio phi(z) / Phi(z) of the standard normal, for any z.

    Abramowitz and Stegun, eq. 26.2.17 (1e-7), and the continued fraction 26.2.14 below -3.
    """
    x = np.maximum(-z, 3.0)
    rest = np.zeros_like(x)
    for term in range(16, 0, -1):
        rest = term / (x + rest)
    tail = x + rest
    magnitude = np.abs(z)
    t = 1.0 / (1.0 + 0.2316419 * magnitude)
    series = (0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429)
    polynomial = np.zeros_like(t)
    for coefficient in reversed(series):
        polynomial = t * (coefficient + polynomial)
    density = np.exp(-0.5 * magnitude**2) / math.sqrt(2.0 * math.pi)
    upper = density * polynomial
    mass = np.where(z >= 0.0, 1.0 - upper, upper)
    return np.where(z < -3.0, tail, density / np.maximum(mass, 1e-300))


MAX_GAP_S = 1.5
"""Poses are not interpolated over longer gaps."""
STANDING_MPS = 0.5
TURN_RAD = math.radians(330.0)
CIRCLE_RAD = math.radians(270.0)
STEP_S = 0.25
MIN_DISTANCE_M = 1.0
"""Distances that are nearer to each other, or within a twentieth, are one."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The point as seen from the vehicle at some times, (n,) each."""

    position_enu_m: Matrix
    """Vehicle positions, (n, 3)."""
    distance_m: Vector
    """Slant distance to the point."""
    closing_mps: Vector
    """Rate of the distance, positive when it grows."""
    speed_mps: Vector
    north_rad: Vector
    """Direction to the point, clockwise from north."""


class PoseTrack:
    """Poses by time; `point_m` is the emitter's known position."""

    def __init__(self, poses: Sequence[TimedPose], point_m: PositionEnu) -> None:
        ordered = sorted(poses, key=lambda pose: pose.t_s)
        kept = [p for i, p in enumerate(ordered) if i == 0 or p.t_s > ordered[i - 1].t_s]
        self.times_s: Vector = np.array([pose.t_s for pose in kept])
        self._positions_enu_m: Matrix = np.array([pose.enu_m for pose in kept]).reshape(-1, 3)
        self.point_m = point_m
        oriented = [pose for pose in kept if pose.yaw_rad is not None]
        self._yaw_times_s: Vector = np.array([pose.t_s for pose in oriented])
        self._yaws_rad = np.unwrap(np.array([pose.yaw_rad for pose in oriented], dtype=float))
        tilts = [(pose.roll_rad or 0.0, pose.pitch_rad or 0.0) for pose in oriented]
        self._tilts_rad: Matrix = np.array(tilts).reshape(-1, 2)
        sigmas = [pose.sigma_m for pose in kept if pose.sigma_m is not None]
        self.sigma_m = float(np.median(sigmas)) if sigmas else None
        """Median accuracy of the vehicle's position; None: not reported."""

    @property
    def has_yaw(self) -> bool:
        """Return True if attitudes are known."""
        return len(self._yaw_times_s) > 1

    def knows(self, times_s: Vector, *, with_yaw: bool = False) -> Flags:
        """Return flags, (n,), of the times with poses near on both sides."""
        known = self._yaw_times_s if with_yaw else self.times_s
        if len(known) < 2:
            return np.zeros(len(times_s), dtype=np.bool_)
        after = np.clip(np.searchsorted(known, times_s), 1, len(known) - 1)
        is_inside = (times_s >= known[0]) & (times_s <= known[-1])
        is_near = known[after] - known[after - 1] <= MAX_GAP_S
        return np.asarray(is_inside & is_near)

    def position_enu_m(self, times_s: Vector) -> Matrix:
        """Return interpolated positions, (n, 3), m."""
        columns = [np.interp(times_s, self.times_s, column) for column in self._positions_enu_m.T]
        return np.stack(columns, axis=1)

    def yaw_rad(self, times_s: Vector) -> Vector:
        """Return the yaw clockwise from north, unwrapped, (n,)."""
        return np.interp(times_s, self._yaw_times_s, self._yaws_rad)

    def seen(self, times_s: Vector) -> Seen:
        """Return the point as seen from the vehicle."""
        position = self.position_enu_m(times_s)
        way = np.array(self.point_m) - position
        distance = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
        half_s = 0.2
        moved = self.position_enu_m(times_s + half_s) - self.position_enu_m(times_s - half_s)
        velocity = moved / (2.0 * half_s)
        closing = -np.sum(velocity * way, axis=1) / distance
        speed = np.linalg.norm(velocity, axis=1)
        return Seen(position, distance, closing, speed, np.arctan2(way[:, 0], way[:, 1]))

    def in_body(self, times_s: Vector) -> Matrix:
        """Return unit vectors to the point along nose, right and down, (n, 3)."""
        way = np.array(self.point_m) - self.position_enu_m(times_s)
        way /= np.maximum(np.linalg.norm(way, axis=1), 1e-6)[:, None]
        north, east, down = way[:, 1], way[:, 0], -way[:, 2]
        yaw = self.yaw_rad(times_s)
        roll, pitch = (
            np.interp(times_s, self._yaw_times_s, column) for column in self._tilts_rad.T
        )
        ahead = np.cos(yaw) * north + np.sin(yaw) * east
        right = -np.sin(yaw) * north + np.cos(yaw) * east
        nose = np.cos(pitch) * ahead - np.sin(pitch) * down
        below = np.sin(pitch) * ahead + np.cos(pitch) * down
        right, below = (
            np.cos(roll) * right + np.sin(roll) * below,
            -np.sin(roll) * right + np.cos(roll) * below,
        )
        return np.stack([nose, right, below], axis=1)


def distances_of(distances_m: Vector) -> list[float]:
    """Return the distinct distances, ascending."""
    found: list[float] = []
    for distance in np.sort(distances_m):
        if not found or distance - found[-1] > max(MIN_DISTANCE_M, 0.05 * found[-1]):
            found.append(float(distance))
    return found


@dataclass(frozen=True, slots=True)
class FieldTests:
    """Tests that the vehicle performed."""

    turned_rad: float = 0.0
    """Yaw over ground that it did not leave, both ways together."""
    circled_rad: float = 0.0
    """Angle flown about the point, at one distance."""
    circle_m: float = 0.0

    @property
    def has_turn(self) -> bool:
        """Return True if it turned once about itself."""
        return self.turned_rad >= TURN_RAD

    @property
    def has_circle(self) -> bool:
        """Return True if it went about the point."""
        return self.circled_rad >= CIRCLE_RAD


def find_tests(track: PoseTrack) -> FieldTests:
    """Find turn and circle by yaw and distance."""
    if len(track.times_s) < 2:
        return FieldTests()
    times = np.arange(track.times_s[0], track.times_s[-1], STEP_S)
    seen = track.seen(times)
    is_known = track.knows(times)
    stands = is_known & (seen.speed_mps < STANDING_MPS)
    turned = 0.0
    if track.has_yaw and len(times) > 1:
        steps = np.abs(np.diff(track.yaw_rad(times)))
        turned = float(steps[stands[1:] & stands[:-1]].sum())
    about = is_known & (seen.speed_mps > 2.0 * STANDING_MPS)
    about &= np.abs(seen.closing_mps) < 0.3 * seen.speed_mps
    if len(times) < 2 or not about.any():
        return FieldTests(turned)
    radius = float(np.median(seen.distance_m[about]))
    about &= np.abs(seen.distance_m - radius) < 0.2 * radius
    steps = np.diff(np.unwrap(seen.north_rad))
    circled = abs(float(steps[about[1:] & about[:-1]].sum()))
    return FieldTests(turned, circled, radius)
