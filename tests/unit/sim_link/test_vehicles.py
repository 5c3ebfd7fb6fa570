"""From wishes to vehicles and files: a signing key that a client sets up."""

from __future__ import annotations

from pathlib import Path

from companion.io.key_file import load_signing_key, store_signing_key
from companion.io.urls import parse_link_url
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import SigningKey
from sim_link.autopilot.scenario import Scenario
from sim_link.vehicles import Files, Wishes, make_vehicles

OLD, NEW = bytes(range(1, 33)), bytes(range(33, 65))
UDP, LINE = 0, 1


def wishes(signing_key: Path | None) -> Wishes:
    return Wishes(
        Scenario(),
        seed=1,
        speed=1.0,
        listen=("127.0.0.1", 14580),
        send_to=(),
        links=(parse_link_url("pty:/tmp/vehicle"),),
        signing_key=signing_key,
    )


def set_up(wanted: Wishes, key: bytes, link: int) -> None:
    """A client sets up a key over a link, and the files are kept."""
    (endpoint,) = make_vehicles(wanted)
    files = Files(wanted, [endpoint])
    message = mavlink.MAVLink_setup_signing_message(1, 1, list(key), 0)
    frame = MavCodec(255, 190).encode(message)
    endpoint.receive(Chunk(link, frame, is_datagram=link == UDP), 0.0)
    files.keep(0.0)


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


def test_the_end_of_signing_leaves_the_file_alone(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    set_up(wishes(path), bytes(32), LINE)
    assert load_signing_key(path).secret == OLD


def test_without_a_file_nothing_is_written(tmp_path: Path) -> None:
    set_up(wishes(None), NEW, LINE)
    assert list(tmp_path.iterdir()) == []
