"""The planner in a session: searching, keep-outs, heights, and texts to the operator."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import LimitsConfig, PlannerConfig
from companion.domain import FlightMode, Waypoint, WaypointReason
from companion.geometry.polygons import depth_m
from companion.guidance.commands import Record, SessionParams
from companion.guidance.navigation import PLAN_PERIOD_S
from companion.guidance.phases import Phase
from companion.planning.crossing import LatchedCrossingParams
from companion.planning.planner import Plan, PlanRequest
from tests.unit.companion.guidance.scripted import TARGET, ScriptedFlight

SEARCH = PlannerConfig(search="lawnmower", lost_after_s=12.0)


def _searching(
    planner: PlannerConfig = SEARCH, params: SessionParams | None = None
) -> ScriptedFlight:
    """Given offboard by the operator while nothing is heard."""
    flight = ScriptedFlight(params, planner=planner)
    flight.follows = True
    flight.has_ranging = False
    flight.ready()
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    return flight


def _waypoints(flight: ScriptedFlight) -> list[str]:
    return [str(c.fields["reason"]) for c in flight.sent(Record) if c.kind == "waypoint"]


def test_without_a_search_it_holds_until_there_is_ranging() -> None:
    flight = _searching(PlannerConfig())
    assert flight.is_in(Phase.HOLD)
    assert flight.session.status(flight.now_s).detail == "waiting for ranging"


def test_with_a_search_it_flies_it_before_anything_is_heard() -> None:
    flight = _searching()
    assert flight.is_in(Phase.NORMAL)
    assert "no contact yet: flying the search pattern" in flight.texts
    assert flight.session.status(flight.now_s).detail.startswith("search: to lawnmower, leg 1")
    before = flight.position_enu_m
    flight.fly(10.0)
    assert math.dist(before, flight.position_enu_m) == pytest.approx(50.0, abs=1.0)


def test_five_measurements_end_the_search() -> None:
    flight = _searching()
    flight.has_ranging = True
    flight.fly(1.0)
    assert flight.session.flight_plan.waypoint is not None
    assert flight.session.flight_plan.waypoint.reason is WaypointReason.APPROACH
    assert "contact: flying to the target" in flight.texts
    flight.fly_until_reported()


def test_contact_lost_is_waited_for_and_then_searched_for() -> None:
    flight = _searching()
    flight.has_ranging = True
    flight.fly(3.0)
    flight.has_ranging = False
    flight.fly(6.0)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: no ranging for 5 s"
    flight.fly(7.0)
    assert flight.is_in(Phase.NORMAL)
    assert "no contact for 12 s: back to the search pattern" in flight.texts
    assert _waypoints(flight)[-1] == "search"
    flight.has_ranging = True
    flight.fly(1.0)
    assert _waypoints(flight)[-1] in ("approach", "crossing")
    assert flight.texts.count("contact: flying to the target") == 2


def test_packets_at_the_edge_of_reception_neither_end_a_search_nor_hold_the_vehicle() -> None:
    flight = _searching()
    flight.has_ranging = True
    flight.fly(3.0)
    flight.has_ranging = False
    for _ in range(4):  # each within `lost_after_s` of the one before
        flight.fly(7.0)
        flight.measure()
    assert "no contact for 12 s: back to the search pattern" in flight.texts
    assert flight.texts.count("contact: flying to the target") == 1
    flight.fly(1.0)
    assert flight.is_in(Phase.NORMAL)
    assert _waypoints(flight)[-1] == "search"


@pytest.mark.slow
def test_what_was_believed_before_contact_was_lost_is_not_reported() -> None:
    flight = _searching(params=SessionParams(stop_radius_m=2.0, stop_confirm_s=8.0))
    flight.has_ranging = True
    while flight.session.estimate is None or flight.session.estimate.r95_m > 1.5:
        flight.fly(0.1)
    flight.has_ranging = False
    flight.fly(60.0)
    assert flight.is_in(Phase.NORMAL)
    assert not flight.results


def test_a_pattern_alone_is_flown_whatever_is_heard() -> None:
    flight = _searching(PlannerConfig(kind="survey", search="sector"))
    flight.has_ranging = True
    flight.fly(20.0)
    assert set(_waypoints(flight)) == {"search"}
    assert not any("contact" in text for text in flight.texts)


def test_a_plan_is_renewed_without_a_measurement() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    plan = flight.session.flight_plan
    flight.fly(1.0)
    assert flight.is_in(Phase.NORMAL)
    assert not plan.is_due(flight.now_s)
    assert plan.is_due(flight.now_s + PLAN_PERIOD_S)


def test_without_a_position_nothing_is_planned() -> None:
    session = ScriptedFlight(planner=SEARCH).session
    assert session.flight_plan.renew(1.0, session.vehicle, None, None) == []
    assert session.flight_plan.waypoint is None


def test_a_frame_that_moves_starts_the_search_again() -> None:
    flight = _searching()
    flight.fly(5.0)
    flight.session.flight_plan.forget()
    assert flight.session.flight_plan.waypoint is None
    assert flight.session.flight_plan.is_due(flight.now_s)
    flight.fly(0.1)
    assert flight.session.flight_plan.waypoint is not None


@pytest.mark.slow
def test_crossings_swing_in_height_within_the_band() -> None:
    planner = PlannerConfig(latched_crossing=LatchedCrossingParams(altitude_swing_m=6.0))
    limits = LimitsConfig(altitude_min_m=16.0, altitude_max_m=24.0)
    flight = ScriptedFlight(limits=limits, planner=planner).in_control()
    flight.follows = True
    flight.fly(40.0)
    ups = [up for _, _, up in flight.setpoints]
    assert max(ups) >= 20.0 + 3.0
    assert min(ups) <= 20.0 - 3.0
    assert all(16.0 <= up <= 24.0 for up in ups)


HOUSE = ((15.0, 5.0), (25.0, 5.0), (25.0, 30.0), (15.0, 30.0))


@pytest.mark.slow
def test_no_setpoint_enters_a_keep_out_on_the_way_to_the_target() -> None:
    limits = LimitsConfig(keep_out_enu_m=(HOUSE,), fence_margin_m=2.0)
    flight = ScriptedFlight(limits=limits).in_control()
    flight.follows = True
    flight.fly_until_reported()
    assert "detour" in _waypoints(flight)
    assert min(-depth_m(HOUSE, setpoint[:2]) for setpoint in flight.setpoints) >= 2.0 - 1e-9
    estimate = flight.results[0].estimate
    assert math.dist(estimate.position_enu_m, TARGET[:2]) < 1.5


@pytest.mark.slow
def test_a_target_in_a_keep_out_is_announced_once_and_found_from_around_it() -> None:
    house = ((30.0, 22.0), (46.0, 22.0), (46.0, 40.0), (30.0, 40.0))
    limits = LimitsConfig(keep_out_enu_m=(house,), fence_margin_m=2.0)
    flight = ScriptedFlight(SessionParams(stop_radius_m=2.0), limits=limits).in_control()
    flight.follows = True
    flight.fly_until_reported()
    assert len([text for text in flight.texts if "in a keep-out" in text]) == 1
    assert min(-depth_m(house, setpoint[:2]) for setpoint in flight.setpoints) >= 2.0 - 1e-9


def test_a_lower_pass_is_reported_when_it_begins_and_when_it_is_over() -> None:
    flight = ScriptedFlight().in_control()

    class Scripted:
        search_after_s: float | None = None
        descent_m = 0.0

        def plan(self, request: PlanRequest, _memory: None) -> Plan[None]:
            offsets = (-self.descent_m, self.descent_m)
            position, reason = request.vehicle_enu_m, WaypointReason.CROSSING
            return Plan(Waypoint(position, reason, "", *offsets), None)

    planner = Scripted()
    flight.session.flight_plan.use(planner, 20.0)
    for planner.descent_m in (0.0, 14.0, 14.0, 0.0):
        flight.fly(1.0)
    assert [text for text in flight.texts if "lower pass" in text] == [
        "lower pass: 14 m below the search altitude",
        "lower pass done: back to the search altitude",
    ]
