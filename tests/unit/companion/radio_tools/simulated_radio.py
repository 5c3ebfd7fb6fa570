"""Simulated radios whose truth is known, and the errors of their calibration.

Every seed draws a radio (range offset, scale, lag, sign, mount, noise, reflections, harmonics of
the antenna and of the compass) and flies it through a turn, a line out and back, a circle and a
blocked run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from companion.io.radio_recording import (
    RadioBytes,
    RadioRecordingWriter,
    RecordedOrigin,
    RecordedRadio,
    RecordingHeader,
    TimedPose,
)
from companion.radio_tools.calibration import Calibration, CalibrationRun
from companion.radio_tools.clustered_fit import Figure

RATE_HZ = 10.0
POINT: PositionEnu = (12.0, -7.0, 1.0)
STOPS_M = (5.0, 10.0, 20.0, 50.0, 100.0)
HEIGHT_M = 4.0


@dataclass(frozen=True, slots=True)
class Truth:
    """A drawn radio."""

    offset_m: float = 1.0
    scale: float = 1.0
    lag_s: float = 0.2
    sign: int = 1
    mount_rad: float = 0.0
    is_folded: bool = False
    view_rad: float = 2.0 * math.pi
    scatter_m: float = 0.1
    between_m: float = 0.1
    correlation_m: float = 2.0
    nlos_share: float = 0.1
    excess_m: float = 3.0
    bearing_sigma_rad: float = 0.08
    gross_share: float = 0.03
    wave_rad: float = 0.03
    compass_rad: float = 0.05
    own_sigma_m: float = 0.02

    @property
    def sigma_m(self) -> float:
        """Noise at one position and between positions together, m."""
        return math.hypot(self.scatter_m, self.between_m)


def drawn(rng: np.random.Generator) -> Truth:
    """Return a radio between UWB and Wi-Fi."""
    scatter = float(math.exp(rng.uniform(math.log(0.05), math.log(0.8))))
    is_folded = bool(rng.random() < 0.4)
    mount = rng.uniform(-60.0, 60.0) if is_folded else rng.uniform(-180.0, 180.0)
    return Truth(
        offset_m=float(rng.uniform(-3.0, 45.0)),
        scale=1.0 if rng.random() < 0.5 else float(1.0 + 0.02 * rng.standard_normal()),
        lag_s=float(rng.uniform(0.0, 1.2)),
        sign=1 if rng.random() < 0.5 else -1,
        mount_rad=math.radians(mount),
        is_folded=is_folded,
        view_rad=math.radians(120.0) if is_folded and rng.random() < 0.5 else 2.0 * math.pi,
        scatter_m=scatter,
        between_m=scatter * float(rng.uniform(0.2, 1.0)),
        correlation_m=float(rng.uniform(0.3, 3.0)),
        nlos_share=float(rng.uniform(0.0, 0.3)),
        excess_m=float(rng.uniform(1.0, 6.0)),
        bearing_sigma_rad=math.radians(float(rng.uniform(2.0, 7.0))),
        gross_share=float(rng.uniform(0.0, 0.06)),
        wave_rad=math.radians(float(rng.uniform(0.0, 3.0))),
        compass_rad=math.radians(float(rng.uniform(0.0, 4.0))),
    )


@dataclass(slots=True)
class Course:
    """Course of a vehicle, sampled at 20 Hz: positions and headings."""

    positions: list[tuple[float, float, float]]
    yaws: list[float]
    step_s: float = 0.05

    def stay(self, seconds: float, turn_rad: float = 0.0) -> None:
        """Stand, turning evenly."""
        count = max(1, round(seconds / self.step_s))
        for _ in range(count):
            self.positions.append(self.positions[-1])
            self.yaws.append(self.yaws[-1] + turn_rad / count)

    def go(self, position: tuple[float, float, float], speed_mps: float) -> None:
        """Fly straight, accelerating and braking within a second; the heading stays."""
        start, end = np.array(self.positions[-1]), np.array(position)
        length = float(np.linalg.norm(end - start))
        seconds = length / speed_mps + 1.0
        for t in np.arange(self.step_s, seconds + self.step_s, self.step_s):
            part = (np.clip(t, 0, seconds - 1.0) + np.clip(t - 1.0, 0, seconds - 1.0)) / 2.0
            share = min(1.0, part / max(seconds - 1.0, 1e-9))
            self.positions.append(tuple(start + share * (end - start)))
            self.yaws.append(self.yaws[-1])

    def circle(self, radius_m: float, speed_mps: float) -> None:
        """Fly once about the point, with the nose along the way."""
        count = round(2.0 * math.pi * radius_m / speed_mps / self.step_s)
        begin = math.atan2(self.positions[-1][1] - POINT[1], self.positions[-1][0] - POINT[0])
        up = self.positions[-1][2]
        self.stay(4.0, math.remainder(-begin - self.yaws[-1], 2.0 * math.pi))
        turns = self.yaws[-1] + begin
        for angle in begin + np.linspace(0.0, 2.0 * math.pi, count):
            east, north = (
                POINT[0] + radius_m * math.cos(angle),
                POINT[1] + radius_m * math.sin(angle),
            )
            self.positions.append((east, north, up))
            self.yaws.append(turns - float(angle))


def at(distance_m: float, up_m: float = HEIGHT_M) -> tuple[float, float, float]:
    """Return the position at a distance from the point, along the line."""
    level = math.sqrt(max(distance_m**2 - (up_m - POINT[2]) ** 2, 0.0))
    return (POINT[0] + 0.8 * level, POINT[1] + 0.6 * level, up_m)


def all_tests() -> tuple[Course, tuple[float, float]]:
    """Return turn, line out and back, circle, blocked run; and the times of the blocked run."""
    course = Course([at(30.0)], [0.3])
    for turn in (2.0 * math.pi, -2.0 * math.pi):
        course.stay(3.0)
        course.stay(40.0, turn)
    course.go(at(STOPS_M[0]), 3.0)
    for stop in STOPS_M:
        course.go(at(stop), 3.0)
        course.stay(6.0)
        course.stay(4.0, 0.5 * math.pi)
        course.stay(6.0)
    course.go(at(STOPS_M[0]), 4.0)
    course.go(at(30.0), 4.0)
    course.circle(float(np.hypot(*(np.array(at(30.0)) - np.array(POINT))[:2])), 5.0)
    begin = len(course.positions) * course.step_s
    course.stay(30.0)
    return course, (begin, len(course.positions) * course.step_s)


class PositionEffect:
    """Range error by reflections, correlated between nearby positions."""

    def __init__(self, rng: np.random.Generator, truth: Truth) -> None:
        waves = 200
        scale = 1.0 / max(truth.correlation_m, 1e-3)
        self._vectors = rng.standard_normal((waves, 3)) * scale
        self._phases = rng.uniform(0.0, 2.0 * math.pi, waves)
        self._gain = truth.between_m * math.sqrt(2.0 / waves)

    def at(self, position: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        """Return the error, about normal, m."""
        return self._gain * float(np.sum(np.cos(self._vectors @ position + self._phases)))


def simulated(
    truth: Truth,
    rng: np.random.Generator,
    course: Course,
    blocked: tuple[float, float] = (math.inf, math.inf),
    radio: str = "simulated",
) -> CalibrationRun:
    """Return the recording of a radio on a course."""
    effect = PositionEffect(rng, truth)
    phase, compass_phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    positions, yaws = np.array(course.positions), np.array(course.yaws)
    times = 100.0 + course.step_s * np.arange(len(positions))
    own = truth.own_sigma_m * rng.standard_normal(positions.shape)
    seen_yaws = yaws + truth.compass_rad * np.cos(yaws - compass_phase)
    poses = [
        TimedPose(
            float(t), tuple(p.tolist()), wrap_pi(float(y)), 0.0, 0.0, max(truth.own_sigma_m, 1e-3)
        )
        for t, p, y in zip(times[::2], (positions + own)[::2], seen_yaws[::2], strict=True)
    ]
    measurements: list[RangingMeasurement] = []
    for t in np.arange(times[0], times[-1] - truth.lag_s, 1.0 / RATE_HZ):
        position = np.array([np.interp(t, times, column) for column in positions.T])
        yaw = float(np.interp(t, times, yaws))
        is_blocked = blocked[0] <= t - 100.0 <= blocked[1]
        measurements.append(
            _measured(truth, rng, (float(t), position, yaw), effect, phase, is_blocked=is_blocked)
        )
    return CalibrationRun(radio, 7, measurements, poses, POINT)


def _measured(
    truth: Truth,
    rng: np.random.Generator,
    moment: tuple[float, np.ndarray[tuple[int], np.dtype[np.float64]], float],
    effect: PositionEffect,
    phase: float,
    *,
    is_blocked: bool,
) -> RangingMeasurement:
    t, position, yaw = moment
    way = np.array(POINT) - position
    slant = float(np.linalg.norm(way))
    share = 0.8 if is_blocked else truth.nlos_share
    excess = float(rng.exponential(truth.excess_m)) if rng.random() < share else 0.0
    noise = truth.scatter_m * float(rng.standard_normal())
    said = truth.offset_m + truth.scale * slant + effect.at(position) + excess + noise
    off = wrap_pi(math.atan2(way[0], way[1]) - yaw - truth.mount_rad)
    normal, gross, anywhere = rng.standard_normal(), rng.random(), rng.uniform(-math.pi, math.pi)
    if truth.is_folded:
        level = float(np.hypot(way[0], way[1])) / slant
        printed = math.sin(off) * level + truth.bearing_sigma_rad * float(normal)
        bearing = math.asin(max(-1.0, min(1.0, printed)))
        bearing = 0.5 * anywhere if gross < truth.gross_share else bearing
    else:
        wave = truth.wave_rad * math.cos(2.0 * off + phase)
        bearing = wrap_pi(off + wave + truth.bearing_sigma_rad * float(normal))
        bearing = anywhere if gross < truth.gross_share else bearing
    is_seen = abs(math.asin(math.sin(off)) if truth.is_folded else off) <= 0.5 * truth.view_rad
    return RangingMeasurement(
        emitter_id=7,
        measured_at_s=t + truth.lag_s,
        range_m=said,
        range_sigma_m=truth.sigma_m,
        bearing_body_rad=truth.sign * bearing if is_seen else None,
        bearing_sigma_rad=2.0 * truth.bearing_sigma_rad if is_seen else None,
        is_array_angle=False,
    )


def record(run: CalibrationRun, path: Path) -> None:
    """Write a run as `companion radio record` would, the radio as NDJSON."""
    radio = RecordedRadio(name="ndjson", url="stdin:")
    origin = RecordedOrigin(latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0)
    header = RecordingHeader(started_unix_s=1.7e9, radios=(radio,), origin=origin)
    records: list[RadioBytes | TimedPose] = list(run.poses)
    for m in run.measurements:
        line: dict[str, object] = {"emitter_id": m.emitter_id, "body_frame": True}
        line |= {"range": m.range_m, "range_std": m.range_sigma_m}
        line |= {"bearing": m.bearing_body_rad, "bearing_std": m.bearing_sigma_rad}
        records.append(RadioBytes(m.measured_at_s, 0, json.dumps(line).encode() + b"\n"))
    with RadioRecordingWriter(path, header) as writer:
        for each in sorted(records, key=lambda each: each.t_s):
            writer.write(each)


@dataclass(frozen=True, slots=True)
class Score:
    """One figure of one seed."""

    name: str
    error: float
    is_within: bool | None
    """True if it is within the specification; None if there is none."""
    is_covered: bool | None
    """True if the interval contains the truth; None if there is no interval."""


def scores(truth: Truth, done: Calibration) -> Iterator[Score]:
    """Yield the errors of a calibration; refused parts have no scores."""
    if done.lag_s is not None:
        error = done.lag_s.value - truth.lag_s
        yield Score("lag s", error, abs(error) <= 0.02, _holds(done.lag_s, truth.lag_s))
        yield Score("lag s, or 2 SE", error, abs(error) <= 0.02 + 2.0 * done.lag_s.sigma, None)
    if done.range_fit is not None and not done.range_refusals:
        fit = done.range_fit
        error = fit.offset_m.value - truth.offset_m
        is_within = abs(error) <= 0.1 + 2.0 * fit.offset_m.sigma
        yield Score("offset m", error, is_within, _holds(fit.offset_m, truth.offset_m))
        if fit.is_scale_seen:
            error = fit.scale.value - truth.scale
            yield Score("scale", error, None, _holds(fit.scale, truth.scale))
        for name, estimated, true in (
            ("scatter", fit.scatter_m, truth.scatter_m),
            ("sigma", fit.sigma_m, truth.sigma_m),
        ):
            ratio = estimated.value / true - 1.0
            yield Score(f"{name}, ratio", ratio, abs(ratio) <= 0.25, _holds(estimated, true))
        if done.blocked is not None:
            true = truth.excess_m + 3.0 * truth.sigma_m  # of what is longer than that
            yield Score("blocked excess m", (done.blocked.excess_m or 0.0) - true, None, None)
    if done.has_bearings and done.bearing_fit is not None:
        yield from _bearing_scores(truth, done)


def _bearing_scores(truth: Truth, done: Calibration) -> Iterator[Score]:
    fit = done.bearing_fit
    assert fit is not None
    is_right = fit.sense.sign == truth.sign and fit.sense.is_folded == truth.is_folded
    yield Score("sign, fold", 0.0 if is_right else 1.0, is_right, None)
    error = wrap_pi(fit.mount_rad.value - truth.mount_rad)
    is_within = abs(error) <= math.radians(1.0) + 2.0 * fit.mount_rad.sigma
    covered = abs(error) <= fit.mount_rad.half_width
    yield Score("mount deg", math.degrees(error), is_within, covered)
    true = _bearing_sigma_rad(truth)
    ratio = fit.sigma_rad.value / true - 1.0
    yield Score("bearing sigma, ratio", ratio, abs(ratio) <= 0.25, _holds(fit.sigma_rad, true))


def _bearing_sigma_rad(truth: Truth) -> float:
    """Return the noise, with the harmonics of antenna and compass where the antenna looks."""
    seen, wave = 1.0, truth.wave_rad
    if truth.is_folded:  # of a cosine, in which the compass shows by the cosine of the angle
        half = min(0.5 * truth.view_rad, math.radians(65.0))
        seen, wave = 0.5 + math.sin(2.0 * half) / (4.0 * half), 0.0
    variance = truth.bearing_sigma_rad**2 + 0.5 * wave**2 + 0.5 * seen * truth.compass_rad**2
    return math.sqrt(variance)


def _holds(estimated: Figure, true: float) -> bool:
    return estimated.low <= true <= estimated.high


def drawn_run(
    seed: int, draw: Callable[[np.random.Generator], Truth] = drawn
) -> tuple[Truth, CalibrationRun]:
    """Run one seed through all tests."""
    rng = np.random.default_rng(seed)
    truth = draw(rng)
    course, blocked = all_tests()
    return truth, simulated(truth, rng, course, blocked)
