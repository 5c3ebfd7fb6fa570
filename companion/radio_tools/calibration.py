"""Calibration of a radio from measurements at known positions, or the reasons for refusing one.

Theory of operation. Bearings and ranges each determine a lag; the radio has one, so the two are
combined. With it both are fitted. Implausible results are refused with the reason, for ranges and
bearings separately, so that half a calibration can be used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from companion.arguments import FieldTestName
from companion.domain import PositionEnu, RangingMeasurement
from companion.io.radio_recording import TimedPose
from companion.radio_tools.bearing_fit import (
    MIN_LEAD,
    BearingFit,
    BearingSamples,
    covered_rad,
    find_sense,
    fit_bearings,
)
from companion.radio_tools.clustered_fit import (
    NORMAL_975,
    FieldTests,
    Figure,
    Flags,
    PoseTrack,
    Vector,
    find_tests,
)
from companion.radio_tools.range_fit import (
    MIN_SPEED_MPS,
    NLOS_SIGMAS,
    RangeFit,
    RangeSamples,
    fit_ranges,
)
from companion.radio_tools.range_lag import MAX_LAG_S, fit_lag, scan_lag

MIN_VALUES = 20
MIN_DISTANCES = 4
BLOCK_S = 5.0
BLOCKED_SHARE = 0.5
KEEP_REPORTED = (0.7, 1.4)
"""Reported over observed sigma within which the radio's own is used."""


@dataclass(frozen=True, slots=True)
class RunWindow:
    """A time window of a recording and the test that was made in it, as the user gives them."""

    name: FieldTestName
    from_s: float = -math.inf
    """Start on the recording's clock."""
    to_s: float = math.inf


@dataclass(frozen=True, slots=True)
class CalibrationRun:
    """Inputs of a calibration."""

    radio: str
    emitter_id: int
    measurements: Sequence[RangingMeasurement]
    """Measurements of the one emitter, from a stage that corrects nothing."""
    poses: Sequence[TimedPose]
    point_enu_m: PositionEnu
    windows: Sequence[RunWindow] = ()


@dataclass(frozen=True, slots=True)
class Blocked:
    """Effect of an obstacle on ranges at this site."""

    seconds: float
    share: float
    """Share of ranges longer by three sigma."""
    excess_m: float | None


@dataclass(slots=True)
class Calibration:
    """Result of a calibration; a refused part is included up to its refusal."""

    radio: str
    emitter_id: int
    ranges: int = 0
    bearings: int = 0
    tests: FieldTests = field(default_factory=FieldTests)
    lag_s: Figure | None = None
    """Lag; None if the recording does not determine it, and 0 is used."""
    range_fit: RangeFit | None = None
    bearing_fit: BearingFit | None = None
    is_by_north: bool = False
    """True if the bearings are from north and no mount is applied."""
    blocked: Blocked | None = None
    range_ratio: float | None = None
    """Reported over observed sigma; None if none is reported."""
    bearing_ratio: float | None = None
    own_sigma_m: float | None = None
    range_refusals: list[str] = field(default_factory=list)
    bearing_refusals: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def refusals(self) -> list[str]:
        """Return the refusals of both parts."""
        return [*self.range_refusals, *self.bearing_refusals]

    @property
    def has_ranges(self) -> bool:
        """Return True if there is a usable calibration of ranges."""
        return self.range_fit is not None and not self.range_refusals

    @property
    def has_bearings(self) -> bool:
        """Return True if there is a usable calibration of bearings."""
        return self.bearing_fit is not None and not self.bearing_refusals

    @property
    def keeps_reported_sigma(self) -> bool:
        """Return True if the reported sigmas agree with the observed scatter."""
        used = [(self.has_ranges, self.range_ratio), (self.has_bearings, self.bearing_ratio)]
        ratios = [ratio for is_used, ratio in used if is_used and ratio is not None]
        low, high = KEEP_REPORTED
        return bool(ratios) and all(low <= ratio <= high for ratio in ratios)


