"""The kind of antenna behind bearings, found from flights across an emitter, 20 m above it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.antenna import AntennaKind
from companion.estimation.filters.target_filter import NO_INFLATION, FilterParams
from companion.estimation.measurement_model import AZIMUTH, COSINES, PLANAR, predicted
from companion.estimation.window.antenna_check import (
    AntennaCheck,
    ConfiguredAntennaCheck,
    rows_as,
    with_antenna,
)
from companion.estimation.window.map_kernels import ARRAY_COLUMNS, row_residuals
from companion.estimation.window.sandwich import Scores
from companion.kernel import Matrix
from companion.kernel import Vector as Array

TARGET = np.array([3.0, -4.0, 0.0, 0.0])
HEIGHT_M = 20.0
SIGMA_RAD = math.radians(2.0)
PARAMS = FilterParams()


def legs(far_m: float = 45.0, near_m: float = -45.0, count: int = 120) -> Matrix:
    """Return positions of crossing legs, (2 count, 3), from `far_m` to `near_m` of the emitter."""
    along = np.linspace(far_m, near_m, count)
    east = np.concatenate([TARGET[0] + along, np.full(count, TARGET[0] + 2.0)])
    north = np.concatenate([np.full(count, TARGET[1] + 2.0), TARGET[1] + along])
    return np.stack([east, north, np.full(2 * count, HEIGHT_M)], axis=1)


def printed(kind: AntennaKind, positions: Matrix, rng: np.random.Generator) -> Matrix:
    """Rows of a planar array, (n, 16), whose angles an antenna of that kind has printed.

    The nose points at the emitter, up to 40 degrees off, and the vehicle leans by a few degrees.
    """
    rows = np.full((len(positions), ARRAY_COLUMNS), np.nan)
    for row, position in zip(rows, positions, strict=True):
        to = TARGET[:3] * (1.0, 1.0, 0.0) - position
        slant = float(np.linalg.norm(to))
        yaw = math.atan2(to[1], to[0]) + rng.uniform(-0.7, 0.7)
        ahead = np.array([math.cos(yaw), math.sin(yaw), 0.05 * rng.normal()])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        x, y = float(ahead @ to) / slant, float(right @ to) / slant
        if kind == "azimuth":
            angle = yaw - math.atan2(to[1], to[0]) + SIGMA_RAD * rng.normal()
        elif kind == "planar":
            angle = math.atan2(y + SIGMA_RAD * rng.normal(), x + SIGMA_RAD * rng.normal())
        else:
            angle = math.asin(min(1.0, max(-1.0, y + SIGMA_RAD * rng.normal())))
        row[:3] = position
        row[3] = slant + 1.5 * rng.normal()
        row[4] = math.remainder(angle, math.tau)
        row[6:9] = 1.5, SIGMA_RAD, math.radians(5.0)
        row[10:16] = *ahead, *right
    return rows


def looked(kind: AntennaKind, seed: int, positions: Matrix) -> AntennaCheck:
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    rows = printed(kind, positions, np.random.default_rng(seed))
    start: Array = TARGET + np.array([1.0, -1.0, 0.0, 0.0])
    check.look(rows, start, NO_INFLATION)
    return check


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["azimuth", "planar", "line"])
def test_flights_across_show_what_the_antenna_is(kind: AntennaKind, seed: int) -> None:
    check = looked(kind, seed, legs())
    assert (check.hypothesis, check.is_identified) == (kind, True)
    assert check.params.antenna.kind == kind


@pytest.mark.parametrize("kind", ["azimuth", "planar"])
def test_from_afar_a_planar_array_is_believed_and_nothing_is_shown(kind: AntennaKind) -> None:
    check = looked(kind, 1, legs(far_m=220.0, near_m=150.0))
    assert (check.hypothesis, check.is_identified) == ("planar", False)


def test_few_bearings_show_nothing() -> None:
    check = looked("azimuth", 2, legs(count=19))
    assert (check.hypothesis, check.is_identified) == ("planar", False)


def test_reflections_do_not_make_an_azimuth_of_a_planar_array() -> None:
    rng = np.random.default_rng(3)
    rows = printed("planar", legs(), rng)
    is_bent = rng.random(len(rows)) < 0.3
    rows[is_bent, 4] += rng.normal(0.0, 0.4, int(is_bent.sum()))
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    check.look(rows, TARGET, NO_INFLATION)
    assert check.hypothesis == "planar"


def around_an_edge(seed: int, edge_m: float, shadow_m: tuple[float, float]) -> Matrix:
    """Rows of an azimuth, reflected at an edge west of the emitter where that is so far off."""
    rng = np.random.default_rng(seed)
    positions = legs(far_m=40.0, near_m=-40.0)
    rows = printed("azimuth", positions, rng)
    edge = TARGET[:2] + np.array([-edge_m, 0.0])
    to_target_m = np.hypot(*(positions[:, :2] - TARGET[:2]).T)
    nearest_m, farthest_m = shadow_m
    for i in np.flatnonzero((to_target_m > nearest_m) & (to_target_m < farthest_m)):
        to = edge - positions[i, :2]
        yaw = math.atan2(rows[i, 11], rows[i, 10])
        off = math.atan2(to[1], to[0]) + SIGMA_RAD * rng.normal()
        rows[i, 4] = math.remainder(yaw - off, math.tau)
        rows[i, 3] += np.hypot(*to) + np.hypot(*(edge - TARGET[:2])) - to_target_m[i]
    return rows


def test_bearings_around_an_edge_are_not_called_worthless_from_above() -> None:
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    check.look(around_an_edge(48, 16.0, (14.0, 45.0)), TARGET, NO_INFLATION)
    assert not check.is_identified


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("edge_m", "shadow_m"), [(8.0, (20.0, 45.0)), (16.0, (20.0, 45.0)), (25.0, (25.0, 45.0))]
)
def test_what_came_around_an_edge_does_not_hide_an_azimuth(
    edge_m: float, shadow_m: tuple[float, float], seed: int
) -> None:
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    check.look(around_an_edge(seed, edge_m, shadow_m), TARGET, NO_INFLATION)
    assert (check.hypothesis, check.is_identified) == ("azimuth", True)


@pytest.mark.parametrize("seed", range(4))
def test_bad_bearings_from_above_with_long_ranges_show_no_planar_array(seed: int) -> None:
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    check.look(around_an_edge(seed, 8.0, (0.0, 12.0)), TARGET, NO_INFLATION)
    assert (check.hypothesis, check.is_identified) == ("planar", False)


@pytest.mark.parametrize("spoilt", ["height", "ranges"])
@pytest.mark.parametrize("seed", range(12, 16))
def test_long_ranges_do_not_hide_a_planar_array(seed: int, spoilt: str) -> None:
    rng = np.random.default_rng(seed)
    rows = printed("planar", legs(), rng)
    level_m = np.hypot(*(rows[:, :2] - TARGET[:2]).T)
    if spoilt == "height":  # which is wrong by 3 m, as the ranges from right above are
        rows[:, 3] += np.hypot(level_m, HEIGHT_M + 3.0) - np.hypot(level_m, HEIGHT_M)
    else:
        rows[:, 3] += rng.exponential(4.0, len(rows)) * (rng.random(len(rows)) < 0.6)
    check = AntennaCheck(with_antenna(PARAMS, "planar"))
    check.look(rows, TARGET, NO_INFLATION)
    assert check.hypothesis == "planar"


def test_an_azimuth_is_given_up_when_more_speaks_against_it_than_spoke_for_it() -> None:
    check = looked("azimuth", 4, legs())
    rows = printed("planar", legs(count=240), np.random.default_rng(5))
    changes = [check.look(rows, TARGET, NO_INFLATION) for _ in range(4)]
    assert changes.count(True) == 1
    assert check.hypothesis == "planar"


def test_an_azimuth_that_was_shown_outlives_bearings_that_are_spoilt() -> None:
    check = looked("azimuth", 4, legs())
    # where each antenna would be hypothesis for a planar array's, had nothing been seen before
    rows = printed("planar", legs(count=60), np.random.default_rng(5))
    fresh = AntennaCheck(with_antenna(PARAMS, "planar"))
    fresh.look(rows, TARGET, NO_INFLATION)
    assert (fresh.hypothesis, fresh.is_identified) == ("planar", True)
    assert [check.look(rows, TARGET, NO_INFLATION) for _ in range(8)] == [False] * 8
    assert (check.hypothesis, check.is_identified) == ("azimuth", True)


def test_a_line_is_given_up_at_an_angle_that_none_prints() -> None:
    check = looked("line", 4, legs())
    kinds: list[AntennaKind] = [check.hypothesis]
    rows = printed("azimuth", legs(), np.random.default_rng(5))
    rows[0, 4] = 2.0
    assert check.look(rows, TARGET, NO_INFLATION)
    kinds.append(check.hypothesis)
    assert kinds == ["line", "azimuth"]


@pytest.mark.parametrize(
    ("kind", "model"), [("azimuth", AZIMUTH), ("planar", PLANAR), ("line", COSINES)]
)
def test_rows_in_another_form_are_what_that_antenna_predicts(kind: AntennaKind, model: int) -> None:
    rng = np.random.default_rng(6)
    rows = printed("planar", legs(count=8), rng)
    params = with_antenna(PARAMS, kind)
    assert params.model.antenna == model
    for row in rows:
        row[4] = predicted(
            TARGET, np.array([*row[:3], *row[10:16]]), with_antenna(PARAMS, "planar").model
        )[1]
    if kind == "line":  # its angle is another one
        to = TARGET[:3] * (1.0, 1.0, 0.0) - rows[:, :3]
        slant = np.linalg.norm(to, axis=1)
        rows[:, 4] = np.arcsin(np.sum(rows[:, 13:16] * to, axis=1) / slant)
    if kind == "azimuth":  # the same where it is level
        rows[:, 12] = 0.0
        rows[:, 10:12] /= np.linalg.norm(rows[:, 10:12], axis=1)[:, None]
        for row in rows:
            row[4] = predicted(
                TARGET, np.array([*row[:3], *row[10:16]]), with_antenna(PARAMS, "planar").model
            )[1]
    other = rows_as(rows, kind)
    u = row_residuals(other, TARGET, np.ones((3, len(rows))), params.model)
    np.testing.assert_allclose(u[1], 0.0, atol=1e-9)


def seen(*off_sigmas: float, count: int = 100) -> Scores:
    """Directions along one axis that are off by this number of standard deviations, alternately."""
    u, is_measured = np.zeros((3, count)), np.zeros((3, count), dtype=bool)
    u[1], is_measured[1] = np.resize(off_sigmas, count), True
    return Scores(u, u, np.zeros((3 * count, 4)), is_measured)


def test_a_configured_antenna_is_contradicted_by_most_directions_for_long() -> None:
    watch = ConfiguredAntennaCheck()
    for time_s, is_contradicted in ((20.0, False), (25.0, False), (30.0, True)):
        watch.look(seen(-6.0, 5.0, 0.0), time_s)
        assert watch.is_contradicted == is_contradicted
    watch.look(seen(3.0), 31.0)
    assert watch.is_contradicted  # as long as they are not what they should be
    watch.look(seen(1.0), 32.0)
    watch.look(seen(-6.0), 45.0)
    assert not watch.is_contradicted


@pytest.mark.parametrize("motion", [seen(100.0, 1.0, -1.0), seen(6.0, count=39)])
def test_gross_errors_of_some_and_few_directions_contradict_no_antenna(motion: Scores) -> None:
    watch = ConfiguredAntennaCheck()
    for time_s in (0.0, 20.0, 40.0):
        watch.look(motion, time_s)
    assert not watch.is_contradicted
