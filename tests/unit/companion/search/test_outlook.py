"""Forecast of a leg against the state of the search after it was flown."""

from __future__ import annotations

import numpy as np
import pytest

from companion.search.detection_model import DetectionModel
from companion.search.outlook import MAX_CELLS, LegTable, outlook_of
from companion.search.search_grid import SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import SearchedArea, state_of

SIDE_M, HEIGHT_M, SPEED_MPS = 400.0, 25.0, 5.0
SQUARE = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M))
HALF = ((0.0, 0.0), (0.5 * SIDE_M, 0.0), (0.5 * SIDE_M, SIDE_M), (0.0, SIDE_M))


def a_grid(weight_west: float = 1.0) -> SearchGrid:
    east = tuple((SIDE_M - e, n) for e, n in HALF)
    return grid_over([WeightedArea(HALF, weight_west), WeightedArea(east, 1.0)], 20.0)


def fly(area: SearchedArea, start: tuple[float, float], end: tuple[float, float]) -> None:
    length_m = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    for share in (np.arange(0.0, length_m, SPEED_MPS) + 0.5 * SPEED_MPS) / length_m:
        position = [a + share * (b - a) for a, b in zip(start, end, strict=True)]
        area.listen((position[0], position[1], HEIGHT_M), 1.0)
    area.finish()


MODELS = [
    DetectionModel(reach_m=80.0, environment=environment, duty_cycle=duty_cycle)
    for environment in ("open", "rubble", "buildings", "unknown")
    for duty_cycle in (1.0, 0.2)
]
WAYS = [((50.0, 100.0), (350.0, 100.0)), ((30.0, 380.0), (250.0, 60.0))]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.environment} {m.duty_cycle}")
@pytest.mark.parametrize("way", WAYS)
def test_a_leg_finds_what_was_forecast(model: DetectionModel, way: tuple) -> None:  # type: ignore[type-arg]
    """First over an area that was not searched, then over one with a leg behind it."""
    area = SearchedArea(a_grid(3.0), model)
    table = LegTable(model, HEIGHT_M, SPEED_MPS)
    for start, end in (way, ((50.0, 190.0), (350.0, 190.0))):
        expected = outlook_of(area).after(start, end, table)
        before = state_of(area).pos
        fly(area, start, end)
        gain = state_of(area).pos - before
        assert gain > 0.03
        assert expected.left == pytest.approx(1.0 - state_of(area).pos, abs=0.25 * gain)


def test_the_same_leg_again_finds_next_to_nothing() -> None:
    model = MODELS[2]
    area = SearchedArea(a_grid(), model)
    fly(area, *WAYS[0])
    table, outlook = LegTable(model, HEIGHT_M, SPEED_MPS), outlook_of(area)
    again = outlook.left - outlook.after(*WAYS[0], table).left
    beside = outlook.left - outlook.after((50.0, 250.0), (350.0, 250.0), table).left
    assert again < 0.1 * beside


def test_a_large_area_is_forecast_in_blocks_of_cells() -> None:
    large = tuple((10.0 * e, 10.0 * n) for e, n in SQUARE)
    outlook = outlook_of(SearchedArea(grid_over([WeightedArea(large)], 20.0), MODELS[0]))
    assert len(outlook.chance) <= MAX_CELLS
    assert outlook.left == pytest.approx(1.0, abs=1e-5)
    centres = outlook.grid.centres_enu_m
    assert centres.min() > 0.0
    assert centres.max() < 10.0 * SIDE_M + outlook.grid.cell_m
    assert outlook.is_even


def test_far_cells_are_not_heard_by_a_leg() -> None:
    model = DetectionModel(reach_m=20.0, reach_sigma_db=1.0, environment="open")
    outlook = outlook_of(SearchedArea(a_grid(), model))
    after = outlook.after((10.0, 10.0), (10.0, 60.0), LegTable(model, 10.0, 5.0))
    far = np.hypot(*(outlook.grid.centres_enu_m - (10.0, 35.0)).T) > 200.0
    assert np.allclose(outlook.chance[far], after.chance[far], rtol=1e-3)
