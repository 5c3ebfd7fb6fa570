"""Cost of a filter update, beside filterpy's extended Kalman filter on the same measurements.

The measurements are range and bearing of one run of the canonical lawnmower. All filters process
them from the same first fix, one after the other in many rounds, so that other load on the machine
hits all of them; a figure is the median over the rounds, per update.

filterpy is used as in its documentation: one filter object, range and bearing at once, model and
Jacobian written in plain Python, prediction and update timed separately. The target lies still, so
that the companion's prediction has nothing to compute; filterpy's multiplies its matrices all the
same.

Compiled and plain kernels cannot live in one process. The plain ones are timed in a second one,
with numba's compilation disabled, against filterpy timed there; both belong to the same run.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from time import perf_counter
from typing import TypeVar

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from companion.estimation.window.map_kernels import (
    COLUMNS,
    DAMPING_START,
    map_step,
    measured_innovations,
)
from companion.kernel import Matrix, Vector, kernel
from tools.study.case import (
    CHANNEL,
    TRUTH,
    Case,
    drawn,
    measured,
    stream,
    track_of,
    truth_of,
)
from tools.study.systems import System, belief_of, recursive_filter_of
from tools.study.walk import WalkFilter, first_fix, updated

WINDOW = 200
"""Measurements of the window whose solution is timed."""
MAP_STEPS = 40
"""Steps timed together; one is too short for the clock."""
START_OFF_M = 2.0
"""Distance east and north from the target to the start of the window's solution."""
ROUNDS = 25
SEED = 1
SYSTEM = System("asymmetric_huber", "passive")

FILTERPY_PREDICT, FILTERPY_UPDATE = "filterpy predict", "filterpy update"
LOOP, OBJECT = "update, in a kernel's loop", "TargetFilter.update"
MAP_STEP = f"MAP step of {WINDOW}"

