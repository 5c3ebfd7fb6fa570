"""Other vehicles of a scenario next to ours on the links of one process."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.mav.codec import MavCodec, sender_of
from companion.mav.dialect import POSITION_ONLY, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import OtherVehicle
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet import load_scenario
from sim_link.neighbours import FleetAmongOthers

PEER = ("127.0.0.1", 14540)


def sky(*others: OtherVehicle, links: int = 2) -> FleetAmongOthers:
    scenario = Scenario(other_vehicles=others)
    return FleetAmongOthers(SimEndpoint(scenario, 1, links=links), scenario, links, links)


def heard(fleet: FleetAmongOthers, since_s: float, until_s: float) -> set[tuple[int, int]]:
    """Links and system ids of what is sent within a time."""
    found, now_s = set(), since_s
    while now_s < until_s:
        fleet.handle_timer(now_s)
        found |= {(chunk.link, sender_of(chunk.data)[0]) for chunk in fleet.take_output()}
        now_s = max(now_s + 1e-6, fleet.next_timer_s())
    return found


def order(system_id: int, link: int, now_s: float) -> Chunk:
    """A companion's setpoint for a system, on a link."""
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        round(now_s * 1e3), system_id, 1, 1, POSITION_ONLY, 5.0, 5.0, -10.0, *(0.0,) * 8
    )
    return Chunk(link, MavCodec(system_id, 191).encode(message), PEER)


def test_those_with_an_address_of_their_own_have_the_links_after_ours() -> None:
    others = OtherVehicle(), OtherVehicle(system_id=3, has_own_address=False), OtherVehicle()
    assert heard(sky(*others), 0.0, 1.5) == {(0, 1), (1, 1), (2, 2), (0, 3), (1, 3), (3, 2)}


def test_they_come_and_go() -> None:
    fleet = sky(OtherVehicle(start_s=2.0, duration_s=1.5))
    systems = [{system for _, system in heard(fleet, s, s + 1.0)} for s in (0.5, 2.1, 4.0)]
    assert systems == [{1}, {1, 2}, {1}]
    assert [each.setup.system_id for each in fleet.others] == [2]


@pytest.mark.parametrize(
    ("link", "has_own_address", "reached"),
    [(0, True, 0), (2, True, 1), (0, False, 1), (1, False, 1)],
)
def test_what_is_sent_to_its_address_reaches_it(
    link: int, has_own_address: bool, reached: int
) -> None:
    fleet = sky(OtherVehicle(system_id=1, has_own_address=has_own_address))
    heard(fleet, 0.0, 1.0)
    fleet.receive(order(1, link, 1.0), 1.0)
    (other,) = fleet.others
    assert other.strange_setpoints == reached
    assert f"other vehicle 1: {reached} setpoints" in other.summary


def test_a_setpoint_to_another_id_is_not_its() -> None:
    fleet = sky(OtherVehicle(system_id=2))
    heard(fleet, 0.0, 1.0)
    fleet.receive(order(1, 2, 1.0), 1.0)
    assert fleet.others[0].strange_setpoints == 0


def test_a_scenario_file_may_list_them(tmp_path: Path) -> None:
    path = tmp_path / "sky.yaml"
    path.write_text("other_vehicles: [{system_id: 1, has_own_address: false, uptime_s: 20}]\n")
    (other,) = load_scenario(path).other_vehicles
    assert (other.system_id, other.has_own_address, other.uptime_s) == (1, False, 20.0)
    path.write_text("other_vehicles: [{system_id: 0}]\n")
    with pytest.raises(ConfigError, match="system_id"):
        load_scenario(path)
