"""After a restart: phase and estimate come back, control and the automatic launch do not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.domain import Autopilot, EstimateState, FlightMode, WaypointReason
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import Arm, SendSetpoint, SessionParams, TakeOff
from companion.guidance.events import (
    AutopilotRestarted,
    MemoryRecalled,
    SessionMemory,
    UncleanExitFound,
)
from companion.guidance.phases import Phase
from companion.guidance.readiness import ORIGIN_TIMEOUT_S
from tests.unit.companion.guidance.scripted import ORIGIN, TARGET, ScriptedFlight

AUTO = SessionParams(engage="auto")


def memory_of_a_flight(duration_s: float = 6.0) -> SessionMemory:
    """Return the memory of a flight in control, with an estimate."""
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly(duration_s)
    memory = flight.session.memory
    assert memory.phase is Phase.NORMAL
    assert memory.belief is not None
    return memory


def recall(flight: ScriptedFlight, memory: SessionMemory, age_s: float = 10.0) -> None:
    flight.give(UncleanExitFound(flight.now_s))
    flight.give(MemoryRecalled(flight.now_s, memory, age_s))


def test_the_estimate_comes_back_before_the_first_measurement() -> None:
    memory = memory_of_a_flight()
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, memory)
    assert flight.session.estimate is None
    flight.ready()
    estimate = flight.session.estimate
    assert estimate is not None
    assert math.dist(estimate.position_enu_m, TARGET[:2]) <= estimate.r95_m
    assert any(text.startswith("estimate resumed") for text in flight.texts)


def test_a_resumed_estimate_is_flown_on_only_with_a_new_measurement() -> None:
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, memory_of_a_flight())
    flight.ready().fly(2.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.is_in(Phase.HOLD)
    flight.has_ranging = True
    flight.fly(0.5)
    assert flight.is_in(Phase.NORMAL)


@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
def test_nothing_launches_by_itself_after_a_restart(autopilot: Autopilot) -> None:
    flight = ScriptedFlight(AUTO, autopilot)
    flight.give(UncleanExitFound(0.0))
    flight.on_the_ground()
    flight.fly(5.0)
    assert flight.phase is Phase.STANDBY
    assert not flight.sent(Arm)
    assert not flight.sent(TakeOff)
    assert flight.asked_modes() == []
    assert any("switch to" in text for text in flight.texts)


def test_before_control_is_given_only_here_is_streamed() -> None:
    flight = ScriptedFlight(AUTO)
    flight.position_enu_m = (12.0, -7.0, 20.0)
    recall(flight, memory_of_a_flight())
    flight.ready()
    flight.fly(2.0)
    assert flight.phase is Phase.STANDBY
    assert set(flight.setpoints) == {(12.0, -7.0, 20.0)}
    flight.show(FlightMode.OFFBOARD)
    before = len(flight.setpoints)
    flight.fly(0.05)
    assert math.dist(flight.setpoints[before], flight.position_enu_m) < 0.5


def test_a_vehicle_found_in_offboard_is_left_alone() -> None:
    flight = ScriptedFlight(AUTO)
    recall(flight, memory_of_a_flight())
    flight.show(FlightMode.OFFBOARD)
    flight.locate()
    flight.fly(5.0)
    assert flight.phase is Phase.WAITING
    assert flight.sent(SendSetpoint) == []
    assert flight.asked_modes() == []


def test_who_had_yielded_stays_silent() -> None:
    memory = replace(memory_of_a_flight(), phase=Phase.YIELD)
    flight = ScriptedFlight()
    flight.show(FlightMode.POSITION)
    recall(flight, memory)
    flight.ready()
    flight.fly(5.0)
    assert flight.phase is Phase.YIELD
    assert flight.sent(SendSetpoint) == []
    assert flight.session.estimate is not None


def test_a_yielded_session_does_not_blame_a_failsafe_that_was_not_reported() -> None:
    flight = ScriptedFlight()
    recall(flight, replace(memory_of_a_flight(), phase=Phase.YIELD))
    flight.fly(0.5)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    assert flight.phase is Phase.YIELD
    assert not any("after a failsafe" in text for text in flight.texts)


def test_a_yield_ends_with_the_flight() -> None:
    flight = ScriptedFlight()
    recall(flight, replace(memory_of_a_flight(), phase=Phase.YIELD))
    flight.show(FlightMode.HOLD, is_armed=False)
    flight.locate()
    flight.fly(2.0)
    assert flight.phase is Phase.STANDBY


def test_who_had_reported_reports_the_same_and_searches_no_more() -> None:
    flown = ScriptedFlight().in_control()
    flown.follows = True
    flown.fly_until_reported()
    flight = ScriptedFlight()
    flight.show(FlightMode.HOLD)
    recall(flight, flown.session.memory)
    flight.ready()
    flight.fly(5.0)
    assert flight.phase is Phase.FINISHED
    assert flight.results == flown.results
    assert flight.sent(SendSetpoint) == []
    assert flight.asked_modes() == []


@pytest.mark.parametrize(
    ("origin", "reason"),
    [
        (LocalOrigin(47.41, 8.5, 488.0), "the local frame moved by 1112 m"),
        (None, "its local frame was not known"),
    ],
)
def test_a_belief_of_another_frame_is_not_believed(origin: LocalOrigin | None, reason: str) -> None:
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, replace(memory_of_a_flight(), origin=origin))
    flight.ready()
    assert flight.session.estimate is None
    assert f"estimate reset: {reason}" in flight.texts


def test_a_belief_does_not_wait_for_ever_for_its_frame() -> None:
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, memory_of_a_flight())
    flight.fly(ORIGIN_TIMEOUT_S + 0.2)
    flight.ready()
    assert flight.session.estimate is None
    assert "estimate reset: the autopilot does not report its origin" in flight.texts


def test_an_autopilot_that_restarts_meanwhile_ends_the_wait() -> None:
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, memory_of_a_flight())
    flight.give(AutopilotRestarted(flight.now_s))
    flight.ready()
    assert flight.session.estimate is None


def test_an_impossible_belief_is_refused_in_words() -> None:
    memory = memory_of_a_flight()
    assert memory.belief is not None
    flight = ScriptedFlight()
    flight.has_ranging = False
    recall(flight, replace(memory, belief=replace(memory.belief, places=())))
    flight.ready()
    assert flight.session.estimate is None
    assert "estimate reset: checkpoint has 0 hypotheses" in flight.texts


def fly_until_localised(flight: ScriptedFlight) -> float:
    """Fly in control from now on; return the time at which the target is localised."""
    flight.ready().fly(2.0)
    flight.in_control()
    flight.follows = True
    while flight.session.estimate is None or (
        flight.session.estimate.state is not EstimateState.LOCALISED
    ):
        flight.fly(0.25)
        assert flight.now_s < 120.0
    return flight.now_s


def test_a_resumed_flight_localises_sooner_than_a_cold_one() -> None:
    cold, resumed = ScriptedFlight(), ScriptedFlight()
    cold_s = fly_until_localised(cold)
    cold.fly(2.0)
    assert cold.phase is Phase.NORMAL
    recall(resumed, cold.session.memory)
    assert fly_until_localised(resumed) < 0.5 * cold_s


@pytest.mark.parametrize(
    "origin",
    [
        LocalOrigin(math.nan, 8.5, 488.0),
        LocalOrigin(47.4, 8.5, math.inf),
        LocalOrigin(91.0, 8.5, 488.0),
        LocalOrigin(47.4, -181.0, 488.0),
    ],
)
def test_an_origin_that_is_no_place_is_reported(origin: LocalOrigin) -> None:
    memory = SessionMemory(Phase.STANDBY, origin, None, None)
    assert memory.problem is not None
    assert replace(memory, origin=ORIGIN).problem is None
    assert replace(memory, origin=None).problem is None


@pytest.mark.slow
@pytest.mark.parametrize("flown_s", [6.0, 12.0])
def test_the_planner_needs_no_memory_of_its_own(flown_s: float) -> None:
    """Its latch is not kept: it is made anew from the estimate, at the first plan."""
    memory = memory_of_a_flight(flown_s)
    flight = ScriptedFlight()
    flight.follows = True
    recall(flight, memory)
    flight.ready().fly(2.0)
    flight.in_control()
    waypoint = flight.session.flight_plan.waypoint
    assert waypoint is not None
    assert waypoint.reason in (WaypointReason.APPROACH, WaypointReason.CROSSING)
    flight.fly_until_reported()
    assert math.dist(flight.results[-1].estimate.position_enu_m, TARGET[:2]) < 1.5
