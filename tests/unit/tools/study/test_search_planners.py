"""Search planners in one world: the course of a flight, and the table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.search.detection_model import DetectionModel
from tools.study.search_planners import (
    FENCE,
    NAMES,
    SPEED_MPS,
    STEP_S,
    Name,
    Poa,
    SearchTimes,
    flown,
    mover_of,
    table_of,
)
from tools.study.searched_area import uneven_poa

MODEL = DetectionModel(reach_m=90.0)


@pytest.mark.parametrize("name", NAMES)
def test_a_planner_keeps_to_fence_and_speed(name: Name) -> None:
    grid = uneven_poa(FENCE[2][0], np.random.default_rng(3), is_turned=True)
    track = flown(mover_of(name, 90.0, MODEL), grid, MODEL, 150.0)
    assert np.hypot(*np.diff(track[:, :2], axis=0).T).max() <= SPEED_MPS * STEP_S + 1e-9
    assert track[:, :2].min() >= 0.0
    assert track[:, :2].max() <= FENCE[2][0]
    assert np.ptp(track[:, 0]) + np.ptp(track[:, 1]) > 100.0


def of(poa: Poa, planner: Name, *times_s: float) -> SearchTimes:
    return SearchTimes(poa, planner, times_s)


def test_the_table_compares_medians_and_misses_count() -> None:
    times = [of("even", name, 10.0, 30.0, 50.0) for name in NAMES]
    times += [of("uneven", "lawnmower", 10.0, 30.0, 50.0), of("uneven", "stonesoup", 1.0, 2.0, 3.0)]
    good = [*times, of("uneven", "probability", 5.0, 20.0, math.inf)]
    text, is_met = table_of([good])
    assert is_met
    assert "probability         20          0.67   0.67" in text
    assert not table_of([times, [of("uneven", "probability", 5.0, 28.0, 30.0)]])[1]
    worse = [each for each in good if (each.poa, each.planner) != ("even", "probability")]
    assert not table_of([worse, [of("even", "probability", 10.0, 31.0, 50.0)]])[1]
