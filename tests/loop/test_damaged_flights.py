"""A recorded flight with a block of one of its files destroyed: that block is lost, and no more."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from companion.cli import main
from companion.config.schema import CompanionConfig
from companion.errors import EXIT_BAD_INPUT, ConfigError
from companion.estimation.screen import AcceptanceParams
from companion.flight_setup import FlightFacts, build_endpoint, write_facts
from companion.guidance.commands import SessionParams
from companion.io.files import EVENTS, FLIGHT, INPUTS, TLOG
from companion.io.flight_recorder import FlightJournal
from companion.io.log_files import Input, event_lines, read_inputs, read_tlog
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkSpec
from companion.replay.flight_replay import FlightReplay, replay_flight
from companion.report.page import write_report
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight, Makers

pytestmark = pytest.mark.slow

FLOWN_S = 25.0
LOGS = (TLOG, INPUTS, EVENTS)
SIZES = (1, 40, 512, 4096)
"""Sizes of a damaged block: a flipped byte, a record, a sector, a page."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that measured and crossed, with its logs."""
    directory = tmp_path_factory.mktemp("flight")
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    write_facts(directory, FlightFacts(started_unix_s=1.8e9, links=1, config=config))
    journal = FlightJournal(directory, 1.8e9)

    def companion(
        config: CompanionConfig, journal_: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        return build_endpoint(config, journal_, links, recorder=journal.inputs)

    Flight(config, Scenario(), 3, journal, makers=Makers(companion)).run(FLOWN_S)
    journal.close(timeout_s=30.0)
    return directory


def damaged(data: bytes, rng: np.random.Generator) -> tuple[bytes, int]:
    """The same with one block destroyed or everything from there on cut off; where it begins."""
    size = int(rng.choice(SIZES))
    at = int(rng.integers(0, max(1, len(data) - size)))
    end = min(len(data), at + size)
    block = {
        "zeros": bytes(end - at),
        "ones": b"\xff" * (end - at),
        "noise": rng.bytes(end - at),
        "flipped": bytes(byte ^ 0x10 for byte in data[at:end]),
        "digits": b"9" * (end - at),
    }
    kind = str(rng.choice([*block, "cut"]))
    return (data[:at], at) if kind == "cut" else (data[:at] + block[kind] + data[end:], at)


@cache
def inputs_until(path: Path, at: int) -> float:
    """Return the time, s, of the last input that lies whole before a byte; 0: there is none."""
    found: list[Input] = []
    whole = path.parent / f"part-{at}"
    whole.write_bytes(path.read_bytes()[:at])
    try:
        found += read_inputs(whole, lambda _: None)
    except ConfigError:
        return 0.0
    finally:
        whole.unlink()
    return round(found[-1].time_s, 4) if found else 0.0  # as the event log has times


def replayed(directory: Path) -> tuple[FlightReplay, list[str]]:
    said: list[str] = []
    return replay_flight(directory, None, said.append), said


def try_damage(flown: Path, directory: Path, name: str, seed: int) -> None:
    """Report and replay say what is missing, and the replay is the same up to there."""
    shutil.copytree(flown, directory)
    rng = np.random.default_rng((seed, LOGS.index(name)))
    data, at = damaged((flown / name).read_bytes(), rng)
    (directory / name).write_bytes(data)
    write_report(directory)
    replay, said = replayed(directory)
    until_s = inputs_until(flown / name, at) if name == INPUTS else FLOWN_S
    before = [
        line
        for line in event_lines(flown / EVENTS)
        if line["kind"] == "estimate" and float(str(line["t_s"])) < until_s
    ]
    assert replay.replayed.estimates[: len(before)] == before
    assert len(said) <= 2
    assert all(str(directory) in line and "\n" not in line for line in said[-1:])
    if name != EVENTS:  # whose digits have no checksum: another digit is another estimate
        assert replay.verdict.startswith("IDENTICAL")
    if name == INPUTS and data != (flown / name).read_bytes():
        assert said
    shutil.rmtree(directory)


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("seed", range(6))
def test_one_damaged_block_costs_that_block(
    flown: Path, tmp_path: Path, name: str, seed: int
) -> None:
    try_damage(flown, tmp_path / "copy", name, seed)


@pytest.mark.campaign
def test_two_thousand_damaged_blocks_cost_no_flight(flown: Path, tmp_path: Path) -> None:
    for seed in range(2000):
        try_damage(flown, tmp_path / "copy", LOGS[seed % len(LOGS)], seed)


def test_a_lost_page_of_the_inputs_is_reported_and_the_rest_of_the_flight_goes_on(
    flown: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "copy"
    shutil.copytree(flown, directory)
    data = (flown / INPUTS).read_bytes()
    half = len(data) // 2
    (directory / INPUTS).write_bytes(data[:half] + bytes(4096) + data[half + 4096 :])
    replay, said = replayed(directory)
    assert replay.verdict.startswith("IDENTICAL: up to the damaged inputs: ")
    assert not replay.is_failed
    (line,) = [each for each in said if "flight.inputs" in each]
    assert "damaged at record " in line
    assert "the rest is read" in line
    ends_s = [float(str(log.estimates[-1]["t_s"])) for log in (replay.recorded, replay.replayed)]
    # a solution that the end interrupts keeps measurements waiting, for less than makes them stale
    assert abs(ends_s[0] - ends_s[1]) < AcceptanceParams().max_age_s
    assert replay.replayed.whole is not None
    assert 0 < replay.replayed.whole[0] < len(replay.replayed.estimates)


@pytest.mark.parametrize("name", [TLOG, EVENTS])
def test_a_lost_page_of_what_was_recorded_leaves_the_replay_identical(
    flown: Path, tmp_path: Path, name: str
) -> None:
    directory = tmp_path / "copy"
    shutil.copytree(flown, directory)
    data = (flown / name).read_bytes()
    half = len(data) // 2
    (directory / name).write_bytes(data[:half] + bytes(4096) + data[half + 4096 :])
    replay, said = replayed(directory)
    assert replay.verdict.startswith("IDENTICAL")
    assert [name in line for line in said] == [True]
    lost = len(list(read_tlog(flown / TLOG))) - len(
        list(read_tlog(directory / TLOG, lambda _: None))
    )
    assert lost == 0 if name == EVENTS else 0 < lost < 200


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"links": 1e9}, "links"), ({"links": 0}, "links"), ({"gcs_links": -1}, "gcs_links")],
)
@pytest.mark.parametrize("command", ["report", "replay"])
def test_impossible_facts_of_a_flight_are_refused_in_one_line(
    flown: Path,
    tmp_path: Path,
    changes: dict[str, float],
    words: str,
    command: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    directory = tmp_path / "copy"
    shutil.copytree(flown, directory)
    facts = json.loads((flown / FLIGHT).read_text())
    (directory / FLIGHT).write_text(json.dumps({**facts, **changes}))
    assert main([command, str(directory)]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
