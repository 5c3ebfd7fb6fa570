"""A target that walks although it is believed to be stationary."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import DEFAULT_ACCURACY
from companion.estimation.stepwise import Steps, Stepwise, finish
from companion.estimation.target_motion import (
    CLEARED_COUNT,
    CONFIRMING_TESTS,
    EVERY_S,
    IDLE_EVERY_COUNT,
    SIGNIFICANT_CHI2,
    SPANS_S,
    MotionWatch,
    TargetMotion,
    motion_of,
)
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import (
    BEARING_SIGMA_RAD,
    RANGE_SIGMA_M,
    TARGET,
    measurement_of,
    params,
    reflected,
    truth,
)

PARAMS = params(range_k_short=6.0)
MAP = WindowMap(PARAMS)
RATE_HZ = 10.0


def rows_of(
    rng: np.random.Generator,
    seconds: float = 20.0,
    *,
    velocity_mps: tuple[float, float] = (0.0, 0.0),
    noise: float = 1.0,
    nlos: float = 0.9,
    start_s: float = 0.0,
    speed_mps: float = 3.0,
) -> Matrix:
    """Seconds of a vehicle that circles about (40, 25); the time is in the last column."""
    time_s = start_s + np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rows = np.full((len(time_s), 10), np.nan)
    phi = speed_mps / 20.0 * time_s
    rows[:, 0], rows[:, 1] = 40.0 + 20.0 * np.cos(phi), 25.0 + 20.0 * np.sin(phi)
    rows[:, 2] = 0.0
    away = np.array(TARGET) + np.outer(time_s - start_s, velocity_mps) - rows[:, :2]
    draws = noise * rng.normal(size=(len(time_s), 2))
    rows[:, 3] = np.hypot(*away.T) + 2.0 + RANGE_SIGMA_M * draws[:, 0]
    rows[:, 4] = np.arctan2(away[:, 1], away[:, 0]) - 0.05 + BEARING_SIGMA_RAD * draws[:, 1]
    rows[:, 6:9] = RANGE_SIGMA_M, BEARING_SIGMA_RAD, 0.05
    rows[:, 9] = time_s
    return reflected(rng, rows, nlos)


def watched(
    watch: MotionWatch, rows: Matrix, mean: Vector | None = None, r95_m: float = 2.0
) -> list[TargetMotion | None]:
    """Return the motion found after each look while the rows come in."""
    seen = []
    for row in rows:
        watch.fresh.append(row)
        if watch.is_due(float(row[9])):
            watch.look(
                MAP, truth() if mean is None else mean, r95_m, DEFAULT_ACCURACY, float(row[9])
            )
            seen.append(watch.motion)
    return seen


DIRECTIONS_RAD = (0.0, 2.0, 4.0)


def velocity_of(speed_mps: float, direction_rad: float) -> tuple[float, float]:
    return (speed_mps * math.cos(direction_rad), speed_mps * math.sin(direction_rad))


@pytest.mark.parametrize("speed_mps", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("direction_rad", DIRECTIONS_RAD)
def test_who_walks_in_sight_is_seen_at_the_right_velocity(
    speed_mps: float, direction_rad: float
) -> None:
    velocity = velocity_of(speed_mps, direction_rad)
    rows = rows_of(np.random.default_rng(1), velocity_mps=velocity, nlos=0.0)
    motion = finish(motion_of(MAP, rows, truth()))
    assert motion is not None
    assert motion.significance > SIGNIFICANT_CHI2
    assert motion.velocity_mps == pytest.approx(velocity, abs=0.1)


@pytest.mark.parametrize("speed_mps", [0.3, 1.0])
@pytest.mark.parametrize("direction_rad", DIRECTIONS_RAD)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_who_walks_among_reflections_is_seen(
    speed_mps: float, direction_rad: float, seed: int
) -> None:
    velocity = velocity_of(speed_mps, direction_rad)
    rows = rows_of(np.random.default_rng(seed), SPANS_S[-1], velocity_mps=velocity)
    motion = finish(motion_of(MAP, rows, truth()))
    assert motion is not None
    assert motion.significance > SIGNIFICANT_CHI2


def test_a_drift_of_the_vehicle_position_that_is_stated_is_no_walk() -> None:
    """The frame drifts by 2 m in 40 s, which is 3.2 sigma where 0.9 m are stated."""
    rows = rows_of(np.random.default_rng(1), 40.0, velocity_mps=(0.04, -0.03), noise=0.1, nlos=0.0)
    found = [finish(motion_of(MAP, rows, truth(), own_m)) for own_m in (0.0, 0.9)]
    assert found[0] is not None
    assert found[1] is not None
    assert found[0].significance > SIGNIFICANT_CHI2 > 5.0 * found[1].significance


@pytest.mark.parametrize("direction_rad", DIRECTIONS_RAD)
def test_who_walks_is_seen_by_a_vehicle_with_single_frequency_gnss(direction_rad: float) -> None:
    velocity = velocity_of(0.3, direction_rad)
    rows = rows_of(np.random.default_rng(1), SPANS_S[-1], velocity_mps=velocity, nlos=0.0)
    motion = finish(motion_of(MAP, rows, truth(), 1.0))
    assert motion is not None
    assert motion.significance > SIGNIFICANT_CHI2


@pytest.mark.parametrize("nlos", [0.0, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("noise", [0.3, 1.0, 4.0])
def test_who_lies_still_is_never_said_to_walk(nlos: float, noise: float) -> None:
    for seed in range(20):
        rng = np.random.default_rng([seed, int(10 * noise), int(10 * nlos)])
        motion = finish(motion_of(MAP, rows_of(rng, noise=noise, nlos=nlos), truth()))
        assert motion is None or motion.significance < 0.6 * SIGNIFICANT_CHI2


def test_a_start_from_a_wrong_place_is_no_walk() -> None:
    for seed in range(20):
        start = truth() + np.array([8.0, -6.0, 1.0, 0.02])
        motion = finish(motion_of(MAP, rows_of(np.random.default_rng(seed)), start))
        assert motion is None or motion.significance < 0.6 * SIGNIFICANT_CHI2


def test_measurements_that_say_nothing_are_no_walk() -> None:
    rows = np.full((40, 10), np.nan)
    rows[:, :3], rows[:, 6:9], rows[:, 9] = 0.0, 1.0, np.arange(40)
    assert finish(motion_of(MAP, rows, truth())) is None


def test_it_is_believed_when_it_is_seen_twice_in_a_row() -> None:
    watch = MotionWatch(PARAMS, 2.0)
    rows = rows_of(np.random.default_rng(2), 20.0, velocity_mps=(0.7, 0.7))
    seen = watched(watch, rows[: round(7.9 * RATE_HZ)])
    assert watch.suspected is None
    step = round(EVERY_S * RATE_HZ)
    at = round(7.9 * RATE_HZ)
    while watch.suspected is None:
        seen += watched(watch, rows[at : at + step])
        at += step
    assert CONFIRMING_TESTS == 2
    assert watch.motion is None
    watched(watch, rows[at : at + step])
    assert watch.motion is not None


def test_it_is_over_when_nothing_has_spoken_for_it_for_a_while() -> None:
    watch, rng = MotionWatch(PARAMS, 2.0), np.random.default_rng(3)
    walking = rows_of(rng, 20.0, velocity_mps=(1.0, 0.0))
    watched(watch, walking)
    assert watch.motion is not None
    still = rows_of(rng, SPANS_S[-1] + 2.0 * CLEARED_COUNT, start_s=20.0)
    still[:, :2] += [20.0, 0.0]
    seen = watched(watch, still, truth() + np.array([20.0, 0.0, 0.0, 0.0]))
    assert seen[-1] is None
    assert sum(motion is None for motion in seen) < len(seen) - CLEARED_COUNT


def test_what_was_measured_moves_along_with_the_navigation() -> None:
    watch = MotionWatch(PARAMS, 2.0)
    rows = rows_of(np.random.default_rng(4), 30.0)
    watched(watch, rows[:150])
    watch.move((5.0, -3.0), np.array([5.0, -3.0, 0.0, 0.0]), PARAMS)
    rows[150:, :2] += [5.0, -3.0]
    seen = watched(watch, rows[150:], truth() + np.array([5.0, -3.0, 0.0, 0.0]))
    assert seen
    assert watch.suspected is None


def test_a_target_that_may_walk_is_not_asked_for() -> None:
    watch = MotionWatch(params(process_noise_m_per_sqrt_s=0.5), 2.0)
    assert watched(watch, rows_of(np.random.default_rng(5), velocity_mps=(1.0, 0.0))) == []


@pytest.mark.slow
def test_it_forgets() -> None:
    watch = MotionWatch(PARAMS, 2.0)
    watched(watch, rows_of(np.random.default_rng(6), 80.0, velocity_mps=(0.3, 0.0)))
    assert watch.suspected is not None
    watch.clear()
    assert watch.suspected is None
    assert not watch.is_due(1e3)


def test_looks_are_a_second_and_some_measurements_apart_and_time_may_go_back() -> None:
    watch, row = MotionWatch(PARAMS, 2.0), np.array([*(0.0,) * 3, *(1.0,) * 6, 0.0])
    watch.fresh.append(row)
    assert watch.is_due(100.0)
    watch.look(MAP, truth(), 2.0, DEFAULT_ACCURACY, 100.0)
    assert not watch.is_due(100.0 + EVERY_S)
    for _ in range(IDLE_EVERY_COUNT):
        assert not watch.is_due(100.0 + EVERY_S)
        watch.fresh.append(row)
    assert not watch.is_due(100.0 + 0.9 * EVERY_S)
    assert watch.is_due(100.0 + EVERY_S)
    assert watch.is_due(3.0)


def test_only_a_place_that_is_reported_with_some_certainty_is_asked_for() -> None:
    rows = rows_of(np.random.default_rng(7), velocity_mps=(1.0, 0.0))
    sure, vague = MotionWatch(PARAMS, 2.0), MotionWatch(PARAMS, 2.0)
    watched(sure, rows, r95_m=6.0)
    assert sure.motion is not None
    watched(vague, rows, r95_m=6.1)
    assert vague.suspected is None
    seen_s, before = float(rows[-1, 9]), sure.suspected
    sure.look(
        MAP, truth(), 1e3, DEFAULT_ACCURACY, seen_s
    )  # a suspicion is watched, however vague the position
    assert sure.suspected is not before


def tracked(rows: Matrix, tracker: TargetTracker) -> list[float]:
    """R95 after every measurement."""
    radii = []
    for row in rows:
        measured, position = measurement_of(row, float(row[9]))
        tracker.fuse(measured, position, float(row[9]))
        estimate = tracker.estimate(float(row[9]))
        radii.append(math.inf if estimate is None else estimate.r95_m)
    return radii


def never(*_: object) -> Steps[None]:
    """Look at nothing, in no step."""
    yield from ()


@pytest.mark.slow
def test_a_tracker_sees_a_target_walk_and_leaves_the_estimate_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = rows_of(np.random.default_rng(8), 60.0, velocity_mps=(0.4, 0.3))
    tracker = TargetTracker(TrackerParams(filter=params()))
    radii = tracked(rows, tracker)
    assert tracker.watch.motion is not None
    assert tracker.watch.motion.speed_mps == pytest.approx(0.5, abs=0.2)
    monkeypatch.setattr(MotionWatch, "look", Stepwise(never))
    assert tracked(rows, TargetTracker(TrackerParams(filter=params()))) == radii
