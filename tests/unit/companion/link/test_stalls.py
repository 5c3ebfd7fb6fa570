"""The control tick stands still, and goes on: what is sent then, and on what knowledge."""

from __future__ import annotations

import itertools

import pytest

from companion.domain import FlightMode
from companion.guidance.commands import SetMode
from companion.guidance.phases import Phase
from companion.link.interface import LinkParams
from companion.link.quality import STALL_S, LinkHealth
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import OFFBOARD, Wire, heartbeat, local_position

Setpoint = mavlink.MAVLink_set_position_target_local_ned_message
Command = mavlink.MAVLink_command_long_message
POSCTL = 3 << 16


def in_control() -> Wire:
    wire = Wire().ready(OFFBOARD)
    speak(wire, 1.0)
    assert wire.endpoint.session.phase is Phase.HOLD
    return wire


def speak(wire: Wire, seconds: float) -> list[Message]:
    """Positions and modes come; the frames sent until then."""
    sent: list[Message] = []
    for _ in range(round(seconds / 0.05)):
        sent += wire.say(wire.position())
        sent += wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
        sent += wire.wait(0.05)
    return sent


def stall(wire: Wire, seconds: float) -> list[Message]:
    """Nothing runs for a while; what the next tick sends."""
    wire.now_s += seconds
    wire.endpoint.handle_timer(wire.now_s)
    return wire._collect()


def is_mode_question(message: Message) -> bool:
    if not isinstance(message, Command) or message.command != mavlink.MAV_CMD_REQUEST_MESSAGE:
        return False
    return bool(message.param1 == mavlink.MAVLINK_MSG_ID_HEARTBEAT)


def setpoints(sent: list[Message]) -> list[Setpoint]:
    return [m for m in sent if isinstance(m, Setpoint)]


def mode_requests(wire: Wire) -> list[Command]:
    return [m for m in wire.of(Command) if m.command == mavlink.MAV_CMD_DO_SET_MODE]


@pytest.mark.parametrize("seconds", [0.1, 0.3, STALL_S - 0.01])
def test_a_hiccup_costs_ticks_and_nothing_else(seconds: float) -> None:
    wire = in_control()
    wire.say(wire.position())
    assert len(setpoints(stall(wire, seconds))) == 1
    assert len(setpoints(speak(wire, 1.0))) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("seconds", [0.6, 5.0, 60.0])
def test_after_a_stall_nothing_is_sent_before_mode_and_position_were_heard_again(
    seconds: float,
) -> None:
    wire = in_control()
    assert setpoints(stall(wire, seconds)) == []
    assert setpoints(wire.wait(0.3)) == []
    wire.say(local_position(round(1e3 * wire.now_s), 0.0, 0.0, -20.0, 0.0, 0.0, 0.0))
    assert setpoints(wire.wait(0.05)) == []
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    assert len(setpoints(wire.wait(0.05))) == 1


def test_the_mode_that_a_socket_kept_from_a_stall_is_not_the_mode_now() -> None:
    wire = in_control()
    began_s = wire.now_s
    stall(wire, 5.0)
    wire.now_s += 0.01
    wire.say(local_position(round(1e3 * began_s) + 50, 0.0, 0.0, -20.0, 0.0, 0.0, 0.0))
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    assert setpoints(wire.wait(0.05)) == []
    wire.say(local_position(round(1e3 * wire.now_s), 0.0, 0.0, -20.0, 0.0, 0.0, 0.0))
    assert setpoints(wire.wait(0.05)) == []
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    assert len(setpoints(wire.wait(0.05))) == 1


@pytest.mark.parametrize("seconds", [2.0, 13.0])
def test_after_a_stall_the_mode_is_asked_for_until_it_is_reported(seconds: float) -> None:
    """The first answer may come before anything stamped, and says nothing then."""
    wire = in_control()
    stall(wire, seconds)
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    asked: list[float] = []
    for _ in range(20):
        wire.say(wire.position())
        sent = wire.wait(0.05)
        assert setpoints(sent) == []
        asked += [wire.now_s for m in sent if is_mode_question(m)]
    assert len(asked) == pytest.approx(4, abs=1)
    assert min(b - a for a, b in itertools.pairwise(asked)) >= 0.25 - 1e-6
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    sent = wire.wait(0.5)
    assert setpoints(sent)
    assert not any(map(is_mode_question, sent))


