"""Search by remaining probability: a pattern if it is uniform, else legs where it is highest.

Theory of operation. A candidate is a row of straight legs: what is left of the current track, the
pattern over the whole area, lanes over connected cells above a level of the remaining density,
along and across, an expanding square about the densest of them, and a sector search about the only
one. The value of a candidate is the highest rate of success per second of its beginnings, the
flight to it included:

    rate = max over k of (POS of the first k legs) / (time of the first k legs)

Rows of tasks with an order of their own are done in the order of this index for the shortest mean
time of discovery (J. B. Sidney, Operations Research 23, 1975; L. D. Stone, Theory of Optimal
Search). The current track is left only for a rate that exceeds its own by `LEAVE_RATIO`. Beginnings
that leave no charge for the way home are excluded.

A decision is made while the current leg is flown, for its end, a few forecasts of a leg at each
request, each O(cells). With an even POA the pattern begins at once; otherwise the vehicle holds
until the first decision is made, a few seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from companion.domain import Waypoint, WaypointReason
from companion.geometry.obstacles import between
from companion.geometry.polygons import Point
from companion.planning.planner import Plan, PlanRequest, hold_position, way_finder
from companion.planning.search import SearchMemory, SearchParams, SearchPlanner
from companion.planning.search_tracks import Leg, Track, expanding_square, lanes_over, sector_search
from companion.search.outlook import LegTable, Outlook
from companion.search.search_grid import Bools, Floats
from companion.search.searched_flight import pieces_of, sector_name

FORECASTS_AT_ONCE = 6
"""Forecasts of a leg in one request: about 2 ms in plain Python, of a control tick's 50 ms."""
MAX_LEGS = 12
"""Legs of a candidate that are forecast; its best beginning is nearly always shorter."""
LEAVE_RATIO = 1.2
"""Rate of another candidate over that of the current track; forecasts err by about as much."""
LEVELS = (0.7, 0.4, 0.15)
"""Densities, relative to the highest, whose regions become candidates."""
MAX_REGIONS = 3
"""Regions of a level that are considered, the most probable first."""


@dataclass(frozen=True, slots=True)
class Region:
    """Neighbouring cells, for lanes along the axes of their spread, or a pattern about them."""

    cells: Bools = field(compare=False)
    turn: int
    """Orientation: 0: lanes along the longer axis, 1: across it, 2: an expanding square, 3: a
    sector search."""


Source = Track | Region | float
"""Legs, a region to lay lanes over, or a level of the density to look for regions at."""


@dataclass(frozen=True, slots=True)
class CandidateLegs:
    """A row of legs, and the forecast of its beginning so far."""

    legs: Track
    outlook: Outlook
    end_enu_m: Point
    flown_m: float = 0.0
    gain: float = 0.0
    index: int = 0
    rate: float = 0.0
    """Highest rate of success so far, 1/m."""
    first: tuple[float, float, str] = (0.0, 0.0, "")
    """Gain, length and sector of the first leg with the flight to it."""


@dataclass(frozen=True, slots=True)
class Decision:
    """Work on the choice of the leg after the current one."""

    outlook: Outlook
    """Expected when it begins."""
    begin_enu_m: Point
    range_m: float
    """Distance that may be flown from there, the way home included."""
    waiting: tuple[Source, ...]
    candidate: CandidateLegs | None = None
    present: CandidateLegs | None = None
    """The current track, finished."""
    best: CandidateLegs | None = None

    @property
    def is_made(self) -> bool:
        """True if nothing is left to forecast."""
        return self.candidate is None and not self.waiting

    @property
    def chosen(self) -> CandidateLegs | None:
        """Best candidate, or the current track unless clearly worse; None if neither is good."""
        best, present = self.best, self.present
        if present is not None and (best is None or best.rate <= LEAVE_RATIO * present.rate):
            return present if present.rate > 0.0 else None
        return best


