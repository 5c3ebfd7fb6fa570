"""From wishes to vehicles and files: a signing key that a client sets up."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.io.links.transports import parse_transport
from companion.io.state_directory import load_signing_key, store_signing_key
from companion.mav.codec import MavCodec, sender_of
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import SigningKey
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet import FleetFiles, FleetOptions, make_vehicles

OLD, NEW = bytes(range(1, 33)), bytes(range(33, 65))
UDP, LINE = 0, 1


def wishes(signing_key: Path | None) -> FleetOptions:
    return FleetOptions(
        Scenario(),
        seed=1,
        speed=1.0,
        listen=("127.0.0.1", 14580),
        send_to=(),
        links=((parse_transport("pty:/tmp/vehicle"), None),),
        signing_key=signing_key,
    )


def set_up(wanted: FleetOptions, key: bytes, link: int) -> None:
    """A client sets up a key over a link, and the files are kept."""
    (endpoint,) = make_vehicles(wanted)
    files = FleetFiles(wanted, [endpoint])
    message = mavlink.MAVLink_setup_signing_message(1, 1, list(key), 0)
    frame = MavCodec(255, 190).encode(message)
    endpoint.receive(Chunk(link, frame, is_datagram=link == UDP), 0.0)
    files.keep(0.0)


def answers(endpoint: SimEndpoint) -> list[bytes]:
    """Return the autopilot's own frames; unproved frames are passed on all the same."""
    return [chunk.data for chunk in endpoint.take_output() if sender_of(chunk.data) == (1, 1)]


def key_file(folder: Path) -> Path:
    path = folder / "signing.key"
    store_signing_key(path, SigningKey(OLD))
    return path


def test_a_key_that_is_set_up_over_a_line_is_there_at_the_next_start(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    set_up(wishes(path), NEW, LINE)
    assert load_signing_key(path).secret == NEW


def test_a_key_from_a_link_that_others_hear_is_not_stored(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    set_up(wishes(path), NEW, UDP)
    assert load_signing_key(path).secret == OLD


def test_the_end_of_signing_lasts_until_another_key_is_set_up(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    set_up(wishes(path), bytes(32), LINE)
    (endpoint,) = make_vehicles(wishes(path))
    assert endpoint.links.signing is None
    set_up(wishes(path), NEW, LINE)
    assert load_signing_key(path).secret == NEW


def test_a_companion_refuses_the_file_of_a_vehicle_whose_signing_ended(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    set_up(wishes(path), bytes(32), LINE)
    with pytest.raises(ConfigError, match=r"signing\.key"):
        load_signing_key(path)


def test_a_key_from_loopback_makes_loopback_need_signatures() -> None:
    (endpoint,) = make_vehicles(wishes(None))
    setup = mavlink.MAVLink_setup_signing_message(1, 1, list(NEW), 0)
    ping = mavlink.MAVLink_timesync_message(0, 42)
    station = MavCodec(255, 190)
    endpoint.receive(Chunk(UDP, station.encode(setup), ("127.0.0.1", 1)), 0.0)
    endpoint.take_output()
    endpoint.receive(Chunk(UDP, station.encode(ping), ("127.0.0.1", 1)), 0.0)
    assert not answers(endpoint)
    endpoint.receive(Chunk(LINE, station.encode(ping), None, is_datagram=False), 0.0)
    assert answers(endpoint)


def test_without_a_file_nothing_is_written(tmp_path: Path) -> None:
    set_up(wishes(None), NEW, LINE)
    assert list(tmp_path.iterdir()) == []
