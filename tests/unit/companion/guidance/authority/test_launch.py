"""The automatic launch: the sequence per autopilot, its patience, and who may end it."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import Arm, Command, SendSetpoint, SessionParams, SetMode, TakeOff
from companion.guidance.events import (
    HeartbeatReceived,
    Outcome,
    RequestAnswered,
    RequestKind,
    StopRequested,
)
from companion.guidance.fencing import Fencing
from companion.guidance.launch import Launch, LaunchView, Stage
from companion.guidance.phases import Phase
from companion.guidance.vehicle import mode_name
from tests.unit.companion.guidance.scripted import ScriptedFlight

AUTO = SessionParams(engage="auto", altitude_m=20.0)
TICK_S = 0.05


class Attempt:
    """One launch with an autopilot that obeys when the test says so."""

    def __init__(
        self, autopilot: Autopilot = Autopilot.PX4, mode: FlightMode | None = None
    ) -> None:
        self.launch = Launch(20.0, 0.0)
        self.autopilot = autopilot
        self.mode = mode or FlightMode.HOLD
        self.is_armed = False
        self.is_ready = True
        self.height_m = 0.0
        self.has_origin = True
        self.now_s = 0.0

    @property
    def heartbeat(self) -> HeartbeatReceived:
        return HeartbeatReceived(
            self.now_s, self.autopilot, self.mode, self.is_armed, self.is_ready, False
        )

    def wait(self, duration_s: float = TICK_S) -> list[Command]:
        commands: list[Command] = []
        for _ in range(round(duration_s / TICK_S)):
            self.now_s += TICK_S
            view = LaunchView(self.now_s, self.heartbeat, self.height_m, 0.5, self.has_origin)
            commands += self.launch.tick(view)
        return commands

    def answer(self, kind: RequestKind, outcome: Outcome = Outcome.ACCEPTED) -> None:
        self.launch.note_answer(RequestAnswered(self.now_s, kind, outcome, "why"))

    def to_stage(self, stage: Stage) -> Attempt:
        """PX4 up to a stage."""
        answers = {
            Stage.ARM: RequestKind.ARM,
            Stage.TAKE_OFF: RequestKind.TAKE_OFF,
        }
        while self.launch.stage is not stage:
            self.wait()
            kind = answers.get(self.launch.stage)
            if kind is not None and self.launch.stage is not stage:
                self.answer(kind)
                self.is_armed = True
            elif self.launch.stage is Stage.CLIMB:
                self.mode, self.height_m = FlightMode.HOLD, 20.0
        return self


def test_px4_arms_in_hold_takes_off_streams_and_asks_for_offboard() -> None:
    attempt = Attempt()
    assert attempt.wait(0.2) == [Arm()]
    attempt.answer(RequestKind.ARM)
    attempt.is_armed = True
    assert attempt.wait(0.2) == [TakeOff(20.0, 0.5)]
    attempt.answer(RequestKind.TAKE_OFF)
    attempt.mode = FlightMode.TAKEOFF
    attempt.height_m = 17.9
    assert attempt.wait(5.0) == []
    assert not attempt.launch.wants_stream
    attempt.height_m = 18.0
    attempt.wait()
    assert attempt.launch.wants_stream
    assert attempt.wait(1.0) == []
    assert attempt.wait(0.5) == [SetMode(FlightMode.OFFBOARD, True)]
    assert attempt.launch.wants_stream


def test_px4_is_put_into_hold_before_it_is_armed() -> None:
    attempt = Attempt(mode=FlightMode.POSITION)
    assert attempt.wait(0.2) == [SetMode(FlightMode.HOLD, False)]
    attempt.answer(RequestKind.SET_MODE)
    assert attempt.wait(0.2) == [Arm()]


def test_ardupilot_goes_to_guided_first() -> None:
    attempt = Attempt(Autopilot.ARDUPILOT, FlightMode.STABILIZED)
    assert attempt.wait(0.2) == [SetMode(FlightMode.OFFBOARD, False)]
    attempt.answer(RequestKind.SET_MODE)
    attempt.mode = FlightMode.OFFBOARD
    assert attempt.wait(0.2) == [Arm()]
    attempt.answer(RequestKind.ARM)
    attempt.is_armed = True
    assert attempt.wait(0.2) == [TakeOff(20.0, 0.5)]
    attempt.answer(RequestKind.TAKE_OFF)
    assert not attempt.launch.is_at_offboard
    attempt.height_m = 18.5
    attempt.wait()
    assert attempt.launch.is_at_offboard


def test_waits_for_the_autopilot_to_become_ready_and_then_gives_up() -> None:
    attempt = Attempt()
    attempt.is_ready = False
    assert attempt.wait(119.0) == []
    assert attempt.launch.failure is None
    attempt.wait(1.5)
    assert attempt.launch.failure == "the autopilot is not ready to arm"


def test_waits_for_the_origin_that_the_takeoff_altitude_needs() -> None:
    attempt = Attempt()
    attempt.has_origin = False
    assert attempt.wait(5.0) == []
    attempt.has_origin = True
    assert attempt.wait(0.2) == [Arm()]


@pytest.mark.parametrize("outcome", [Outcome.REJECTED, Outcome.NO_ANSWER])
def test_a_refused_arming_is_tried_again_every_two_seconds_for_two_minutes(
    outcome: Outcome,
) -> None:
    attempt = Attempt()
    attempt.to_stage(Stage.ARM)
    tries = 0
    while attempt.launch.failure is None:
        assert attempt.now_s < 125.0
        if attempt.wait():
            tries += 1
            attempt.answer(RequestKind.ARM, outcome)
    assert attempt.launch.failure == f"arming: {outcome.value} why"
    assert 115.0 < attempt.now_s < 125.0
    assert 55 <= tries <= 61


@pytest.mark.parametrize(
    ("stage", "kind"),
    [(Stage.TAKE_OFF, RequestKind.TAKE_OFF), (Stage.OFFBOARD, RequestKind.SET_MODE)],
)
def test_any_other_refusal_ends_the_launch(stage: Stage, kind: RequestKind) -> None:
    attempt = Attempt().to_stage(stage)
    attempt.wait(0.1)
    attempt.answer(kind, Outcome.REJECTED)
    assert attempt.launch.failure == f"{stage.value}: rejected why"


@pytest.mark.parametrize("how", ["sent again", "asked again"])
@pytest.mark.parametrize("has_begun", [True, False])
def test_a_repeated_take_off_that_is_refused_may_have_begun(how: str, has_begun: bool) -> None:
    """The first answer was lost; ArduPilot refuses the second, because it climbs already."""
    attempt = Attempt(Autopilot.ARDUPILOT, FlightMode.OFFBOARD).to_stage(Stage.TAKE_OFF)
    attempt.wait(0.1)
    if how == "asked again":
        attempt.answer(RequestKind.TAKE_OFF, Outcome.NO_ANSWER)
        attempt.wait(2.5)
    kind, is_repeated = RequestKind.TAKE_OFF, how == "sent again"
    refusal = RequestAnswered(
        attempt.now_s, kind, Outcome.REJECTED, "failed", is_repeated=is_repeated
    )
    attempt.launch.note_answer(refusal)
    assert attempt.launch.failure is None
    assert attempt.wait(5.0) == []
    attempt.height_m = 1.5 if has_begun else 0.2
    attempt.wait(5.0)
    assert attempt.launch.failure == (None if has_begun else "taking off: rejected failed")
    if has_begun:
        attempt.height_m = 19.0
        attempt.wait()
        assert attempt.launch.is_at_offboard


def test_an_unanswered_request_is_repeated_three_times() -> None:
    attempt = Attempt().to_stage(Stage.TAKE_OFF)
    asked = 0
    while attempt.launch.failure is None:
        assert attempt.now_s < 60.0
        if attempt.wait():
            asked += 1
            attempt.answer(RequestKind.TAKE_OFF, Outcome.NO_ANSWER)
    assert asked == 4
    assert attempt.launch.failure == "taking off: no answer why"


def test_an_answer_to_something_else_changes_nothing() -> None:
    attempt = Attempt().to_stage(Stage.ARM)
    attempt.answer(RequestKind.SET_MODE)
    attempt.answer(RequestKind.TAKE_OFF, Outcome.REJECTED)
    assert attempt.launch.stage is Stage.ARM
    assert attempt.launch.failure is None


def test_a_climb_that_does_not_arrive_ends_the_launch() -> None:
    attempt = Attempt().to_stage(Stage.CLIMB)
    attempt.height_m = 5.0
    attempt.wait(90.0)
    assert attempt.launch.failure is None
    attempt.wait(0.2)
    assert attempt.launch.failure == "the vehicle did not reach its altitude"


def test_offboard_that_is_accepted_but_never_entered_ends_the_launch() -> None:
    attempt = Attempt().to_stage(Stage.OFFBOARD)
    attempt.wait(0.1)
    attempt.answer(RequestKind.SET_MODE)
    attempt.wait(5.2)
    assert attempt.launch.failure == "offboard was accepted but never entered"


def test_a_lost_request_for_offboard_leaves_its_time_to_the_one_that_is_accepted() -> None:
    attempt = Attempt().to_stage(Stage.OFFBOARD)
    attempt.wait(4.0)
    attempt.answer(RequestKind.SET_MODE, Outcome.NO_ANSWER)
    assert attempt.wait(2.5) == [SetMode(FlightMode.OFFBOARD, True)]
    attempt.answer(RequestKind.SET_MODE)
    attempt.wait(4.9)
    assert attempt.launch.failure is None
    attempt.wait(0.3)
    assert attempt.launch.failure == "offboard was accepted but never entered"


@pytest.mark.parametrize(
    ("autopilot", "mode"),
    [
        (Autopilot.PX4, FlightMode.POSITION),
        (Autopilot.PX4, FlightMode.OFFBOARD),
        (Autopilot.PX4, FlightMode.HOLD),
        (Autopilot.ARDUPILOT, FlightMode.POSITION),
        (Autopilot.ARDUPILOT, FlightMode.HOLD),
    ],
)
def test_a_vehicle_that_is_already_flying_is_not_launched(
    autopilot: Autopilot, mode: FlightMode
) -> None:
    attempt = Attempt(autopilot, mode)
    attempt.is_armed, attempt.height_m = True, 5.0
    assert attempt.wait(3.0) == []
    name = mode_name(mode, autopilot)
    assert attempt.launch.failure == f"the vehicle is already flying, in {name}"


def test_an_unknown_autopilot_is_not_launched() -> None:
    attempt = Attempt(Autopilot.OTHER, FlightMode.UNKNOWN)
    assert attempt.wait(1.0) == []
    assert attempt.launch.failure == "only PX4 and ArduPilot can be launched"


# With the session around it


def launching(autopilot: Autopilot = Autopilot.PX4) -> ScriptedFlight:
    """Return a flight that is armed and climbing by the autopilot's reports."""
    flight = ScriptedFlight(AUTO, autopilot).on_the_ground()
    if autopilot is Autopilot.ARDUPILOT:
        flight.answer(RequestKind.SET_MODE)
        flight.mode = FlightMode.OFFBOARD
        flight.fly(0.5)
    assert flight.sent(Arm)
    flight.answer(RequestKind.ARM)
    flight.is_armed = True
    flight.fly(0.1)
    assert flight.sent(TakeOff)
    flight.answer(RequestKind.TAKE_OFF)
    flight.mode = FlightMode.TAKEOFF if autopilot is Autopilot.PX4 else FlightMode.OFFBOARD
    flight.position_enu_m = (0.0, 0.0, 8.0)
    flight.fly(2.0)
    assert flight.is_in(Phase.LAUNCHING)
    return flight