@dataclass(frozen=True, slots=True)
class ProbabilityMemory(SearchMemory):
    """Progress along the current track, and the decision about the following leg."""

    decision: Decision | None = None
    is_choosing: bool = False
    """True while it waits for the decision."""
    flown_m: float = 0.0
    """Length of all legs that were finished."""
    pattern_m: float = math.inf
    """Length of the pattern over the whole area, which is one sweep."""
    why: str = ""
    """Text of the probability that the current leg succeeds."""


class ProbabilityPlanner(SearchPlanner):
    """Planner of straight legs by success per second; without an outlook it flies its pattern."""

    def __init__(self, pattern: SearchParams, table: LegTable) -> None:
        super().__init__(pattern)
        self._table = table

    def plan(self, request: PlanRequest, memory: SearchMemory | None) -> Plan[SearchMemory | None]:
        """Return the end of the leg, or the path to its start, while the decision continues."""
        if not isinstance(memory, ProbabilityMemory):
            memory = self._begun(request)
        if request.outlook is None:
            memory = replace(memory, decision=None, is_choosing=False)
        elif memory.decision is not None:
            memory = replace(memory, decision=self._advanced_decision(request, memory.decision))
        if memory.is_choosing:
            if memory.decision is None or not memory.decision.is_made:
                return Plan(hold_position(request, "choosing the next leg"), memory)
            memory = self._chosen(request, memory)
        return super().plan(request, memory)

    def _begun(self, request: PlanRequest) -> ProbabilityMemory:
        datum, outlook = request.vehicle_enu_m, request.outlook
        track = self.pattern.track(request, datum, 0)
        length_m = sum(leg.length_m for leg in track)
        memory = ProbabilityMemory(track, datum, pattern_m=max(length_m, 1.0))
        if outlook is None or not track:
            return memory
        decision = self._decision(request, outlook, datum, track)
        if outlook.is_even:
            return self._deciding(request, memory)
        return replace(memory, decision=decision, is_choosing=True)

    def _at_next_leg(self, request: PlanRequest, memory: SearchMemory) -> SearchMemory:
        assert isinstance(memory, ProbabilityMemory)
        if memory.is_choosing:
            return memory
        flown_m = memory.flown_m + memory.leg.length_m
        memory = replace(memory, flown_m=flown_m, sweep=int(flown_m / memory.pattern_m), why="")
        if memory.decision is not None and memory.decision.is_made:
            return self._chosen(request, memory)
        return self._following(request, memory)

    def _chosen(self, request: PlanRequest, memory: ProbabilityMemory) -> ProbabilityMemory:
        """Return the memory at the first leg of the chosen candidate."""
        decision = memory.decision
        chosen = None if decision is None else decision.chosen
        if decision is None or chosen is None:
            return self._following(request, replace(memory, decision=None, is_choosing=False))
        gain, length_m, name = chosen.first
        share = 100.0 * gain / max(decision.outlook.left, 1e-300)
        why = f"{name}: {share:.0f} % of the probability, {length_m / self._table.speed_mps:.0f} s"
        return self._deciding(request, _on_track(memory, chosen.legs, 0, why))

    def _following(self, request: PlanRequest, memory: ProbabilityMemory) -> ProbabilityMemory:
        """Return the memory on the next leg of the track, or of a new sweep of the pattern."""
        if memory.index + 1 < len(memory.track):
            return self._deciding(request, _on_track(memory, memory.track, memory.index + 1, ""))
        if memory.decision is not None and request.outlook is not None:
            return replace(memory, is_choosing=True)
        track = self.pattern.track(request, memory.datum_enu_m, memory.sweep) or memory.track
        return self._deciding(request, _on_track(memory, track, 0, ""))

    def _deciding(self, request: PlanRequest, memory: ProbabilityMemory) -> ProbabilityMemory:
        """Return the memory with a pending decision about the next leg."""
        if request.outlook is None:
            return replace(memory, decision=None)
        leg, vehicle = memory.leg, request.vehicle_enu_m
        outlook = request.outlook.after(vehicle, leg.start_enu_m, self._table)
        outlook = outlook.after(leg.start_enu_m, leg.end_enu_m, self._table)
        rest = memory.track[memory.index + 1 :]
        spent_m = math.dist(vehicle, leg.start_enu_m) + leg.length_m
        decision = self._decision(request, outlook, leg.end_enu_m, rest, spent_m)
        return replace(memory, decision=decision)

    def _decision(
        self,
        request: PlanRequest,
        outlook: Outlook,
        begin_enu_m: Point,
        rest: Track,
        spent_m: float = 0.0,
    ) -> Decision:
        pattern = self.pattern.track(replace(request, vehicle_enu_m=begin_enu_m), begin_enu_m, 0)
        waiting: tuple[Source, ...] = (rest, pattern, *LEVELS)
        return Decision(outlook, begin_enu_m, request.range_left_m - spent_m, waiting)

    def _advanced_decision(self, request: PlanRequest, decision: Decision) -> Decision:
        for _ in range(FORECASTS_AT_ONCE):
            if decision.is_made:
                break
            if decision.candidate is None:
                decision = self._opened(request, decision)
            else:
                decision = self._forecast(request, decision, decision.candidate)
        return decision

    def _opened(self, request: PlanRequest, decision: Decision) -> Decision:
        """Return the decision with its next source made into a candidate, or into regions."""
        source, waiting = decision.waiting[0], decision.waiting[1:]
        if isinstance(source, float):
            found = _regions(decision.outlook, source)
            return replace(decision, waiting=(*found, *waiting))
        legs = source if isinstance(source, tuple) else self._lanes(request, decision, source)
        candidate = CandidateLegs(legs, decision.outlook, decision.begin_enu_m)
        is_reachable = bool(legs) and _is_reachable(request, decision.begin_enu_m, legs[0])
        if is_reachable:
            return replace(decision, waiting=waiting, candidate=candidate)
        if decision.present is None:
            return replace(decision, waiting=waiting, present=candidate)
        return replace(decision, waiting=waiting)

    def _lanes(self, request: PlanRequest, decision: Decision, region: Region) -> Track:
        grid, begin_enu_m = decision.outlook.grid, decision.begin_enu_m
        centres = grid.centres_enu_m[region.cells]
        mass = decision.outlook.chance.sum(axis=1, dtype=float)[region.cells]
        middle, along_rad = _axis(centres, mass)
        finder = way_finder(request)
        spaces = [] if finder is None else [finder.space]
        spacing_m = self.pattern.spacing_m
        if region.turn == 2:
            far_m = float(np.abs(centres - middle).max())
            radius_m = max(spacing_m, min(far_m, 3.0 * spacing_m))
            return expanding_square(middle, spacing_m, radius_m, along_rad, spaces)
        if region.turn == 3:
            radius_m = max(spacing_m, float(np.hypot(*(centres - middle).T).max()))
            return sector_search(middle, radius_m, along_rad, spaces)
        heading_rad = along_rad + 0.5 * math.pi * region.turn
        return lanes_over(centres, grid.cell_m, spacing_m, heading_rad, spaces, begin_enu_m)

    def _forecast(self, request: PlanRequest, decision: Decision, it: CandidateLegs) -> Decision:
        """Return the decision with one more leg of the candidate forecast."""
        leg, before, table = it.legs[it.index], it.outlook, self._table
        to_m = math.dist(it.end_enu_m, leg.start_enu_m)
        range_m = decision.range_m - it.flown_m - to_m
        flown = _affordable(leg, range_m, request.home_enu_m)
        if flown.length_m < min(leg.length_m, self.pattern.spacing_m):
            return _with_result(decision, it)
        outlook = before
        if to_m > self.pattern.spacing_m:
            outlook = outlook.after(it.end_enu_m, leg.start_enu_m, table)
        outlook = outlook.after(leg.start_enu_m, flown.end_enu_m, table)
        gain, flown_m = it.gain + before.left - outlook.left, it.flown_m + to_m + flown.length_m
        first = it.first
        if it.index == 0:
            first = (gain, flown_m, sector_name(outlook.grid, _gaining(before, outlook)))
        following = replace(
            it,
            legs=it.legs if flown is leg else (*it.legs[: it.index], flown),
            outlook=outlook,
            end_enu_m=flown.end_enu_m,
            flown_m=flown_m,
            gain=gain,
            index=it.index + 1,
            rate=max(it.rate, gain / max(flown_m, 1.0)),
            first=first,
        )
        if following.index in (len(following.legs), MAX_LEGS):
            return _with_result(decision, following)
        return replace(decision, candidate=following)

    def _wanted(self, memory: SearchMemory) -> Waypoint:
        wanted = super()._wanted(memory)
        why = memory.why if isinstance(memory, ProbabilityMemory) else ""
        if not why or wanted.reason is not WaypointReason.SEARCH:
            return wanted
        return replace(wanted, detail=why)


