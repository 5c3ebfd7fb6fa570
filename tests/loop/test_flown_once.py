"""A flight that continues from a copied beginning is the flight that goes on, byte for byte."""

from __future__ import annotations

import pytest

from companion.guidance.phases import IN_CONTROL, Phase
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import AUTO, Loop, flown_once


@flown_once
def searching(flavour: FlavourName) -> Loop:
    loop = Loop(AUTO, Scenario(autopilot=AutopilotParams(flavour=flavour)), seed=6)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    return loop


@pytest.mark.parametrize("flavour", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_copies_and_the_flight_itself_go_on_alike_and_apart(flavour: FlavourName) -> None:
    first, second, third = (searching(flavour) for _ in range(3))
    began = bytearray(third.companion_bytes), bytearray(third.vehicle_bytes)
    for loop in (first, second):
        loop.run(8.0)
    assert (third.companion_bytes, third.vehicle_bytes) == began
    third.run(8.0)
    assert first.phase in IN_CONTROL
    assert len(first.companion_bytes) > len(began[0]) + 100
    assert first.companion_bytes == second.companion_bytes == third.companion_bytes
    assert first.vehicle_bytes == second.vehicle_bytes == third.vehicle_bytes
    assert first.notes.texts == second.notes.texts == third.notes.texts
