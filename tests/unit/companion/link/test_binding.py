from __future__ import annotations

import pytest

from companion.domain import Autopilot
from companion.link.intake import AutopilotBinding
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import ARDUPILOT, NOBODY, PEER, PX4, STRANGER, heartbeat


def from_system(message: Message, system: int = 1, component: int = 1) -> Message:
    (received,) = MavCodec(9, 9).decode(MavCodec(system, component).encode(message))
    return received


ATTITUDE = from_system(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))


def bound() -> AutopilotBinding:
    binding = AutopilotBinding()
    assert binding.recognise(from_system(heartbeat()), PEER, 10.0)
    return binding


@pytest.mark.parametrize(("system", "component"), [(255, 190), (1, 158), (1, 191), (7, 100)])
def test_stations_and_payloads_do_not_bind(system: int, component: int) -> None:
    binding = AutopilotBinding()
    assert not binding.recognise(from_system(heartbeat(NOBODY), system, component), PEER, 0.0)
    assert not binding.is_bound


def test_nothing_but_a_heartbeat_binds() -> None:
    binding = AutopilotBinding()
    assert not binding.recognise(ATTITUDE, PEER, 0.0)
    assert not binding.is_bound


@pytest.mark.parametrize(
    ("number", "kind"),
    [(PX4, Autopilot.PX4), (ARDUPILOT, Autopilot.ARDUPILOT), (0, Autopilot.OTHER)],
)
def test_the_first_autopilot_binds_for_good(number: int, kind: Autopilot) -> None:
    binding = AutopilotBinding()
    assert binding.recognise(from_system(heartbeat(number), 4, 1), PEER, 0.0)
    assert (binding.system_id, binding.autopilot, binding.peer) == (4, kind, PEER)
    assert not binding.recognise(from_system(heartbeat(PX4), 5, 1), PEER, 1.0)
    assert not binding.recognise(from_system(heartbeat(PX4), 4, 2), PEER, 1.0)
    assert binding.system_id == 4


def test_only_the_wanted_system_binds() -> None:
    binding = AutopilotBinding(wanted_system_id=3)
    assert not binding.recognise(from_system(heartbeat(), 1), PEER, 0.0)
    assert binding.recognise(from_system(heartbeat(), 3), PEER, 0.0)


@pytest.mark.parametrize(("silence_s", "is_believed"), [(0.1, False), (2.9, False), (3.0, True)])
def test_an_address_is_taken_over_only_after_silence(silence_s: float, is_believed: bool) -> None:
    binding = bound()
    assert binding.recognise(ATTITUDE, STRANGER, 10.0 + silence_s) == is_believed
    assert binding.peer == (STRANGER if is_believed else PEER)
    assert binding.unknown_senders == (0 if is_believed else 1)


def test_a_stranger_does_not_keep_the_link_alive() -> None:
    binding = bound()
    binding.recognise(ATTITUDE, STRANGER, 12.0)
    assert binding.heard_s == 10.0
