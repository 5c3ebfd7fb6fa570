"""A search on each kind of link that PX4 has, with its rates and one peer."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.link.inbound import UNREAD
from companion.link.interface import LinkParams
from companion.mav.codec import message_id
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.addressing import LinkMode, LinkSetup
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight, Makers, MemoryJournal
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import AUTO, run_until, said

STOPPING = msgspec.structs.replace(AUTO, link=LinkParams(stop_unread_streams=True))
LINKS: tuple[LinkMode, ...] = ("station", "narrow")


@pytest.mark.slow
@pytest.mark.parametrize("mode", LINKS)
def test_a_search_ends_on_every_kind_of_link(mode: LinkMode) -> None:
    def switch_on(scenario: Scenario, seed: int, now_s: float) -> SimEndpoint:
        return SimEndpoint(scenario, seed, now_s, [LinkSetup(mode, has_one_peer=True)])

    notes = MemoryJournal()
    flight = Flight(AUTO, Scenario(), 1, notes, makers=Makers(simulator=switch_on))
    run_until(flight, lambda: bool(notes.results), 180.0)
    flight.run(5.0)
    assert flight.sim.vehicle.flavour.mode is FlightMode.HOLD
    (_, result) = notes.results[0]
    truth = flight.scenario.emitter.position_enu_m
    assert math.dist(result.estimate.position_enu_m[:2], truth) < 5.0
    assert not said(notes, "hold: vehicle position is stale")


class UnreadFrames(Observer):
    """Counter of the autopilot's frames that the companion does not read."""

    def __init__(self) -> None:
        self.count = 0

    def vehicle_sent(self, frame: Frame) -> None:
        self.count += message_id(frame.data) in UNREAD


@pytest.mark.parametrize(("config", "least", "most"), [(AUTO, 1500, 2500), (STOPPING, 0, 0)])
def test_unread_streams_stop_only_where_that_is_configured(
    config: CompanionConfig, least: int, most: int
) -> None:
    flight = Flight(config, Scenario(), 1, MemoryJournal())
    flight.run(5.0)
    unread = UnreadFrames()
    flight.observers.append(unread)
    flight.run(10.0)
    assert least <= unread.count <= most