def calibrate(run: CalibrationRun) -> Calibration:
    """Fit all parameters that the run can determine."""
    track = PoseTrack(run.poses, run.point_enu_m)
    done = Calibration(run.radio, run.emitter_id, own_sigma_m=track.sigma_m)
    done.tests = find_tests(track)
    times = np.array([m.measured_at_s for m in run.measurements])
    has_pose = track.knows(times)
    lost = int(len(times) - has_pose.sum())
    if lost:
        done.remarks.append(f"{lost} of {len(times)} answers have no pose close in time")
    is_blocked = _in_windows(times, run.windows, ("blocked",))
    is_fitted = has_pose & ~is_blocked
    others = [window.name for window in run.windows if window.name != "blocked"]
    if others:
        is_fitted &= _in_windows(times, run.windows, ("turn", "line", "circle"))
    wants_ranges = not others or "line" in others
    wants_bearings = not others or others != ["line"] * len(others)
    ranged = np.array([m.range_m is not None for m in run.measurements], dtype=np.bool_)
    values = np.array([m.range_m or 0.0 for m in run.measurements])
    ranges = RangeSamples(times[ranged & is_fitted], values[ranged & is_fitted])
    fitted = [m for m, use in zip(run.measurements, is_fitted, strict=True) if use]
    bearings, turned_track = _bearing_samples(fitted, run, track, done)
    done.ranges, done.bearings = len(ranges.times_s), len(bearings.times_s)
    range_lag = _range_lag(ranges, track, done) if wants_ranges else None
    if wants_bearings and done.bearings:
        _fit_bearings(bearings, turned_track, done, range_lag)
    else:
        done.lag_s = range_lag
    if wants_ranges and done.ranges:
        blocked = ranged & has_pose & is_blocked
        _fit_ranges(ranges, RangeSamples(times[blocked], values[blocked]), track, done)
    _compare_reported(fitted, done)
    _check_vehicle_position(track, bearings, done)
    if not done.ranges and not done.bearings:
        done.range_refusals.append("no measurement has a known vehicle position")
    elif not (done.has_ranges or done.has_bearings or done.refusals):
        done.range_refusals.append(
            f"{' and '.join(others)} needs {'bearings' if wants_bearings else 'ranges'}, "
            "which this radio does not measure"
        )
    return done


def _in_windows(times: Vector, windows: Sequence[RunWindow], names: tuple[str, ...]) -> Flags:
    inside = np.zeros(len(times), dtype=np.bool_)
    for window in windows:
        if window.name in names:
            inside |= (times >= window.from_s) & (times <= window.to_s)
    return inside


def _bearing_samples(
    fitted: Sequence[RangingMeasurement],
    run: CalibrationRun,
    track: PoseTrack,
    done: Calibration,
) -> tuple[BearingSamples, PoseTrack]:
    """Return the bearings, and the track with the yaw from which they are seen."""
    by_north = [m for m in fitted if m.bearing_enu_rad is not None]
    by_body = [m for m in fitted if m.bearing_body_rad is not None]
    if len(by_north) > len(by_body):
        done.is_by_north = True
        level = [
            msgspec.structs.replace(pose, yaw_rad=0.0, roll_rad=0.0, pitch_rad=0.0)
            for pose in run.poses
        ]  # of a vehicle that looks north
        times = np.array([m.measured_at_s for m in by_north])
        said = np.array([0.5 * math.pi - (m.bearing_enu_rad or 0.0) for m in by_north])
        return BearingSamples(times, said), PoseTrack(level, run.point_enu_m)
    if by_body and not track.has_yaw:
        done.bearing_refusals.append("no yaw was recorded: bearings need the autopilot's attitude")
        by_body = []
    times = np.array([m.measured_at_s for m in by_body])
    said = np.array([m.bearing_body_rad or 0.0 for m in by_body])
    known = track.knows(times, with_yaw=True)
    is_array = bool(by_body) and sum(m.is_array_angle for m in by_body) * 2 > len(by_body)
    return BearingSamples(times[known], said[known], is_array), track


def _range_lag(ranges: RangeSamples, track: PoseTrack, done: Calibration) -> Figure | None:
    if len(ranges.times_s) < MIN_VALUES:
        return None
    lag = fit_lag(ranges, track)
    if lag is not None and abs(lag.value) > MAX_LAG_S:
        done.range_refusals.append(_clocks(lag.value))
    if lag is None:
        seen = track.seen(ranges.times_s)
        moves = float(np.mean(seen.speed_mps > MIN_SPEED_MPS))
        is_scanned = scan_lag(ranges, track) is not None
        if moves > 0.5 and is_scanned:
            done.remarks.append(
                "ranges do not show the lag: go out and back the same way, or stop at each distance"
            )
    return lag


def _clocks(lag_s: float) -> str:
    return f"clocks disagree: a lag of {lag_s:+.2f} s, above {MAX_LAG_S:.0f} s"