def test_the_first_setpoint_after_a_stall_is_where_the_vehicle_is_then() -> None:
    wire = in_control()
    stall(wire, 5.0)
    wire.now_s += 0.01
    wire.say(local_position(round(1e3 * wire.now_s), 30.0, 40.0, -25.0, 0.0, 0.0, 0.0))
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    (first,) = setpoints(wire.wait(0.05))
    assert (first.x, first.y, first.z) == pytest.approx((30.0, 40.0, -25.0))


@pytest.mark.parametrize("lost", [0, 100, 150, 250, 255, 400])
def test_a_mode_that_comes_after_what_the_socket_could_not_keep_is_new(lost: int) -> None:
    wire = in_control()
    offboard = heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4)
    kept = [wire.autopilot.encode(message) for message in (wire.position(), offboard)]
    for _ in range(lost):
        wire.autopilot.encode(wire.position())
    wire.now_s += 5.0
    for data in kept:
        wire.bytes(data)
    assert setpoints(wire.wait(0.05)) == []
    wire.say(wire.position())
    wire.say(offboard)
    assert len(setpoints(wire.wait(0.05))) == 1


def test_what_piled_up_during_the_stall_is_not_the_present() -> None:
    wire = in_control()
    backlog = [
        wire.autopilot.encode(message)
        for message in (wire.position(), heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    ]
    wire.now_s += 5.0
    for data in backlog:
        wire.bytes(data)
    wire.endpoint.handle_timer(wire.now_s)
    assert setpoints(wire._collect()) == []
    assert setpoints(wire.wait(0.5)) == []


def test_a_mode_that_changed_during_the_stall_ends_control() -> None:
    wire = in_control()
    stall(wire, 5.0)
    wire.say(wire.position())
    wire.say(heartbeat(custom_mode=POSCTL, is_armed=True, status=4))
    assert wire.endpoint.session.phase is Phase.YIELD
    assert setpoints(speak(wire, 1.9)) == []


def test_after_a_stall_the_mode_is_asked_for_at_once() -> None:
    asked = [m for m in stall(in_control(), 0.6) if isinstance(m, Command)]
    assert (mavlink.MAV_CMD_REQUEST_MESSAGE, 0.0) in [(m.command, m.param1) for m in asked]


def test_a_stall_is_reported_and_counted_and_no_tick_is_made_up_for() -> None:
    wire = in_control()
    wire.journal.texts.clear()
    sent = stall(wire, 5.0)
    assert sum(m.get_type() == "HEARTBEAT" for m in sent) == 1
    assert wire.journal.texts[0] == "control loop stalled 5.0 s: reacquiring state"
    wire.wait(11.0)
    record = [fields for kind, fields in wire.journal.records if kind == "link"][-1]
    assert (record["stalls"], record["missed_ticks"]) == (1, 99)


def test_what_was_asked_before_a_stall_is_not_asked_again() -> None:
    wire = in_control()
    wire.endpoint.executor.execute(SetMode(FlightMode.HOLD, is_armed=True), wire.now_s)
    wire.wait(0.05)
    assert len(mode_requests(wire)) == 1
    stall(wire, 0.8)
    wire.wait(3.0)
    assert len(mode_requests(wire)) == 1


def test_a_hand_back_is_asked_again_once_it_is_known_who_flies() -> None:
    wire = in_control()
    wire.endpoint.request_stop(wire.now_s)
    wire.wait(0.05)
    assert len(mode_requests(wire)) == 1
    stall(wire, 0.8)
    wire.wait(0.1)
    assert len(mode_requests(wire)) == 1
    speak(wire, 0.1)
    assert len(mode_requests(wire)) == 2


def test_missed_ticks_are_those_that_never_came() -> None:
    health = LinkHealth(LinkParams())
    stalls = [health.tick(now_s) for now_s in (0.0, 0.05, 0.11, 0.26, 0.31, 1.31)]
    assert stalls == [None] * 5 + [pytest.approx(1.0)]
    assert (health.missed_ticks, health.stalls) == (2 + 19, 1)
