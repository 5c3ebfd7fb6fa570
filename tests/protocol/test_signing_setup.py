"""SETUP_SIGNING: a key that arrives while flying unsigned (MAVLink guide, Message Signing)."""

from __future__ import annotations

import pytest

from companion.mav.dialect import mavlink
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.link_layer import LinkSecurity
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.conformance.mavlink_oracle import signature_of
from sim_link.lab.conformance.rules import Flavour
from sim_link.lab.conformance.station import Signer
from sim_link.lab.conformance.vehicle_probe import VehicleProbe
from tests.protocol.conformance_rigs import KEY, SEED
from tests.protocol.memory_link import MemoryHub

FLAVOURS = pytest.mark.parametrize("flavour", list(Flavour), ids=lambda flavour: flavour.value)
TIMESTAMP = 50_000_000_000


WIRE, RADIO = 0, 1
"""A trusted link inside the vehicle, and one that others can hear."""


def clients(flavour: Flavour) -> tuple[VehicleProbe, VehicleProbe]:
    """A client on the wire and one on the radio."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour.value))
    hub = MemoryHub(
        SimEndpoint(scenario, SEED, links=2, security=LinkSecurity(trusted_links=frozenset({WIRE})))
    )
    wire, radio = VehicleProbe(hub.connect(WIRE)), VehicleProbe(hub.connect(RADIO))
    wire.attach()
    radio.attach()
    return wire, radio


def set_up(probe: VehicleProbe, key: bytes, target: tuple[int, int] | None = None) -> None:
    probe.send(
        mavlink.MAVLink_setup_signing_message(*(target or probe.target), list(key), TIMESTAMP)
    )


def is_signing(probe: VehicleProbe) -> bool:
    """Return True if messages are signed with the key, from the next one on."""
    mark = probe.mark
    probe.run(1.0)
    signatures = [
        signature_of(entry.frame, KEY)
        for entry in probe.inbox[mark:]
        if entry.source == probe.target
    ]
    assert signatures
    return all(signature is not None and signature.is_right for signature in signatures)


@FLAVOURS
def test_a_key_from_the_wire_signs_everything_at_once(flavour: Flavour) -> None:
    wire, radio = clients(flavour)
    set_up(wire, KEY)
    assert is_signing(radio)
    assert not radio.is_alive()
    radio.signer = Signer(KEY, 2 * TIMESTAMP)
    assert radio.is_alive()


@FLAVOURS
def test_a_key_of_zeros_ends_signing(flavour: Flavour) -> None:
    wire, radio = clients(flavour)
    set_up(wire, KEY)
    set_up(wire, bytes(32))
    assert not is_signing(radio)
    assert radio.is_alive()


@FLAVOURS
def test_a_key_over_the_radio_is_not_taken(flavour: Flavour) -> None:
    _, radio = clients(flavour)
    set_up(radio, KEY)
    assert not is_signing(radio)
    assert radio.is_alive()


@FLAVOURS
@pytest.mark.parametrize("target", [(77, 1), (1, 77), (0, 0)])
def test_a_key_for_another_system_or_for_all_is_not_taken(
    flavour: Flavour, target: tuple[int, int]
) -> None:
    wire, radio = clients(flavour)
    set_up(wire, KEY, target)
    assert radio.is_alive()
