"""Tiles of the usual web map, against positions whose tiles are known."""

from __future__ import annotations

import pytest

from companion.geometry.coordinates import corner_of, tile_at


def test_a_known_place_has_its_known_tile() -> None:
    # The example of OpenStreetMap's wiki, "Slippy map tilenames".
    assert tile_at((51.51202, 0.02435), 17) == (65544, 43582)


@pytest.mark.parametrize("zoom", [0, 3, 12, 19])
@pytest.mark.parametrize("position", [(47.4, 8.5), (-33.9, 151.2), (0.1, -179.9), (84.0, 0.0)])
def test_a_place_is_between_the_corners_of_its_tile(
    position: tuple[float, float], zoom: int
) -> None:
    x, y = tile_at(position, zoom)
    north, west = corner_of(x, y, zoom)
    south, east = corner_of(x + 1, y + 1, zoom)
    assert south <= position[0] <= north
    assert west <= position[1] <= east


def test_beyond_the_map_the_nearest_tile_counts() -> None:
    assert tile_at((89.0, 180.0), 4) == tile_at((85.0, 179.99), 4)
