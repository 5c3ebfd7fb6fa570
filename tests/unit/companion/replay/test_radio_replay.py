"""A flight keeps the radio's own bytes, and its replay decodes them again, also otherwise."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import pytest

from companion.config.radios import RadioConfig
from companion.config.schema import CompanionConfig
from companion.flight_setup import FlightFacts, build_endpoint, write_facts
from companion.io.files import INPUTS
from companion.io.flight_recorder import FlightJournal
from companion.io.log_files import read_inputs
from companion.mav.endpoint import Chunk
from companion.replay.flight_replay import FlightReplay, replay_flight
from tests.unit.companion.link.wire import HOLD, Wire, heartbeat, local_position

pytestmark = pytest.mark.slow

EMITTER_ENU_M = (40.0, 30.0, 0.0)
OFFSET_M = 27.0
RADIO = RadioConfig(name="ndjson", url="serial:/dev/null", settings={"range_offset_m": OFFSET_M})
CONFIG = CompanionConfig(radios=(RADIO,))


def line_of(position_enu_m: tuple[float, float, float], now_s: float) -> bytes:
    """Return the radio's line at a position: its range is 27 m too long, its clock its own."""
    said_m = math.dist(position_enu_m, EMITTER_ENU_M) + OFFSET_M
    line = {"emitter_id": "tag", "time_usec": round(1e6 * (now_s + 500.0)), "range": said_m}
    return json.dumps(line).encode() + b"\n"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight past the emitter, whose radio is unplugged in the middle of a line and back."""
    directory = tmp_path_factory.mktemp("flight")
    facts = FlightFacts(started_unix_s=1.8e9, links=2, config=CONFIG)
    write_facts(directory, facts)
    journal = FlightJournal(directory, 1.8e9)
    wire = Wire()
    wire.endpoint = build_endpoint(CONFIG, journal, facts.link_specs(), recorder=journal.inputs)
    wire.ready()
    for step in range(160):
        wire.wait(0.25)
        position = (0.4 * step, 20.0 * math.sin(0.1 * step), 20.0)
        boot_ms = round(1e3 * wire.now_s)
        wire.say(local_position(boot_ms, position[1], position[0], -position[2], 0.0, 0.0, 0.0))
        if step % 4 == 0:
            wire.say(heartbeat(custom_mode=HOLD, is_armed=True, status=4))
        line = line_of(position, wire.now_s)
        pieces = (line[:9], b"") if step == 80 else (line[:9], line[9:])
        for piece in pieces:
            wire.endpoint.receive(Chunk(1, piece, is_datagram=False), wire.now_s)
    journal.close(timeout_s=30.0)
    return directory


def position_of(replay: FlightReplay) -> tuple[float, float]:
    position = replay.replayed.estimates[-1]["position_enu_m"]
    assert isinstance(position, list)
    return (position[0], position[1])


def test_the_log_has_the_very_bytes_and_where_the_line_was_lost(recorded: Path) -> None:
    raw = [value.data for value in read_inputs(recorded / INPUTS) if value.link == 1]
    assert raw[0].startswith(b'{"emitte')
    assert raw.count(b"") == 1
    assert len(raw) == 320


def test_the_same_settings_give_the_same_bits(recorded: Path) -> None:
    replay = replay_flight(recorded, None, lambda _: None)
    assert len(replay.recorded.estimates) > 50
    assert replay.verdict.startswith("IDENTICAL")
    assert math.dist(position_of(replay), EMITTER_ENU_M[:2]) < 2.0


def test_a_configuration_that_says_nothing_of_the_radio_leaves_it_as_it_flew(
    recorded: Path,
) -> None:
    replay = replay_flight(recorded, CompanionConfig(), lambda _: None)
    assert replay.is_same_configuration
    assert replay.is_identical


def test_other_settings_decode_the_same_bytes_again(recorded: Path) -> None:
    settings = {"range_offset_m": OFFSET_M - 12.0, "emitters": {"tag": 9}}
    other = RadioConfig(name="ndjson", settings=settings)
    config = msgspec.structs.replace(CONFIG, radios=(other,))
    replay = replay_flight(recorded, config, lambda _: None)
    assert not replay.is_same_configuration
    assert not replay.is_failed
    assert {line["emitter_id"] for line in replay.replayed.estimates} == {9}
    differences = zip(replay.recorded.estimates, replay.replayed.estimates, strict=False)
    before, after = next(differences)
    assert before["t_s"] == after["t_s"]
    assert before["position_enu_m"] != after["position_enu_m"]
