"""Authority: first foreign frames, flaps, late frames and grants."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.domain import Autopilot, BatteryLevel, FlightMode, LandedState, VehicleClass
from companion.guidance.commands import SessionParams
from companion.guidance.control import TICK_S
from companion.guidance.control_authority import Finding, Reason, Verdict
from companion.guidance.events import (
    AutopilotRestarted,
    BatteryReported,
    IdConflictHeard,
    IdentityDoubted,
    OperatorCommand,
    OperatorCommandReceived,
    Outcome,
    RequestAnswered,
    RequestKind,
)
from companion.guidance.handover import GRANT_HOW
from companion.guidance.phases import IN_CONTROL, Phase
from companion.guidance.vehicle import vehicle_refusal
from tests.unit.companion.guidance.authority.authority_helpers import (
    AUTOPILOTS,
    CRITICAL,
    FOREIGN,
    acts,
    flying,
    numbered,
)
from tests.unit.companion.guidance.scripted import ScriptedFlight


@pytest.mark.slow
@pytest.mark.parametrize("away_s", [2.5, 10.0, 60.0])
def test_a_px4_that_a_failsafe_took_gives_nothing_back_by_itself(away_s: float) -> None:
    """It goes back to offboard with the first setpoints that a link had kept."""
    flight = flying()
    flight.show(FlightMode.HOLD, is_failsafe=True)
    lost_s = flight.now_s
    flight.fly(away_s)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.phase is Phase.YIELD
    assert acts(flight, lost_s) == 0
    assert [text for text in flight.texts if "failsafe" in text] == [
        f"grant needed, failsafe: {GRANT_HOW}",
        f"offboard mode ignored: failsafe; {GRANT_HOW}",
    ]


def test_an_autopilot_of_another_kind_is_named_and_never_ready() -> None:
    """Its modes are unknown, so a switch could not hand over control."""
    flight = ScriptedFlight(autopilot=Autopilot.OTHER).ready()
    flight.fly(12.0)
    assert flight.phase is Phase.WAITING
    text = "no control: only PX4 and ArduPilot are supported: this is another autopilot"
    assert [each for each in flight.texts if "control" in each] == [text]


@pytest.mark.parametrize(
    ("vehicle_class", "name"),
    [(VehicleClass.AIRSHIP, "an airship"), (VehicleClass.FIXED_WING, "a fixed wing")],
)
def test_a_class_that_is_not_flown_is_named(vehicle_class: VehicleClass, name: str) -> None:
    text = vehicle_refusal(vehicle_class, Autopilot.PX4)
    assert text == f"only multicopters are supported: this is {name}"


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_failsafe_that_is_reported_a_beat_after_its_mode_gives_nothing_back_either(
    autopilot: Autopilot,
) -> None:
    flight = flying(autopilot)
    flight.show(FlightMode.HOLD)
    lost_s = flight.now_s
    flight.fly(1.0)
    flight.show(FlightMode.HOLD, is_failsafe=True)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.phase is Phase.YIELD
    assert acts(flight, lost_s) == 0


def test_a_failsafe_in_standby_takes_nothing_that_is_chosen_then() -> None:
    """A pilot who lost the transmitter gives the vehicle to a companion that is ready."""
    flight = ScriptedFlight().ready()
    flight.show(FlightMode.POSITION)
    flight.show(FlightMode.RETURN, is_failsafe=True)
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD)
    assert flight.phase is Phase.HOLD


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("is_granted", [False, True])
def test_what_a_failsafe_took_is_given_by_a_grant_alone(
    autopilot: Autopilot, is_granted: bool
) -> None:
    flight = flying(autopilot)
    flight.show(FlightMode.RETURN, is_failsafe=True)
    flight.fly(5.0)
    if is_granted:
        flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    flight.show(FlightMode.HOLD)
    flight.fly(3.0)
    assert f"grant needed, failsafe: {GRANT_HOW}" in flight.texts
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.phase is (Phase.NORMAL if is_granted else Phase.YIELD)


def second_source(flight: ScriptedFlight) -> None:
    flight.session.handover.yield_control(FOREIGN, flight.now_s)


def hand_back(flight: ScriptedFlight) -> None:
    flight.session.handover.hand_back(CRITICAL, flight.now_s)
    flight.show(FlightMode.RETURN)


def land(flight: ScriptedFlight) -> None:
    flight.report_landed(LandedState.LANDING)


def land_by_switch(flight: ScriptedFlight) -> None:
    """The landing is reported before or after the mode: both mean the same."""
    flight.show(FlightMode.LAND)
    flight.report_landed(LandedState.LANDING)


def conflict_before(flight: ScriptedFlight) -> None:
    flight.give(IdConflictHeard(flight.now_s))
    flight.show(FlightMode.POSITION)


def conflict_after(flight: ScriptedFlight) -> None:
    flight.show(FlightMode.POSITION)
    flight.give(IdConflictHeard(flight.now_s))


def leave_a_second_source(flight: ScriptedFlight) -> None:
    """The mode is left while the vehicle is held for it."""
    source = Finding(Verdict.HOLD, Reason.SECOND_SOURCE, "second source of setpoints")
    flight.session.context.record_finding(source, flight.now_s)
    flight.show(FlightMode.POSITION)


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (second_source, "second source of setpoints"),
        (leave_a_second_source, "second source of setpoints"),
        (hand_back, "handed back"),
        (land, "landed"),
        (land_by_switch, "landed"),
        (conflict_before, "id conflict"),
        (conflict_after, "id conflict"),
    ],
)
def test_what_was_not_left_by_choice_needs_a_grant_and_says_so(
    autopilot: Autopilot, end: Callable[[ScriptedFlight], None], reason: str
) -> None:
    flight = flying(autopilot)
    end(flight)
    flight.fly(0.1)
    ended_s = flight.now_s
    flight.show(FlightMode.POSITION)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(15.0)
    assert flight.is_in(Phase.YIELD)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    assert flight.is_in(Phase.YIELD)
    assert acts(flight, ended_s) == 0
    assert flight.texts.count(f"grant needed, {reason}: {GRANT_HOW}") == 1
    assert flight.texts[-1] == f"{flight.guided_name} ignored: {reason}; {GRANT_HOW}"
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_targets_of_a_mode_that_was_just_chosen_are_no_second_source(autopilot: Autopilot) -> None:
    flight = flying(autopilot)
    flight.show(FlightMode.OFFBOARD)
    source = Finding(
        Verdict.HOLD, Reason.SECOND_SOURCE, "second source", since_s=flight.now_s + 0.1
    )
    flight.session.context.record_finding(source, flight.now_s)
    flight.show(FlightMode.POSITION)
    flight.fly(4.0)
    assert not flight.is_in(Phase.YIELD)
    assert not [text for text in flight.texts if "grant needed" in text]


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_pilot_who_took_over_by_the_sticks_gives_it_back_by_the_switch(
    autopilot: Autopilot,
) -> None:
    flight = flying(autopilot)
    sticks = Finding(Verdict.YIELD, Reason.STICKS, "pilot moves the sticks")
    flight.session.handover.yield_control(sticks, flight.now_s)
    took_s = flight.now_s
    flight.fly(5.0)  # still in the mode, which is not given again by staying
    assert flight.is_in(Phase.YIELD)
    flight.show(FlightMode.POSITION)
    flight.fly(1.9)
    assert acts(flight, took_s) == 0
    flight.fly(0.3)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


def test_heartbeats_of_the_past_do_not_count_as_time_in_another_mode() -> None:
    flight = ScriptedFlight().ready()
    numbered(flight, FlightMode.OFFBOARD, 50)
    flight.fly(1.9)
    flight.has_heartbeat = False
    numbered(flight, FlightMode.OFFBOARD, 60)
    for order in (55, 56, 57):
        numbered(flight, FlightMode.HOLD, order)
        flight.fly(1.2)
    numbered(flight, FlightMode.OFFBOARD, 70)
    assert flight.is_in(Phase.YIELD)


def test_a_battery_that_was_handed_back_for_is_so_once_in_a_flight() -> None:
    """The pilot takes over and reselects the mode, and knows the charge by then."""
    flight = flying()
    for _ in range(2):
        flight.give(BatteryReported(flight.now_s, 5.0, BatteryLevel.UNKNOWN))
    flight.fly(0.1)
    for _ in range(2):  # handed back, and then ended early with the report
        flight.show(FlightMode.RETURN)
        flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
        flight.show(FlightMode.OFFBOARD)
        flight.fly(1.0)
    assert flight.is_in(Phase.HOLD)
    asked_s = flight.now_s
    flight.show(FlightMode.POSITION)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.is_in(Phase.HOLD)
    assert flight.asked_modes(asked_s) == []


def test_offboard_after_the_report_is_not_ignored_in_silence() -> None:
    flight = ScriptedFlight(
        SessionParams(stop_confirm_s=1.0, stop_radius_m=2.0), Autopilot.ARDUPILOT
    )
    flight.report_landed(LandedState.IN_AIR)
    flight.follows = True
    flight.in_control()
    flight.fly_until_reported()
    flight.show(FlightMode.HOLD)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    assert flight.is_in(Phase.FINISHED)
    text = f"GUIDED ignored: the search is over; {GRANT_HOW}"
    assert flight.texts.count(text) == 1


def test_a_search_that_the_battery_ended_is_not_said_to_have_reported_its_target() -> None:
    flight = flying(Autopilot.ARDUPILOT)
    for _ in range(3):
        flight.give(BatteryReported(flight.now_s, 93.0, BatteryLevel.LOW))
        flight.fly(1.0)
    flight.fly(22.0)
    assert any(text.startswith("SEARCH ENDED, battery low") for text in flight.texts)
    flight.show(FlightMode.RETURN)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    ignored = [text for text in flight.texts if text.startswith("GUIDED ignored")]
    assert ignored == [f"GUIDED ignored: the search is over; {GRANT_HOW}"]


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("period_s", [0.2, 0.5, 1.0, 1.9])
def test_a_mode_that_flaps_is_left_alone(autopilot: Autopilot, period_s: float) -> None:
    flight = flying(autopilot)
    flight.show(FlightMode.POSITION)
    lost_s = flight.now_s
    for _ in range(20):
        flight.fly(period_s)
        flight.show(FlightMode.OFFBOARD)
        flight.fly(period_s)
        flight.show(FlightMode.POSITION)
    assert flight.is_in(Phase.YIELD)
    assert acts(flight, lost_s) == 0


def test_a_mode_that_flaps_too_slowly_for_its_heartbeats_needs_a_grant() -> None:
    """PX4 shows one a second, and refuses OFFBOARD unseen until it is streamed to."""
    flight = flying()
    flight.show(FlightMode.POSITION)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(0.7)
    assert flight.is_in(Phase.NORMAL)
    flight.show(FlightMode.POSITION)
    flight.fly(5.0)
    assert flight.is_in(Phase.YIELD)
    assert f"grant needed, mode flaps: {GRANT_HOW}" in flight.texts


def test_offboard_given_again_too_soon_is_explained_once() -> None:
    flight = flying(Autopilot.ARDUPILOT)
    flight.show(FlightMode.POSITION)
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.is_in(Phase.YIELD)
    text = "GUIDED too soon: leave it 2 s, until ready"
    assert flight.texts.count(text) == 1


def test_a_heartbeat_that_was_overtaken_ends_nothing() -> None:
    flight = ScriptedFlight().ready()
    numbered(flight, FlightMode.OFFBOARD, 50)
    numbered(flight, FlightMode.HOLD, 49)
    flight.fly(0.2)
    assert flight.is_in(Phase.NORMAL)
    numbered(flight, FlightMode.HOLD, 51)
    assert flight.is_in(Phase.YIELD)


def test_an_overtaken_heartbeat_gives_nothing_either() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    flight.report_landed(LandedState.IN_AIR)
    numbered(flight, FlightMode.POSITION, 50)
    numbered(flight, FlightMode.OFFBOARD, 49)
    flight.fly(TICK_S)
    assert flight.is_in(Phase.STANDBY)


def test_an_order_that_makes_no_sense_hides_no_foreign_mode() -> None:
    flight = flying()
    numbered(flight, FlightMode.OFFBOARD, 10_000)
    flight.fly(0.1)
    numbered(flight, FlightMode.HOLD, 3)
    assert flight.is_in(Phase.YIELD)


def test_numbers_begin_again_with_the_autopilot() -> None:
    flight = flying()
    numbered(flight, FlightMode.OFFBOARD, 5000)
    flight.give(AutopilotRestarted(flight.now_s))
    numbered(flight, FlightMode.HOLD, 7)
    assert flight.session.vehicle.mode is FlightMode.HOLD


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_neighbour_with_our_ids_that_stands_disarmed_gives_nothing_back(
    autopilot: Autopilot,
) -> None:
    """A second ArduCopter behind our address: ours, still in GUIDED, was in control again."""
    flight = flying(autopilot)
    flight.show(FlightMode.POSITION, is_armed=False)  # the neighbour's
    flight.give(IdentityDoubted(flight.now_s, "two vehicles send as 1/1"))
    flight.fly(0.5)
    flight.give(IdentityDoubted(flight.now_s, None))
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.session.phase not in IN_CONTROL
    flight.show(FlightMode.POSITION)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.session.phase in IN_CONTROL


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_vehicle_in_our_mode_after_a_doubt_is_not_called_ready(autopilot: Autopilot) -> None:
    """A neighbour was heard, and GUIDED chosen meanwhile: 'ready: switch to GUIDED', in GUIDED."""
    flight = flying(autopilot)
    flight.show(FlightMode.POSITION)
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    flight.give(IdentityDoubted(flight.now_s, "systems 1 and 2 are autopilots on this link"))
    flight.show(FlightMode.OFFBOARD)
    flight.fly(0.5)
    before = len(flight.texts)
    flight.give(IdentityDoubted(flight.now_s, None))
    flight.fly(3.0)
    said = " ".join(flight.texts[before:])
    assert "ready" not in said
    assert "no control: found in " in said
    assert "; leave it first" in said
    flight.show(FlightMode.POSITION)
    flight.fly(3.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert flight.session.phase in IN_CONTROL


def test_after_offboard_was_confirmed_to_the_launch_another_mode_is_a_choice() -> None:
    flight = ScriptedFlight(SessionParams(engage="auto")).asking_for_offboard()
    accepted = RequestAnswered(flight.now_s, RequestKind.SET_MODE, Outcome.ACCEPTED, order=100)
    flight.give(accepted)
    numbered(flight, FlightMode.HOLD, 99)
    assert flight.is_in(Phase.LAUNCHING)
    numbered(flight, FlightMode.HOLD, 101)
    assert flight.is_in(Phase.YIELD)
