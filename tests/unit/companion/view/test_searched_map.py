"""The searched area on the map: where it lies, its gaps, and that only changes are sent."""

from __future__ import annotations

import base64
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.area_handoff import png_of
from companion.geometry.coordinates import LocalOrigin
from companion.search.search_grid import MAX_CELLS, SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import SearchState
from companion.search.searched_flight import gaps_of
from companion.view.history import PackedState, SearchedHistory, drawn

TRIANGLE = WeightedArea(((0.0, 0.0), (200.0, 0.0), (0.0, 160.0)), 3.0)
BESIDE = WeightedArea(((200.0, 0.0), (400.0, 0.0), (400.0, 160.0), (200.0, 160.0)), 1.0)
GRID = grid_over([TRIANGLE, BESIDE], 20.0)
HOME = LocalOrigin(47.0, 8.0, 488.0)


def searched_west(grid: SearchGrid = GRID) -> SearchState:
    """A search of all but the east."""
    east = grid.centres_enu_m[:, 0]
    return SearchState(grid, np.where(east < 300.0, 0.913, 0.207))


def test_what_is_packed_comes_back_to_three_digits() -> None:
    state = searched_west()
    again = PackedState.of(state).state()
    assert np.array_equal(again.grid.inside, GRID.inside)
    np.testing.assert_allclose(again.pod, state.pod, rtol=1e-3)
    np.testing.assert_allclose(again.grid.poa, GRID.poa, rtol=2e-3)
    assert again.pos == pytest.approx(state.pos, abs=1e-3)


def test_the_map_has_the_image_of_the_hand_off_and_its_gaps_in_metres() -> None:
    state = searched_west()
    area: Any = drawn(PackedState.of(state))
    head, _, data = area["image"].partition(",")
    assert head == "data:image/png;base64"
    size = struct.unpack(">II", base64.b64decode(data)[16:24])
    assert size == struct.unpack(">II", png_of(state)[16:24])
    assert area["corners"] == [(0.0, 0.0), (400.0, 160.0)]
    (gap,) = area["gaps"]
    (expected,) = gaps_of(state)
    assert gap["text"] == f"gap: {expected.name}, POA {100.0 * expected.poa:.0f} %"
    (outline,) = gap["outlines"]
    assert set(outline["outside_enu_m"]) == {(304, 0), (400, 0), (400, 160), (304, 160)}
    assert 304.0 < gap["label"][0] < 400.0


def session(state: SearchState | None, frame: LocalOrigin | None = HOME) -> Any:
    searching = SimpleNamespace(is_worth_reporting=True, frame=HOME, state=state)
    return SimpleNamespace(searching=searching, vehicle=SimpleNamespace(frame=frame))


def test_only_a_change_is_sent() -> None:
    history = SearchedHistory()
    history.look(session(None))
    assert (history.items, history.version) == ([], 0)
    versions = []
    for state in (searched_west(), searched_west(), SearchState(GRID, np.zeros(len(GRID.poa)))):
        for _picture in range(2):
            history.look(session(state))
            versions.append(history.version)
    assert versions == [1, 1, 1, 1, 2, 2]


def test_the_map_stays_on_the_ground_when_the_origin_moves() -> None:
    moved = LocalOrigin(47.0009, 8.0, 488.0)  # 100 m to the north
    history = SearchedHistory()
    state = searched_west()
    for frame in (HOME, moved):
        history.look(session(state, frame))
    assert history.items[0].south_m == pytest.approx(-100.0, abs=1.0)
    assert history.items[0].west_m == pytest.approx(0.0, abs=0.1)


def test_the_largest_grid_is_small_enough_for_the_pipe() -> None:
    side_m = 20.0 * MAX_CELLS**0.5
    square = WeightedArea(((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m)))
    grid = grid_over([square], 20.0)
    east, north = grid.centres_enu_m.T
    state = SearchState(grid, 0.5 + 0.5 * np.sin(east / 300.0) * np.cos(north / 200.0))
    packed = PackedState.of(state)
    assert len(packed.cells) < 200_000
