from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from companion.search.detection_model import DetectionModel, Wall, received_share
from companion.search.search_grid import SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import BLOCK, SearchedArea, SearchState, state_of

SQUARE = ((0.0, 0.0), (200.0, 0.0), (200.0, 200.0), (0.0, 200.0))
MODEL = DetectionModel(reach_m=60.0, reach_sigma_db=3.0, duty_cycle=0.5)
PROPAGATION = MODEL.propagation


def one_cell() -> SearchGrid:
    return SearchGrid(-5.0, -5.0, 10.0, np.ones((1, 1), dtype=bool), np.ones(1))


def pod_of(looks: list[tuple[float, float, float]], model: DetectionModel = MODEL) -> float:
    """Return the POD of a cell at the origin; looks are east of it, height and seconds."""
    area = SearchedArea(one_cell(), model)
    for east_m, up_m, seconds in looks:
        area.listen((east_m, 0.0, up_m), seconds)
    area.finish()
    return float(state_of(area).pod[0])


@pytest.mark.parametrize("k_db", [-20.0, 0.0, 6.0, 15.0])
def test_fading_is_rices_about_its_median(k_db: float) -> None:
    margins_db = np.linspace(-15.0, 15.0, 31)
    b = math.sqrt(2.0 * 10.0 ** (0.1 * k_db))
    median = stats.rice.median(b)
    expected = stats.rice.sf(median * 10.0 ** (-margins_db / 20.0), b)
    np.testing.assert_allclose(received_share(margins_db, k_db), expected, atol=1e-9)


def test_pod_is_what_the_model_means() -> None:
    """Against the model's own random numbers: two positions, five and two answers."""
    rng = np.random.default_rng(3)
    runs = 400_000
    shared = rng.normal(0.0, MODEL.cell_sigma_db, runs)
    missed = np.ones(runs)
    for east_m, answers in ((70.0, 5), (110.0, 2)):
        path = rng.normal(0.0, MODEL.path_sigma_db, runs)
        slant_m = math.hypot(east_m, 20.0)
        margin_db = (
            10.0 * PROPAGATION.exponent * math.log10(MODEL.reach_m / slant_m) + shared + path
        )
        grid = np.linspace(-40.0, 40.0, 1601)
        received = np.interp(margin_db, grid, received_share(grid, PROPAGATION.rice_k_db))
        missed *= (1.0 - MODEL.duty_cycle * received) ** answers
    expected = 1.0 - missed.mean()
    assert pod_of([(70.0, 20.0, 5.0), (110.0, 20.0, 2.0)]) == pytest.approx(expected, abs=0.005)


def test_a_thousand_looks_from_one_place_are_about_one() -> None:
    one, many = pod_of([(110.0, 20.0, 1.0)]), pod_of([(110.0, 20.0, 1000.0)])
    assert 1.0 - (1.0 - one) ** 1000 > 0.999  # were they independent
    assert many < 0.7
    assert many < pod_of([(110.0 + 20.0 * k, 20.0, 50.0) for k in range(-2, 3)])


def test_an_emitter_that_sleeps_is_missed_more_often() -> None:
    awake = DetectionModel(reach_m=60.0, duty_cycle=1.0)
    asleep = DetectionModel(reach_m=60.0, duty_cycle=0.05)
    assert pod_of([(50.0, 20.0, 5.0)], asleep) < 0.5 * pod_of([(50.0, 20.0, 5.0)], awake)


def test_a_place_that_is_entered_again_goes_on_where_it_was_left() -> None:
    near, far = (70.0, 20.0, 4.0), (110.0, 20.0, 4.0)
    once = pod_of([(70.0, 20.0, 8.0), far])
    assert pod_of([near, far, near]) == pytest.approx(once, abs=1e-4)
    assert pod_of([near, far, near, far, near]) < pod_of(
        [near, far, near, far, near, (30.0, 20.0, 1.0)]
    )


def test_what_was_flown_before_can_be_taken_in() -> None:
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    flown, read = SearchedArea(grid, MODEL), SearchedArea(grid, MODEL)
    for second in range(60):
        flown.listen((3.0 * second, 100.0 - second, 20.0), 1.0)
    flown.finish()
    read.take(flown.looks)
    np.testing.assert_allclose(state_of(read).pod, state_of(flown).pod, atol=1e-4)


def test_work_is_done_piece_by_piece() -> None:
    area = SearchedArea(grid_over([WeightedArea(SQUARE)], 20.0), MODEL)
    assert not area.advance()
    for second in range(8):
        area.listen((20.0 * second, 100.0, 20.0), 1.0)
    pieces = 0
    while area.advance():
        pieces += 1
    assert 7 <= pieces <= 16
    assert state_of(area).pos > 0.0


def test_behind_a_wall_less_is_heard_and_above_it_not() -> None:
    wall = Wall(corners_enu_m=((20.0, -30.0), (30.0, -30.0), (30.0, 30.0), (20.0, 30.0)))
    walled = DetectionModel(reach_m=60.0, walls=(wall,))
    assert pod_of([(70.0, 5.0, 5.0)], walled) < pod_of(
        [(70.0, 5.0, 5.0)], DetectionModel(reach_m=60.0)
    )
    over = pod_of([(40.0, 60.0, 5.0)], walled)  # at the wall the way is higher than its roof
    assert over == pytest.approx(pod_of([(40.0, 60.0, 5.0)], DetectionModel(reach_m=60.0)))


def test_inside_a_building_the_roof_counts() -> None:
    hall = Wall(corners_enu_m=((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)))
    inside = DetectionModel(reach_m=60.0, walls=(hall,))
    assert pod_of([(0.0, 80.0, 1.0)], inside) < pod_of(
        [(0.0, 80.0, 1.0)], DetectionModel(reach_m=60.0)
    )


def test_what_follows_from_pod() -> None:
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    pod = np.zeros(100)
    pod[:50] = 0.9
    state = SearchState(grid, pod)
    assert state.pos == pytest.approx(0.45)
    assert state.share_at(0.8) == 0.5
    assert state.poa.sum() == pytest.approx(1.0)
    assert state.poa[50:].sum() == pytest.approx(50.0 / 55.0)
    assert SearchState(grid, np.ones(100)).poa.sum() == pytest.approx(1.0)


def test_a_large_area_is_renewed_in_blocks_and_shown_when_all_are_done() -> None:
    side_m = 3000.0
    corners = ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m))
    area = SearchedArea(grid_over([WeightedArea(corners)], 20.0), MODEL)
    area.listen((1500.0, 100.0, 20.0), 5.0)
    area.listen((1500.0, 1500.0, 20.0), 5.0)
    while area.advance():
        pass
    calls = 1
    while not area.renew():
        assert area.state.pos == pytest.approx(0.0, abs=1e-6)
        calls += 1
    assert calls == math.ceil(len(area.grid.poa) / BLOCK) > 1
    np.testing.assert_allclose(area.state.pod, state_of(area).pod, atol=1e-5)
    assert area.state.pos > 0.001
