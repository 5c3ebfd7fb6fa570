from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest

from tools.benches.filter_bench import (
    FILTERPY_PREDICT,
    FILTERPY_UPDATE,
    LOOP,
    OBJECT,
    SYSTEM,
    Walk,
    print_filters,
    print_times,
    retraced,
    seconds_of,
    verdicts_of,
)
from tools.study.case import Case
from tools.study.trials import run_trial

COSTS_US = {FILTERPY_PREDICT: 4.0, FILTERPY_UPDATE: 16.0, LOOP: 2.0, OBJECT: 48.0}


@pytest.fixture
def walk() -> Walk:
    return Walk.of(Case(), SYSTEM)


def test_limits_are_met_at_their_value() -> None:
    verdicts = verdicts_of(COSTS_US, COSTS_US)
    assert [verdict.partition("; ")[2] for verdict in verdicts] == [
        "limit 0.1 x: met",
        "limit 3 x: met",
    ]
    assert "2.00 us, 0.100 x filterpy predict + filterpy update (20.00 us)" in verdicts[0]


def test_without_numba_only_plain_python_is_judged() -> None:
    (verdict,) = verdicts_of(None, {**COSTS_US, OBJECT: 49.0})
    assert verdict.startswith("plain")
    assert verdict.endswith("NOT MET")


def test_the_loop_ends_where_the_studies_walk_does(walk: Walk) -> None:
    trial = run_trial(Case(), SYSTEM, 1)
    mean, _ = retraced(walk.track_enu_m, walk.z, walk.picks, walk.belief, walk.steering)
    np.testing.assert_allclose(mean[:2], trial.estimates_enu_m[-1], rtol=1e-9)


def test_everything_is_timed(walk: Walk) -> None:
    costs_us = seconds_of(walk, rounds=1)
    assert set(COSTS_US) == set(costs_us)
    assert all(cost > 0.0 for cost in costs_us.values())


@pytest.mark.skipif(importlib.util.find_spec("numba") is not None, reason="would compile")
def test_without_numba_the_bench_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    print_filters(rounds=1)
    said = capsys.readouterr().out
    assert "no numba" in said
    assert said.splitlines()[-1].startswith("plain")


def test_the_other_process_answers_in_json(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_times(1)
    assert OBJECT in json.loads(capsys.readouterr().out)
