"""Events that end a launch, after which nothing is requested, sent or taken."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.domain import Autopilot, BatteryLevel, FlightMode, LandedState
from companion.guidance.commands import Arm, SendSetpoint
from companion.guidance.control import TICK_S
from companion.guidance.events import (
    BatteryReported,
    ControlStalled,
    EstimatorStatusReported,
    FixReported,
    HeartbeatReceived,
    OperatorCommand,
    OperatorCommandReceived,
    Outcome,
    RequestAnswered,
    RequestKind,
    SticksReported,
    StopRequested,
)
from companion.guidance.launch import Launch, LaunchView
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.authority.test_launch import AUTO, launching
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since

AUTOPILOTS = [Autopilot.PX4, Autopilot.ARDUPILOT]


def assert_left_alone(flight: ScriptedFlight, duration_s: float = 10.0) -> None:
    """Assert that the launch ended, and the vehicle flies on to its altitude without us."""
    assert flight.is_in(Phase.YIELD)
    ended_s = flight.now_s
    flight.position_enu_m = (0.0, 0.0, 20.0)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(duration_s)
    assert flight.is_in(Phase.YIELD)
    assert silent_since(flight, ended_s)


@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
def test_a_failsafe_during_the_launch_ends_it_until_a_grant(autopilot: Autopilot) -> None:
    flight = launching(autopilot)
    flight.show(flight.mode, is_failsafe=True)
    assert flight.is_in(Phase.YIELD)
    assert_left_alone(flight)
    flight.is_failsafe = False
    assert_left_alone(flight)
    flight.show(FlightMode.POSITION)
    assert_left_alone(flight)
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


def test_offboard_that_others_enter_during_the_climb_is_not_ours() -> None:
    """PX4 enters it in the air only if another system streams setpoints."""
    flight = launching()
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.YIELD)
    ended_s = flight.now_s
    flight.fly(10.0)
    assert silent_since(flight, ended_s)


@pytest.mark.parametrize("order", ["pilot first", "stall first"])
def test_offboard_that_was_asked_for_before_the_launch_ended_was_not_given(order: str) -> None:
    """The request was on its way already, and the autopilot obeys it after the pilot."""
    flight = ScriptedFlight(AUTO).asking_for_offboard()
    if order == "pilot first":
        flight.show(FlightMode.POSITION)
    else:
        flight.give(ControlStalled(flight.now_s, 1.0))
        assert flight.texts[-1].endswith("; takeoff aborted")
        flight.show(FlightMode.TAKEOFF)
    assert flight.is_in(Phase.YIELD)
    ended_s = flight.now_s
    flight.fly(0.6)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(10.0)
    assert flight.is_in(Phase.YIELD)
    assert silent_since(flight, ended_s)


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("is_fresh", [True, False])
def test_a_stop_during_the_climb_sends_no_place_of_the_past(
    autopilot: Autopilot, is_fresh: bool
) -> None:
    """The takeoff needs no setpoints, and its progress is unknown."""
    flight = launching(autopilot)
    flight.has_position = is_fresh
    flight.fly(0.8)
    flight.give(StopRequested(flight.now_s))
    stopped_s = flight.now_s
    flight.fly(0.5)
    assert flight.is_in(Phase.HANDBACK)
    assert flight.asked_modes(stopped_s - TICK_S) == [FlightMode.HOLD]
    assert bool(flight.sent(SendSetpoint, stopped_s)) is is_fresh


# Hold during the climb


class Climb:
    """A launch of a PX4 whose takeoff was asked for, to 20 m."""

    def __init__(self) -> None:
        self.launch = Launch(20.0, 0.0)
        self._order = 0
        self.tick(is_armed=False)
        for kind in (RequestKind.ARM, RequestKind.TAKE_OFF):
            self.tick(is_armed=True)
            self.answer(kind)

    def heartbeat(
        self, mode: FlightMode, *, is_armed: bool = True, order: int | None = None
    ) -> HeartbeatReceived:
        return HeartbeatReceived(0.0, Autopilot.PX4, mode, is_armed, True, False, order=order)

    def tick(self, *, is_armed: bool) -> None:
        heartbeat = self.heartbeat(FlightMode.HOLD, is_armed=is_armed)
        self.launch.tick(LaunchView(TICK_S, heartbeat, 0.0, 0.0))

    def answer(self, kind: RequestKind) -> None:
        self.launch.note_answer(RequestAnswered(TICK_S, kind, Outcome.ACCEPTED, order=100))

    def objection(
        self, mode: FlightMode, height_m: float | None, order: int | None = None
    ) -> str | None:
        return self.launch.observe(self.heartbeat(mode, order=order), height_m)


@pytest.mark.parametrize("height_m", [0.1, 8.5, 18.9, None])
def test_hold_below_the_top_is_a_pilots(height_m: float | None) -> None:
    climb = Climb()
    assert climb.objection(FlightMode.TAKEOFF, 0.1) is None
    assert climb.objection(FlightMode.HOLD, height_m) == "mode is hold"


def test_hold_at_the_top_is_the_end_of_the_takeoff_and_hold_left_behind_is_not() -> None:
    climb = Climb()
    assert climb.objection(FlightMode.TAKEOFF, 8.0) is None
    assert climb.objection(FlightMode.HOLD, 19.2) is None
    assert climb.objection(FlightMode.HOLD, 20.1) is None
    assert climb.objection(FlightMode.HOLD, 12.0) == "mode is hold"


def test_hold_that_was_shown_before_the_takeoff_ends_nothing() -> None:
    """The mode the vehicle was armed in, also where a newer heartbeat has overtaken it."""
    climb = Climb()
    assert climb.objection(FlightMode.HOLD, 0.1) is None
    assert climb.objection(FlightMode.HOLD, 0.1, order=99) is None
    assert climb.objection(FlightMode.TAKEOFF, 0.5, order=110) is None
    assert climb.objection(FlightMode.HOLD, 0.5, order=108) is None
    assert climb.objection(FlightMode.HOLD, 0.5, order=111) == "mode is hold"


def test_hold_after_the_takeoff_was_accepted_is_a_pilots() -> None:
    climb = Climb()
    assert climb.objection(FlightMode.HOLD, 0.3, order=101) == "mode is hold"


def test_a_pilot_who_holds_a_px4_during_its_climb_keeps_it() -> None:
    flight = launching()
    flight.show(FlightMode.HOLD)
    assert "takeoff aborted: mode is hold" in flight.texts
    assert_left_alone(flight, 30.0)


# What is watched while launching

Trouble = Callable[[ScriptedFlight], None]


def moved_sticks(flight: ScriptedFlight) -> None:
    flight.give(SticksReported(flight.now_s, (0.0, 0.8, 0.0, 0.0)))


def doubt(flight: ScriptedFlight) -> None:
    flight.give(EstimatorStatusReported(flight.now_s, 1.5))


def no_fix(flight: ScriptedFlight) -> None:
    flight.give(FixReported(flight.now_s, has_fix=False))


def empty_battery(flight: ScriptedFlight) -> None:
    flight.give(BatteryReported(flight.now_s, 5.0, BatteryLevel.UNKNOWN))


def well(flight: ScriptedFlight) -> None:
    flight.give(SticksReported(flight.now_s, (0.0, 0.0, 0.0, 0.0)))
    flight.give(FixReported(flight.now_s, has_fix=True))
    flight.give(EstimatorStatusReported(flight.now_s, 0.2))
    flight.give(BatteryReported(flight.now_s, 90.0, BatteryLevel.UNKNOWN))


def fly_with(flight: ScriptedFlight, trouble: Trouble, duration_s: float) -> None:
    """Fly with a trouble that is reported five times a second."""
    for _ in range(round(duration_s / 0.2)):
        trouble(flight)
        flight.fly(0.2)


TROUBLES = [
    (moved_sticks, "pilot moves the sticks"),
    (doubt, "autopilot's position estimate is poor"),
    (no_fix, "autopilot lost GNSS fix"),
    (empty_battery, "battery critical, 5 %"),
]


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize(("trouble", "words"), TROUBLES)
def test_what_would_be_held_on_in_control_ends_a_launch(
    trouble: Trouble, words: str, autopilot: Autopilot
) -> None:
    flight = launching(autopilot)
    well(flight)
    fly_with(flight, trouble, 1.4)
    assert f"takeoff aborted: {words}" in flight.texts
    assert_left_alone(flight)


@pytest.mark.parametrize(("trouble", "words"), TROUBLES)
def test_on_the_ground_it_is_waited_for(trouble: Trouble, words: str) -> None:
    flight = ScriptedFlight(AUTO)
    flight.is_ready = False
    flight.on_the_ground()
    well(flight)
    fly_with(flight, trouble, 1.4)
    flight.is_ready = True
    fly_with(flight, trouble, 5.0)
    assert not flight.sent(Arm)
    fly_with(flight, well, 4.0)
    assert flight.sent(Arm)
    assert not any(words in text for text in flight.texts if "launch" in text)


def test_what_does_not_pass_on_the_ground_is_named() -> None:
    flight = ScriptedFlight(AUTO)
    flight.is_ready = False
    flight.has_ranging = False
    flight.on_the_ground()
    fly_with(flight, doubt, 122.0)
    assert "takeoff aborted: autopilot's position estimate is poor for 5 s" in flight.texts
    assert not flight.sent(Arm)
