"""The session when the autopilot restarts, or its local frame moves."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.authority.state_machine import Phase
from companion.guidance.commands import Arm, SendSetpoint
from companion.guidance.events import (
    AutopilotFenceRead,
    AutopilotRestarted,
    OriginSet,
)
from companion.guidance.session_params import SessionParams
from tests.unit.companion.guidance.scripted import ORIGIN, ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since


@pytest.mark.slow
def test_a_restart_of_the_autopilot_forgets_tracker_and_frame() -> None:
    flight = ScriptedFlight(SessionParams(engage="auto")).launched_by_itself()
    flight.give(AutopilotRestarted(flight.now_s))
    restarted_s = flight.now_s
    assert flight.is_in(Phase.WAITING)
    assert flight.session.estimate is None
    assert flight.session.tracker.estimate(flight.now_s) is None
    assert flight.session.vehicle.origin is None
    assert flight.texts[-1].startswith("autopilot restarted")
    flight.show(FlightMode.HOLD, is_armed=False)
    flight.locate()
    flight.give(AutopilotFenceRead(flight.now_s))
    flight.fly(30.0)
    assert flight.is_in(Phase.STANDBY)
    assert "launching" not in flight.texts[-1]
    assert flight.sent(Arm, restarted_s) == []
    assert flight.asked_modes(restarted_s) == []


def test_a_vehicle_that_flies_in_offboard_after_a_restart_is_left_alone() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(AutopilotRestarted(flight.now_s))
    restarted_s = flight.now_s
    flight.locate()
    flight.fly(10.0)
    assert silent_since(flight, restarted_s)


@pytest.mark.parametrize(("north_m", "is_new_frame"), [(0.9, False), (1.1, True), (1000.0, True)])
def test_an_origin_that_moves_takes_the_estimate_with_it(
    north_m: float, is_new_frame: bool
) -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    moved = LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))
    flight.give(OriginSet(flight.now_s, moved))
    assert (flight.session.estimate is None) == is_new_frame
    assert (flight.is_in(Phase.HOLD)) == is_new_frame
    assert any("local origin moved" in text for text in flight.texts) == is_new_frame


def test_an_origin_that_creeps_takes_the_estimate_with_it_after_a_metre() -> None:
    flight = ScriptedFlight().in_control()
    for north_m in (0.4, 0.8):
        flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))))
        assert flight.session.estimate is not None
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 1.2, 0.0)))))
    assert flight.session.estimate is None


def test_heights_stay_above_the_same_home_when_the_origin_moves() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 5.0, 7.0)))))
    assert flight.session.vehicle.home_enu_m == pytest.approx((0.0, -5.0, -7.0), abs=1e-3)


def test_after_the_origin_moved_it_holds_in_the_new_frame_until_new_ranging() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.place = (0.0, -50.0, 20.0)
    since_s = flight.now_s
    flight.locate(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0))))
    flight.fly(3.0)
    assert flight.is_in(Phase.HOLD)
    sent = flight.sent(SendSetpoint, since_s)
    assert {c.setpoint.position_enu_m for c in sent} == {(0.0, -50.0, 20.0)}
    flight.has_ranging = True
    flight.fly(1.1)
    assert flight.is_in(Phase.NORMAL)


def test_a_position_of_the_old_frame_is_not_flown_in_the_new_one() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = flight.has_ranging = False
    since_s = flight.now_s
    flight.locate(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0))))
    flight.fly(0.3)
    assert flight.sent(SendSetpoint, since_s) == []
    flight.has_position = True
    flight.fly(0.1)
    assert len(flight.sent(SendSetpoint, since_s)) == 2


def test_from_an_origin_that_is_nowhere_near_nothing_is_sent_that_stands_on_home() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(OriginSet(flight.now_s, LocalOrigin(-ORIGIN.latitude_deg, 90.0, 0.0)))
    moved_s = flight.now_s
    flight.fly(2.0)
    assert flight.session.vehicle.home_enu_m is None
    assert flight.sent(SendSetpoint, moved_s) == []
    flight.locate()
    flight.fly(1.0)
    assert all(abs(value) < 1e3 for value in flight.setpoints[-1])
