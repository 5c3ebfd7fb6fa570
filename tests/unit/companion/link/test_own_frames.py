from __future__ import annotations

from companion.link.own_frames import FOREIGN_FRAMES, KEPT, OwnFrames
from companion.mav.codec import MavCodec
from tests.unit.companion.link.wire import Wire, heartbeat


def frame(number: int) -> bytes:
    return number.to_bytes(8, "little")


def test_what_we_sent_is_an_echo_however_often_it_comes() -> None:
    own = OwnFrames()
    own.sent(frame(1))
    assert not any(own.came_back(frame(1)) for _ in range(10))
    assert (own.echoes, own.foreign) == (10, 0)


def test_what_we_did_not_send_raises_one_alarm() -> None:
    own = OwnFrames()
    raised = [own.came_back(frame(n)) for n in range(10)]
    assert raised == [n == FOREIGN_FRAMES - 1 for n in range(10)]


def test_only_the_last_frames_are_remembered() -> None:
    own = OwnFrames()
    for number in range(3 * KEPT):
        own.sent(frame(number))
        own.sent(frame(1))
    assert len(own._sent) <= KEPT
    own.came_back(frame(1))
    own.came_back(frame(3 * KEPT - 1))
    assert (own.echoes, own.foreign) == (2, 0)
    own.came_back(frame(2))
    assert own.foreign == 1


def flown_beside_another_companion(*, is_router_loop: bool) -> Wire:
    wire = Wire().ready()
    other = MavCodec(1, 191)
    for _ in range(40):
        wire.wait(0.05)
        wire.say(wire.position())
        data = wire.raw[-1].data if is_router_loop else other.encode(heartbeat(autopilot=8))
        wire.bytes(data)
    return wire


def test_a_router_that_sends_our_frames_back_is_no_second_companion() -> None:
    wire = flown_beside_another_companion(is_router_loop=True)
    assert not any("someone else" in text for text in wire.journal.texts)


def test_a_second_companion_on_the_vehicle_is_told_once() -> None:
    wire = flown_beside_another_companion(is_router_loop=False)
    said = [text for text in wire.journal.texts if "someone else sends as 1/191" in text]
    assert len(said) == 1