def test_the_session_launches_px4_and_engages() -> None:
    flight = launching()
    flight.position_enu_m = (0.0, 0.0, 20.0)
    flight.mode = FlightMode.HOLD
    since_s = flight.now_s
    flight.fly(1.5)
    assert flight.asked_modes() == [FlightMode.OFFBOARD]
    assert len(flight.sent(SendSetpoint, since_s)) >= 24
    flight.answer(RequestKind.SET_MODE)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


def test_a_launch_without_control_in_offboard_stays_at_one_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fence has changed since then; a setpoint that followed the drift would lead it on."""
    flight = launching()
    flight.position_enu_m = (0.0, 0.0, 20.0)
    flight.mode = FlightMode.HOLD
    flight.fly(1.5)
    flight.answer(RequestKind.SET_MODE)
    monkeypatch.setattr(Fencing, "is_ready", property(lambda _: False))
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.LAUNCHING)
    begun, began_s = flight.setpoints[-1], flight.now_s
    for step in range(4):
        flight.position_enu_m = (0.2 * step, 0.0, 20.0)
        flight.fly(1.0)
    sent = [c.setpoint.position_enu_m for c in flight.sent(SendSetpoint, began_s)]
    assert {position[:2] for position in sent} == {begun[:2]}
    flight.fly(1.5)
    assert flight.is_in(Phase.YIELD)
    failure = "offboard was entered, but control waits for its inputs"
    assert f"takeoff aborted: {failure}" in flight.texts


def test_the_session_launches_ardupilot_and_engages_after_the_climb() -> None:
    flight = launching(Autopilot.ARDUPILOT)
    assert flight.setpoints == []
    flight.position_enu_m = (0.0, 0.0, 20.0)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(1.2)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
@pytest.mark.parametrize(
    "mode", [FlightMode.POSITION, FlightMode.RETURN, FlightMode.LAND, FlightMode.STABILIZED]
)
def test_a_pilot_who_takes_over_during_the_launch_keeps_the_vehicle(
    autopilot: Autopilot, mode: FlightMode
) -> None:
    flight = launching(autopilot)
    taken_s, asked = flight.now_s, len(flight.asked_modes())
    flight.show(mode)
    assert flight.is_in(Phase.YIELD)
    assert flight.has_withdrawn
    flight.position_enu_m = (0.0, 0.0, 20.0)
    flight.fly(30.0)
    assert flight.sent(SendSetpoint, taken_s) == []
    assert len(flight.asked_modes()) == asked
    assert f"takeoff aborted: mode is {mode_name(mode, autopilot)}" in flight.texts


def test_braking_an_ardupilot_during_its_climb_is_taking_over() -> None:
    flight = launching(Autopilot.ARDUPILOT)
    flight.show(FlightMode.HOLD)
    assert flight.is_in(Phase.YIELD)


def test_a_vehicle_that_disarms_during_the_launch_is_not_launched_again() -> None:
    flight = launching()
    flight.show(FlightMode.HOLD, is_armed=False)
    assert flight.is_in(Phase.WAITING)
    since_s = flight.now_s
    flight.fly(30.0)
    assert flight.is_in(Phase.STANDBY)
    assert flight.sent(Arm, since_s) == []


@pytest.mark.slow
def test_a_launch_that_gives_up_leaves_the_vehicle_alone() -> None:
    flight = launching()
    flight.fly(95.0)
    assert flight.is_in(Phase.YIELD)
    assert "takeoff aborted: the vehicle did not reach its altitude" in flight.texts


@pytest.mark.parametrize("what", ["has_position", "has_link"])
def test_a_vehicle_that_is_not_seen_any_more_is_not_launched_for_ever(what: str) -> None:
    flight = launching()
    setattr(flight, what, False)
    flight.fly(9.5)
    assert flight.is_in(Phase.LAUNCHING)
    flight.fly(1.5)
    assert flight.is_in(Phase.YIELD)
    assert "takeoff aborted: no link, mode or fresh position for 10 s" in flight.texts


def test_a_stop_during_the_climb_asks_for_hold() -> None:
    flight = launching()
    flight.give(StopRequested(flight.now_s))
    assert flight.asked_modes() == [FlightMode.HOLD]
    assert flight.is_in(Phase.HANDBACK)
