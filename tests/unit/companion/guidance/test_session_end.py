"""The end of a session: the report, the mode that follows, and a stop."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.guidance.commands import SendSetpoint, SessionParams
from companion.guidance.control import TICK_S
from companion.guidance.events import (
    OperatorCommand,
    OperatorCommandReceived,
    Outcome,
    RequestKind,
    StopRequested,
)
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since


@pytest.mark.parametrize(
    ("on_localised", "mode"),
    [("hold", FlightMode.HOLD), ("return", FlightMode.RETURN), ("land", FlightMode.LAND)],
)
def test_reports_after_the_confirmation_time_and_asks_for_the_mode_that_follows(
    on_localised: str, mode: FlightMode
) -> None:
    params = SessionParams(on_localised=on_localised)  # type: ignore[arg-type]
    flight = ScriptedFlight(params).in_control()
    flight.follows = True
    flight.fly_until_reported()
    (result,) = flight.results
    assert result.estimate.r95_m <= params.stop_radius_m
    assert result.latitude_deg == pytest.approx(47.4 + 30.0 / 111_200, abs=1e-5)
    assert flight.asked_modes() == [mode]
    assert flight.is_in(Phase.FINISHED)
    confident_s = next(at for at, r95_m in flight.r95_history if r95_m <= params.stop_radius_m)
    assert flight.now_s - confident_s >= params.stop_confirm_s - 0.051


@pytest.mark.slow
def test_a_break_in_control_breaks_the_confirmation() -> None:
    flight = ScriptedFlight(SessionParams(stop_confirm_s=10.0, stop_radius_m=2.0)).in_control()
    flight.follows = True
    while flight.session.estimate is None or flight.session.estimate.r95_m > 1.9:
        flight.fly(0.5)
    flight.fly(1.0)
    flight.show(FlightMode.POSITION)
    flight.fly(12.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(9.0)
    assert flight.results == []
    flight.fly(1.5)
    assert len(flight.results) == 1


def test_after_the_report_setpoints_flow_until_the_mode_is_left_and_never_again() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    reported_s = flight.now_s
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, reported_s)) == 10
    flight.show(FlightMode.POSITION)
    assert flight.has_withdrawn
    taken_s = flight.now_s
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert silent_since(flight, taken_s)


def test_a_stop_asks_for_hold_and_streams_until_it_is_confirmed() -> None:
    flight = ScriptedFlight().in_control()
    asked_s = flight.now_s
    flight.give(StopRequested(asked_s))
    assert flight.asked_modes() == [FlightMode.HOLD]
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, asked_s)) == 10
    assert not flight.session.is_stopped
    flight.answer(RequestKind.SET_MODE)
    assert flight.session.is_stopped
    stopped_s = flight.now_s
    flight.fly(1.0)
    assert silent_since(flight, stopped_s)


def test_an_unconfirmed_stop_ends_within_a_second_and_a_half() -> None:
    flight = ScriptedFlight().in_control()
    asked_s = flight.now_s
    flight.give(StopRequested(asked_s))
    while not flight.session.is_stopped:
        flight.fly(0.05)
    assert flight.now_s - asked_s <= 1.5 + 1e-9
    assert flight.texts[-1] == "hand-back not confirmed: take over now"


@pytest.mark.parametrize("situation", ["waiting", "standby", "yield"])
def test_a_stop_out_of_control_ends_at_once_without_a_request(situation: str) -> None:
    flight = ScriptedFlight()
    if situation == "standby":
        flight.ready()
    if situation == "yield":
        flight.in_control().show(FlightMode.RETURN)
    flight.give(StopRequested(flight.now_s))
    assert flight.session.is_stopped
    assert flight.asked_modes() == []


def test_a_stop_right_after_the_report_still_hands_back() -> None:
    flight = ScriptedFlight(SessionParams(on_localised="return")).in_control()
    flight.follows = True
    flight.fly_until_reported()
    flight.give(StopRequested(flight.now_s))
    assert flight.is_in(Phase.HANDBACK)
    assert flight.asked_modes() == [FlightMode.RETURN, FlightMode.RETURN]


def test_a_refused_follow_up_is_reported() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    flight.answer(RequestKind.SET_MODE, Outcome.REJECTED)
    assert flight.texts[-1] == "set mode: rejected"


def test_granted_before_the_mode_was_left_the_setpoint_stays_where_it_is() -> None:
    """As long as offboard is shown it is obeyed, and one that follows the vehicle holds nothing."""
    flight = ScriptedFlight()
    flight.follows = True
    flight.in_control()
    flight.fly_until_reported()
    flight.follows = False
    east_m, north_m, up_m = flight.position_enu_m
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    granted_s = flight.now_s
    assert flight.is_in(Phase.STANDBY)
    for tick in range(10):
        flight.position_enu_m = (east_m + 0.2 * tick, north_m, up_m)
        flight.fly(TICK_S)
    sent = [c.setpoint.position_enu_m for c in flight.sent(SendSetpoint, granted_s)]
    assert len(sent) == 10
    assert len(set(sent)) == 1
