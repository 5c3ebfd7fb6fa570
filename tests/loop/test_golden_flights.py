"""Twenty recorded flights, run again: every estimate and every setpoint bit by bit as it was."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.estimation.tracker_params import TrackerParams
from companion.kernel import IS_COMPILED
from tests.loop.golden_flights import (
    FOLDER,
    PLANS,
    SUFFIX,
    estimates_digest,
    load,
    replayed,
    samples_of,
    setpoints_digest,
)

HOW = "if the change is meant: python -m tools.update_golden"
MAX_BYTES = 3_000_000
APART_M = 0.05


@pytest.mark.parametrize("name", PLANS)
def test_a_golden_flight_is_run_again_bit_by_bit(name: str) -> None:
    golden = load(FOLDER / f"{name}{SUFFIX}")
    course = replayed(golden)
    assert len(course.setpoints) == golden.setpoints, HOW
    assert len(course.estimates) == golden.estimates, HOW
    for was, now in zip(golden.samples, samples_of(course), strict=True):
        assert math.dist(was, now) < APART_M, f"at {was[0]} s; {HOW}"
    if golden.is_of_this_arithmetic and golden.facts.is_compiled == IS_COMPILED:
        assert estimates_digest(course) == golden.estimates_digest, HOW
        assert setpoints_digest(course) == golden.setpoints_digest, HOW


def test_there_are_twenty_and_they_are_small() -> None:
    files = sorted(FOLDER.glob(f"*{SUFFIX}"))
    assert [file.name.removesuffix(SUFFIX) for file in files] == sorted(PLANS)
    assert len(files) == 20
    assert sum(file.stat().st_size for file in files) < MAX_BYTES


def test_another_estimator_is_noticed() -> None:
    golden = load(FOLDER / f"px4{SUFFIX}")
    config = msgspec.structs.replace(golden.facts.config, estimation=TrackerParams(kind="ekf"))
    facts = msgspec.structs.replace(golden.facts, config=config)
    course = replayed(msgspec.structs.replace(golden, facts=facts))
    assert estimates_digest(course) != golden.estimates_digest
