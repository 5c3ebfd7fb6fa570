"""Trials that start real processes and time them, so each has the machine to itself."""

from __future__ import annotations

import pytest

from tests.e2e.loaded_flights import FLIGHT_S, LOADS, fly_loaded
from tools.campaign import process_trials
from tools.campaign.flights import Trial
from tools.campaign.runner import run_one

KILLED, STOPPED = 4, 5
"""Seeds: even ones kill, odd ones stop."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", [KILLED, STOPPED])
def test_a_signalled_companion_leaves_nothing_amiss(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    # faster than real time, with plain kernels, needs a core that other tests may be using
    monkeypatch.setattr(process_trials, "SPEED", 1.0)
    outcome = run_one(Trial("signal", seed, 0.2))
    assert outcome.findings == (), outcome.story
    assert outcome.sums["signals"] == 1.0


LOADED_S = 24.0
"""In control from about 14 s on, on a machine that other tests keep busy as well."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LOADS)
def test_setpoints_keep_flowing_under_a_load(name: str) -> None:
    loaded = fly_loaded(name, 1, LOADED_S).loaded
    assert loaded.is_kept, loaded.story
    assert 0.05 <= loaded.gap_s < 0.5, loaded.story


@pytest.mark.campaign
@pytest.mark.parametrize("name", LOADS)
def test_a_whole_flight_under_a_load_finds_its_target_as_well(name: str) -> None:
    compared = fly_loaded(name, 1, FLIGHT_S)
    assert compared.findings == (), compared.loaded.story
