"""Two direction cosines in the window are one direction: both are weighed and dropped alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.antenna import AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import BEARING, ELEVATION, predicted
from companion.estimation.window.map_kernels import VALUES, normaliser, row_sigmas
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix

PARAMS = FilterParams(antenna=AntennaParams(kind="two_axis"), own_position_sigma_m=0.5)
MEAN = np.array([3.0, -2.0, 0.0, 0.0])
AXES = (0.0, 1.0, 0.0, 1.0, 0.0, 0.0)
GROSS = 4


def _rows() -> Matrix:
    """A look down from a circle about the target, without noise."""
    rows = np.empty((24, 16))
    for index in range(24):
        angle = 2.0 * math.pi * index / 24
        pose = [3.0 + 15.0 * math.cos(angle), 15.0 * math.sin(angle) - 2.0, 20.0, *AXES]
        z = predicted(MEAN, np.array(pose), PARAMS.model)
        rows[index] = [*pose[:3], *z, 1.5, 0.03, 0.03, index, *AXES]
    return rows


@pytest.mark.parametrize("modality", [BEARING, ELEVATION])
def test_a_direction_with_either_cosine_grossly_off_goes_whole(modality: int) -> None:
    rows, solver = _rows(), WindowMap(PARAMS)
    rows[GROSS, VALUES + modality] += 0.8
    optimum = solver.optima(rows, [MEAN], is_white=True)[0]
    kept = solver.without_gross(rows, optimum.mean)
    assert kept is not None
    assert np.isnan(kept[GROSS, VALUES : VALUES + 3]).tolist() == [False, True, True]
    assert np.isnan(kept).sum() == 2


def test_both_cosines_say_less_of_a_vague_place() -> None:
    rows, solver = _rows(), WindowMap(PARAMS)
    sharp, vague = (solver.scores(rows, MEAN, spread_m2).H for spread_m2 in (0.0, 400.0))
    parts = np.abs(vague).reshape(3, 24, 4).sum(axis=(1, 2))
    parts /= np.abs(sharp).reshape(3, 24, 4).sum(axis=(1, 2))
    assert parts[0] == pytest.approx(1.0)
    assert parts[BEARING] == pytest.approx(parts[ELEVATION], rel=0.05)
    assert parts[BEARING] < 0.2


def test_costs_of_places_are_comparable_by_both_cosines() -> None:
    rows = _rows()
    sigmas = row_sigmas(rows, MEAN, PARAMS.model)
    both = normaliser(rows, sigmas, PARAMS.model)
    rows[:, VALUES + ELEVATION] = np.nan
    assert both == pytest.approx(2.0 * normaliser(rows, sigmas, PARAMS.model))
    assert both > 0.0