def _affordable(leg: Leg, range_m: float, home: Point | None) -> Leg:
    """Return the leg, or the beginning of it after which the range lasts for the way home."""
    if home is None or leg.length_m + math.dist(leg.end_enu_m, home) <= range_m:
        return leg
    low, high = 0.0, 1.0
    for _ in range(12):
        share = 0.5 * (low + high)
        end = between(leg.start_enu_m, leg.end_enu_m, share)
        is_enough = share * leg.length_m + math.dist(end, home) <= range_m
        low, high = (share, high) if is_enough else (low, share)
    return Leg(leg.start_enu_m, between(leg.start_enu_m, leg.end_enu_m, low))


def _on_track(memory: ProbabilityMemory, track: Track, index: int, why: str) -> ProbabilityMemory:
    return replace(
        memory,
        track=track,
        index=index,
        is_on_leg=False,
        is_left=False,
        so_far_m=0.0,
        decision=None,
        is_choosing=False,
        why=why,
    )


def _with_result(decision: Decision, candidate: CandidateLegs) -> Decision:
    """Return the decision with a candidate that is forecast to its end."""
    if decision.present is None:
        return replace(decision, candidate=None, present=candidate)
    best = decision.best
    if candidate.rate > 0.0 and (best is None or candidate.rate > best.rate):
        best = candidate
    return replace(decision, candidate=None, best=best)


