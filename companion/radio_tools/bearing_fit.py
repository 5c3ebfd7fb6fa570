"""Sign, fold, mount, lag and noise of the bearings that a radio reported of a known point.

Theory of operation. A device counts clockwise or counter-clockwise from a boresight at some angle
to the vehicle's nose, and an emitter behind it is reported there or, by two antennas, as its mirror
image in front. Each of the four combinations is tried at every lag; the one whose residuals have
the largest resultant length is chosen if it is clearly the best. Around it mount and lag are
fitted robustly, together with harmonics over the angle (the antenna's elements, the vehicle's body)
and, if a circle was flown, over the heading (the compass).

For two antennas a reversed sign is the same as a boresight to the other side; it is assumed to be
in front, which for their measurement, a direction cosine, makes no difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.radio_tools.clustered_fit import (
    MAD_TO_SIGMA,
    Figure,
    Flags,
    Labels,
    LinearFit,
    Matrix,
    PoseTrack,
    Vector,
    figure,
    linear_fit,
    numbered,
    ratio_figure,
    solved,
    sums_of,
)

SCAN_S = 2.5
SCAN_STEP_S = 0.1
MAX_SCANNED = 500
"""Bearings of the scan; the fit takes all."""
MIN_RESULTANT = 0.5
MIN_FOLDED_RESULTANT = 0.8
"""Minimum resultant length of folded angles; even one that stands still has 0.64."""
UNLIKELY_PER_S = 1e-3
"""Penalty per second, so that of equally good lags the smallest is chosen."""
MIN_LEAD = 0.15
"""Minimum difference by which the resultant of one sign must be the longer."""
NORTH_LEAD = 0.05
"""The same lead for bearings from north, most of which may have one direction."""
HUBER_K = 1.5
SECTORS = 12
MIN_SECTORS = 8
PIECE_S = 5.0
VIEW_STEP_RAD = math.radians(15.0)
MIN_PER_STEP = 8
WIDER = 2.5
"""Minimum ratio of the scatter of bearings beyond the field of view to that in its middle."""
CLIP_SIGMAS = 3.0
LAG_SIGMA_S = 0.15
MIN_SIGMA_RAD = 1e-4


@dataclass(frozen=True, slots=True)
class BearingSamples:
    """Bearings as the radio reported them, (n,) each."""

    times_s: Vector
    bearings_rad: Vector
    is_array: bool = False
    """True if they are arcsines of direction cosines."""


@dataclass(frozen=True, slots=True)
class BearingSense:
    """Sense of a device's angles, as the scan found it."""

    sign: int
    is_folded: bool
    mount_rad: float
    lag_s: float
    resultant: float
    other_resultant: float
    """The best of the other sign."""

    @property
    def follows(self) -> bool:
        """Return True if the bearing turns with the vehicle."""
        least = MIN_FOLDED_RESULTANT if self.is_folded else MIN_RESULTANT
        return self.resultant >= least


@dataclass(frozen=True, slots=True)
class BearingFit:
    """Mount, lag and noise of the bearings that fit a calibration run best."""

    sense: BearingSense
    mount_rad: Figure
    """Boresight clockwise from the nose, including the constant error of the compass."""
    lag_s: Figure | None
    sigma_rad: Figure
    """Standard deviation about sign and mount; of a folded antenna that of the direction cosine, so
    at boresight."""
    gross_share: float
    """Share of outliers."""
    field_of_view_rad: float
    """Whole angle of the field of view; beyond it bearings are worse."""
    behind_share: float
    """Share of bearings of a point behind the boresight."""
    waves_rad: tuple[float, float] | None
    """Amplitudes over the angle, once and twice a turn; None: no whole turn."""
    compass_rad: float | None
    """Amplitude over the heading; None: inseparable from the waves."""
    covered_rad: float
    """Angle around the vehicle at which the point was seen."""


def wrapped(angles_rad: Vector) -> Vector:
    """Return angles wrapped to [-pi, pi)."""
    return (angles_rad + math.pi) % (2.0 * math.pi) - math.pi


def predicted(body: Matrix, mount_rad: float, *, is_folded: bool) -> Vector:
    """Return a device's clockwise angles, (n,), of body unit vectors (n, 3): nose, right, down."""
    if not is_folded:
        return wrapped(np.arctan2(body[:, 1], body[:, 0]) - mount_rad)
    right = math.cos(mount_rad) * body[:, 1] - math.sin(mount_rad) * body[:, 0]
    return np.arcsin(np.clip(right, -1.0, 1.0))


