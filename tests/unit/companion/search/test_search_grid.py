from __future__ import annotations

import numpy as np
import pytest
import shapely

from companion.search.search_grid import (
    MAX_CELLS,
    SearchGrid,
    WeightedArea,
    grid_of_weights,
    grid_over,
)
from companion.search.searched_area import SearchState
from companion.search.searched_flight import gaps_of, outlines

SQUARE = ((0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0))
EAST = ((400.0, 0.0), (800.0, 0.0), (800.0, 400.0), (400.0, 400.0))


def test_poa_is_shared_by_weight_and_even_within() -> None:
    grid = grid_over([WeightedArea(SQUARE, 70.0), WeightedArea(EAST, 30.0)], 20.0)
    east = grid.centres_enu_m[:, 0] > 400.0
    assert len(grid.poa) == 800
    assert grid.poa[~east].sum() == pytest.approx(0.7)
    assert np.unique(grid.poa.round(12)).tolist() == [0.00075, 0.00175]


def test_overlapping_areas_add_up() -> None:
    grid = grid_over([WeightedArea(SQUARE), WeightedArea(SQUARE)], 20.0)
    assert grid.poa == pytest.approx(1.0 / 400.0)


def test_a_hole_is_not_searched() -> None:
    hole = ((100.0, 100.0), (200.0, 100.0), (200.0, 200.0), (100.0, 200.0))
    grid = grid_over([WeightedArea(SQUARE, holes_enu_m=(hole,))], 20.0)
    assert len(grid.poa) == 375


def test_a_small_area_has_small_cells() -> None:
    small = ((0.0, 0.0), (30.0, 0.0), (30.0, 60.0), (0.0, 60.0))
    assert grid_over([WeightedArea(small)], 20.0).cell_m == 3.0


@pytest.mark.parametrize("sides_m", [(4001.0, 4001.0), (300.0, 60_000.0), (9e4, 7e4)])
def test_a_large_area_has_cells_as_small_as_their_number_allows(
    sides_m: tuple[float, float],
) -> None:
    width_m, height_m = sides_m
    large = ((0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m))
    grid = grid_over([WeightedArea(large)], 20.0)
    assert 0.95 * MAX_CELLS < grid.inside.size <= MAX_CELLS
    assert grid.cell_m > 20.0


@pytest.mark.parametrize(
    ("areas", "problem"),
    [
        ([], "no polygon of the search area has a weight above 0"),
        ([WeightedArea(SQUARE, 0.0)], "no polygon of the search area has a weight above 0"),
        (
            [WeightedArea(SQUARE, holes_enu_m=(SQUARE,))],
            "a polygon of the search area encloses nothing",
        ),
    ],
)
def test_what_is_no_search_area_is_refused(areas: list[WeightedArea], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        grid_over(areas, 20.0)


def test_a_raster_of_weights_leaves_out_what_has_none() -> None:
    weights = np.array([[1.0, np.nan], [3.0, 0.0]])
    grid = grid_of_weights(10.0, 20.0, 5.0, weights)
    assert grid.poa.tolist() == [0.25, 0.75]
    assert grid.centres_enu_m.tolist() == [[12.5, 22.5], [12.5, 27.5]]
    with pytest.raises(ValueError, match="no cell"):
        grid_of_weights(0.0, 0.0, 5.0, np.zeros((3, 3)))


@pytest.mark.parametrize("seed", range(40))
def test_outlines_are_valid_polygons_about_just_the_wanted_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inside = rng.random(tuple(rng.integers(1, 12, 2))) < 0.9
    inside[0, 0] = True
    cells = int(inside.sum())
    grid = SearchGrid(3.0, -4.0, 2.0, inside, np.full(cells, 1.0 / cells))
    wanted = rng.random(cells) < 0.6
    found = [shapely.Polygon(o.outside_enu_m, o.holes_enu_m) for o in outlines(grid, wanted)]
    assert all(polygon.is_valid and polygon.exterior.is_ccw for polygon in found)
    assert sum(polygon.area for polygon in found) == pytest.approx(4.0 * wanted.sum())
    inside_one = shapely.union_all(found).contains(shapely.points(grid.centres_enu_m))
    assert inside_one.tolist() == wanted.tolist()


def test_gaps_are_named_as_they_are_said() -> None:
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    east, north = grid.centres_enu_m.T
    pod = np.where((east > 300.0) & (north > 300.0), 0.1, 0.9)
    pod[(east < 60.0) & (abs(north - 200.0) < 60.0)] = 0.2
    pod[0] = 0.0  # one cell is not worth a word
    gaps = gaps_of(SearchState(grid, pod))
    assert [gap.name for gap in gaps] == ["NE corner", "W side"]
    assert gaps[0].poa == pytest.approx(25.0 / 400.0)


def test_an_area_that_was_not_searched_is_one_gap() -> None:
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    (gap,) = gaps_of(SearchState(grid, np.zeros(400)))
    assert gap.name == "most of the area"
