"""Trials that start real processes and time them, so each has the machine to itself."""

from __future__ import annotations

import pytest

from tools.campaign import process_trials
from tools.campaign.flights import Trial
from tools.campaign.load_trials import FLIGHT_S, LOADS
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
"""In control from some 14 s on, on a machine that other tests keep busy as well."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LOADS)
def test_setpoints_keep_flowing_under_a_load(name: str) -> None:
    outcome = run_one(Trial(name, 1, LOADED_S / FLIGHT_S))
    assert outcome.sums[f"{name}_kept"] == 1.0, outcome.story
    assert 0.05 <= outcome.most[f"{name}_gap_s"] < 0.5, outcome.story