def _regions(outlook: Outlook, level: float) -> tuple[Region, ...]:
    """Return the regions above a level of the density, the most probable first."""
    density = outlook.density
    found = list(pieces_of(outlook.grid, density >= level))
    found.sort(key=lambda cells: -float(density[cells].sum()))
    turns = (0, 1, 2, 3) if len(found) == 1 else (0, 1, 2)  # a sector search is about one peak
    return tuple(Region(cells, turn) for cells in found[:MAX_REGIONS] for turn in turns)


def _gaining(before: Outlook, after: Outlook) -> Bools:
    """Return the cells that make up most of a gain."""
    gain = (before.chance - after.chance).sum(axis=1)
    cells: Bools = gain >= 0.5 * gain.max()
    return cells


def _axis(centres: Floats, mass: Floats) -> tuple[Point, float]:
    """Return the centre of mass, and the heading of the longer axis of the spread."""
    middle = np.average(centres, axis=0, weights=mass)
    apart = centres - middle
    spread = apart.T @ apart
    heading_rad = 0.5 * math.atan2(2.0 * float(spread[0, 1]), float(spread[1, 1] - spread[0, 0]))
    return (float(middle[0]), float(middle[1])), heading_rad


def _is_reachable(request: PlanRequest, begin: Point, leg: Leg) -> bool:
    finder = way_finder(request)
    if finder is None:
        return True
    start = finder.space.nearest_allowed(begin)
    return start is not None and finder.way(start, leg.start_enu_m) is not None
