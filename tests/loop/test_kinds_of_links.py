"""A search on each kind of link that PX4 has, with its rates and one peer."""

from __future__ import annotations

import math

import pytest

from companion.domain import FlightMode
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.addressing import LinkMode, LinkSetup
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep.flight import Flight, Makers, MemoryJournal
from tests.loop.loop_helpers import AUTO, run_until, said

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
    assert not said(notes, "hold: own position is stale")
