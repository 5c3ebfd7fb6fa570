"""The session when the autopilot restarts, or its local frame moves."""

from __future__ import annotations

import math

import pytest

from companion.domain import FlightMode
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import Arm, SendSetpoint, SessionParams
from companion.guidance.events import (
    AutopilotFenceRead,
    AutopilotRestarted,
    OriginSet,
)
from companion.guidance.phases import Phase
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


@pytest.mark.parametrize(("north_m", "is_new_frame"), [(0.9, False), (1.1, True), (900.0, True)])
def test_an_origin_that_moves_takes_the_estimate_with_it(
    north_m: float, is_new_frame: bool
) -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    moved = LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))
    before = flight.session.estimate
    flight.give(OriginSet(flight.now_s, moved))
    after = flight.session.estimate
    assert before is not None
    assert after is not None
    (east_m, north_m_0), shift_m = before.position_enu_m, north_m if is_new_frame else 0.0
    assert after.position_enu_m == pytest.approx((east_m, north_m_0 - shift_m), abs=0.02)
    assert after.r95_m == pytest.approx(before.r95_m)
    assert (flight.is_in(Phase.HOLD)) == is_new_frame
    assert any("local origin moved" in text for text in flight.texts) == is_new_frame


def test_an_origin_that_creeps_takes_the_estimate_with_it_after_a_metre() -> None:
    flight = ScriptedFlight().in_control()
    for north_m in (0.4, 0.8):
        flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))))
        assert not any("local origin moved" in text for text in flight.texts)
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 1.2, 0.0)))))
    assert any("local origin moved" in text for text in flight.texts)


@pytest.mark.parametrize("up_m", [0.0, 6.0])
@pytest.mark.parametrize("is_reported_first", [True, False])
def test_an_origin_that_moves_is_one_step_whichever_is_reported_first(
    is_reported_first: bool, up_m: float
) -> None:
    """Positions of the new frame may overtake the origin, which must not move all once more."""
    flight = ScriptedFlight().in_control()
    before, at_m = flight.session.estimate, flight.position_enu_m
    assert before is not None
    moved = LocalOrigin(*ORIGIN.geodetic_from_enu((3.0, 8.0, up_m)))
    flight.has_ranging = False
    position = (at_m[0] - 3.0, at_m[1] - 8.0, at_m[2] - up_m)
    if is_reported_first:
        flight.give(OriginSet(flight.now_s, moved))
    flight.position_enu_m = position
    flight.fly(0.2)
    if not is_reported_first:
        flight.give(OriginSet(flight.now_s, moved))
    flight.fly(0.5)
    after = flight.session.estimate
    assert after is not None
    shifted = (before.position_enu_m[0] - 3.0, before.position_enu_m[1] - 8.0)
    assert after.position_enu_m == pytest.approx(shifted, abs=0.05)
    assert after.height_m == pytest.approx(before.height_m - up_m, abs=0.05)
    assert after.r95_m <= before.r95_m + 0.05
    flight.has_ranging = True
    flight.fly(6.0)
    assert flight.is_in(Phase.NORMAL)
    assert flight.session.tracker.integrity.restarts == 0


def test_an_origin_that_is_reported_alone_moves_nothing_in_the_end() -> None:
    """The autopilot reported another origin, but its local positions go on as before."""
    flight = ScriptedFlight().in_control()
    before = flight.session.estimate
    assert before is not None
    flight.give(OriginSet(flight.now_s, LocalOrigin(*ORIGIN.geodetic_from_enu((9.0, 0.0, 0.0)))))
    flight.fly(6.0)
    after = flight.session.estimate
    assert after is not None
    assert math.dist(after.position_enu_m, before.position_enu_m) < 0.5
    assert flight.session.tracker.integrity.restarts == 0


def test_heights_stay_above_the_same_home_when_the_origin_moves() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 5.0, 7.0)))))
    assert flight.session.vehicle.home_enu_m == pytest.approx((0.0, -5.0, -7.0), abs=1e-3)


def test_after_the_origin_moved_it_holds_for_a_while_in_the_new_frame() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.position_enu_m = (0.0, -50.0, 20.0)
    since_s = flight.now_s
    flight.locate(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0))))
    flight.fly(1.9)
    assert flight.is_in(Phase.HOLD)
    sent = flight.sent(SendSetpoint, since_s)
    assert all(math.dist(c.setpoint.position_enu_m, (0.0, -50.0, 20.0)) < 3.0 for c in sent)
    flight.has_ranging = True
    flight.fly(2.0)
    assert flight.is_in(Phase.NORMAL)


def test_what_was_flown_in_the_old_frame_is_the_same_place_in_the_new_one() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = flight.has_ranging = False
    since_s, last = flight.now_s, flight.setpoints[-1]
    flight.give(OriginSet(since_s, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0)))))
    flight.fly(0.3)
    sent = flight.sent(SendSetpoint, since_s)
    assert len(sent) == 6
    same = (last[0], last[1] - 50.0, last[2])
    assert all(math.dist(c.setpoint.position_enu_m, same) < 3.0 for c in sent)


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
