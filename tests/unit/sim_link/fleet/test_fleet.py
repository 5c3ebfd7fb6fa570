"""Several vehicles behind one shell, and the weather around one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ConfigError
from companion.io.links.transports import TcpFanOut, UdpFanOut, parse_transport
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.fleet import Fleet, FleetOptions, link_specs, make_vehicles, numbered_path
from sim_link.world.environment import EmitterParams
from sim_link.world.point_mass import MulticopterParams, PointMass, WindParams
from tests.protocol.sim_helpers import GroundStation

SEND_TO = (("127.0.0.1", 14550), ("127.0.0.1", 14540))


def wishes(vehicles: int = 3, *links: str) -> FleetOptions:
    urls = tuple((parse_transport(link), None) for link in links)
    scenario = Scenario(vehicles=vehicles)
    return FleetOptions(scenario, 1, 1.0, ("127.0.0.1", 14580), SEND_TO, urls)


def test_px4_has_a_port_for_stations_and_one_for_companions() -> None:
    wanted = wishes(3, "tcpin:127.0.0.1:5760")
    assert [e.vehicle.system_id for e in make_vehicles(wanted)] == [1, 2, 3]
    assert link_specs(wanted, 2) == [
        UdpFanOut("127.0.0.1", 14582, (("127.0.0.1", 14542),)),
        UdpFanOut("127.0.0.1", 18572, (("127.0.0.1", 14550),)),
        TcpFanOut("127.0.0.1", 5762),
    ]


def test_ardupilot_has_one_port_for_all() -> None:
    scenario = Scenario(vehicles=3, autopilot=AutopilotParams(flavour="ardupilot"))
    wanted = dataclasses.replace(wishes(3), scenario=scenario)
    remotes = (("127.0.0.1", 14550), ("127.0.0.1", 14542))
    assert link_specs(wanted, 2) == [UdpFanOut("127.0.0.1", 14582, remotes)]


@pytest.mark.parametrize("is_shared", [False, True])
def test_a_port_of_px4_answers_whom_it_heard_first(is_shared: bool) -> None:
    wanted = dataclasses.replace(wishes(1), shares_ports=is_shared)
    (sim,) = make_vehicles(wanted)
    codec = MavCodec(255, 190)
    for port in (50_001, 50_002):
        ping = codec.encode(mavlink.MAVLink_ping_message(0, port, 0, 0))
        sim.receive(Chunk(0, ping, ("127.0.0.1", port)), 0.0)
    sim.handle_timer(0.0)
    peers = {chunk.peer for chunk in sim.take_output() if chunk.link == 0}
    assert peers == {None if is_shared else ("127.0.0.1", 50_001)}


def test_a_line_serves_one_vehicle_only() -> None:
    with pytest.raises(ConfigError, match="one vehicle only"):
        link_specs(wishes(2, "pty:/tmp/vehicle"), 0)


def test_files_are_numbered_from_the_second_vehicle_on() -> None:
    assert [str(numbered_path(Path("a/r.json"), n)) for n in (0, 1)] == ["a/r.json", "a/r-2.json"]


def test_each_vehicle_has_its_own_links() -> None:
    fleet = Fleet([SimEndpoint(Scenario(system_id=n), n, links=2) for n in (1, 2)], links_each=2)
    arm = mavlink.MAVLink_command_long_message(2, 1, 400, 0, 0.0, *[0.0] * 6)
    fleet.receive(Chunk(3, MavCodec(255, 190).encode(arm), ("127.0.0.1", 1)), 0.0)
    reader = MavCodec(9, 9)
    heard = [(c.link, m) for c in fleet.take_output() for m in reader.decode(c.data)]
    acks = [(link, m) for link, m in heard if m.get_type() == "COMMAND_ACK"]
    assert [(link, m.get_srcSystem()) for link, m in acks] == [(3, 2)]
    fleet.handle_timer(0.0)
    assert {chunk.link for chunk in fleet.take_output()} == {0, 1, 2, 3}


def test_every_link_has_rates_of_its_own() -> None:
    sim, codec = SimEndpoint(Scenario(), 1, links=2), MavCodec(255, 190)
    ask = mavlink.MAVLink_command_long_message(1, 1, 511, 0, 30.0, 1e6, *[0.0] * 5)
    sim.receive(Chunk(1, codec.encode(ask), ("127.0.0.1", 1)), 0.0)
    for step in range(501):
        sim.handle_timer(step * 0.02)
    heard = {0: 0, 1: 0}
    for chunk in sim.take_output():
        if chunk.link == 1 and chunk.peer is None:
            continue  # for those who did not ask
        kinds = [m.get_type() for m in codec.decode(chunk.data)]
        heard[chunk.link] += kinds.count("ATTITUDE")
    assert heard == {0: pytest.approx(500, abs=2), 1: pytest.approx(10, abs=1)}


def test_gusts_have_the_spread_that_was_asked_for() -> None:
    wind = WindParams(east_mps=5.0, gust_sigma_mps=2.0, gust_time_constant_s=1.0, let_through=1.0)
    body = PointMass(MulticopterParams(), wind, (0.0, 0.0, 10.0))
    rng = np.random.default_rng(1)
    speeds = []
    for _ in range(50_000):
        east, north = rng.standard_normal(2).tolist()
        body.blow((east, north), 0.02)
        speeds.append(body.drift_mps)
    expected = float(np.mean(np.hypot(*(rng.normal([[5.0], [0.0]], 2.0, (2, 50_000))))))
    assert float(np.mean(speeds)) == pytest.approx(expected, rel=0.1)


def test_several_emitters_are_heard() -> None:
    others = (EmitterParams(emitter_id=7, position_enu_m=(20.0, 80.0)),)
    station = GroundStation(Scenario(emitters=others))
    station.take_off()
    station.run(5.0)
    reports = station.all(MAVLink_radio_ranging_message, component=158)
    assert {report.emitter_id for report in reports} == {1, 7}
