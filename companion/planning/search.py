"""Search patterns, flown leg by leg with interruptions, and handed over to crossing on contact.

Theory of operation. A pattern lays out a track, legs in order (`search_tracks`), which this
module flies. The memory holds the track, the leg and the progress along it, so that after an
interruption (a brief contact, a detour, strong wind) the search resumes where it was left, and no
part is skipped. A leg that cannot be reached is passed over.

At the end of the track the search starts over with turned legs, as the IAMSAR manual prescribes for
a second search of the same area: the next may detect what the first one missed because of its
direction. Lanes turn by 90 degrees, the square by 45, the sectors by 30.

Contact is usable ranging that is not older than `lost_after_s`: five measurements that agree,
without a gap, and an estimate that does not contradict its measurements. It hands over to the
crossing planner at once; without it the search resumes from there, because the emitter may be
received there again. Otherwise single packets at the edge of reception would hold the vehicle
there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Generic, Literal, Self, TypeVar

import msgspec

from companion.domain import EstimateState, Params, Positive, Waypoint, WaypointReason
from companion.geometry.obstacles import FreeSpace
from companion.geometry.polygons import Point, Polygon, nearest_on_segment, polygon_problem
from companion.planning.planner import (
    Plan,
    Planner,
    PlanRequest,
    hold_position,
    route_to,
    way_finder,
)
from companion.planning.search_tracks import (
    Leg,
    Track,
    expanding_square,
    heading_of_fewest_lanes_rad,
    parallel_track,
    sector_search,
)

TRANSITIONS_AT_ONCE = 4
"""Maximum number of leg ends passed in one request; no real track has more that close."""


Spacing = Annotated[float, msgspec.Meta(ge=1.0, le=1e4)]
"""Metres between neighbouring legs."""


class SearchParams(Params, frozen=True):
    """Layout of a search, and the parameters that all patterns share."""

    name: ClassVar[str]
    spacing_m: Spacing = 20.0
    """Distance between neighbouring legs: at most twice the reliable range of the radio."""
    arrival_radius_m: Positive = 1.5
    """Distance within which the end of a leg is reached."""

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """Return the legs of a sweep (0: the first), if any; the search began at the datum."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class SearchMemory:
    """Progress of a search: legs of its pattern, sweeps, and the leg being flown."""

    track: Track
    datum_enu_m: Point
    """Vehicle position when the search began."""
    sweep: int = 0
    """Number of completed sweeps."""
    index: int = 0
    """Index of the leg being flown, or flown to."""
    is_on_leg: bool = False
    """True if the start of the leg was reached."""
    is_left: bool = False
    """True if the leg was interrupted, and begins where it was left."""
    so_far_m: float = 0.0
    """Progress along the leg."""

    @property
    def leg(self) -> Leg:
        """Leg being flown, or flown to."""
        return self.track[self.index]

    def interrupted(self) -> Self:
        """Return the memory after something else was flown: the leg resumes where it was left."""
        return replace(self, is_on_leg=False, is_left=True) if self.is_on_leg else self


