from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.domain import WaypointReason
from companion.geometry.polygons import Point
from companion.planning.planner import PlanRequest
from companion.planning.search import (
    Corner,
    ExpandingSquareParams,
    LawnmowerParams,
    SearchMemory,
    SearchPlanner,
    SectorParams,
)
from companion.planning.search_tracks import Track

FIELD = ((0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0))
PARAMS = LawnmowerParams(area_enu_m=FIELD, spacing_m=20.0)
PLANNER = SearchPlanner(PARAMS)
STEP_M = 2.0


class Flight:
    """A vehicle that flies what a search wants."""

    def __init__(
        self, planner: SearchPlanner, start: Point, request: PlanRequest | None = None
    ) -> None:
        self.planner = planner
        self.position = start
        self.request = request or PlanRequest(start)
        self.memory: SearchMemory | None = None
        self.details: list[str] = []
        self.positions: list[Point] = []

    def step(self) -> None:
        plan = self.planner.plan(replace(self.request, vehicle_enu_m=self.position), self.memory)
        self.memory, aim = plan.memory, plan.waypoint.position_enu_m
        if not self.details or self.details[-1] != plan.waypoint.detail:
            self.details.append(plan.waypoint.detail)
        share = min(1.0, STEP_M / math.dist(self.position, aim)) if self.position != aim else 1.0
        self.position = (
            self.position[0] + share * (aim[0] - self.position[0]),
            self.position[1] + share * (aim[1] - self.position[1]),
        )
        self.positions.append(self.position)

    def until(self, detail: str) -> None:
        for _ in range(2000):
            self.step()
            if self.details[-1] == detail:
                return
        pytest.fail(f"never: {detail}; {self.details}")


def test_a_sweep_and_the_next_one_across_it() -> None:
    flight = Flight(PLANNER, (-5.0, -5.0))
    flight.until("to lawnmower, leg 1 of 5, sweep 2")
    assert flight.details == [
        "to lawnmower, leg 1 of 3",
        "lawnmower, leg 1 of 3",
        "to lawnmower, leg 2 of 3",
        "lawnmower, leg 2 of 3",
        "to lawnmower, leg 3 of 3",
        "lawnmower, leg 3 of 3",
        "to lawnmower, leg 1 of 5, sweep 2",
    ]
    assert flight.memory is not None
    for leg in flight.memory.track:
        assert leg.start_enu_m[0] == pytest.approx(leg.end_enu_m[0])
    flight.until("to lawnmower, leg 1 of 3, sweep 3")


def test_after_an_interruption_it_goes_on_where_it_was_left() -> None:
    flight = Flight(PLANNER, (0.0, 10.0))
    while flight.position[0] < 40.0:
        flight.step()
    left = flight.position
    assert flight.memory is not None
    flight.memory = flight.memory.interrupted()
    flight.position = (90.0, 10.0)  # farther along the very lane
    flight.until("resuming on lawnmower, leg 1 of 3")
    flight.until("lawnmower, leg 1 of 3")
    assert flight.position[0] == pytest.approx(left[0], abs=3.0 * STEP_M)
    flight.until("to lawnmower, leg 2 of 3")


def test_blown_off_its_lane_it_comes_back_to_it() -> None:
    flight = Flight(PLANNER, (0.0, 10.0))
    while flight.position[0] < 40.0:
        flight.step()
    flight.position = (60.0, 19.0)  # within half a spacing
    flight.step()
    assert flight.details[-1] == "lawnmower, leg 1 of 3"
    flight.position = (70.0, 21.0)
    flight.step()
    assert flight.details[-1] == "resuming on lawnmower, leg 1 of 3"
    flight.until("lawnmower, leg 1 of 3")
    assert flight.position[0] == pytest.approx(60.0, abs=2.0 * STEP_M)


def test_interrupted_on_the_way_to_a_leg_there_is_nothing_to_come_back_to() -> None:
    memory = PLANNER.plan(PlanRequest((-50.0, 0.0)), None).memory
    assert memory is not None
    assert memory.interrupted() is memory


def test_a_leg_without_a_way_to_it_is_passed_over() -> None:
    """A keep-out cuts off the southern third of the area."""
    wall = ((-50.0, 18.0), (150.0, 18.0), (150.0, 22.0), (-50.0, 22.0))
    yard = ((-20.0, -20.0), (120.0, -20.0), (120.0, 80.0), (-20.0, 80.0))
    request = PlanRequest((50.0, 50.0), None, yard, 1.0, keep_out_enu_m=(wall,))
    planner = SearchPlanner(LawnmowerParams(area_enu_m=FIELD, start_corner="south_west"))
    plan = planner.plan(request, None)
    assert plan.waypoint.detail == "to lawnmower, leg 2 of 3"
    flight = Flight(planner, (50.0, 50.0), request)
    flight.until("to lawnmower, leg 1 of 10, sweep 2")
    flight.until("to lawnmower, leg 2 of 3, sweep 3")
    assert min(north for _, north in flight.positions) > 22.0


def test_where_no_leg_can_be_reached_it_holds() -> None:
    cage = (
        ((-10.0, 80.0), (10.0, 80.0), (10.0, 82.0), (-10.0, 82.0)),
        ((-10.0, 98.0), (10.0, 98.0), (10.0, 100.0), (-10.0, 100.0)),
        ((-10.0, 81.0), (-8.0, 81.0), (-8.0, 99.0), (-10.0, 99.0)),
        ((8.0, 81.0), (10.0, 81.0), (10.0, 99.0), (8.0, 99.0)),
    )
    plan = PLANNER.plan(PlanRequest((0.0, 90.0), keep_out_enu_m=cage, fence_margin_m=0.5), None)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.waypoint.detail == "lawnmower: no path to any leg"