def covered_rad(track: PoseTrack, times_s: Vector) -> float:
    """Return the angle about the nose, of a whole turn, at which the point was seen."""
    body = track.in_body(times_s)
    angles = np.arctan2(body[:, 1], body[:, 0])
    bins = np.bincount(((angles + math.pi) / (2.0 * math.pi) * 36.0).astype(int) % 36, minlength=36)
    return 2.0 * math.pi * float(np.mean(bins > 0))


def find_sense(
    samples: BearingSamples, track: PoseTrack, *, is_by_north: bool = False
) -> BearingSense:
    """Return sign and fold, and the starting values of mount and lag.

    Bearings from north are not folded, and are clockwise unless that is clearly wrong.
    """
    known = track.knows(samples.times_s - SCAN_S, with_yaw=True)
    known &= track.knows(samples.times_s + SCAN_S, with_yaw=True)
    if known.sum() < 20:
        known = track.knows(samples.times_s, with_yaw=True)
    step = max(1, int(known.sum()) // MAX_SCANNED)
    times, said = samples.times_s[known][::step], samples.bearings_rad[known][::step]
    best: dict[tuple[int, bool], tuple[float, float, float]] = {}
    for lag in np.arange(-SCAN_S, SCAN_S + 1e-9, SCAN_STEP_S):
        body = track.in_body(times - lag)
        for sign in (1, -1):
            tries: dict[bool, tuple[float, float]] = {}
            if not is_by_north:
                tries[True] = _folded_mount(sign * said, body)
            if not samples.is_array:
                tries[False] = _open_mount(sign * said, body)
            for is_folded, (resultant, mount) in tries.items():
                key = (sign, is_folded)
                resultant -= UNLIKELY_PER_S * abs(float(lag))
                if resultant > best.get(key, (-9.0, 0.0, 0.0))[0]:
                    best[key] = (resultant, mount, float(lag))
    lead = NORTH_LEAD if is_by_north else 0.0
    chosen = max(best, key=lambda key: best[key][0] + 0.02 * (not key[1]) + lead * (key[0] > 0))
    sign, is_folded = chosen
    resultant, mount, lag_s = best[chosen]
    other = best[(-sign, is_folded)][0]
    return BearingSense(sign, is_folded, mount, lag_s, resultant, other)


def _open_mount(turned: Vector, body: Matrix) -> tuple[float, float]:
    mean = complex(np.mean(np.exp(1j * (np.arctan2(body[:, 1], body[:, 0]) - turned))))
    return abs(mean), math.atan2(mean.imag, mean.real)


def _folded_mount(turned: Vector, body: Matrix) -> tuple[float, float]:
    best = (-1.0, 0.0)
    for mount_deg in range(-85, 91, 10):
        mount = math.radians(mount_deg)
        errors = turned - predicted(body, mount, is_folded=True)
        best = max(best, (float(abs(np.mean(np.exp(1j * errors)))), mount))
    return best


class _FitProblem:
    """Residuals of the bearings, reported less predicted, by mount and lag."""

    def __init__(self, samples: BearingSamples, track: PoseTrack, sense: BearingSense) -> None:
        self.track, self.sense = track, sense
        known = track.knows(samples.times_s - sense.lag_s, with_yaw=True)
        self.times_s = samples.times_s[known]
        self.said_rad = sense.sign * samples.bearings_rad[known]

    def within(self, used: Flags) -> None:
        """Keep a subset of the bearings."""
        self.times_s, self.said_rad = self.times_s[used], self.said_rad[used]

    def errors(self, mount_rad: float, lag_s: float) -> Vector:
        """Return the residuals as angles, or as direction cosines if folded."""
        body = self.track.in_body(self.times_s - lag_s)
        seen = predicted(body, mount_rad, is_folded=self.sense.is_folded)
        if self.sense.is_folded:
            return np.sin(self.said_rad) - np.sin(seen)
        return wrapped(self.said_rad - seen)

    def off_boresight(self, mount_rad: float, lag_s: float) -> Vector:
        """Return the true angle clockwise from the boresight, in the antenna's plane."""
        body = self.track.in_body(self.times_s - lag_s)
        return wrapped(np.arctan2(body[:, 1], body[:, 0]) - mount_rad)

    def yaw(self, lag_s: float) -> Vector:
        """Return the yaw clockwise from north."""
        return self.track.yaw_rad(self.times_s - lag_s)


@dataclass(frozen=True, slots=True)
class Waves:
    """Harmonics that are fitted together with mount and lag."""

    has_angle: bool = False
    has_heading: bool = False


def _observable_waves(
    sense: BearingSense, covered: float, view_rad: float, *, has_circle: bool
) -> Waves:
    """Return the observable harmonics: over the angle if all of it was seen, and over the heading.

    In a turn on one spot both are the same, except where a cosine is measured.
    """
    if sense.is_folded:
        return Waves(has_heading=covered > math.radians(200.0))
    has_angle = covered > math.radians(300.0) and view_rad > math.radians(300.0)
    return Waves(has_angle, has_angle and has_circle)


def core_sigma(errors: Vector, groups: list[Labels]) -> tuple[Figure, float]:
    """Return the standard deviation of a normal core and the share of outliers, by EM.

    Of the intervals by each grouping of correlated errors the widest is used.
    """
    sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(errors))), MIN_SIGMA_RAD)
    share, anywhere = 0.05, 1.0 / max(2.0 * float(np.max(np.abs(errors))), 12.0 * sigma)
    core = np.ones(len(errors))
    for _ in range(40):
        density = np.exp(-0.5 * (errors / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
        core = (1.0 - share) * density / ((1.0 - share) * density + share * anywhere)
        share = min(max(1.0 - float(core.mean()), 1e-4), 0.5)
        sigma = max(math.sqrt(float(np.sum(core * errors**2) / core.sum())), MIN_SIGMA_RAD)
    squares = core * errors**2
    figures = [ratio_figure(sums_of(squares, by), sums_of(core, by)) for by in groups]
    variance = max(figures, key=lambda figure: figure.half_width)
    low, high = math.sqrt(max(variance.low, 0.0)), math.sqrt(variance.high)
    return Figure(sigma, low, high), share


def fit_bearings(
    samples: BearingSamples,
    track: PoseTrack,
    sense: BearingSense,
    *,
    has_circle: bool,
    lag_s: float | None = None,
) -> BearingFit:
    """Fit mount and lag near the scan's result; `lag_s` fixes the lag."""
    problem = _FitProblem(samples, track, sense)
    covered = covered_rad(track, problem.times_s - sense.lag_s)
    mount, lag, _ = _solved(problem, lag_s, Waves())
    off = problem.off_boresight(mount, lag)
    errors = problem.errors(mount, lag)
    view_rad = field_of_view(off, errors, is_folded=sense.is_folded)
    looked = np.abs(_front(off) if sense.is_folded else off)
    behind_share = float(np.mean(np.abs(off) > 0.5 * math.pi))
    inside = looked <= 0.5 * view_rad + 1e-9
    if sense.is_folded:  # no arcsine is beyond a right angle, so noise there has one side
        usual = MAD_TO_SIGMA * float(np.median(np.abs(errors)))
        inside &= np.abs(np.sin(problem.said_rad) - errors) <= max(0.5, 1.0 - CLIP_SIGMAS * usual)
    if inside.sum() >= MIN_PER_STEP:
        problem.within(inside)
    waves = _observable_waves(sense, covered, view_rad, has_circle=has_circle)
    mount, lag, fit = _solved(problem, lag_s, waves)
    errors = problem.errors(mount, lag)
    amplitudes = [float(math.hypot(*fit.beta[i : i + 2])) for i in range(2, len(fit.beta), 2)]
    labels = _sectors(problem, mount, lag)
    wider = labels // max(1, (int(labels.max()) + 1) // SECTORS)
    pieces = numbered(np.floor(problem.times_s / (4.0 * PIECE_S)))
    sigma, gross = core_sigma(errors, [labels, wider, pieces])
    lag_sigma = math.sqrt(float(fit.covariance[1, 1])) if lag_s is None else math.inf
    return BearingFit(
        sense=sense,
        mount_rad=figure(mount, math.sqrt(float(fit.covariance[0, 0])), fit.freedom),
        lag_s=figure(lag, lag_sigma, fit.freedom) if lag_sigma < LAG_SIGMA_S else None,
        sigma_rad=sigma,
        gross_share=gross,
        field_of_view_rad=view_rad,
        behind_share=behind_share,
        waves_rad=(amplitudes[0], amplitudes[1]) if waves.has_angle else None,
        compass_rad=amplitudes[-1] if waves.has_heading else None,
        covered_rad=covered,
    )


def _waves(problem: _FitProblem, mount: float, lag: float, waves: Waves) -> Matrix:
    """Return columns for the antenna's error by its angle and the compass's by the heading."""
    off, yaw = problem.off_boresight(mount, lag), problem.yaw(lag)
    columns: list[Vector] = []
    if waves.has_angle:
        columns += [np.cos(off), np.sin(off), np.cos(2.0 * off), np.sin(2.0 * off)]
    if waves.has_heading:
        gain = np.cos(off) if problem.sense.is_folded else np.ones(len(yaw))
        columns += [gain * np.cos(yaw), gain * np.sin(yaw)]
    return np.stack(columns, axis=1) if columns else np.zeros((len(off), 0))


def _solved(
    problem: _FitProblem, held_s: float | None, waves: Waves
) -> tuple[float, float, LinearFit]:
    """Return mount, lag and the last fit, whose parameters are mount, lag and the harmonics."""
    mount = problem.sense.mount_rad
    lag = problem.sense.lag_s if held_s is None else held_s
    half_s = 0.05
    for _ in range(10):
        errors = problem.errors(mount, lag)
        by_mount = (problem.errors(mount + 1e-3, lag) - problem.errors(mount - 1e-3, lag)) / 2e-3
        by_lag = problem.errors(mount, lag + half_s) - problem.errors(mount, lag - half_s)
        by_lag = wrapped(by_lag) / (2.0 * half_s) if held_s is None else np.zeros(len(errors))
        sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(errors))), MIN_SIGMA_RAD)
        columns = _waves(problem, mount, lag, waves)
        rows = np.concatenate([-by_mount[:, None], -by_lag[:, None], columns], axis=1)
        if held_s is not None:
            rows = np.delete(rows, 1, axis=1)
        weights = np.ones(len(errors))
        for _ in range(6):
            beta = solved(rows, errors, weights)
            left = np.abs(errors - rows @ beta) / sigma
            weights = np.where(left > HUBER_K, HUBER_K / np.maximum(left, HUBER_K), 1.0)
        by, step_s = float(beta[0]), float(beta[1]) if held_s is None else 0.0
        mount = float(wrapped(np.array([mount + np.clip(by, -0.5, 0.5)]))[0])
        lag = float(np.clip(lag + np.clip(step_s, -0.3, 0.3), -SCAN_S - 0.5, SCAN_S + 0.5))
        if abs(by) < 1e-5 and abs(step_s) < 1e-4:
            break
    fit = linear_fit(rows, errors, weights, _sectors(problem, mount, lag))
    return mount, lag, fit if held_s is None else _with_held_lag(fit)


