"""The monitor's geometry against matplotlib's paths and brute force."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path

from sim_link.lab.monitor.independent_checks import Corners, depth_m, is_way_clear
from tools.campaign.random_missions import SITES, Site

coordinates = st.floats(-160.0, 160.0, allow_nan=False)
points = st.tuples(coordinates, coordinates)
sites = st.sampled_from(SITES)


def border(corners: Corners, count: int = 4000) -> np.ndarray:
    """Points close together on the border of a polygon."""
    ends = np.array([*corners, corners[0]], dtype=float)
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.vstack([a + share * (b - a) for a, b in itertools.pairwise(ends)])


BORDERS = {
    corners: border(corners) for p in SITES for corners in (p.fence_enu_m, *p.keep_out_enu_m)
}


@given(sites, points)
@settings(max_examples=300, deadline=None)
def test_inside_is_what_a_path_contains(site: Site, point: tuple[float, float]) -> None:
    for corners in (site.fence_enu_m, *site.keep_out_enu_m):
        nearest = float(np.min(np.hypot(*(BORDERS[corners] - point).T)))
        if nearest > 0.1:
            assert (depth_m(corners, (), point) >= 0.0) == bool(Path(corners).contains_point(point))


@given(sites, points)
@settings(max_examples=300, deadline=None)
def test_depth_is_the_distance_to_the_nearest_border_point(
    site: Site, point: tuple[float, float]
) -> None:
    inside = Path(site.fence_enu_m).contains_point(point)
    away = float(np.min(np.hypot(*(BORDERS[site.fence_enu_m] - point).T)))
    expected = away if inside else -away
    for keep_out in site.keep_out_enu_m:
        away = float(np.min(np.hypot(*(BORDERS[keep_out] - point).T)))
        expected = min(expected, -away if Path(keep_out).contains_point(point) else away)
    assert depth_m(site.fence_enu_m, site.keep_out_enu_m, point) == pytest.approx(expected, abs=0.1)


@given(sites, points, points)
@settings(max_examples=300, deadline=None)
def test_a_way_is_clear_if_every_point_of_it_is_inside(
    site: Site, start: tuple[float, float], end: tuple[float, float]
) -> None:
    fence, keep_outs = site.fence_enu_m, site.keep_out_enu_m
    if min(depth_m(fence, keep_outs, p) for p in (start, end)) <= 0.0:
        return
    count = max(2, math.ceil(math.dist(start, end) / 0.05))
    share = np.linspace(0.0, 1.0, count)[:, None]
    walked = np.asarray(start) + share * (np.asarray(end) - np.asarray(start))
    depths = [
        depth_m(fence, keep_outs, (float(e), float(n))) for e, n in walked[:: max(1, count // 400)]
    ]
    if min(depths) < -1e-6:
        assert not is_way_clear(fence, keep_outs, start, end)
    if min(depths) > 1.0:
        assert is_way_clear(fence, keep_outs, start, end)
