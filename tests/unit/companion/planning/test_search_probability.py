"""Routes of the planner by probability, and the limits that it keeps to."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.domain import Waypoint, WaypointReason
from companion.geometry.obstacles import FreeSpace
from companion.geometry.polygons import Point, Polygon
from companion.planning.planner import PlanRequest
from companion.planning.search import LawnmowerParams, SearchPlanner
from companion.planning.search_probability import ProbabilityMemory, ProbabilityPlanner, _regions
from companion.search.detection_model import DetectionModel
from companion.search.outlook import LegTable, outlook_of
from companion.search.search_grid import SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import SearchedArea, state_of

SIDE_M, HEIGHT_M, SPEED_MPS = 400.0, 20.0, 5.0
FENCE = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M))
MODEL = DetectionModel(reach_m=50.0)
LANES = LawnmowerParams(spacing_m=50.0)
PLANNER = ProbabilityPlanner(LANES, LegTable(MODEL, HEIGHT_M, SPEED_MPS))
HOME: Point = (10.0, 10.0)


def box(west: float, south: float, east: float, north: float) -> tuple[Point, ...]:
    return (west, south), (east, south), (east, north), (west, north)


def even() -> SearchGrid:
    return grid_over([WeightedArea(FENCE)], 20.0)


def with_a_spot(weight: float = 10.0) -> SearchGrid:
    """Most of the chance is in the north-eastern corner, far from home."""
    return grid_over(
        [WeightedArea(FENCE), WeightedArea(box(280.0, 280.0, 380.0, 380.0), weight)], 20.0
    )


class Flight:
    """A point that flies the plan and listens."""

    def __init__(self, grid: SearchGrid, keep_out: tuple[Polygon, ...] = ()) -> None:
        self.area = SearchedArea(grid, MODEL)
        self.request = PlanRequest(HOME, None, FENCE, 3.0, keep_out_enu_m=keep_out, home_enu_m=HOME)
        self.memory: Any = None
        self.waypoint: Waypoint | None = None

    def run(self, seconds: int, planner: SearchPlanner = PLANNER) -> Iterator[Point]:
        for _ in range(seconds):
            self.area.renew()
            request = replace(self.request, outlook=outlook_of(self.area))
            for _ in range(5):
                plan = planner.plan(request, self.memory)
                self.memory, self.waypoint = plan.memory, plan.waypoint
            yield self.move(plan.waypoint.position_enu_m)

    def share_left_at(self, position: Point) -> float:
        """Return the probability left about a position, as a share of that before the search."""
        state = state_of(self.area)
        near = np.hypot(*(state.grid.centres_enu_m - position).T) < 40.0
        return float(1.0 - state.pod[near].mean())

    def move(self, goal: Point) -> Point:
        east, north = self.request.vehicle_enu_m
        apart_m = math.dist((east, north), goal)
        share = min(1.0, SPEED_MPS / apart_m) if apart_m > 0.0 else 0.0
        position = (east + share * (goal[0] - east), north + share * (goal[1] - north))
        self.request = replace(self.request, vehicle_enu_m=position)
        self.area.listen((*position, HEIGHT_M), 1.0)
        while self.area.advance():
            pass
        return position


def test_it_flies_to_where_the_chance_is_and_says_so() -> None:
    flight, said = Flight(with_a_spot()), set()
    positions = []
    for position in flight.run(160):
        positions.append(position)
        assert flight.waypoint is not None
        said.add(flight.waypoint.detail)
    assert min(math.dist(position, (330.0, 330.0)) for position in positions[:100]) < 60.0
    assert "choosing the next leg" in said
    assert any(text.startswith("NE corner: ") and " of the probability, " in text for text in said)
    lawnmower = Flight(with_a_spot())
    list(lawnmower.run(160, SearchPlanner(LANES)))
    assert state_of(flight.area).pos > 2.0 * state_of(lawnmower.area).pos


def test_an_even_area_begins_as_the_pattern_without_a_wait() -> None:
    flight, lawnmower = Flight(even()), Flight(even())
    by_map = list(flight.run(60))
    assert by_map == list(lawnmower.run(60, SearchPlanner(LANES)))


def test_in_an_even_area_it_is_no_worse_than_the_pattern() -> None:
    flight, lawnmower = Flight(even()), Flight(even())
    for seconds in (150, 250):
        list(flight.run(seconds))
        list(lawnmower.run(seconds, SearchPlanner(LANES)))
        assert state_of(flight.area).pos >= 0.98 * state_of(lawnmower.area).pos


def test_every_leg_keeps_to_fence_and_keep_outs() -> None:
    house = box(150.0, 150.0, 260.0, 250.0)
    space = FreeSpace(FENCE, (house,), 3.0 - 1e-6)
    flight = Flight(with_a_spot(), (house,))
    before = HOME
    for position in flight.run(500):
        assert space.is_clear(before, position)
        before = position


def test_chosen_legs_leave_a_way_home() -> None:
    """The spot is 450 m away; with charge for 500 m it is not searched, with more it is."""
    near, far = Flight(with_a_spot()), Flight(with_a_spot())
    for flight, range_m in ((near, 500.0), (far, 3000.0)):
        left_m, chosen = range_m, 0
        for _ in range(120):
            before = flight.request.vehicle_enu_m
            if left_m - math.dist(before, HOME) < SPEED_MPS:  # the search is over
                break
            flight.request = replace(flight.request, range_left_m=left_m)
            position = next(flight.run(1))
            left_m -= math.dist(before, position)
            assert flight.waypoint is not None
            if "of the probability" in flight.waypoint.detail:
                goal = flight.waypoint.position_enu_m
                assert math.dist(position, goal) + math.dist(goal, HOME) <= left_m + 1e-6
                chosen += 1
        assert chosen > 20
        assert (flight.share_left_at((330.0, 330.0)) < 0.5) is (flight is far)


def test_an_interrupted_leg_goes_on_where_it_was_left() -> None:
    flight = Flight(with_a_spot())
    list(flight.run(100))
    memory = flight.memory
    assert isinstance(memory, ProbabilityMemory)
    assert memory.is_on_leg
    left_at = flight.request.vehicle_enu_m
    flight.memory = memory.interrupted()
    flight.request = replace(flight.request, vehicle_enu_m=(left_at[0], left_at[1] - 60.0))
    list(flight.run(1))
    assert flight.waypoint is not None
    assert math.dist(flight.waypoint.position_enu_m, left_at) < 2.0 * SPEED_MPS


def test_without_a_map_it_flies_its_pattern() -> None:
    """As after a contact that was lost: what is left is not counted any more."""
    request = PlanRequest(HOME, None, FENCE, 3.0)
    plan = PLANNER.plan(request, None)
    assert plan.waypoint == SearchPlanner(LANES).plan(request, None).waypoint
    flight = Flight(with_a_spot())
    list(flight.run(100))
    for _ in range(400):
        plan = PLANNER.plan(flight.request, flight.memory)
        flight.memory = plan.memory
        flight.move(plan.waypoint.position_enu_m)
        assert plan.waypoint.reason in (WaypointReason.SEARCH, WaypointReason.DETOUR)


def test_the_same_request_and_memory_give_the_same_plan() -> None:
    flight = Flight(with_a_spot())
    for _ in flight.run(30):
        request = replace(flight.request, outlook=outlook_of(flight.area))
        first = PLANNER.plan(request, flight.memory)
        assert first.waypoint == PLANNER.plan(request, flight.memory).waypoint


def test_a_sweep_is_the_effort_of_one_pattern() -> None:
    flight = Flight(even())
    length_m = sum(leg.length_m for leg in LANES.track(flight.request, HOME, 0))
    for sweeps in (1, 2):
        while flight.memory is None or flight.memory.sweep < sweeps:
            list(flight.run(10))
        assert flight.memory.flown_m == pytest.approx(sweeps * length_m, abs=SIDE_M), sweeps


def test_a_sector_search_is_weighed_about_a_single_peak() -> None:
    """Of two peaks none is the datum."""
    spots = [box(180.0, 180.0, 240.0, 240.0), box(20.0, 20.0, 80.0, 80.0)]
    for count, expected in ((1, {0, 1, 2, 3}), (2, {0, 1, 2})):
        areas = [WeightedArea(FENCE, 0.2), *(WeightedArea(spot, 5.0) for spot in spots[:count])]
        area = SearchedArea(grid_over(areas, 20.0), MODEL)
        assert {region.turn for region in _regions(outlook_of(area), 0.7)} == expected