Seconds = dict[str, float]
"""Time per update or step, by name."""
Contender = Callable[[], Seconds]
Subject = TypeVar("Subject", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Walk:
    """Input of every filter."""

    case: Case
    track_enu_m: Matrix
    """(n, 2)"""
    z: Matrix
    """(n, 3) range, bearing and no elevation."""
    belief: WalkFilter

    def first_fix(self) -> tuple[Vector, Matrix]:
        """Return the mean and covariance at which all filters start."""
        (east_m, north_m), (range_m, bearing_rad, _) = self.track_enu_m[0], self.z[0]
        return first_fix(east_m, north_m, range_m, bearing_rad, self.belief)


def print_filters(rounds: int = ROUNDS) -> None:
    """Time the filters, compiled if numba is installed, and plain; print times and limits."""
    walk = canonical_walk()
    has_numba = importlib.util.find_spec("numba") is not None
    compiled = seconds_of(walk, rounds) if has_numba else None
    plain = _plain_in_a_process(rounds) if has_numba else seconds_of(walk, rounds)
    numba = f"numba {version('numba')}" if has_numba else "no numba: plain Python only"
    print(f"Python {platform.python_version()}, numpy {np.__version__}, {numba}")
    print(f"medians over {rounds} rounds of {len(walk.z) - 1} updates, microseconds\n")
    print(f"{'':28s}{'compiled':>10s}{'plain':>10s}")
    for name, plain_us in plain.items():
        compiled_us = "-" if compiled is None else f"{compiled[name]:.2f}"
        print(f"{name:28s}{compiled_us:>10s}{plain_us:10.2f}")
    print("", *verdicts_of(compiled, plain), sep="\n")


def verdicts_of(compiled_us: dict[str, float] | None, plain_us: dict[str, float]) -> list[str]:
    """Return each cost with a limit beside its peer's, from costs in microseconds."""
    found = []
    for way, costs_us, name, peers, limit in (
        ("compiled", compiled_us, LOOP, (FILTERPY_PREDICT, FILTERPY_UPDATE), 0.1),
        ("compiled", compiled_us, MAP_STEP, (FILTERPY_UPDATE,), 5.0),
        ("plain", plain_us, OBJECT, (FILTERPY_UPDATE,), 3.0),
    ):
        if costs_us is not None:
            cost_us, peers_us = costs_us[name], sum(costs_us[peer] for peer in peers)
            ratio, named = cost_us / peers_us, " + ".join(peers)
            found.append(
                f"{way} {name}: {cost_us:.2f} us, {ratio:.3f} x {named} ({peers_us:.2f} us); "
                f"limit {limit:g} x: {'met' if ratio <= limit else 'NOT MET'}"
            )
    return found


def canonical_walk() -> Walk:
    """Return the canonical lawnmower, measured once."""
    case = Case()
    track = track_of(case)
    truth = truth_of(case, stream(SEED, TRUTH))
    draws = drawn(stream(SEED, CHANNEL), case.steps)
    z = [
        (*measured(draw, east_m, north_m, truth), math.nan)
        for draw, (east_m, north_m) in zip(draws, track.tolist(), strict=True)
    ]
    return Walk(case, track, np.array(z), belief_of(case, SYSTEM))


def contenders(walk: Walk) -> list[Contender]:
    """Return everything that is timed, with the kernels as they are in this process."""
    return [
        lambda: filterpy_seconds(walk),
        lambda: loop_seconds(walk),
        lambda: object_seconds(walk),
        lambda: window_seconds(walk),
    ]


def seconds_of(walk: Walk, rounds: int) -> dict[str, float]:
    """Return the medians of this process, microseconds."""
    return timed({SYSTEM: contenders(walk)}, rounds)[SYSTEM]


def print_times(rounds: int) -> None:
    """Write the medians of this process to its standard output, as JSON."""
    sys.stdout.write(json.dumps(seconds_of(canonical_walk(), rounds)))


def timed(timers: Mapping[Subject, Sequence[Contender]], rounds: int) -> dict[Subject, Seconds]:
    """Return the median times of each subject over interleaved rounds, microseconds.

    The first round, which compiles, is excluded.
    """
    named = [(subject, timer) for subject, own in timers.items() for timer in own]
    for _, timer in named:
        timer()
    found: dict[Subject, dict[str, list[float]]] = {subject: {} for subject in timers}
    for _ in range(rounds):
        for subject, timer in named:
            for name, seconds in timer().items():
                found[subject].setdefault(name, []).append(seconds)
    return {
        subject: {name: 1e6 * statistics.median(values) for name, values in own.items()}
        for subject, own in found.items()
    }


def filterpy_seconds(walk: Walk) -> Seconds:
    """Run filterpy's filter once, prediction and update timed separately."""
    mean, covariance = walk.first_fix()
    ekf = ExtendedKalmanFilter(dim_x=4, dim_z=2)
    ekf.x, ekf.P, ekf.F, ekf.Q = mean, covariance, np.eye(4), np.zeros((4, 4))
    ekf.R = np.diag(walk.belief.sigma[:2] ** 2)
    predicting = updating = 0.0
    for place, z in zip(walk.track_enu_m[1:].tolist(), walk.z[1:, :2], strict=True):
        at = tuple(place)
        begun = perf_counter()
        ekf.predict()
        predicted = perf_counter()
        ekf.update(z, _jacobian, _expected, args=at, hx_args=at, residual=_residual)
        updating += perf_counter() - predicted
        predicting += predicted - begun
    updates = len(walk.z) - 1
    return {FILTERPY_PREDICT: predicting / updates, FILTERPY_UPDATE: updating / updates}


@kernel
def filtered(track_enu_m: Matrix, z: Matrix, belief: WalkFilter) -> Vector:
    """Return the mean after a walk, (n,); the target lies still, so a prediction changes nothing.

    Args:
        track_enu_m: (n, 2).
        z: (n, 3).
    """
    mean, covariance = first_fix(track_enu_m[0, 0], track_enu_m[0, 1], z[0, 0], z[0, 1], belief)
    sensor = np.zeros(3)
    for step in range(1, z.shape[0]):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
    return mean


def loop_seconds(walk: Walk) -> Seconds:
    """Run once as a loop inside a kernel, as the studies do it."""
    begun = perf_counter()
    filtered(walk.track_enu_m, walk.z, walk.belief)
    return {LOOP: (perf_counter() - begun) / (len(walk.z) - 1)}


def object_seconds(walk: Walk) -> Seconds:
    """Run the filter class that flies once, its report included."""
    target_filter = recursive_filter_of(walk.case, SYSTEM)
    state = FilterState.of(0.0, *walk.first_fix())
    seen = [
        ((*place, 0.0), RangingMeasurement(1, 0.0, range_m=z[0], bearing_enu_rad=z[1]))
        for place, z in zip(walk.track_enu_m[1:].tolist(), walk.z[1:].tolist(), strict=True)
    ]
    begun = perf_counter()
    for place, measurement in seen:
        state = target_filter.update(state, measurement, place).state
    return {OBJECT: (perf_counter() - begun) / len(seen)}


@kernel
def stepped_often(
    rows: Matrix, start: Vector, belief: WalkFilter, information: Matrix, pull: Vector, steps: int
) -> float:
    """Return the sum of the eastings at which `count` first steps of the window end."""
    total = 0.0
    for _ in range(steps):
        moved, _, _, _, _ = map_step(
            rows,
            start,
            measured_innovations(rows, start, belief.model),
            DAMPING_START,
            belief.thresholds,
            belief.bounds,
            information,
            pull,
            belief.model,
        )
        total += moved[0]
    return total


def window_seconds(walk: Walk) -> Seconds:
    """Time the first step of a window's solution."""
    rows, belief = window_rows(walk), walk.belief
    start = belief.prior_mean.copy()
    start[:2] = np.array(walk.case.target_enu_m) + START_OFF_M
    weights = 1.0 / belief.prior_sigmas**2
    weights[:2] = 0.0
    information, pull = np.diag(weights), weights * belief.prior_mean
    begun = perf_counter()
    stepped_often(rows, start, belief, information, pull, MAP_STEPS)
    return {MAP_STEP: (perf_counter() - begun) / MAP_STEPS}


def window_rows(walk: Walk) -> Matrix:
    """Return the first measurements as a window holds them, (WINDOW, COLUMNS)."""
    rows = np.zeros((WINDOW, COLUMNS))
    rows[:, :2] = walk.track_enu_m[:WINDOW]
    rows[:, 3:6] = walk.z[:WINDOW]
    rows[:, 6:9] = walk.belief.sigma
    rows[:, 9] = np.arange(WINDOW)
    return rows


def _plain_in_a_process(rounds: int) -> dict[str, float]:
    """Return the medians with numba's compilation disabled, which makes kernels plain functions."""
    code = f"from {__name__} import print_times; print_times({rounds})"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    plain_us: dict[str, float] = json.loads(done.stdout)
    return plain_us


def _expected(x: Vector, east_m: float, north_m: float) -> Vector:
    de, dn = x[0] - east_m, x[1] - north_m
    return np.array([math.sqrt(de * de + dn * dn) + x[2], math.atan2(dn, de) + x[3]])


def _jacobian(x: Vector, east_m: float, north_m: float) -> Matrix:
    de, dn = x[0] - east_m, x[1] - north_m
    ground2 = de * de + dn * dn
    ground = math.sqrt(ground2)
    return np.array([[de / ground, dn / ground, 1.0, 0.0], [-dn / ground2, de / ground2, 0.0, 1.0]])


def _residual(z: Vector, expected: Vector) -> Vector:
    y: Vector = z - expected
    y[1] = (y[1] + math.pi) % (2.0 * math.pi) - math.pi
    return y