class SearchPlanner:
    """Planner that repeats a pattern regardless of the estimate."""

    search_after_s: float | None = 0.0

    def __init__(self, pattern: SearchParams) -> None:
        self.pattern = pattern
        self._arrival_m = pattern.arrival_radius_m

    def plan(self, request: PlanRequest, memory: SearchMemory | None) -> Plan[SearchMemory | None]:
        """Return the end of the leg, or the path to its start."""
        if memory is None:
            datum = request.vehicle_enu_m
            memory = SearchMemory(self.pattern.track(request, datum, 0), datum)
        if not memory.track:
            return Plan(hold_position(request, f"{self.pattern.name}: nothing to search"), None)
        memory = self._advanced(request, memory)
        for _ in range(len(memory.track)):
            waypoint = route_to(request, self._wanted(memory))
            if waypoint.reason is not WaypointReason.HOLD:
                return Plan(waypoint, memory)
            memory = self._at_next_leg(request, memory)
        return Plan(hold_position(request, f"{self.pattern.name}: no path to any leg"), memory)

    def _advanced(self, request: PlanRequest, memory: SearchMemory) -> SearchMemory:
        """Return the memory with the progress of the vehicle."""
        vehicle = request.vehicle_enu_m
        for _ in range(TRANSITIONS_AT_ONCE):
            leg = memory.leg
            if not memory.is_on_leg:
                if math.dist(vehicle, _begin(memory)) > self._arrival_m:
                    return memory
                memory = replace(memory, is_on_leg=True)
                continue
            here = nearest_on_segment(leg.start_enu_m, leg.end_enu_m, vehicle)
            if math.dist(here, vehicle) > max(0.5 * self.pattern.spacing_m, self._arrival_m):
                return memory.interrupted()
            if math.dist(here, leg.end_enu_m) > self._arrival_m:
                so_far_m = max(memory.so_far_m, math.dist(leg.start_enu_m, here))
                return replace(memory, so_far_m=so_far_m)
            memory = self._at_next_leg(request, memory)
        return memory

    def _at_next_leg(self, request: PlanRequest, memory: SearchMemory) -> SearchMemory:
        datum, following = memory.datum_enu_m, memory.index + 1
        if following < len(memory.track):
            return SearchMemory(memory.track, datum, memory.sweep, following)
        track = self.pattern.track(request, datum, memory.sweep + 1)
        return SearchMemory(track or memory.track, datum, memory.sweep + 1)

    def _wanted(self, memory: SearchMemory) -> Waypoint:
        leg_of = f"{self.pattern.name}, leg {memory.index + 1} of {len(memory.track)}"
        if memory.sweep > 0:
            leg_of = f"{leg_of}, sweep {memory.sweep + 1}"
        if memory.is_on_leg:
            return Waypoint(memory.leg.end_enu_m, WaypointReason.SEARCH, leg_of)
        to = "resuming on" if memory.is_left else "to"
        return Waypoint(_begin(memory), WaypointReason.SEARCH, f"{to} {leg_of}")


def _begin(memory: SearchMemory) -> Point:
    """Return the point to join the leg: its start, or where it was left."""
    leg, length_m = memory.leg, memory.leg.length_m
    share = 0.0 if length_m == 0.0 else min(1.0, memory.so_far_m / length_m)
    (e0, n0), (e1, n1) = leg.start_enu_m, leg.end_enu_m
    return (e0 + share * (e1 - e0), n0 + share * (n1 - n0))


MIN_AREA_M2 = 1.0
"""Smallest area to search."""
MAX_LEGS = 2000
"""Limit of legs: more cannot be flown, and planning them would delay control ticks."""
HeadingDeg = Annotated[float, msgspec.Meta(ge=0.0, le=360.0)]
Corner = Literal["nearest", "south_west", "south_east", "north_west", "north_east"]


class LawnmowerParams(SearchParams, frozen=True):
    """Parallel lanes over a polygon (IAMSAR: parallel track)."""

    name: ClassVar[str] = "lawnmower"
    area_enu_m: tuple[Point, ...] | None = None
    """Corners of the area to search; null: the whole fence."""
    lane_heading_deg: HeadingDeg | None = None
    """Heading of the lanes, clockwise from north; null: along the longer side."""
    start_corner: Corner = "nearest"
    """Start of the first sweep; nearest: to the vehicle."""

    def __post_init__(self) -> None:
        """Reject an invalid area."""
        area = self.area_enu_m
        if area is None:
            return
        problem = polygon_problem(area, MIN_AREA_M2)
        if problem is not None:
            raise ValueError(f"area_enu_m {problem}")
        if math.dist(*_extent(area)) > MAX_LEGS * self.spacing_m:
            raise ValueError(f"area_enu_m would take more than {MAX_LEGS} lanes at this spacing_m")

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """Return the lanes, perpendicular to the previous sweep's; none without area and fence."""
        del datum_enu_m
        spaces = _spaces(request)
        if self.area_enu_m is not None:
            area: Polygon = self.area_enu_m
            inset_m, spaces = 0.0, [FreeSpace(area), *spaces]
        elif request.fence_enu_m is not None:
            area, inset_m = request.fence_enu_m, request.fence_margin_m
        else:
            return ()
        heading_rad = (
            heading_of_fewest_lanes_rad(area)
            if self.lane_heading_deg is None
            else math.radians(self.lane_heading_deg)
        )
        heading_rad += 0.5 * math.pi * (sweep % 2)
        entry = request.vehicle_enu_m
        if sweep == 0 and self.start_corner != "nearest":
            easts, norths = [p[0] for p in area], [p[1] for p in area]
            east = min(easts) if self.start_corner.endswith("west") else max(easts)
            north = min(norths) if self.start_corner.startswith("south") else max(norths)
            entry = (east, north)
        return parallel_track(area, inset_m, self.spacing_m, heading_rad, spaces, entry)