def _fit_bearings(
    samples: BearingSamples, track: PoseTrack, done: Calibration, range_lag: Figure | None
) -> None:
    """Fit bearings, and determine the common lag."""
    done.lag_s = range_lag
    if len(samples.times_s) < MIN_VALUES:
        done.bearing_refusals.append(
            f"only {len(samples.times_s)} bearings; at least {MIN_VALUES} are needed"
        )
        return
    sense = find_sense(samples, track, is_by_north=done.is_by_north)
    if abs(sense.lag_s) > MAX_LAG_S and sense.follows:
        done.bearing_refusals.append(_clocks(sense.lag_s))
        return
    if not sense.follows:
        done.bearing_refusals.append(
            f"the bearing does not follow the turn (resultant {sense.resultant:.2f} of 1): "
            "no bearing, or another emitter's"
        )
        return
    is_turned = done.tests.has_turn or covered_rad(track, samples.times_s) > math.radians(270.0)
    if not done.is_by_north and not is_turned:
        done.bearing_refusals.append(
            "no full turn: the sign of the bearing is uncertain; turn once about the vertical axis"
        )
    elif sense.resultant - sense.other_resultant < MIN_LEAD and not done.is_by_north:
        done.bearing_refusals.append(
            "clockwise and counter-clockwise fit equally well"
            + (": the antenna faces sideways; mount it facing ahead" if sense.is_folded else "")
        )
    elif done.is_by_north and sense.sign < 0:
        done.bearing_refusals.append(
            "bearings from north turn counter-clockwise and should turn clockwise"
        )
    has_circle = done.tests.has_circle and not done.is_by_north
    fit = fit_bearings(samples, track, sense, has_circle=has_circle)
    if fit.lag_s is not None and abs(fit.lag_s.value) > MAX_LAG_S:
        done.bearing_refusals.append(_clocks(fit.lag_s.value))
    if range_lag is not None:
        lag = combined_figure(range_lag, fit.lag_s)
        fit = _at_lag(samples, track, fit, lag, has_circle=has_circle)
        done.lag_s = lag
    elif fit.lag_s is not None:
        done.lag_s = fit.lag_s
    else:
        fit = fit_bearings(samples, track, sense, has_circle=has_circle, lag_s=0.0)
    done.bearing_fit = fit


def combined_figure(one: Figure, other: Figure | None) -> Figure:
    """Return the inverse-variance weighted mean of two figures."""
    if other is None:
        return one
    weights = [1.0 / max(f.sigma, 1e-6) ** 2 for f in (one, other)]
    value = (weights[0] * one.value + weights[1] * other.value) / sum(weights)
    half = NORMAL_975 / math.sqrt(sum(weights))
    return Figure(value, value - half, value + half)


def _at_lag(
    samples: BearingSamples,
    track: PoseTrack,
    fit: BearingFit,
    lag: Figure,
    *,
    has_circle: bool,
) -> BearingFit:
    """Return the fit at the common lag; the lag's uncertainty widens the mount's interval."""
    sense = replace(fit.sense, lag_s=lag.value, mount_rad=fit.mount_rad.value)
    held = fit_bearings(samples, track, sense, has_circle=has_circle, lag_s=lag.value)
    later = fit_bearings(
        samples, track, sense, has_circle=has_circle, lag_s=lag.value + max(lag.half_width, 1e-3)
    )
    moved = later.mount_rad.value - held.mount_rad.value
    half = math.hypot(held.mount_rad.half_width, moved)
    value = held.mount_rad.value
    return replace(held, mount_rad=Figure(value, value - half, value + half))


def _fit_ranges(
    ranges: RangeSamples, blocked: RangeSamples, track: PoseTrack, done: Calibration
) -> None:
    """Fit the ranges that are not blocked; `blocked` is a flag for each from the user."""
    if len(ranges.times_s) < MIN_VALUES:
        done.range_refusals.append(
            f"only {len(ranges.times_s)} ranges; at least {MIN_VALUES} are needed"
        )
        return
    lag_s, half_s = (0.0, 0.0) if done.lag_s is None else (done.lag_s.value, done.lag_s.half_width)
    used = track.knows(ranges.times_s - lag_s)
    if done.lag_s is None:  # ranges under way may be wrong by any distance if they are late
        used &= track.seen(ranges.times_s).speed_mps < MIN_SPEED_MPS
        if used.sum() < max(MIN_VALUES, 0.2 * len(used)):
            done.range_refusals.append(
                "offset and lag cannot be separated on this path: go back the same way, or stop "
                "at each distance"
            )
            return
    ranges = _picked(ranges, used)
    fit = fit_ranges(ranges, track, lag_s, half_s)
    if len(blocked.times_s):
        done.blocked = _blocked(blocked, track, fit, lag_s)
    else:
        inside = _blocked_blocks(ranges, track, fit, lag_s)
        if inside.any() and np.sum(~inside) >= MIN_VALUES:
            fit = fit_ranges(_picked(ranges, ~inside), track, lag_s, half_s)
            done.blocked = _blocked(_picked(ranges, inside), track, fit, lag_s)
    done.range_fit = fit
    _check_ranges(fit, done)


