"""Curvature, bilateral information and lines, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.rivals import (
    COLLINEAR_RATIO,
    mirrored,
    observability_of,
    track_line,
)
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import params, reflected, truth, walk

PLANE = params(range_k_long=1.5)


def _row(
    position: tuple[float, float], range_m: float = math.nan, bearing_rad: float = math.nan
) -> list[float]:
    return [*position, 0.0, range_m, bearing_rad, math.nan, 2.0, 0.1, 0.1, 0.0]


def _observed(rows: list[list[float]], p: FilterParams = PLANE) -> tuple[Matrix, float, float]:
    """ERCM, smallest eigenvalue and bilateral share about a target at the origin."""
    array = np.array(rows)
    seen = observability_of(array, WindowMap(p).scores(array, np.zeros(4)))
    return np.array(seen.ercm), seen.min_eigenvalue, seen.bilateral_share


def test_a_range_bends_the_cost_along_its_line_of_sight() -> None:
    ercm, least, share = _observed([_row((30.0, 0.0), 30.0)])
    np.testing.assert_allclose(ercm, np.diag([1.0 / 2.0**2, 0.0]), atol=1e-15)
    assert least == pytest.approx(0.0, abs=1e-15)
    assert share == 1.0


def test_a_bearing_bends_it_across_and_less_from_afar() -> None:
    near, far = (_observed([_row((d, 0.0), bearing_rad=-math.pi)])[0] for d in (10.0, 20.0))
    np.testing.assert_allclose(near, np.diag([0.0, 1.0 / (0.1 * 10.0) ** 2]), atol=1e-12)
    np.testing.assert_allclose(far, near / 4.0, atol=1e-12)


def test_two_ranges_at_a_right_angle_tell_both_ways() -> None:
    ercm, least, _ = _observed([_row((30.0, 0.0), 30.0), _row((0.0, -50.0), 50.0)])
    np.testing.assert_allclose(ercm, np.diag([0.25, 0.25]), atol=1e-15)
    assert least == pytest.approx(0.25)


def test_ranges_at_an_angle_by_hand() -> None:
    """C = 1/4 (e1 e1' + e2 e2') with unit lines of sight east and 60 degrees north of it."""
    c, s = 0.5, math.sqrt(0.75)
    ercm, least, _ = _observed([_row((30.0, 0.0), 30.0), _row((30.0 * c, 30.0 * s), 30.0)])
    expected = 0.25 * np.array([[1.0 + c * c, c * s], [c * s, s * s]])
    np.testing.assert_allclose(ercm, expected, atol=1e-15)
    assert least == pytest.approx(0.25 * (1.0 - c))


def test_a_saturated_range_bends_nothing() -> None:
    """Statistical-geometric degeneracy: measured from two sides, curved to one only."""
    there, beside = _row((30.0, 0.0), 30.0), _row((0.0, -50.0), 50.0 + 2.0 * 1.5 + 0.1)
    ercm, least, share = _observed([there, beside])
    np.testing.assert_allclose(ercm, np.diag([0.25, 0.0]), atol=1e-15)
    assert least == pytest.approx(0.0, abs=1e-15)
    assert share == 0.5
    short = _row((0.0, -50.0), 40.0)  # however short, on the quadratic side
    assert _observed([there, short])[1] == pytest.approx(0.25)


def test_the_share_counts_measurements_and_not_rows() -> None:
    silent = _row((5.0, 5.0))
    both = _row((30.0, 0.0), 60.0, -math.pi)
    assert _observed([silent, both, silent])[2] == 0.5
    assert _observed([silent])[2] == 0.0


def test_it_falls_with_the_share_of_reflections() -> None:
    shares, least = [], []
    for nlos in (0.0, 0.5, 0.9):
        rng = np.random.default_rng(3)
        rows = reflected(rng, walk(rng, bearings=False), nlos)
        seen = observability_of(rows, WindowMap(PLANE).scores(rows, truth()))
        shares.append(seen.bilateral_share)
        least.append(seen.min_eigenvalue)
    assert shares[0] > 0.9 > 0.65 > shares[1] > 0.3 > shares[2]
    assert least == sorted(least, reverse=True)
    assert least[2] > 0.0


# -- Lines ---------------------------------------------------------------------------------------


def _track(direction_rad: float, across_m: float = 0.0) -> Matrix:
    along = np.linspace(-40.0, 40.0, 41)
    across = across_m * (-1.0) ** np.arange(41)
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    return np.array([7.0 + along * c - across * s, -3.0 + along * s + across * c]).T


@pytest.mark.parametrize("direction_rad", [0.0, 0.4, math.pi / 2.0, 2.5])
def test_the_line_of_a_straight_track(direction_rad: float) -> None:
    centre, direction, ratio = track_line(_track(direction_rad))
    np.testing.assert_allclose(centre, [7.0, -3.0], atol=1e-12)
    turn = direction[0] * math.sin(direction_rad) - direction[1] * math.cos(direction_rad)
    assert turn == pytest.approx(0.0, abs=1e-9)
    assert ratio == pytest.approx(0.0, abs=1e-6)


def test_a_ratio_is_spread_across_over_spread_along() -> None:
    along_m = float(np.std(np.linspace(-40.0, 40.0, 41)))
    for across_m in (0.5, 2.0, 10.0):
        _, _, ratio = track_line(_track(0.4, across_m))
        assert ratio == pytest.approx(across_m / along_m, rel=0.01)


def test_a_square_is_as_wide_as_long() -> None:
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    assert track_line(corners)[2] == pytest.approx(1.0)


@pytest.mark.parametrize("count", [1, 5])
def test_a_single_place_is_a_line_of_no_length(count: int) -> None:
    centre, direction, ratio = track_line(np.full((count, 2), 3.0))
    assert centre.tolist() == [3.0, 3.0]
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert ratio in (0.0, 1.0)
    if count > 1:
        assert ratio == 0.0


@pytest.mark.parametrize(("straight", "is_collinear"), [(True, True), (False, False)])
def test_a_walk_along_a_line_is_reported(straight: bool, is_collinear: bool) -> None:
    rows = walk(np.random.default_rng(1), straight=straight)
    seen = observability_of(rows, WindowMap(PLANE).scores(rows, truth()))
    assert seen.is_collinear is is_collinear
    assert (seen.track_ratio < COLLINEAR_RATIO) is is_collinear


@pytest.mark.parametrize("direction_rad", [0.0, 0.4, 2.5])
def test_a_mirror_image_is_as_far_from_every_place_on_the_line(direction_rad: float) -> None:
    positions, mean = _track(direction_rad), np.array([20.0, 15.0, 1.0, 0.1, 0.02])
    image = mirrored(mean, positions)
    for point in positions:
        assert math.dist(image[:2], point) == pytest.approx(math.dist(mean[:2], point))
    assert math.dist(image[:2], mean[:2]) > 1.0
    assert image[2:].tolist() == mean[2:].tolist()
    back: Vector = mirrored(image, positions)
    np.testing.assert_allclose(back, mean, atol=1e-9)
