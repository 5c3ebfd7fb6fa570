"""A trial of signals starts real processes and times them, so it has the machine to itself."""

from __future__ import annotations

import pytest

from sim_link.lab.campaign.flights import Trial
from sim_link.lab.campaign.runner import run_one

KILLED, STOPPED = 4, 5
"""Seeds: even ones kill, odd ones stop."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", [KILLED, STOPPED])
def test_a_signalled_companion_leaves_nothing_amiss(seed: int) -> None:
    outcome = run_one(Trial("signal", seed, 0.2))
    assert outcome.findings == ()
    assert outcome.sums["signals"] == 1.0