def _picked(samples: RangeSamples, used: Flags) -> RangeSamples:
    return RangeSamples(samples.times_s[used], samples.ranges_m[used])


def _check_ranges(fit: RangeFit, done: Calibration) -> None:
    if len(fit.distances_m) < MIN_DISTANCES:
        listed = ", ".join(f"{distance:.1f}" for distance in fit.distances_m)
        done.range_refusals.append(
            f"only {len(fit.distances_m)} distances ({listed} m); at least "
            f"{MIN_DISTANCES} are needed, such as 5 10 20 50 100 m"
        )
    elif not fit.is_scale_seen:
        done.remarks.append(
            "the spread of distances is too small for the scale, which is held at 1: farthest over "
            "nearest at least 4, and 10 sigma between them"
        )
    if fit.is_split:
        done.range_refusals.append(
            "ranges at one position form two groups, more than 2 m apart: two emitters or two paths"
        )


def _errors(samples: RangeSamples, track: PoseTrack, fit: RangeFit, lag_s: float) -> Vector:
    distance = track.seen(samples.times_s - lag_s).distance_m
    return samples.ranges_m - fit.offset_m.value - fit.effective_scale * distance


def _blocked_blocks(samples: RangeSamples, track: PoseTrack, fit: RangeFit, lag_s: float) -> Flags:
    """Return flags of ranges in periods longer than a block in which most were too long."""
    is_long = _errors(samples, track, fit, lag_s) > NLOS_SIGMAS * fit.sigma_m.value
    times = samples.times_s
    seconds = float(times.max() - times.min()) or 1.0
    block_s = max(BLOCK_S, MIN_VALUES * seconds / len(times))
    blocks = np.asarray((times - times.min()) // block_s, dtype=np.int64)
    counts = np.bincount(blocks)
    share = np.bincount(blocks, weights=is_long) / np.maximum(counts, 1)
    is_blocked = (counts >= MIN_VALUES // 2) & (share > BLOCKED_SHARE)
    lasts = np.convolve(is_blocked, [1, 1, 1], mode="same") >= 2
    return np.asarray((is_blocked & lasts)[blocks])


def _blocked(samples: RangeSamples, track: PoseTrack, fit: RangeFit, lag_s: float) -> Blocked:
    errors = _errors(samples, track, fit, lag_s)
    is_long = errors > NLOS_SIGMAS * fit.sigma_m.value
    excess = float(errors[is_long].mean()) if is_long.any() else None
    seconds = float(np.ptp(samples.times_s))
    return Blocked(seconds, float(is_long.mean()), excess)


def _compare_reported(fitted: Sequence[RangingMeasurement], done: Calibration) -> None:
    ranges = [m.range_sigma_m for m in fitted if m.range_sigma_m is not None]
    bearings = [m.bearing_sigma_rad for m in fitted if m.bearing_sigma_rad is not None]
    if ranges and done.range_fit is not None:
        done.range_ratio = float(np.median(ranges)) / done.range_fit.sigma_m.value
    if bearings and done.bearing_fit is not None:
        done.bearing_ratio = float(np.median(bearings)) / done.bearing_fit.sigma_rad.value


def _check_vehicle_position(track: PoseTrack, bearings: BearingSamples, done: Calibration) -> None:
    """Check that the vehicle's position is three times as accurate as the radio."""
    own = track.sigma_m
    if own is None:
        done.remarks.append("accuracy of the vehicle's position is unknown; RTK is good enough")
        return
    if done.range_fit is not None and own > done.range_fit.sigma_m.value / 3.0:
        done.range_refusals.append(
            f"the vehicle's position is known to {own:.2f} m, which is above a third of the sigma "
            f"found, {done.range_fit.sigma_m.value:.2f} m: needs RTK"
        )
    if done.bearing_fit is not None:
        distance = float(np.median(track.seen(bearings.times_s).distance_m))
        sigma = done.bearing_fit.sigma_rad.value
        if own / distance > sigma / 3.0:
            done.bearing_refusals.append(
                f"the vehicle's position is known to {own:.2f} m, at {distance:.0f} m more "
                f"than a third of the sigma found, {math.degrees(sigma):.1f} deg: needs RTK, or "
                "farther away"
            )
