"""The compiled EKF of the studies' tables against filterpy's filter.

The compiled EKF flies, and filterpy's filter fuses each measurement from the EKF's state at that
time. It is reset to that state each time, because an EKF that has lost its target multiplies a
difference of rounding by ten every 40 steps.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from sim_link.world.environment import NO_MEMORY, ObstacleParams
from tests.oracle.filterpy_ekf import FilterpyEkf
from tools.study import case as cases
from tools.study import systems
from tools.study.case import Case, RunSeed
from tools.study.systems import System, belief_of
from tools.study.trials import run_trial
from tools.study.walk import RANGE_OFFSET, TARGET_EAST, first_fix, updated

SHORT = Case(steps=40)
BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))


def largest_difference_m(case: Case, system: System, runs: int) -> float:
    """The largest difference of a coordinate or range offset after any step, metres.

    Between the two filters, or between the one that was compared and the one that flew.
    """
    seeds = cases.run_seeds(1, runs)
    return max(gap_m for seed in seeds for gap_m in _gaps_m(case, system, seed))


def _gaps_m(case: Case, system: System, seed: RunSeed) -> list[float]:
    belief, scene, library = belief_of(case, system), cases.scene_of(case), FilterpyEkf(case.belief)
    draws, truth, start_enu_m = cases.run_inputs(case, seed)
    mean, covariance = first_fix(0.0, 0.0, 1.0, 0.0, belief)
    mean[:2] = start_enu_m
    z, memory = np.full(3, np.nan), NO_MEMORY
    gaps: list[float] = []
    for draw, flown in zip(draws, run_trial(case, system, seed).record, strict=True):
        east_m, north_m = flown[:2].tolist()
        z[0], z[1], memory = cases.measured_in(draw, east_m, north_m, truth, scene, memory)
        if math.isnan(mean[0]):  # the first fix is not an update
            mean, covariance = first_fix(east_m, north_m, z[0], z[1], belief)
            theirs = mean
        else:
            range_m, bearing_rad = z[:2].tolist()
            seen = RangingMeasurement(1, 0.0, range_m=range_m, bearing_enu_rad=bearing_rad)
            before = FilterState.of(0.0, mean, covariance)
            theirs = library.update(before, seen, (east_m, north_m, 0.0)).state.mean
            sensor = np.array([east_m, north_m, 0.0])
            mean, covariance = updated(mean, covariance, sensor, z, belief)
        others = (theirs[:3], flown[TARGET_EAST : RANGE_OFFSET + 1])
        gaps += [float(np.max(np.abs(mean[:3] - other))) for other in others]
    return gaps


@pytest.mark.parametrize("planner", ["latched", "reactive"])
@pytest.mark.parametrize(
    "case",
    [
        SHORT,
        msgspec.structs.replace(SHORT, first_estimate="uniform", offsets="prior"),
        msgspec.structs.replace(SHORT, obstacles=(BLOCK,)),
    ],
)
def test_the_ekf_is_filterpys(case: Case, planner: systems.PlannerName) -> None:
    gap_m = largest_difference_m(case, System("ekf", planner), runs=2)
    assert 0.0 < gap_m < 1e-9


def test_another_filter_is_not() -> None:
    gap_m = largest_difference_m(SHORT, System("huber", "latched"), runs=1)
    assert 1e-3 < gap_m < math.inf


def test_filterpys_filter_walks_where_ours_does() -> None:
    (seed,) = cases.run_seeds(1, 1)
    system = System("ekf", "fim")
    draws, truth, _ = cases.run_inputs(SHORT, seed)
    fuse = systems.fuse_by_filter(FilterpyEkf(SHORT.belief), SHORT.belief)
    steer, scene = systems.pilot_of(SHORT, system), cases.scene_of(SHORT)
    record, _ = systems.flown(draws, SHORT.start_enu_m, truth, scene, fuse, steer)
    ours = run_trial(SHORT, system, seed).record
    np.testing.assert_allclose(ours, record, rtol=1e-8, atol=1e-8)
