"""Flying a search pattern, leg by leg, with interruptions.

Theory of operation. A pattern lays out a track, legs in their order; this flies it. The memory
holds the track, the leg and how far along it the vehicle has come, so that after an interruption
(a contact that came to nothing, a detour, a stronger wind) the search goes on at the very place
where it was left, and nothing is skipped. A leg that there is no way to is passed over.

At the end of the track the search starts over with turned legs, as the IAMSAR manual has it for a
second search of the same area: what the first one missed by its direction, the next may hear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import msgspec

from companion.domain import Point, Waypoint, WaypointReason
from companion.geometry.polygons import nearest_on_segment
from companion.params import Params, Positive
from companion.planning.base import Plan, PlanRequest
from companion.planning.routing import held, routed
from companion.planning.tracks import Leg, Track

TRANSITIONS_AT_ONCE = 4
"""Leg ends that one request may pass; more are not reached at one place by any real track."""


Spacing = Annotated[float, msgspec.Meta(ge=1.0)]
"""Metres between neighbouring legs."""


class SearchParams(Params, frozen=True):
    """What every pattern has."""

    spacing_m: Spacing = 20.0
    """Distance between neighbouring legs: not more than twice what the radio surely hears."""
    arrival_radius_m: Positive = 1.5
    """The end of a leg counts as reached within this distance."""


@dataclass(frozen=True, slots=True)
class SearchMemory:
    """How far a search has come."""

    track: Track
    datum_enu_m: Point
    """Where the vehicle was when the search began."""
    sweep: int = 0
    """How often the track has been flown to its end before."""
    index: int = 0
    """Of the leg being flown, or flown to."""
    is_on_leg: bool = False
    """Whether the start of the leg was reached."""
    is_left: bool = False
    """Whether the leg was interrupted, and begins where it was."""
    so_far_m: float = 0.0
    """How far along the leg the vehicle has come."""

    @property
    def leg(self) -> Leg:
        """The leg being flown, or flown to."""
        return self.track[self.index]


class Pattern(Protocol):
    """A way to lay out a search."""

    @property
    def params(self) -> SearchParams:
        """What every pattern has."""

    @property
    def name(self) -> str:
        """As the operator knows it."""

    def track(self, request: PlanRequest, datum_enu_m: Point, sweep: int) -> Track:
        """The legs of a sweep; none where there is nothing to search.

        Args:
            request: With the fence, the keep-outs and the vehicle.
            datum_enu_m: Where the vehicle was when the search began.
            sweep: 0 for the first time over the area.
        """


class SearchPlanner:
    """Flies a pattern again and again, whatever the estimate.

    Args:
        pattern: What to fly.
    """

    search_after_s: float | None = 0.0

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        self._arrival_m = pattern.params.arrival_radius_m

    def initial_memory(self) -> SearchMemory | None:
        """Not begun."""
        return None

    def plan(self, request: PlanRequest, memory: SearchMemory | None) -> Plan[SearchMemory | None]:
        """The end of the leg, or the way to its start."""
        if memory is None:
            datum = request.vehicle_enu_m
            memory = SearchMemory(self.pattern.track(request, datum, 0), datum)
        if not memory.track:
            return Plan(held(request, f"{self.pattern.name}: nothing to search"), None)
        memory = self._advanced(request, memory)
        for _ in range(len(memory.track)):
            waypoint = routed(request, self._wanted(memory))
            if waypoint.reason is not WaypointReason.HOLD:
                return Plan(waypoint, memory)
            memory = self._at_next_leg(request, memory)
        return Plan(held(request, f"{self.pattern.name}: no way to any leg"), memory)

    def interrupted(self, memory: SearchMemory | None) -> SearchMemory | None:
        """The memory after something else was flown: the rest of the leg, from where it was left.

        Args:
            memory: As it was when the search was left.
        """
        if memory is None or not memory.is_on_leg:
            return memory
        return replace(memory, is_on_leg=False, is_left=True)

    def _advanced(self, request: PlanRequest, memory: SearchMemory) -> SearchMemory:
        """The memory with what the vehicle has reached by now."""
        vehicle = request.vehicle_enu_m
        for _ in range(TRANSITIONS_AT_ONCE):
            leg = memory.leg
            if not memory.is_on_leg:
                if math.dist(vehicle, _begin(memory)) > self._arrival_m:
                    return memory
                memory = replace(memory, is_on_leg=True)
                continue
            here = nearest_on_segment(leg.start_enu_m, leg.end_enu_m, vehicle)
            if math.dist(here, vehicle) > max(0.5 * self.pattern.params.spacing_m, self._arrival_m):
                left = self.interrupted(memory)
                return memory if left is None else left
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
        to = "back to where it was left on" if memory.is_left else "to"
        return Waypoint(_begin(memory), WaypointReason.SEARCH, f"{to} {leg_of}")


def _begin(memory: SearchMemory) -> Point:
    """Where to get on the leg: its start, or where it was left."""
    leg, length_m = memory.leg, memory.leg.length_m
    share = 0.0 if length_m == 0.0 else min(1.0, memory.so_far_m / length_m)
    (e0, n0), (e1, n1) = leg.start_enu_m, leg.end_enu_m
    return (e0 + share * (e1 - e0), n0 + share * (n1 - n0))