def _with_held_lag(fit: LinearFit) -> LinearFit:
    covariance = np.insert(np.insert(fit.covariance, 1, 0.0, axis=0), 1, 0.0, axis=1)
    return LinearFit(np.insert(fit.beta, 1, 0.0), covariance, fit.freedom)


def _sectors(problem: _FitProblem, mount: float, lag: float) -> Labels:
    """Return sectors of angle and heading, where elements or compass err; blocks of time if few."""
    off, yaw = problem.off_boresight(mount, lag), problem.yaw(lag)
    turns = [np.floor((a % (2.0 * math.pi)) / (2.0 * math.pi) * SECTORS) for a in (off, yaw)]
    labels = numbered(turns[0] * SECTORS + turns[1])
    if int(labels.max()) + 1 >= MIN_SECTORS:
        return labels
    return numbered(np.floor(problem.times_s / PIECE_S))


def _front(off: Vector) -> Vector:
    """Return angles from the nearer end of a folded antenna's boresight."""
    return np.arcsin(np.sin(off))


def field_of_view(off: Vector, errors: Vector, *, is_folded: bool) -> float:
    """Return the whole angle about the boresight with bearings that are as good as ahead."""
    angles = np.abs(_front(off)) if is_folded else np.abs(off)
    most = 0.5 * math.pi if is_folded else math.pi
    inner = np.abs(errors[angles <= 3.0 * VIEW_STEP_RAD])
    if len(inner) < MIN_PER_STEP:
        return 2.0 * most
    usual = max(float(np.median(inner)), MIN_SIGMA_RAD)
    for step in range(2, round(most / VIEW_STEP_RAD)):
        low = step * VIEW_STEP_RAD
        beyond = np.abs(errors[(angles > low) & (angles <= low + VIEW_STEP_RAD)])
        is_empty = len(beyond) < MIN_PER_STEP
        if is_empty or float(np.median(beyond)) > WIDER * usual:
            return 2.0 * low
    return 2.0 * most
