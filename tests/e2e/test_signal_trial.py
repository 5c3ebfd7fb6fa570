"""A trial of signals starts real processes and times them, so it has the machine to itself."""

from __future__ import annotations

import pytest

from sim_link.lab.campaign.flights import Trial
from tools.campaign import process_trials
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
