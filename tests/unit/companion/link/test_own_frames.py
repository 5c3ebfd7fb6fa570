from __future__ import annotations

import pytest

from companion.guidance.control_authority import ID_CONFLICT_S
from companion.guidance.phases import IN_CONTROL, Phase
from companion.link import outbound
from companion.link.outlet import FOREIGN_FRAMES, KEPT, OwnFrames
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import HOLD, OFFBOARD, Wire, heartbeat


def frame(number: int) -> bytes:
    return number.to_bytes(8, "little")


def test_what_we_sent_is_an_echo_however_often_it_comes() -> None:
    own = OwnFrames()
    own.record_sent(frame(1))
    assert not any(own.record_received(frame(1), float(n)) for n in range(10))
    assert (own.echoes, own.foreign) == (10, 0)


def test_what_we_did_not_send_over_a_while_is_another_companions() -> None:
    own = OwnFrames()
    heard = [own.record_received(frame(n), float(n)) for n in range(10)]
    assert heard == [n >= FOREIGN_FRAMES - 1 for n in range(10)]


def test_a_handful_at_once_or_one_now_and_then_is_no_other_companions() -> None:
    own = OwnFrames()
    assert not any(own.record_received(frame(n), 0.05 * n) for n in range(20))
    own = OwnFrames()
    assert not any(own.record_received(frame(n), 1.1 * ID_CONFLICT_S * n) for n in range(20))


def test_only_the_last_frames_are_remembered() -> None:
    own = OwnFrames()
    for number in range(3 * KEPT):
        own.record_sent(frame(number))
        own.record_sent(frame(1))
    assert len(own._sent) <= KEPT
    own.record_received(frame(1), 0.0)
    own.record_received(frame(3 * KEPT - 1), 0.0)
    assert (own.echoes, own.foreign) == (2, 0)
    own.record_received(frame(2), 0.0)
    assert own.foreign == 1


def flown_beside_another_companion(*, is_router_loop: bool) -> Wire:
    wire = Wire().ready()
    other = MavCodec(1, 191)
    for _ in range(40):
        wire.wait(0.05)
        wire.say(wire.position())
        data = wire.raw[-1].data if is_router_loop else other.encode(mark())
        wire.bytes(data)
    return wire


def test_a_router_that_sends_our_frames_back_is_no_second_companion() -> None:
    wire = flown_beside_another_companion(is_router_loop=True)
    assert not any("someone else" in text for text in wire.journal.texts)


def test_a_second_companion_on_the_vehicle_is_reported_once() -> None:
    wire = flown_beside_another_companion(is_router_loop=False)
    said = [text for text in wire.journal.texts if "another companion sends as 1/191" in text]
    assert len(said) == 1


def mark() -> Message:
    """Return the message by which a companion recognises another one."""
    return mavlink.MAVLink_named_value_float_message(0, outbound.MARK, 191.0)


class Twin:
    """A companion that sends under our ids and shows itself once a second, as every one does."""

    def __init__(self, wire: Wire) -> None:
        self.codec = MavCodec(1, 191)
        self.wire = wire

    def beside(self, duration_s: float, *, custom_mode: int = HOLD, is_heard: bool = True) -> None:
        """Time passes on a vehicle in the air."""
        wire, ticks = self.wire, round(duration_s / 0.05)
        for tick in range(ticks):
            wire.wait(0.05)
            wire.say(wire.position())
            if tick % 20 == 0:
                wire.say(heartbeat(custom_mode=custom_mode, is_armed=True, status=4))
                if is_heard:
                    wire.bytes(self.codec.encode(outbound.heartbeat()))
                    wire.bytes(self.codec.encode(mark()))


def phase_of(wire: Wire) -> Phase:
    return wire.endpoint.session.phase


def test_control_is_not_offered_while_a_twin_is_heard() -> None:
    wire = Wire().ready()
    twin = Twin(wire)
    twin.beside(4.0)
    assert phase_of(wire) is Phase.WAITING
    assert any("uses our ids; stop one" in text for text in wire.journal.texts)
    wire.sent.clear()
    twin.beside(4.0)
    assert wire.of(mavlink.MAVLink_set_position_target_local_ned_message) == []
    twin.beside(3.0, custom_mode=OFFBOARD)
    assert phase_of(wire) is Phase.WAITING


def test_control_is_offered_again_once_the_twin_is_silent() -> None:
    wire = Wire().ready()
    twin = Twin(wire)
    twin.beside(4.0)
    twin.beside(8.0, is_heard=False)
    assert phase_of(wire) is Phase.WAITING
    twin.beside(4.0, is_heard=False)
    assert phase_of(wire) is Phase.STANDBY


