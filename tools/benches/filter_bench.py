"""Cost of a filter update, and of filterpy's extended Kalman filter on the same measurements.

The measurements are range and bearing of one run of the canonical lawnmower. All filters process
them from the same first fix, one after the other in many rounds, so that other load on the machine
hits all of them; a figure is the median over the rounds, per update.

filterpy is used as in its documentation: one filter object, range and bearing at once, model and
Jacobian written in plain Python, prediction and update timed separately. The target is stationary,
so that the companion's prediction has nothing to compute; filterpy's multiplies its matrices
anyway.

Compiled and plain kernels cannot share a process. The plain ones are timed in a second one,
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from time import perf_counter

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from companion.kernel import Matrix, Vector, kernel
from companion.planning.views import NO_LATCH
from tools.study.case import PLANNER, Case, channel_draws, measured, stream
from tools.study.systems import System, belief_of, recursive_filter_of, steering_of
from tools.study.trials import run_trial
from tools.study.walk import (
    FIXED,
    WalkFilter,
    WalkSteering,
    first_fix,
    next_position,
    updated,
)

ROUNDS = 25
SEED = 1
SYSTEM = System("asymmetric_huber", "passive")

FILTERPY_PREDICT, FILTERPY_UPDATE = "filterpy predict", "filterpy update"
LOOP, OBJECT = "update, in a kernel's loop", "TargetFilter.update"

Seconds = dict[str, float]
"""Time per update, by name."""
Contender = Callable[[], Seconds]


@dataclass(frozen=True, slots=True)
class Walk:
    """Run of a system, with all data for retracing it."""

    case: Case
    system: System
    track_enu_m: Matrix
    """Positions of the sensor, (n, 2), metres."""
    z: Matrix
    """Measurements, (n, 3): range, bearing and no elevation."""
    picks: Vector
    """Draws of the planner, (n,)."""
    belief: WalkFilter
    steering: WalkSteering

    @classmethod
    def of(cls, case: Case, system: System) -> Walk:
        """Fly a system in a case; a ValueError if there are no kernels for its filter."""
        belief, steering = belief_of(case, system), steering_of(case, system)
        trial, draws = run_trial(case, system, SEED), channel_draws(case, SEED)
        track = np.ascontiguousarray(trial.track_enu_m)
        z = [
            (*measured(draw, east_m, north_m, trial.truth), math.nan)
            for draw, (east_m, north_m) in zip(draws, track.tolist(), strict=True)
        ]
        picks = stream(SEED, PLANNER).random(case.steps)
        return cls(case, system, track, np.array(z), picks, belief, steering)

    def first_fix(self) -> tuple[Vector, Matrix]:
        """Return the mean and covariance at which all filters start."""
        (east_m, north_m), (range_m, bearing_rad, _) = self.track_enu_m[0], self.z[0]
        return first_fix(east_m, north_m, range_m, bearing_rad, self.belief)


def print_filters(rounds: int = ROUNDS) -> None:
    """Time the filters, compiled if numba is installed, and plain; print times and limits."""
    walk = Walk.of(Case(), SYSTEM)
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
    """Return each cost with a limit next to its peer's, from costs in microseconds."""
    found = []
    for way, costs_us, name, peers, limit in (
        ("compiled", compiled_us, LOOP, (FILTERPY_PREDICT, FILTERPY_UPDATE), 0.1),
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


def seconds_of(walk: Walk, rounds: int) -> dict[str, float]:
    """Return the medians of everything timed, kernels as in this process, microseconds."""
    contenders: list[Contender] = [
        lambda: filterpy_seconds(walk),
        lambda: {LOOP: step_seconds(walk, perf_counter)},
        lambda: object_seconds(walk),
    ]
    return timed({SYSTEM: contenders}, rounds)[SYSTEM]


def print_times(rounds: int) -> None:
    """Write the medians of this process to its standard output, as JSON."""
    sys.stdout.write(json.dumps(seconds_of(Walk.of(Case(), SYSTEM), rounds)))


def timed(timers: Mapping[System, Sequence[Contender]], rounds: int) -> dict[System, Seconds]:
    """Return the median times of each system over interleaved rounds, microseconds.

    The first round, which compiles, is excluded.
    """
    named = [(system, timer) for system, own in timers.items() for timer in own]
    for _, timer in named:
        timer()
    found: dict[System, dict[str, list[float]]] = {system: {} for system in timers}
    for _ in range(rounds):
        for system, timer in named:
            for name, seconds in timer().items():
                found[system].setdefault(name, []).append(seconds)
    return {
        system: {name: 1e6 * statistics.median(values) for name, values in own.items()}
        for system, own in found.items()
    }


def filterpy_seconds(walk: Walk) -> Seconds:
    """Run filterpy's filter once, prediction and update timed separately."""
    mean, covariance = walk.first_fix()
    ekf = ExtendedKalmanFilter(dim_x=4, dim_z=2)
    ekf.x, ekf.P, ekf.F, ekf.Q = mean, covariance, np.eye(4), np.zeros((4, 4))
    ekf.R = np.diag(walk.belief.sigma[:2] ** 2)
    predicting = updating = 0.0
    for position, z in zip(walk.track_enu_m[1:].tolist(), walk.z[1:, :2], strict=True):
        at = tuple(position)
        begun = perf_counter()
        ekf.predict()
        predicted = perf_counter()
        ekf.update(z, _jacobian, _expected, args=at, hx_args=at, residual=_residual)
        updating += perf_counter() - predicted
        predicting += predicted - begun
    updates = len(walk.z) - 1
    return {FILTERPY_PREDICT: predicting / updates, FILTERPY_UPDATE: updating / updates}


@kernel
def retraced(
    track_enu_m: Matrix, z: Matrix, picks: Vector, belief: WalkFilter, steering: WalkSteering
) -> tuple[Vector, Matrix]:
    """Return the last mean, (n,), and every decision after the first one, (steps - 1, 2).

    Args:
        track_enu_m: (steps, 2) positions of the run.
        z: (steps, 3) its measurements.
        picks: (steps,) draws of its planner.
    """
    positions = track_enu_m[1:].copy()
    sensor, latch = np.zeros(3), NO_LATCH
    sensor[:2] = track_enu_m[0]
    mean, covariance = first_fix(sensor[0], sensor[1], z[0, 0], z[0, 1], belief)
    if steering.planner != FIXED:
        _, _, latch = next_position(sensor, mean, covariance, picks[0], latch, belief, steering)
    for step in range(1, z.shape[0]):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
        if steering.planner != FIXED:
            positions[step - 1, 0], positions[step - 1, 1], latch = next_position(
                sensor, mean, covariance, picks[step], latch, belief, steering
            )
    return mean, positions


def step_seconds(walk: Walk, clock: Callable[[], float]) -> float:
    """Run filter and planner once as a loop inside a kernel, as the studies do; s a step."""
    begun = clock()
    retraced(walk.track_enu_m, walk.z, walk.picks, walk.belief, walk.steering)
    return (clock() - begun) / (len(walk.z) - 1)


def object_seconds(walk: Walk) -> Seconds:
    """Run the filter class that flies once, its report included."""
    target_filter = recursive_filter_of(walk.case, SYSTEM)
    state = FilterState.of(0.0, *walk.first_fix())
    seen = [
        ((*position, 0.0), RangingMeasurement(1, 0.0, range_m=z[0], bearing_enu_rad=z[1]))
        for position, z in zip(walk.track_enu_m[1:].tolist(), walk.z[1:].tolist(), strict=True)
    ]
    begun = perf_counter()
    for position, measurement in seen:
        state = target_filter.update(state, measurement, position).state
    return {OBJECT: (perf_counter() - begun) / len(seen)}


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
