from __future__ import annotations

import math

import numpy as np
import pytest

from tools.study.case import Case, along, lane_corners, stepped, track_of


def test_a_step_goes_towards_the_waypoint() -> None:
    assert stepped(1.0, 2.0, 7.0, 10.0, 5.0) == pytest.approx((4.0, 6.0))


@pytest.mark.parametrize("step_m", [5.0, 6.0])
def test_a_waypoint_within_a_step_is_reached(step_m: float) -> None:
    assert stepped(0.0, 0.0, 3.0, 4.0, step_m) == (3.0, 4.0)


def test_lanes_run_to_and_fro_half_a_spacing_inside() -> None:
    assert lane_corners((100.0, 15.0), 5.0) == [
        (0.0, 2.5),
        (100.0, 2.5),
        (100.0, 7.5),
        (0.0, 7.5),
        (0.0, 12.5),
        (100.0, 12.5),
    ]


def test_an_area_narrower_than_a_lane_has_one() -> None:
    assert len(lane_corners((10.0, 1.0), 5.0)) == 2


def test_places_are_even_along_the_polyline() -> None:
    corners = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 6.0]])
    expected = [[0.0, 0.0], [5.0, 0.0], [6.0, 4.0], [6.0, 6.0], [6.0, 6.0]]
    np.testing.assert_allclose(along(corners, 5.0, 5), expected)


def test_the_canonical_lawnmower() -> None:
    case = Case()
    track = track_of(case)
    assert track.shape == (500, 2)
    assert tuple(track[0]) == case.start_enu_m
    steps_m = np.hypot(*np.diff(track, axis=0).T)
    assert steps_m.max() <= 5.0 + 1e-9  # shorter only where a corner is cut
    assert np.median(steps_m) == pytest.approx(5.0)
    assert {2.5 + 5.0 * lane for lane in range(20)} <= set(np.round(track[:, 1], 6))
    # Never right on the target, where a bearing would be worth infinitely much.
    assert np.hypot(*(track - case.target_enu_m).T).min() > 3.0


def test_after_the_last_lane_it_turns_around() -> None:
    track = track_of(Case(area_m=(20.0, 10.0), start_enu_m=(0.0, 2.5), steps=22))
    np.testing.assert_allclose(track[9], (0.0, 7.5))  # 20 m, 5 m, 20 m
    np.testing.assert_allclose(track[18], (0.0, 2.5))
    np.testing.assert_allclose(track[18:22, 0], [0.0, 5.0, 10.0, 15.0])
    assert math.isclose(track[21, 1], 2.5)
