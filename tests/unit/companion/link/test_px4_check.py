from __future__ import annotations

import struct

import pytest

from companion.domain import Autopilot
from companion.link.autopilot_fence import PARAMETER, RC_BIT, WARNING, Px4FailsafeCheck
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import ARDUPILOT, Wire, heartbeat


def name_of(request: mavlink.MAVLink_param_request_read_message) -> str:
    name: bytes | str = request.param_id
    return (name.decode() if isinstance(name, bytes) else name).rstrip("\x00")


Request = mavlink.MAVLink_param_request_read_message


def parameter(value: int, name: str = PARAMETER) -> Message:
    """PARAM_VALUE as PX4 sends an INT32: its bytes in the float."""
    (as_float,) = struct.unpack("<f", struct.pack("<i", value))
    return mavlink.MAVLink_param_value_message(name.encode(), as_float, 6, 900, 17)


def sys_status(*, has_rc: bool) -> Message:
    bits = RC_BIT if has_rc else 0
    return mavlink.MAVLink_sys_status_message(bits, bits, bits, 0, 0, -1, -1, 0, 0, 0, 0, 0, 0)


def over_the_wire(message: Message) -> Message:
    return MavCodec(9, 9).decode(MavCodec(1, 1).encode(message))[0]


@pytest.mark.parametrize(
    ("action", "has_rc", "warned"),
    [(0, False, True), (0, True, False), (3, False, False), (5, False, False)],
)
def test_only_the_default_without_an_rc_deserves_a_warning(
    action: int, has_rc: bool, warned: bool
) -> None:
    check = Px4FailsafeCheck()
    assert check.receive(over_the_wire(parameter(action))) is None
    assert check.receive(over_the_wire(sys_status(has_rc=has_rc))) == (WARNING if warned else None)
    assert check.receive(over_the_wire(sys_status(has_rc=has_rc))) is None


def test_another_parameter_says_nothing() -> None:
    check = Px4FailsafeCheck()
    check.receive(over_the_wire(parameter(0, "COM_OF_LOSS_T")))
    assert check.receive(over_the_wire(sys_status(has_rc=False))) is None


def test_an_autopilot_that_does_not_answer_is_asked_three_times() -> None:
    check = Px4FailsafeCheck()
    asked = [check.due(0.5 * tick, Autopilot.PX4, (1, 1)) for tick in range(100)]
    assert len([message for message in asked if message is not None]) == 3
    answered = Px4FailsafeCheck()
    answered.receive(over_the_wire(parameter(5)))
    assert answered.due(0.0, Autopilot.PX4, (1, 1)) is None


def test_ardupilot_is_not_asked() -> None:
    wire = Wire()
    wire.say(heartbeat(ARDUPILOT))
    wire.wait(10.0)
    assert PARAMETER not in {name_of(request) for request in wire.of(Request)}


def test_the_warning_reaches_the_operator() -> None:
    wire = Wire()
    wire.say(heartbeat())
    wire.wait(2.0)
    (request, *_) = wire.of(Request)
    assert (request.target_system, request.target_component) == (1, 1)
    wire.say(parameter(0))
    texts = wire.say(sys_status(has_rc=False))
    assert any("COM_OBL_RC_ACT" in text for text in wire.journal.texts)
    assert all(isinstance(m, mavlink.MAVLink_statustext_message) for m in texts)
