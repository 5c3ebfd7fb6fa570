"""Errors of a path in the open and in a shadow, by their statistics."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.kernel import Vector
from sim_link.world.environment import (
    NO_MEMORY,
    Environment,
    ObstacleParams,
    OpenPath,
    ShadowParams,
    obstruction,
    open_obstruction,
    shadow_of,
)
from sim_link.world.line_of_sight import detour
from tools.study.case import STUDY_SHADOW

BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))
TARGET = (50.0, 50.0, 0.0)
OPEN = OpenPath(p_nlos=0.1, bias_mean_m=8.0, bend_sigma_rad=math.radians(5.0))
HIDDEN, SEEN = (10.0, 50.0), (70.0, 50.0)
SAMPLES = 20_000


def suffered(
    shadow: ShadowParams, positions: list[tuple[float, float]], seed: int = 1
) -> tuple[Vector, Vector]:
    """Return excess and bend at one position after the other."""
    surroundings = Environment([BLOCK]).around(TARGET)
    rng, memory, rows = np.random.default_rng(seed), NO_MEMORY, []
    for position in positions:
        drawn = (rng.random(), rng.standard_exponential(), rng.standard_normal())
        excess_m, bend_rad, memory = obstruction(
            drawn, (*position, 0.0), OPEN, shadow_of(shadow), surroundings, memory
        )
        rows.append((excess_m, bend_rad))
    table = np.array(rows)
    return table[:, 0], table[:, 1]


def along_the_shadow(step_m: float, count: int) -> list[tuple[float, float]]:
    """Return a track back and forth where every position is hidden."""
    metres = step_m * np.arange(count)
    return [(10.0, 45.0 + float(abs((metre % 10.0) - 5.0))) for metre in metres]


# The regime of the studies


def test_the_block_of_the_studies() -> None:
    """Blocked: always obstructed, mean 15 m and 10 deg; every draw is new."""
    excess_m, bend_rad = suffered(STUDY_SHADOW, [HIDDEN] * SAMPLES)
    assert excess_m.min() > 0.0
    assert excess_m.mean() == pytest.approx(15.0, rel=0.03)
    assert excess_m.std() == pytest.approx(15.0, rel=0.04)
    assert np.degrees(bend_rad).mean() == pytest.approx(0.0, abs=0.3)
    assert np.degrees(bend_rad).std() == pytest.approx(10.0, rel=0.03)
    for values in (excess_m, bend_rad):
        assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.03


def test_beside_the_block_one_of_ten_is_obstructed() -> None:
    excess_m, bend_rad = suffered(STUDY_SHADOW, [SEEN] * SAMPLES)
    assert np.mean(excess_m > 0.0) == pytest.approx(0.1, abs=0.01)
    assert ((excess_m > 0.0) == (bend_rad != 0.0)).all()
    assert excess_m[excess_m > 0.0].mean() == pytest.approx(8.0, rel=0.1)


def test_a_new_draw_shows_the_drawn_exponential_itself() -> None:
    rng = np.random.default_rng(2)
    surroundings, shadow = Environment([BLOCK]).around(TARGET), shadow_of(STUDY_SHADOW)
    for uniform, exponential, normal in rng.random((50, 3)):
        excess_m, bend_rad, _ = obstruction(
            (uniform, exponential, normal), (*HIDDEN, 0.0), OPEN, shadow, surroundings, NO_MEMORY
        )
        assert excess_m == pytest.approx(15.0 * exponential, rel=1e-12)
        assert bend_rad == pytest.approx(math.radians(10.0) * normal, rel=1e-12)


# The detour


def test_without_chance_the_detour_shows() -> None:
    quiet = ShadowParams(extra_bias_mean_m=0.0, bearing_bias_sigma_deg=0.0)
    expected = detour(*HIDDEN, 0.0, Environment([BLOCK]).around(TARGET))
    assert expected[0] > 1.0
    assert abs(expected[1]) > 0.1
    excess_m, bend_rad = suffered(quiet, [HIDDEN])
    assert (excess_m[0], bend_rad[0]) == pytest.approx(expected)
    half = msgspec.structs.replace(quiet, detour_share=0.5, pull_share=0.25)
    excess_m, bend_rad = suffered(half, [HIDDEN])
    assert (excess_m[0], bend_rad[0]) == pytest.approx((0.5 * expected[0], 0.25 * expected[1]))


def test_the_extra_is_exponential_whatever_it_remembers() -> None:
    shadow = ShadowParams(detour_share=0.0, pull_share=0.0, correlation_m=3.0)
    excess_m, bend_rad = suffered(shadow, along_the_shadow(1.0, SAMPLES))
    assert excess_m.mean() == pytest.approx(5.0, rel=0.06)
    assert excess_m.std() == pytest.approx(5.0, rel=0.09)
    assert np.median(excess_m) == pytest.approx(5.0 * math.log(2.0), rel=0.08)
    assert np.degrees(bend_rad).std() == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize("lag", [1, 2, 4])
def test_extra_and_bend_forget_themselves_over_the_way(lag: int) -> None:
    shadow = ShadowParams(detour_share=0.0, pull_share=0.0, correlation_m=3.0)
    for values in suffered(shadow, along_the_shadow(1.0, SAMPLES)):
        found = np.corrcoef(values[lag:], values[:-lag])[0, 1]
        assert found == pytest.approx(math.exp(-lag / 3.0), abs=0.06)


def test_who_hovers_in_the_shadow_measures_the_same_bias() -> None:
    excess_m, bend_rad = suffered(ShadowParams(), [HIDDEN] * 5)
    np.testing.assert_allclose(excess_m, excess_m[0])
    np.testing.assert_allclose(bend_rad, bend_rad[0])


def test_the_open_between_leaves_the_memory_of_the_shadow() -> None:
    positions = [HIDDEN, *[SEEN] * 5, HIDDEN]
    excess_m, bend_rad = suffered(ShadowParams(), positions)
    assert excess_m[-1] == pytest.approx(excess_m[0])
    assert bend_rad[-1] == pytest.approx(bend_rad[0])


_draws = (st.floats(0.0, 1.0, exclude_max=True), st.floats(0.0, 50.0), st.floats(-6.0, 6.0))
_coordinates = st.floats(-20.0, 120.0)


@given(*_draws, _coordinates, _coordinates, st.floats(0.0, 30.0))
def test_no_path_is_shorter_than_straight(
    uniform: float, exponential: float, normal: float, east: float, north: float, up: float
) -> None:
    obstacle = msgspec.structs.replace(BLOCK, height_m=20.0)
    surroundings = Environment([obstacle]).around(TARGET)
    shadow, memory = shadow_of(ShadowParams()), NO_MEMORY
    for position in ((0.0, 50.0, 1.0), (east, north, up)):
        excess_m, bend_rad, memory = obstruction(
            (uniform, exponential, normal), position, OPEN, shadow, surroundings, memory
        )
        assert 0.0 <= excess_m < math.inf
        assert math.isfinite(bend_rad)


@given(*_draws)
def test_without_obstacles_only_the_open_remains(
    uniform: float, exponential: float, normal: float
) -> None:
    surroundings, shadow = Environment().around(TARGET), shadow_of(ShadowParams())
    drawn = (uniform, exponential, normal)
    result = obstruction(drawn, (*HIDDEN, 0.0), OPEN, shadow, surroundings, NO_MEMORY)
    assert result[:2] == open_obstruction(*drawn, OPEN)
    assert result[2] is NO_MEMORY


# Parameters


@pytest.mark.parametrize(
    ("corners", "problem"),
    [
        (((0.0, 0.0), (1.0, 0.0)), "at least 3 corners"),
        (((0.0, 0.0), (9.0, 9.0), (9.0, 0.0), (0.0, 9.0)), "cross each other"),
        (((0.0, 0.0), (1.0, 1.0), (2.0, 2.0)), "encloses no area"),
        (((0.0, 0.0), (1.0, math.nan), (2.0, 0.0)), "not a finite number"),
    ],
)
def test_what_is_no_obstacle_is_refused(
    corners: tuple[tuple[float, float], ...], problem: str
) -> None:
    with pytest.raises(ValueError, match=problem) as caught:
        ObstacleParams(name="tower", corners_enu_m=corners)
    assert "`tower`" in str(caught.value)
