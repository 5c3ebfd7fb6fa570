"""The search patterns: lawnmower, expanding square and sector search.

What they look like is in `tracks`; here are their parameters, where they lie, and how a second
sweep is turned: lanes by 90 degrees, the square by 45, the sectors by 30.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from companion.domain import Point
from companion.geometry.obstacles import FreeSpace
from companion.geometry.polygons import Polygon, area_m2, is_simple
from companion.params import Positive
from companion.planning.base import PlanRequest
from companion.planning.routing import way_finder
from companion.planning.search import SearchParams
from companion.planning.tracks import (
    Track,
    expanding_square,
    heading_of_fewest_lanes_rad,
    parallel_track,
    sector_search,
)

MOST_LEGS = 2000
"""More cannot be flown, and planning them would cost the flight its ticks."""
HeadingDeg = Annotated[float, msgspec.Meta(ge=0.0, le=360.0)]
Corner = Literal["nearest", "south_west", "south_east", "north_west", "north_east"]


class LawnmowerParams(SearchParams, frozen=True):
    """Parallel lanes over a polygon (IAMSAR: parallel track)."""

    area_enu_m: tuple[Point, ...] | None = None
    """Corners of the area to search; null: all that the fence leaves."""
    lane_heading_deg: HeadingDeg | None = None
    """Of the lanes, clockwise from north; null: along the longer side."""
    start_corner: Corner = "nearest"
    """Where the first sweep begins; nearest: to the vehicle."""

    def __post_init__(self) -> None:
        """Refuse an area that is none."""
        area = self.area_enu_m
        if area is None:
            return
        if len(area) < 3 or not all(math.isfinite(v) for corner in area for v in corner):
            raise ValueError("area_enu_m needs at least 3 corners, all finite")
        if not is_simple(area) or area_m2(area) < 1.0:
            raise ValueError("area_enu_m must enclose an area, without edges that touch or cross")
        if math.dist(*_extent(area)) > MOST_LEGS * self.spacing_m:
            raise ValueError(f"area_enu_m would take more than {MOST_LEGS} lanes at this spacing_m")


def _extent(area: Polygon) -> tuple[Point, Point]:
    """The south-western and the north-eastern corner of the box around an area."""
    east, north = zip(*area, strict=True)
    return (min(east), min(north)), (max(east), max(north))


class DatumSearchParams(SearchParams, frozen=True):
    """What the patterns about a datum share."""

    datum_enu_m: Point | None = None
    """Where the target most likely is; null: where the vehicle is when the search begins."""
    heading_deg: HeadingDeg = 0.0
    """Of the first leg, clockwise from north."""


class ExpandingSquareParams(DatumSearchParams, frozen=True):
    """A square spiral (IAMSAR: SS), for a target that is probably close to the datum."""

    radius_m: Positive = 100.0
    """Half the width of the whole square."""

    def __post_init__(self) -> None:
        """Refuse a square without a ring."""
        if self.radius_m < self.spacing_m:
            raise ValueError("radius_m must not be less than spacing_m")
        if 4.0 * self.radius_m > MOST_LEGS * self.spacing_m:
            raise ValueError(f"radius_m would take more than {MOST_LEGS} legs at this spacing_m")


class SectorParams(DatumSearchParams, frozen=True):
    """Three triangles about the datum (IAMSAR: VS), for a target that is almost surely there."""

    radius_m: Positive = 60.0
    """Of the circle, and length of every leg."""


class Lawnmower:
    """Parallel lanes over a polygon."""

    name = "lawnmower"

    def __init__(self, params: LawnmowerParams) -> None:
        self.params = params

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """The lanes; crossed by those of the sweep before. Empty without an area and a fence."""
        del datum_enu_m
        p, spaces = self.params, _spaces(request)
        if p.area_enu_m is not None:
            area: Polygon = p.area_enu_m
            inset_m, spaces = 0.0, [FreeSpace(area), *spaces]
        elif request.fence_enu_m is not None:
            area, inset_m = request.fence_enu_m, request.fence_margin_m
        else:
            return ()
        heading_rad = (
            heading_of_fewest_lanes_rad(area)
            if p.lane_heading_deg is None
            else math.radians(p.lane_heading_deg)
        )
        heading_rad += 0.5 * math.pi * (sweep % 2)
        entry = request.vehicle_enu_m
        if sweep == 0 and p.start_corner != "nearest":
            entry = _corner_of(area, p.start_corner)
        return parallel_track(area, inset_m, p.spacing_m, heading_rad, spaces, entry)


class ExpandingSquare:
    """A square spiral about a datum."""

    name = "expanding square"

    def __init__(self, params: ExpandingSquareParams) -> None:
        self.params = params

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """The spiral, turned by 45 degrees against the sweep before."""
        p = self.params
        datum = datum_enu_m if p.datum_enu_m is None else p.datum_enu_m
        heading_rad = math.radians(p.heading_deg + 45.0 * sweep)
        return expanding_square(datum, p.spacing_m, p.radius_m, heading_rad, _spaces(request))


class SectorSearch:
    """Three triangles about a datum."""

    name = "sector search"

    def __init__(self, params: SectorParams) -> None:
        self.params = params

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """The triangles, turned by 30 degrees against the sweep before."""
        p = self.params
        datum = datum_enu_m if p.datum_enu_m is None else p.datum_enu_m
        heading_rad = math.radians(p.heading_deg + 30.0 * sweep)
        return sector_search(datum, p.radius_m, heading_rad, _spaces(request))


def _spaces(request: PlanRequest) -> list[FreeSpace]:
    finder = way_finder(request)
    return [] if finder is None else [finder.space]


def _corner_of(area: Polygon, name: str) -> Point:
    """A corner of an area's bounding box."""
    easts, norths = [p[0] for p in area], [p[1] for p in area]
    east = min(easts) if name.endswith("west") else max(easts)
    north = min(norths) if name.startswith("south") else max(norths)
    return (east, north)