def _extent(area: Polygon) -> tuple[Point, Point]:
    """Return the south-western and the north-eastern corner of an area's bounding box."""
    east, north = zip(*area, strict=True)
    return (min(east), min(north)), (max(east), max(north))


class DatumSearchParams(SearchParams, frozen=True):
    """Common parameters of the patterns about a datum."""

    datum_enu_m: Point | None = None
    """Most likely position of the target; null: the vehicle position when the search begins."""
    heading_deg: HeadingDeg = 0.0
    """Heading of the first leg, clockwise from north."""

    def _datum(self, began_enu_m: Point) -> Point:
        return began_enu_m if self.datum_enu_m is None else self.datum_enu_m


class ExpandingSquareParams(DatumSearchParams, frozen=True):
    """Square spiral (IAMSAR: SS), for a target that is probably close to the datum."""

    name: ClassVar[str] = "expanding square"
    radius_m: Positive = 100.0
    """Half the width of the whole square."""

    def __post_init__(self) -> None:
        """Reject a square without a ring."""
        if self.radius_m < self.spacing_m:
            raise ValueError("radius_m must not be less than spacing_m")
        if 4.0 * self.radius_m > MAX_LEGS * self.spacing_m:
            raise ValueError(f"radius_m would take more than {MAX_LEGS} legs at this spacing_m")

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """Return the spiral, turned by 45 degrees against the sweep before."""
        datum, spaces = self._datum(datum_enu_m), _spaces(request)
        heading_rad = math.radians(self.heading_deg + 45.0 * sweep)
        return expanding_square(datum, self.spacing_m, self.radius_m, heading_rad, spaces)


class SectorParams(DatumSearchParams, frozen=True):
    """Three triangles about the datum (IAMSAR: VS), for a target that is almost surely there."""

    name: ClassVar[str] = "sector search"
    radius_m: Positive = 60.0
    """Radius of the circle, and length of every leg."""

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """Return the triangles, turned by 30 degrees against the sweep before."""
        heading_rad = math.radians(self.heading_deg + 30.0 * sweep)
        datum = self._datum(datum_enu_m)
        return sector_search(datum, self.radius_m, heading_rad, _spaces(request))


def _spaces(request: PlanRequest) -> list[FreeSpace]:
    finder = way_finder(request)
    return [] if finder is None else [finder.space]


Crossing = TypeVar("Crossing")


@dataclass(frozen=True, slots=True)
class SearchThenCrossMemory(Generic[Crossing]):
    """Memories of both planners, and which of them flies."""

    search: SearchMemory | None = None
    crossing: Crossing | None = None
    is_crossing: bool = False

    def without_target(self) -> Self:
        """Return the memory of the search alone, which resumes where it was left."""
        search = self.search.interrupted() if self.search and self.is_crossing else self.search
        return replace(self, search=search, crossing=None, is_crossing=False)


class SearchThenCross(Generic[Crossing]):
    """Pair of planners: one crosses during contact, one searches `lost_after_s` after it."""

    def __init__(
        self, search: SearchPlanner, crossing: Planner[Crossing], lost_after_s: float
    ) -> None:
        self.search_after_s: float | None = lost_after_s
        self._lost_after_s = lost_after_s
        self._search = search
        self._crossing = crossing

    def plan(
        self, request: PlanRequest, memory: SearchThenCrossMemory[Crossing] | None
    ) -> Plan[SearchThenCrossMemory[Crossing]]:
        """Return the waypoint of the active planner."""
        memory = memory or SearchThenCrossMemory()
        if self._has_contact(request, memory):
            crossed = self._crossing.plan(request, memory.crossing)
            following = SearchThenCrossMemory(memory.search, crossed.memory, is_crossing=True)
            return Plan(crossed.waypoint, following)
        if memory.is_crossing:
            memory = memory.without_target()
        searched = self._search.plan(request, memory.search)
        return Plan(searched.waypoint, SearchThenCrossMemory(searched.memory))

    def _has_contact(self, request: PlanRequest, memory: SearchThenCrossMemory[Crossing]) -> bool:
        if request.estimate is None:
            return False
        contact_s = request.contact_s
        if contact_s is not None and request.time_s - contact_s > self._lost_after_s:
            return False
        return memory.is_crossing or request.estimate.state is not EstimateState.DIVERGED