def test_without_an_area_and_a_fence_there_is_nothing_to_search() -> None:
    planner = SearchPlanner(LawnmowerParams())
    plan = planner.plan(PlanRequest((0.0, 0.0)), None)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.waypoint.detail == "lawnmower: nothing to search"
    assert plan.memory is None


def test_without_an_area_it_searches_what_the_fence_leaves() -> None:
    planner = SearchPlanner(LawnmowerParams())
    request = PlanRequest((0.0, 0.0), None, FIELD, 10.0)
    memory = planner.plan(request, None).memory
    assert memory is not None
    norths = [leg.start_enu_m[1] for leg in memory.track]
    assert norths == pytest.approx([20.0, 40.0])
    assert memory.track[0].start_enu_m == pytest.approx((10.0, 20.0), abs=1e-5)


@pytest.mark.parametrize(
    ("corner", "start"),
    [
        ("nearest", (100.0, 50.0)),
        ("south_west", (0.0, 10.0)),
        ("south_east", (100.0, 10.0)),
        ("north_west", (0.0, 50.0)),
        ("north_east", (100.0, 50.0)),
    ],
)
def test_the_start_corner(corner: Corner, start: Point) -> None:
    params = LawnmowerParams(area_enu_m=FIELD, start_corner=corner)
    track = params.track(PlanRequest((99.0, 59.0)), (0.0, 0.0), 0)
    assert track[0].start_enu_m == pytest.approx(start, abs=1e-6)


def test_the_heading_of_the_lanes() -> None:
    params = LawnmowerParams(area_enu_m=FIELD, lane_heading_deg=0.0)
    track = params.track(PlanRequest((0.0, 0.0)), (0.0, 0.0), 0)
    assert len(track) == 5
    assert all(leg.length_m == pytest.approx(60.0) for leg in track)


def _first_heading_deg(track: Track) -> float:
    (east0, north0), (east1, north1) = track[0].start_enu_m, track[0].end_enu_m
    return math.degrees(math.atan2(east1 - east0, north1 - north0))


def test_patterns_about_a_datum_begin_at_it_and_turn_with_every_sweep() -> None:
    here, request = (7.0, 9.0), PlanRequest((7.0, 9.0))
    square = ExpandingSquareParams(heading_deg=10.0)
    sector = SectorParams(heading_deg=10.0)
    for pattern, turn_deg in ((square, 45.0), (sector, 30.0)):
        for sweep in range(3):
            track = pattern.track(request, here, sweep)
            assert track[0].start_enu_m == here
            assert _first_heading_deg(track) == pytest.approx(10.0 + turn_deg * sweep)
    there = (1.0, 2.0)
    for named in (
        ExpandingSquareParams(datum_enu_m=there),
        SectorParams(datum_enu_m=there),
    ):
        assert named.track(request, here, 0)[0].start_enu_m == there


def test_the_datum_is_where_the_search_began_even_in_later_sweeps() -> None:
    planner = SearchPlanner(SectorParams(radius_m=20.0))
    flight = Flight(planner, (30.0, 40.0))
    flight.until("sector search, leg 1 of 9, sweep 2")
    assert flight.memory is not None
    assert flight.memory.datum_enu_m == (30.0, 40.0)
    assert flight.memory.track[0].start_enu_m == (30.0, 40.0)


def test_legs_within_the_arrival_radius_are_passed_a_few_at_a_time() -> None:
    tiny = ExpandingSquareParams(spacing_m=1.0, radius_m=1.0)
    plan = SearchPlanner(tiny).plan(PlanRequest((0.0, 0.0)), None)
    assert plan.waypoint.reason is WaypointReason.SEARCH
    assert plan.memory is not None
    assert plan.memory.index == 2


def test_a_square_that_leaves_the_fence_is_cut_by_it() -> None:
    request = PlanRequest((50.0, 30.0), None, FIELD, 3.0)
    flight = Flight(SearchPlanner(ExpandingSquareParams()), (50.0, 30.0), request)
    for _ in range(600):
        flight.step()
    assert all(2.99 <= e <= 97.01 and 2.99 <= n <= 57.01 for e, n in flight.positions)
    assert flight.memory is not None
    assert flight.memory.sweep >= 1


@pytest.mark.parametrize(
    "area",
    [
        ((0.0, 0.0), (10.0, 0.0)),
        ((0.0, 0.0), (10.0, 0.0), (math.inf, 5.0)),
        ((0.0, 0.0), (10.0, 10.0), (10.0, 0.0), (0.0, 10.0)),
        ((0.0, 0.0), (10.0, 0.0), (20.0, 0.0)),
    ],
)
def test_an_area_that_is_none_is_refused(area: tuple[Point, ...]) -> None:
    with pytest.raises(ValueError, match="area_enu_m"):
        LawnmowerParams(area_enu_m=area)


def test_a_square_without_a_ring_is_refused() -> None:
    with pytest.raises(ValueError, match="radius_m"):
        ExpandingSquareParams(spacing_m=50.0, radius_m=40.0)
