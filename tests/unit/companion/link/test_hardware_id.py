"""The hardware id of an autopilot: asked for a few times, kept, and compared."""

from __future__ import annotations

import pytest

from companion.link.identity import MAX_REQUESTS, HardwareId, uid_of
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink


def version(uid: int = 0, uid2: bytes = bytes(18)) -> Message:
    nothing = [0] * 8
    message = mavlink.MAVLink_autopilot_version_message(
        0, 0, 0, 0, 0, nothing, nothing, nothing, 0, 0, uid, list(uid2)
    )
    (decoded,) = MavCodec(9, 9).decode(MavCodec(1, 1).encode(message), is_datagram=True)
    return decoded


@pytest.mark.parametrize(
    ("message", "uid"),
    [
        (version(), None),
        (version(uid=0xABC), "0000000000000abc"),
        (version(uid=0xABC, uid2=bytes(range(18))), bytes(range(18)).hex()),
        (mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), None),
    ],
)
def test_the_longer_id_counts_and_zero_is_none(message: Message, uid: str | None) -> None:
    assert uid_of(message) == uid


def test_an_autopilot_that_does_not_answer_is_asked_a_few_times() -> None:
    hardware = HardwareId()
    asked = [hardware.is_due(0.05 * tick) for tick in range(400)]
    assert sum(asked) == MAX_REQUESTS


def test_an_answer_ends_the_asking_until_there_is_a_cause() -> None:
    hardware = HardwareId()
    assert hardware.is_due(0.0)
    assert not hardware.differs("a", 1.0)
    assert not hardware.is_due(10.0)
    hardware.ask_again()
    assert hardware.is_due(20.0)
    assert hardware.differs("b", 21.0)
    assert (hardware.uid, hardware.heard_s) == ("a", 1.0)
    assert hardware.is_due(22.0)
