"""Check of the compiled EKF of the tables against filterpy's filter.

The compiled EKF flies, and filterpy's filter fuses each measurement from the EKF's state at that
time. It is reset to that state each time, because an EKF that has lost its target multiplies a
difference of rounding by ten every 40 steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from sim_link.world.environment import NO_MEMORY
from tools.study import case as cases
from tools.study.case import Case, RunSeed
from tools.study.filterpy_ekf import FilterpyEkf
from tools.study.systems import System, belief_of
from tools.study.trials import RunSeries, run_trial
from tools.study.walk import RANGE_OFFSET, TARGET_EAST, first_fix, updated

CHECKED_RUNS = 2
"""Checked runs of every cell, from the first."""
LARGEST_DIFFERENCE_M = 1e-6


@dataclass(frozen=True, slots=True)
class EkfCheck(RunSeries):
    """The first runs of an EKF cell, for filterpy to repeat."""


def largest_difference_m(check: RunSeries) -> float:
    """Return the largest difference of a coordinate or range offset after any step, metres.

    Between the two filters, or between the one that was compared and the one that flew.
    """
    seeds = cases.run_seeds(check.seed, check.runs)
    gaps = [gap_m for seed in seeds for gap_m in _gaps_m(check.case, check.system, seed)]
    return max(gaps) if np.isfinite(gaps).all() else math.inf


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
        if math.isnan(mean[0]):  # the first fix is no update
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
