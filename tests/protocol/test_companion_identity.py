"""A companion takes the system id of its vehicle (MAVLink guide, MAVLink IDs)."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from sim_link.lab.conformance.puppet import CompanionProbe, accept
from sim_link.lab.conformance.rules import Flavour
from sim_link.lab.lockstep import MemoryJournal
from tests.protocol.memory_link import MemoryHub


@pytest.mark.parametrize("system_id", [1, 7, 254])
def test_it_takes_the_system_id_of_its_vehicle(system_id: int) -> None:
    endpoint = build_endpoint(CompanionConfig(), MemoryJournal())
    probe = CompanionProbe(MemoryHub(endpoint).connect(), Flavour.PX4, accept, system_id)
    probe.attach()
    assert probe.companion == (system_id, 191)
    assert all(command.target_system == system_id for command in probe.commands())
    assert probe.commands()
