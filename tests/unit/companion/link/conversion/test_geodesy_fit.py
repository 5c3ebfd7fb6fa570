"""Pairs of local and global positions: those that belong together, and those that do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.domain import PositionEnu
from companion.geometry.coordinates import LocalOrigin, Projection
from companion.link.conversion.geodesy_fit import MIN_OFF_M, MIN_PAIRS, GeodesyFit

REPORTED = LocalOrigin(47.397742, 8.545594, 488.0, Projection.SPHERE)
GLOBAL_PERIOD_S = 0.5
Path = Callable[[float], PositionEnu]
Damaged = Callable[[int, PositionEnu], PositionEnu]
"""Function of a local position's number and geodetic position, to the position that arrives."""


def circle(time_s: float) -> PositionEnu:
    """120 m about the origin at 8 m/s."""
    angle = time_s * 8.0 / 120.0
    return (120.0 * math.cos(angle), 120.0 * math.sin(angle), 20.0)


def still(time_s: float) -> PositionEnu:
    del time_s
    return (100.0, -60.0, 20.0)


def flown(
    fit: GeodesyFit,
    true: LocalOrigin,
    path: Path = circle,
    seconds: float = 60.0,
    damaged: Damaged = lambda _, position: position,
) -> int:
    """Return the changes of the fit while an autopilot reports positions about an origin."""
    changes, next_s = 0, 0.1
    for step in range(round(seconds / 0.05)):
        now_s = 0.05 * step
        while next_s <= now_s:
            lat, lon, alt_m = true.geodetic_from_enu(path(next_s))
            position = (round(lat * 1e7) / 1e7, round(lon * 1e7) / 1e7, round(alt_m, 3))
            changes += fit.note_global(round(next_s, 3), position)
            next_s += GLOBAL_PERIOD_S + 0.013
        changes += fit.note_local(now_s, damaged(step, path(now_s)))
    return changes


def off_m(fit: GeodesyFit, true: LocalOrigin, position: PositionEnu) -> float:
    return math.dist(fit.origin.enu_from_geodetic(*true.geodetic_from_enu(position)), position)


@pytest.mark.parametrize("projection", Projection)
def test_an_autopilot_of_the_known_projection_needs_no_fit(projection: Projection) -> None:
    reported = replace(REPORTED, projection=projection)
    fit = GeodesyFit(reported)
    assert flown(fit, reported, seconds=600.0) == 0
    assert fit.off_m < 0.03
    assert fit.origin == reported


@pytest.mark.parametrize("projection", [Projection.ELLIPSOID, Projection.FLAT])
def test_another_projection_is_known_by_where_it_is_flown_and_holds_far_away(
    projection: Projection,
) -> None:
    true, fit = replace(REPORTED, projection=projection), GeodesyFit(REPORTED)
    assert off_m(fit, true, (120.0, 30.0, 0.0)) > MIN_OFF_M
    assert flown(fit, true) >= 1
    for position in ((120.0, 30.0, 0.0), (-60.0, 90.0, 0.0), (700.0, -700.0, 20.0)):
        assert off_m(fit, true, position) < 0.02


def test_an_unknown_projection_is_fitted_where_it_is_flown() -> None:
    true, fit = replace(REPORTED, scale_en=(1.004, 0.997)), GeodesyFit(REPORTED)
    assert flown(fit, true) >= 1
    for position in ((120.0, 30.0, 0.0), (-60.0, 90.0, 0.0), (0.0, 0.0, 20.0)):
        assert off_m(fit, true, position) < 0.06


def test_an_origin_that_is_not_the_reported_one_is_found() -> None:
    true = LocalOrigin(
        REPORTED.latitude_deg + 3e-5, REPORTED.longitude_deg, 491.0, Projection.SPHERE
    )
    fit = GeodesyFit(REPORTED)
    flown(fit, true, still, seconds=20.0)
    assert fit.off_m == pytest.approx(math.hypot(3.34, 3.0), abs=0.02)
    assert off_m(fit, true, still(0.0)) < 0.05
    assert off_m(fit, true, (300.0, 300.0, 40.0)) < 0.3


def test_a_few_pairs_prove_nothing_and_two_frames_cannot_be_fitted() -> None:
    true = LocalOrigin(
        REPORTED.latitude_deg + 3e-5, REPORTED.longitude_deg, 488.0, Projection.SPHERE
    )
    few = GeodesyFit(REPORTED)
    assert flown(few, true, seconds=0.5 * (MIN_PAIRS - 2)) == 0
    elsewhere, fit = replace(REPORTED, latitude_deg=48.0), GeodesyFit(REPORTED)
    assert flown(fit, elsewhere) == 0
    assert fit.origin == REPORTED


@pytest.mark.parametrize("absurd", [1e30, -1e30, math.inf, math.nan, 2e5])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_places_that_are_none_are_in_no_pair(absurd: float, axis: int) -> None:
    def damaged(step: int, position: PositionEnu) -> PositionEnu:
        values = [
            absurd if step % 3 == 0 and number == axis else v for number, v in enumerate(position)
        ]
        return (values[0], values[1], values[2])

    fit = GeodesyFit(REPORTED)
    assert flown(fit, REPORTED, damaged=damaged) == 0
    for stamp_s in (100.0, 100.1, 100.2):  # a global one of the very moment of a local one
        fit.note_local(stamp_s - 0.05, damaged(0, still(stamp_s)))
        fit.note_local(stamp_s, still(stamp_s))
        assert not fit.note_global(stamp_s, REPORTED.geodetic_from_enu(still(stamp_s)))
    assert fit.origin == REPORTED
    assert fit.off_m < 0.03


@pytest.mark.parametrize("every", [15, 37])
def test_single_places_that_are_wrong_prove_nothing(every: int) -> None:
    """A jump that is over with the next report, damage that passes its checksum."""
    fit = GeodesyFit(REPORTED)
    assert flown(fit, REPORTED, damaged=lambda n, p: (0.0, *p[1:]) if n % every == 0 else p) == 0
    assert fit.origin == REPORTED
