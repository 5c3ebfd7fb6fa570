from __future__ import annotations

import pytest

from companion.link.intake import SHIELD_UP_S
from companion.mav.codec import MavCodec
from companion.mav.endpoint import Address
from tests.unit.companion.link.test_authenticity import wire as keyed_wire
from tests.unit.companion.link.wire import PEER, Wire, heartbeat

STRANGER: Address = ("10.0.0.9", 666)


def flooded(wire: Wire) -> Wire:
    """One control tick's worth of a flood."""
    data = MavCodec(1, 1).encode(heartbeat())
    for _ in range(1000):
        wire.bytes(data, peer=STRANGER)
    wire.say(wire.position())
    wire.wait(0.1)
    return wire


def test_without_a_flood_everybody_is_heard() -> None:
    wire = Wire().ready()
    wire.say(heartbeat(), peer=STRANGER)
    wire.wait(0.1)
    assert wire.endpoint.shield.sole_peer(wire.now_s) is None


def test_in_a_flood_only_the_autopilot_is_heard_for_a_while() -> None:
    wire = flooded(Wire().ready())
    assert wire.endpoint.shield.sole_peer(wire.now_s) == PEER
    for _ in range(round(SHIELD_UP_S / 0.1) + 1):
        wire.say(wire.position())
        wire.wait(0.1)
    assert wire.endpoint.shield.sole_peer(wire.now_s) is None


@pytest.mark.parametrize(("is_keyed", "silence_s"), [(False, 3.0), (True, 0.5)])
def test_an_autopilot_that_falls_silent_may_come_back_from_elsewhere(
    is_keyed: bool, silence_s: float
) -> None:
    wire = flooded((keyed_wire() if is_keyed else Wire()).ready())
    heard_s = wire.endpoint.binding.heard_s or 0.0
    assert wire.endpoint.shield.sole_peer(heard_s + 0.49 * silence_s) == PEER
    assert wire.endpoint.shield.sole_peer(heard_s + 0.51 * silence_s) is None


def test_before_an_autopilot_is_bound_everybody_is_heard() -> None:
    wire = Wire()
    data = MavCodec(255, 190).encode(heartbeat(8))
    for _ in range(1000):
        wire.bytes(data, peer=STRANGER)
    wire.wait(0.1)
    assert wire.endpoint.shield.sole_peer(wire.now_s) is None
