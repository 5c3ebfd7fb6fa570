from __future__ import annotations

import msgspec
import numpy as np
import pytest

from companion.geometry.coordinates import LocalOrigin
from companion.search.detection_model import DetectionModel
from companion.search.search_grid import SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import LearntReach, SearchedArea, SearchState, state_of
from companion.search.searched_flight import (
    SearchedFlight,
    StoredGrid,
    combined_area,
    reach_source,
    statement,
)

SQUARE = ((0.0, 0.0), (200.0, 0.0), (200.0, 200.0), (0.0, 200.0))
MODEL = DetectionModel(reach_m=50.0)
ORIGIN = LocalOrigin(47.0, 8.0, 400.0)


def grid() -> SearchGrid:
    return grid_over([WeightedArea(SQUARE)], 20.0)


def flight(north_m: float, origin: LocalOrigin = ORIGIN, reach_m: float = 50.0) -> SearchedFlight:
    """Along a line over the square, at a height of 20 m."""
    return SearchedFlight(
        began_unix_s=0.0,
        ended_unix_s=100.0,
        listened_s=100.0,
        is_radio_heard=True,
        origin=origin,
        detection=DetectionModel(reach_m=reach_m),
        grid=StoredGrid.of(grid()),
        looks=[(2.0 * second, north_m, 20.0, 1.0) for second in range(100)],
    )


def pos_of(*flights: SearchedFlight) -> float:
    state = combined_area(flights)
    assert state is not None
    return state.pos


def test_a_flight_is_the_same_after_its_file() -> None:
    written = flight(100.0)
    read = msgspec.json.decode(msgspec.json.encode(written), type=SearchedFlight)
    assert read == written
    area = SearchedArea(grid(), MODEL)
    for east, north, up, _ in written.looks:
        area.listen((east, north, up), 1.0)
    area.finish()
    assert pos_of(read) == pytest.approx(state_of(area).pos, abs=5e-3)


def test_flights_together_have_searched_more_than_each() -> None:
    south, north = flight(40.0), flight(160.0)
    both = pos_of(south, north)
    assert both > max(pos_of(south), pos_of(north)) + 0.05
    assert both == pytest.approx(pos_of(north, south), abs=1e-3)


def test_the_same_flight_twice_is_hardly_more_than_once() -> None:
    once = pos_of(flight(100.0))
    assert once <= pos_of(flight(100.0), flight(100.0)) < once + 0.05
    two_radios = pos_of(flight(100.0), flight(100.0, reach_m=51.0))
    independent = 1.0 - (1.0 - once) ** 2
    assert once <= two_radios < independent


def test_a_flight_of_another_origin_is_moved() -> None:
    position = ORIGIN.geodetic_from_enu((0.0, -60.0, 0.0))
    moved = flight(170.0, LocalOrigin(position[0], position[1], 400.0))
    assert pos_of(flight(110.0), moved) == pytest.approx(
        pos_of(flight(110.0), flight(110.0)), abs=1e-3
    )


def test_what_is_no_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="no cells"):
        StoredGrid(0.0, 0.0, 5.0, [[None, None]]).grid()
    with pytest.raises(ValueError, match="inhomogeneous"):
        StoredGrid(0.0, 0.0, 5.0, [[0.5], [0.25, 0.25]]).grid()


def test_the_sentence_for_the_radio() -> None:
    pod = np.where(grid().centres_enu_m.sum(axis=1) > 320.0, 0.1, 0.9)
    state = SearchState(grid(), pod)
    assert statement(flight(0.0), state) == (
        "Nothing heard. 94 % of the planned area searched at 80 % or more; POS 85 %; gaps: "
        "NE corner. Reach 50 m, as configured."
    )
    silent = msgspec.structs.replace(flight(0.0), is_radio_heard=False)
    assert "sent nothing at all: check that it was receiving" in statement(silent, state)
    late = msgspec.structs.replace(flight(0.0), contact_unix_s=50.0)
    assert statement(late, state).startswith("Searched before contact:")
    assert "the radio's reach is unknown" in statement(flight(0.0), None)


@pytest.mark.parametrize(
    ("reported", "heard", "sought", "expected"),
    [
        ((), (), None, "Nothing heard. "),
        ((7,), (), (), "1 reported (emitter 7); nothing heard of others. "),
        ((3, 7), (9,), (), "2 reported (emitters 3, 7), 1 heard (emitter 9); nothing heard of "),
        ((), (7,), (3, 4), "1 heard (emitter 7); nothing heard of emitters 3, 4. "),
        ((7,), (), None, "Searched before contact: "),
    ],
)
def test_the_sentence_says_of_which_emitters_nothing_was_heard(
    reported: tuple[int, ...], heard: tuple[int, ...], sought: tuple[int, ...] | None, expected: str
) -> None:
    contact = 10.0 if reported or heard else None
    it = msgspec.structs.replace(
        flight(100.0), reported=reported, heard=heard, sought=sought, contact_unix_s=contact
    )
    assert statement(it, combined_area([it])).startswith(expected)


def test_the_source_of_the_reach_is_named() -> None:
    it = msgspec.structs.replace(flight(100.0), reach_from="preset")
    assert statement(it, combined_area([it])).endswith(" Reach 50 m, from the radio's preset.")
    assert reach_source(it) == "preset, estimation.filter.reach_m: 50 m, 4 dB"
    learnt = msgspec.structs.replace(it, learnt=LearntReach(41.0, 2.5))
    assert reach_source(learnt) == (
        "first contact of this flight: 41 m, 2.5 dB; preset, estimation.filter.reach_m: 50 m, 4 dB"
    )
