"""Control ends: landings, kills, disarming, hand-backs and yields."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import SendSetpoint, SessionParams
from companion.guidance.control import TICK_S
from companion.guidance.events import (
    AutopilotRestarted,
    HeartbeatReceived,
    LandedStateChanged,
    OperatorCommand,
    OperatorCommandReceived,
    Outcome,
    RequestKind,
    StopRequested,
    ThrottleReported,
)
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.authority.authority_helpers import (
    AUTOPILOTS,
    CRITICAL,
    FOREIGN,
    acts,
    flying,
    numbered,
)
from tests.unit.companion.guidance.scripted import ScriptedFlight


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("landed", [LandedState.ON_GROUND, LandedState.LANDING])
def test_landing_in_control_ends_it(autopilot: Autopilot, landed: LandedState) -> None:
    flight = flying(autopilot)
    flight.give(ThrottleReported(flight.now_s, 0.1))
    flight.report_landed(landed)
    assert flight.is_in(Phase.YIELD)
    landed_s = flight.now_s
    flight.fly(10.0)
    assert acts(flight, landed_s) == 0
    assert flight.is_in(Phase.YIELD)  # the mode is still offboard, and was not selected again


def test_a_vehicle_that_takes_control_on_the_ground_is_not_landing() -> None:
    flight = ScriptedFlight()
    flight.report_landed(LandedState.ON_GROUND)
    flight.in_control()
    flight.report_landed(LandedState.ON_GROUND)
    assert flight.is_in(Phase.NORMAL)
    flight.report_landed(LandedState.IN_AIR)
    flight.give(ThrottleReported(flight.now_s, 0.1))
    flight.report_landed(LandedState.ON_GROUND)
    assert flight.is_in(Phase.YIELD)


@pytest.mark.parametrize("throttle", [None, 0.16, 0.5])
def test_a_landing_at_search_height_is_doubted_unless_the_throttle_is_idle(
    throttle: float | None,
) -> None:
    flight = flying(Autopilot.PX4)
    if throttle is not None:
        flight.give(ThrottleReported(flight.now_s, throttle))
    flight.report_landed(LandedState.ON_GROUND)
    flight.fly(1.0)
    assert flight.is_in(Phase.HOLD)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(5.0)
    assert flight.is_in(Phase.NORMAL)


def test_a_landed_state_that_was_overtaken_ends_nothing() -> None:
    flight = ScriptedFlight().ready()
    numbered(flight, FlightMode.OFFBOARD, 50)
    flight.give(LandedStateChanged(flight.now_s, LandedState.LANDING, order=49))
    flight.fly(TICK_S)
    assert flight.is_in(Phase.NORMAL)


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_kill_ends_everything_at_once(autopilot: Autopilot) -> None:
    flight = flying(autopilot)
    flight.give(
        HeartbeatReceived(
            flight.now_s,
            autopilot,
            FlightMode.OFFBOARD,
            True,
            False,
            is_failsafe=True,
            is_terminated=True,
        )
    )
    killed_s = flight.now_s
    flight.has_heartbeat = False
    flight.fly(1.0)
    assert acts(flight, killed_s) == 0
    assert flight.is_in(Phase.WAITING)
    assert "flight terminated: flight over" in flight.texts


@pytest.mark.parametrize("phase", [Phase.NORMAL, Phase.HOLD, Phase.FINISHED])
def test_disarming_ends_everything_at_once(phase: Phase) -> None:
    flight = ScriptedFlight(SessionParams(stop_confirm_s=1.0, stop_radius_m=2.0))
    flight.follows = True
    flight.in_control()
    if phase is Phase.HOLD:
        flight.has_ranging = False
        flight.fly(6.0)
    elif phase is Phase.FINISHED:
        flight.fly_until_reported()
    assert flight.is_in(phase)
    flight.show(FlightMode.OFFBOARD, is_armed=False)
    assert flight.has_withdrawn
    disarmed_s = flight.now_s
    flight.fly(0.9)
    assert acts(flight, disarmed_s) == 0


# Handing back and giving way in flight


def test_handing_back_asks_once_stays_and_is_silent_once_it_is_answered() -> None:
    flight = flying()
    flight.session.handover.hand_back(CRITICAL, flight.now_s)
    flight.fly(TICK_S)
    assert flight.is_in(Phase.HANDBACK)
    assert flight.asked_modes() == [FlightMode.RETURN]
    asked_s = flight.now_s
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, asked_s)) == 10
    flight.answer(RequestKind.SET_MODE)
    assert flight.is_in(Phase.YIELD)
    answered_s = flight.now_s
    flight.show(FlightMode.RETURN)
    flight.fly(30.0)
    assert acts(flight, answered_s) == 0
    assert not flight.session.is_stopped


@pytest.mark.parametrize("outcome", [Outcome.REJECTED, Outcome.NO_ANSWER])
def test_a_hand_back_that_fails_is_reported_and_leaves_the_vehicle(outcome: Outcome) -> None:
    flight = flying(Autopilot.ARDUPILOT)
    flight.session.handover.hand_back(CRITICAL, flight.now_s)
    flight.fly(0.2)
    flight.answer(RequestKind.SET_MODE, outcome)
    assert f"hand-back: {outcome.value}" in flight.texts
    failed_s = flight.now_s
    flight.fly(30.0)  # in GUIDED all the time: it was not selected again
    assert acts(flight, failed_s) == 0
    assert flight.is_in(Phase.YIELD)


def test_an_unanswered_hand_back_ends_within_a_second_and_a_half() -> None:
    flight = flying()
    flight.session.handover.hand_back(CRITICAL, flight.now_s)
    flight.fly(1.5)
    assert flight.is_in(Phase.YIELD)
    assert flight.has_withdrawn


def test_a_stop_during_a_hand_back_ends_the_process_with_it() -> None:
    flight = flying()
    flight.session.handover.hand_back(CRITICAL, flight.now_s)
    flight.give(StopRequested(flight.now_s))
    assert flight.is_in(Phase.HANDBACK)
    flight.answer(RequestKind.SET_MODE)
    assert flight.session.is_stopped


def test_a_restart_during_a_stop_ends_the_process() -> None:
    flight = flying()
    flight.give(StopRequested(flight.now_s))
    flight.give(AutopilotRestarted(flight.now_s))
    assert flight.session.is_stopped


def test_giving_way_is_silence_until_the_mode_is_given_again() -> None:
    flight = flying(Autopilot.ARDUPILOT)
    flight.session.handover.yield_control(FOREIGN, flight.now_s)
    assert flight.is_in(Phase.YIELD)
    gave_s = flight.now_s
    flight.fly(20.0)
    assert acts(flight, gave_s) == 0
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)
