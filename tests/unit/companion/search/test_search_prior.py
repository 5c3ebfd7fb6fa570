"""Prior of the first hypotheses that a search in vain leaves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.search.detection_model import DetectionModel
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import MIN_ODDS, SearchedArea, SearchPrior, state_of

SQUARE = ((0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0))


@pytest.fixture
def prior() -> SearchPrior:
    """Return the prior after a lane along the southern border."""
    area = SearchedArea(grid_over([WeightedArea(SQUARE)], 20.0), DetectionModel(reach_m=80.0))
    for east in np.arange(0.0, 400.0, 5.0):
        area.listen((float(east), 60.0, 20.0), 1.0)
    area.finish()
    return SearchPrior.of(state_of(area))


def test_what_was_searched_in_vain_is_less_likely(prior: SearchPrior) -> None:
    along = [prior.log_at((200.0, north)) for north in (60.0, 150.0, 250.0, 390.0)]
    assert along == sorted(along)
    assert along[0] == pytest.approx(math.log(MIN_ODDS))
    assert along[-1] > math.log(0.9)


def test_beyond_the_map_it_is_as_at_its_border(prior: SearchPrior) -> None:
    assert prior.log_at((200.0, -500.0)) == prior.log_at((200.0, 5.0))
    assert prior.log_at((1e7, 1e7)) == prior.log_at((399.0, 399.0))


def test_it_moves_with_the_frame(prior: SearchPrior) -> None:
    moved = prior.moved((100.0, -7.0)).moved((0.0, 7.0))
    assert moved.log_at((300.0, 150.0)) == prior.log_at((200.0, 150.0))


def test_weights_of_the_area_count() -> None:
    west = ((0.0, 0.0), (200.0, 0.0), (200.0, 400.0), (0.0, 400.0))
    areas = [WeightedArea(west, 3.0), WeightedArea(tuple((400.0 - e, n) for e, n in west), 1.0)]
    area = SearchedArea(grid_over(areas, 20.0), DetectionModel(reach_m=80.0))
    prior = SearchPrior.of(state_of(area))
    assert prior.log_at((300.0, 200.0)) == pytest.approx(math.log(1.0 / 3.0))
    assert prior.log_at((100.0, 200.0)) == 0.0
