"""HEARTBEATs are lost right after the pilot chose another mode: that gives no control back."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.guidance.phases import IN_CONTROL
from companion.guidance.vehicle import MODE_UNKNOWN_AFTER_S
from sim_link.autopilot.scenario import FlavourName
from sim_link.lab.faults.fault_models import StreamMute
from tests.loop.test_other_vehicles import FLAVOURS, SLOW, in_control


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("lost_s", [2.5, SLOW(8.0), MODE_UNKNOWN_AFTER_S + 5.0])
def test_heartbeats_lost_after_a_mode_switch_give_no_control_back(
    flavour: FlavourName, lost_s: float
) -> None:
    sky = in_control(flavour)
    sky.injector.add(StreamMute(message="HEARTBEAT", duration_s=lost_s))
    sky.run(0.1)
    sky.choose(FlightMode.HOLD)
    began_s = sky.now_s
    sky.run(lost_s + 2.0)
    assert sky.phase not in IN_CONTROL
    assert sky.mode is FlightMode.HOLD
    for _ in range(20):
        sky.run(0.5)
        assert sky.phase not in IN_CONTROL
    assert [number for at, number in sky.commands if at > began_s and number == 176] == []
    sky.give()
    assert sky.phase in IN_CONTROL, sky.notes.texts