def test_a_vehicle_that_a_twin_flew_is_not_taken_when_that_one_dies() -> None:
    wire = Wire().ready()
    twin = Twin(wire)
    twin.beside(4.0)
    twin.beside(4.0, custom_mode=OFFBOARD)
    twin.beside(12.0, custom_mode=OFFBOARD, is_heard=False)
    assert phase_of(wire) is Phase.WAITING
    twin.beside(4.0, is_heard=False)
    assert phase_of(wire) is Phase.STANDBY


def test_a_companion_in_control_continues_beside_a_twin_that_was_started_later() -> None:
    wire = Wire().ready(OFFBOARD)
    twin = Twin(wire)
    assert phase_of(wire) in IN_CONTROL
    twin.beside(8.0, custom_mode=OFFBOARD)
    assert phase_of(wire) in IN_CONTROL


def test_after_a_yield_the_mode_gives_no_control_beside_a_twin() -> None:
    wire = Wire().ready(OFFBOARD)
    twin = Twin(wire)
    twin.beside(4.0)
    assert phase_of(wire) is Phase.YIELD
    twin.beside(4.0, custom_mode=OFFBOARD)
    assert phase_of(wire) is Phase.YIELD


def test_frames_left_over_from_the_run_before_do_not_delay_anything() -> None:
    wire = Wire().bound()
    before = MavCodec(1, 191)
    for _ in range(12):
        wire.wait(0.05)
        wire.bytes(before.encode(heartbeat(autopilot=8)))
    wire.ready()
    wire.wait(0.05)
    assert phase_of(wire) is Phase.STANDBY


MAVROS_HEARTBEAT = outbound.heartbeat()
"""The same as ours: an onboard controller of another kind differs in what it does not send."""


def beside_another_kind(wire: Wire, duration_s: float, *component_ids: int) -> None:
    """Time passes on a vehicle with other components, which show themselves once a second."""
    codecs = [MavCodec(1, component_id) for component_id in component_ids]
    for tick in range(round(duration_s / 0.05)):
        wire.wait(0.05)
        wire.say(wire.position())
        if tick % 20 == 0:
            wire.say(heartbeat(is_armed=True, status=4))
            for codec in codecs:
                wire.bytes(codec.encode(MAVROS_HEARTBEAT))


def own_id_of(wire: Wire) -> int:
    return wire.endpoint.outlet.own_ids[1]


@pytest.mark.parametrize(
    ("taken", "ours"), [((191,), 192), ((191, 192), 193), ((191, 192, 193), 194), ((192,), 191)]
)
def test_the_next_free_id_is_taken_beside_another_kind_of_component(
    taken: tuple[int, ...], ours: int
) -> None:
    wire = Wire().ready()
    beside_another_kind(wire, 6.0, *taken)
    assert own_id_of(wire) == ours
    said = [text for text in wire.journal.texts if "is in use" in text]
    assert len(said) == (ours != 191)
    assert phase_of(wire) is Phase.STANDBY
    wire.raw.clear()
    beside_another_kind(wire, 2.0, *taken)
    assert {frame.data[6] for frame in wire.raw} == {ours}


def test_where_all_four_are_taken_it_is_a_conflict() -> None:
    wire = Wire().ready()
    beside_another_kind(wire, 6.0, 191, 192, 193, 194)
    assert phase_of(wire) is Phase.WAITING
    assert any("another companion sends as 1/191" in text for text in wire.journal.texts)


def test_in_control_the_id_stays_and_it_is_said() -> None:
    wire = Wire().ready(OFFBOARD)
    for _ in range(6):
        beside_in_offboard(wire)
    assert phase_of(wire) in IN_CONTROL
    assert own_id_of(wire) == 191
    assert any("another companion sends as 1/191" in text for text in wire.journal.texts)


def beside_in_offboard(wire: Wire) -> None:
    """A second in control next to MAVROS."""
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    wire.bytes(MavCodec(1, 191).encode(MAVROS_HEARTBEAT))
    for _ in range(20):
        wire.wait(0.05)
        wire.say(wire.position())


def test_a_second_companion_under_another_id_is_a_conflict_too() -> None:
    wire = Wire().ready()
    twin = Twin(wire)
    twin.codec = MavCodec(1, 192)
    twin.beside(4.0)
    assert own_id_of(wire) == 191
    assert phase_of(wire) is Phase.WAITING


def test_a_companion_with_a_neighbour_shows_that_it_is_one() -> None:
    wire = Wire().ready()
    wire.wait(2.0)
    assert wire.of(mavlink.MAVLink_named_value_float_message) == []
    beside_another_kind(wire, 4.0, 193)
    marks = wire.of(mavlink.MAVLink_named_value_float_message)
    assert {message.value for message in marks} == {191.0}
    assert 3 <= len(marks) <= 5
