"""Cursor on Target over loopback: when an event goes out, how often, and what it says."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from xml.etree import ElementTree as ET

import pytest

from companion.domain import EstimateState, TargetEstimate
from companion.errors import ConfigError, LinkError
from companion.guidance.session import EmitterStatus
from companion.view.cot import CotRule, CotView, cot_address
from sim_link.lab.lockstep import Flight
from tests.loop.loop_helpers import Loop

ESTIMATE = TargetEstimate(
    0.0, EstimateState.LOCALISED, (10.0, 20.0), ((1.0, 0.0), (0.0, 1.0)), 5.0, 0.0, 0.0, 50
)
VAGUE = replace(ESTIMATE, state=EstimateState.SEARCHING, r95_m=60.0)


def emitter(estimate: TargetEstimate | None, *, is_reported: bool = False) -> EmitterStatus:
    return EmitterStatus(7, estimate, is_current=True, is_reported=is_reported)


def due_times(estimates: list[tuple[float, TargetEstimate]]) -> list[float]:
    rule = CotRule()
    return [time_s for time_s, estimate in estimates if rule.is_due(emitter(estimate), time_s)]


def test_nothing_is_reported_before_an_emitter_is_localised() -> None:
    assert not CotRule().is_due(emitter(None), 0.0)
    assert not CotRule().is_due(emitter(VAGUE), 0.0)
    assert CotRule().is_due(emitter(ESTIMATE), 0.0)
    assert CotRule().is_due(emitter(VAGUE, is_reported=True), 0.0)


def test_what_stays_is_repeated_once_a_minute() -> None:
    assert due_times([(0.5 * n, ESTIMATE) for n in range(300)]) == [0.0, 60.0, 120.0]


def test_what_changes_all_the_time_is_reported_once_a_second() -> None:
    moving = [(0.25 * n, replace(ESTIMATE, position_enu_m=(2.0 * n, 0.0))) for n in range(41)]
    assert due_times(moving) == [float(n) for n in range(11)]


@pytest.mark.parametrize(
    "changed",
    [
        replace(ESTIMATE, position_enu_m=(11.5, 20.0)),
        replace(ESTIMATE, r95_m=3.5),
        replace(ESTIMATE, absolute_r95_m=12.0),
        replace(ESTIMATE, state=EstimateState.AMBIGUOUS),
    ],
    ids=["moved", "narrower", "worse for others", "in doubt"],
)
def test_a_change_that_matters_is_reported(changed: TargetEstimate) -> None:
    little = replace(ESTIMATE, position_enu_m=(10.3, 20.0))
    assert due_times([(0.0, ESTIMATE), (2.0, little), (4.0, changed)]) == [0.0, 4.0]


@pytest.fixture
def team() -> Iterator[socket.socket]:
    """A map of a ground team."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(2.0)
        yield receiver


def received(team: socket.socket) -> list[ET.Element]:
    team.setblocking(False)
    events = []
    while True:
        try:
            events.append(ET.fromstring(team.recv(65_535)))
        except BlockingIOError:
            return events


@pytest.mark.slow
def test_a_flight_leads_a_team_to_the_emitter(team: socket.socket) -> None:
    view = CotView(team.getsockname(), lambda: 1.8e9)
    loop = Loop(seed=1)

    def update(flight: Flight = loop.flight) -> None:
        view.update(flight.companion, flight.now_s)
        flight.at(flight.now_s + 0.1, update)

    loop.flight.at(0.1, update)
    loop.run_until(lambda: loop.companion.session.result is not None, 120.0)
    loop.run(1.5)
    view.close()
    events = received(team)
    assert len(events) == view.sent > 1
    assert view.refused == 0
    assert {event.attrib["uid"] for event in events} == {"companion-1.emitter.1"}
    origin, estimate = loop.companion.session.vehicle.origin, loop.companion.session.estimate
    assert origin is not None
    assert estimate is not None
    point = events[-1].find("point")
    assert point is not None
    degrees = float(point.attrib["lat"]), float(point.attrib["lon"])
    position = origin.enu_from_geodetic(*degrees, origin.altitude_m)
    assert position[:2] == pytest.approx(loop.flight.scenario.emitter.position_enu_m[:2], abs=3.0)
    assert float(point.attrib["ce"]) == pytest.approx(estimate.absolute_r95_m, abs=0.2)
    assert estimate.r95_m < 2.0
    view.update(loop.companion, loop.now_s + 100.0)  # its socket is gone: nothing is raised
    assert view.refused == 1


@pytest.mark.parametrize("text", ["6969", "host", "host:", ":6969", "host:0", "host:70000", "h:x"])
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="must be HOST:PORT"):
        cot_address(text)


def test_an_address_is_read() -> None:
    assert cot_address("239.2.3.1:6969") == ("239.2.3.1", 6969)
    assert cot_address("[::1]:4242") == ("::1", 4242)


def test_a_host_that_does_not_exist_is_a_clear_error() -> None:
    with pytest.raises(LinkError, match=r"--cot nowhere\.invalid:6969: "):
        CotView(("nowhere.invalid", 6969))
