"""A recorded flight, run again: the same to the last bit, and a difference is found."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.config.tunables import Tunables
from companion.estimation.tracker_params import EstimationConfig
from companion.flight_setup import (
    FlightFacts,
    build_endpoint,
    build_planner,
    facts_as_json,
    write_facts,
)
from companion.guidance.commands import SessionParams, Severity
from companion.guidance.emitters import QueueParams
from companion.guidance.events import ProcessMessage
from companion.io.files import EVENTS, FLIGHT, INPUTS, MCAP, TLOG
from companion.io.flight_recorder import FlightJournal
from companion.io.log_files import event_lines
from companion.io.mcap_file import McapLog
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkSpec
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.replay.flight_replay import replay_flight
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import VEHICLE_PEER, Flight, Makers, MemoryJournal
from sim_link.world.environment import EmitterParams
from tools.campaign.checkpointing import Checkpointing

pytestmark = pytest.mark.slow

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
FLOWN_S = 60.0
REMARKS: list[str] = []


def fly(
    journal: FlightJournal,
    config: CompanionConfig,
    scenario: Scenario,
    prepare: Callable[[Flight], None] = lambda _: None,
) -> None:
    """Fly a minute and close the log."""

    def companion(
        config: CompanionConfig, journal_: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        return build_endpoint(config, journal_, links, recorder=journal.inputs)

    flight = Flight(config, scenario, 3, journal, makers=Makers(companion))
    prepare(flight)
    for _ in range(int(FLOWN_S)):
        flight.run(1.0)
        while journal.health.queued > 5_000:  # it flies faster than a busy computer writes
            time.sleep(0.01)
    journal.close(timeout_s=30.0)
    assert journal.health.dropped == 0


def record(directory: Path, config: CompanionConfig, scenario: Scenario | None = None) -> None:
    """Leave a flight directory."""
    write_facts(directory, FlightFacts(started_unix_s=1.8e9, links=1, config=config))
    fly(FlightJournal(directory, 1.8e9), config, scenario or Scenario())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("flight")
    record(directory, AUTO)
    return directory


@pytest.fixture
def copy(recorded: Path, tmp_path: Path) -> Path:
    """The recorded flight, to be tampered with."""
    for path in recorded.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def test_the_same_configuration_gives_the_same_bits(recorded: Path) -> None:
    replay = replay_flight(recorded / TLOG, None, REMARKS.append)
    assert len(replay.recorded.estimates) > 50
    assert len(replay.recorded.setpoints) > 500
    assert replay.first_difference is None
    assert replay.verdict.startswith("IDENTICAL")
    assert not replay.is_failed


def test_a_flight_with_several_emitters_replays_to_the_bit(tmp_path: Path) -> None:
    mission = SessionParams(engage="auto", stop_radius_m=1.9, stop_confirm_s=2.0)
    config = CompanionConfig(mission=mission, emitters=QueueParams(order="nearest"))
    second = EmitterParams(emitter_id=2, position_enu_m=(80.0, 30.0))
    record(tmp_path, config, Scenario(emitters=(second,)))
    replay = replay_flight(tmp_path, None, REMARKS.append)
    assert {e["emitter_id"] for e in replay.recorded.estimates} == {1, 2}
    assert replay.first_difference is None
    both = (replay.recorded.localised_s, replay.replayed.localised_s)
    assert both[0] == pytest.approx(both[1], abs=1e-3)  # of the first one
    handed_over = (tmp_path / "handoff.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in handed_over] == ["emitter 1", "emitter 2"]


def test_another_estimator_is_compared_side_by_side(recorded: Path) -> None:
    config = msgspec.structs.replace(AUTO, estimation=EstimationConfig(kind="ekf"))
    replay = replay_flight(recorded, config, REMARKS.append)
    assert replay.verdict.startswith("another configuration")
    assert not replay.is_failed
    assert "estimates apart" in replay.table()
    assert replay.as_json()["identical"] is False


def test_one_changed_digit_of_the_log_is_found(copy: Path) -> None:
    lines = (copy / EVENTS).read_text().splitlines()
    number = max(i for i, line in enumerate(lines) if '"kind":"estimate"' in line)
    lines[number] = lines[number].replace('"r95_m":', '"r95_m":1', 1)
    (copy / EVENTS).write_text("\n".join(lines) + "\n")
    replay = replay_flight(copy, None, REMARKS.append)
    assert replay.is_failed
    assert replay.verdict.startswith("DIFFERENT")
    assert "r95_m" in replay.verdict


def test_without_the_recorded_inputs_a_replay_is_close_and_says_so(copy: Path) -> None:
    (copy / INPUTS).unlink()
    replay = replay_flight(copy, None, REMARKS.append)
    assert not replay.is_exact
    assert not replay.is_failed
    apart = replay.as_json()["apart_end_m"]
    assert apart is None or float(str(apart)) < 0.5


def test_a_flight_of_other_kernels_is_remarked(copy: Path) -> None:
    facts = msgspec.json.decode((copy / FLIGHT).read_bytes(), type=FlightFacts)
    write_facts(copy, msgspec.structs.replace(facts, is_compiled=not facts.is_compiled))
    remarks: list[str] = []
    replay_flight(copy, None, remarks.append)
    assert "kernels" in remarks[0]


def test_the_facts_keep_the_whole_configuration(recorded: Path) -> None:
    facts = msgspec.json.decode((recorded / FLIGHT).read_bytes(), type=FlightFacts)
    assert facts.config == AUTO


def test_parameters_that_were_changed_before_and_in_flight_are_part_of_it(tmp_path: Path) -> None:
    tunables = Tunables(AUTO, build_planner)
    assert tunables.restore({"CMP_SPEED": 3.0}) == []
    facts = FlightFacts(started_unix_s=1.8e9, links=1, config=AUTO, parameters=tunables.changed)
    write_facts(tmp_path, facts)
    journal = FlightJournal(tmp_path, 1.8e9)
    station = MavCodec(255, 190)

    def companion(
        config: CompanionConfig, journal_: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        inputs = journal.inputs
        return build_endpoint(config, journal_, links, tunables=tunables, recorder=inputs)

    flight = Flight(AUTO, Scenario(), 3, journal, makers=Makers(companion))

    def set_speed(speed_mps: float) -> None:
        change = mavlink.MAVLink_param_set_message(1, 191, b"CMP_SPEED", speed_mps, 9)
        flight.companion.receive(Chunk(0, station.encode(change), VEHICLE_PEER), flight.now_s)

    for at_s, speed_mps in ((17.0, 5.0), (19.0, 9.0), (21.0, 1.5)):
        flight.at(at_s, partial(set_speed, speed_mps))
    flight.run(24.0)
    journal.close(timeout_s=30.0)
    replay = replay_flight(tmp_path, None, REMARKS.append)
    assert replay.verdict.startswith("IDENTICAL")
    assert tunables.changed == {"CMP_SPEED": 1.5}
    changes = [line for line in event_lines(tmp_path / EVENTS) if line["kind"] == "parameter"]
    assert [line["new"] for line in changes] == [5.0, 1.5]
    without = msgspec.structs.replace(facts, parameters={})
    write_facts(tmp_path, without)
    assert replay_flight(tmp_path, None, REMARKS.append).is_failed


def test_a_flight_on_a_computer_that_is_too_slow_replays_to_the_bit(tmp_path: Path) -> None:
    """It stalls, and its process says so by itself, in the middle of the flight."""
    write_facts(tmp_path, FlightFacts(started_unix_s=1.8e9, links=1, config=AUTO))
    journal = FlightJournal(tmp_path, 1.8e9)

    def slow(flight: Flight) -> None:
        def complain() -> None:
            text = "computer too slow: 44 control ticks missed in 10 s"
            flight.companion.handle_event(ProcessMessage(flight.now_s, Severity.WARNING, text))

        for at_s in (18.0, 24.0, 31.0):
            flight.at(at_s, partial(flight.suspend_companion, 0.9))
            flight.at(at_s + 1.5, complain)

    fly(journal, AUTO, Scenario(), slow)
    replay = replay_flight(tmp_path, None, REMARKS.append)
    assert replay.first_difference is None
    assert replay.verdict.startswith("IDENTICAL")
    said = [line["text"] for line in event_lines(tmp_path / EVENTS) if line["kind"] == "text"]
    assert sum("computer too slow" in str(text) for text in said) == 1  # in 30 s
    assert len(replay.recorded.setpoints) > 400
    assert any("control loop stalled" in str(text) for text in said)


def test_a_flight_that_took_up_the_memory_of_a_killed_process_is_the_same(tmp_path: Path) -> None:
    journals: list[FlightJournal] = []

    def companion(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        del journal
        folder = tmp_path / str(len(journals))
        folder.mkdir()
        write_facts(folder, FlightFacts(started_unix_s=1.8e9, links=1, config=config))
        journals.append(FlightJournal(folder, 1.8e9))
        return build_endpoint(config, journals[-1], links, recorder=journals[-1].inputs)

    flight = Flight(AUTO, Scenario(), 3, MemoryJournal(), makers=Makers(companion))
    Checkpointing(flight)
    flight.run(26.0)
    flight.kill_companion()
    flight.run(2.0)
    flight.start_companion()
    flight.run(6.0)
    for journal in journals:
        journal.close(timeout_s=30.0)
    second = replay_flight(tmp_path / "1", None, REMARKS.append)
    assert second.verdict.startswith("IDENTICAL")
    assert second.recorded.estimates
    lines = event_lines(tmp_path / "1" / EVENTS)
    assert [line for line in lines if line["kind"] == "resumed"]


def test_an_mcap_file_alone_is_replayed(tmp_path: Path) -> None:
    facts = FlightFacts(started_unix_s=1.8e9, links=1, config=AUTO)
    write_facts(tmp_path, facts)
    mcap = McapLog(tmp_path / MCAP, 1.8e9, facts_as_json(facts).decode())
    journal = FlightJournal(tmp_path, 1.8e9, mcap=mcap)
    fly(journal, AUTO, Scenario())
    alone = tmp_path / "elsewhere.mcap"
    (tmp_path / MCAP).rename(alone)
    replay = replay_flight(alone, None, REMARKS.append)
    assert replay.verdict.startswith("IDENTICAL")
    assert len(replay.recorded.estimates) > 50
    assert len(replay.recorded.setpoints) > 500
