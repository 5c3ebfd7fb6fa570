"""Twenty flights, as recorded and flown here, run again: every estimate and setpoint bit by bit."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import pytest

from companion.estimation.tracker_params import EstimationConfig
from companion.kernel import IS_COMPILED
from companion.replay.flight_replay import replay_flight
from tests.loop.golden_flights import (
    FOLDER,
    PLANS,
    SUFFIX,
    GoldenOutput,
    fly,
    load,
    load_outputs,
    replayed,
)

HOW = "if the change is meant: python -m tools.update_golden"
MAX_BYTES = 3_000_000
APART_M = 0.05


EVERY_DAY = {"px4", "ardupilot"}
"""Run again by `make test`, too."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in EVERY_DAY else pytest.mark.slow) for name in PLANS],
)
def test_a_golden_flight_is_run_again_bit_by_bit(name: str) -> None:
    was, now = load_outputs()[name], GoldenOutput.of(replayed(load(FOLDER / f"{name}{SUFFIX}")))
    assert (now.estimates, now.setpoints) == (was.estimates, was.setpoints), HOW
    for before, after in zip(was.samples, now.samples, strict=True):
        assert math.dist(before, after) < APART_M, f"at {before[0]} s; {HOW}"
    if was.is_of_this_arithmetic and not IS_COMPILED:
        assert now.estimates_digest == was.estimates_digest, HOW
        assert now.setpoints_digest == was.setpoints_digest, HOW


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANS)
def test_a_flight_of_each_kind_that_is_flown_here_replays_to_the_bit(
    name: str, tmp_path: Path
) -> None:
    """On every machine, however it rounds."""
    fly(PLANS[name], tmp_path)
    replay = replay_flight(max(tmp_path.iterdir()), None, lambda _: None)
    assert len(replay.recorded.estimates) > 50
    assert replay.first_difference is None
    assert replay.verdict.startswith("IDENTICAL")


def test_there_are_as_many_as_planned_and_they_are_small() -> None:
    files = sorted(FOLDER.glob(f"*{SUFFIX}"))
    assert [file.name.removesuffix(SUFFIX) for file in files] == sorted(PLANS)
    assert sum(file.stat().st_size for file in files) < MAX_BYTES


@pytest.mark.slow
def test_another_estimator_is_noticed() -> None:
    golden = load(FOLDER / f"px4{SUFFIX}")
    config = msgspec.structs.replace(golden.facts.config, estimation=EstimationConfig(kind="ekf"))
    facts = msgspec.structs.replace(golden.facts, config=config)
    output = GoldenOutput.of(replayed(msgspec.structs.replace(golden, facts=facts)))
    assert output.estimates_digest != load_outputs()["px4"].estimates_digest
