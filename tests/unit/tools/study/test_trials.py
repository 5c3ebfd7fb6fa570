from __future__ import annotations

import numpy as np
import pytest

from tools.study.case import Case, run_seeds
from tools.study.systems import System
from tools.study.trials import (
    RunSeries,
    RunTally,
    joined_in_order,
    run_block,
    tally_of,
    unpacked,
)
from tools.verify_estimation import tallies_of

SHORT = Case(steps=15)
CAMPAIGN = RunSeries(SHORT, System("asymmetric_huber", "latched"), seed=2, runs=60)


def test_blocks_are_the_runs_in_order() -> None:
    assert [(block.first, block.runs) for block in CAMPAIGN.blocks()] == [
        (0, 50),
        (50, 10),
    ]


def test_a_tally_says_what_its_trials_say() -> None:
    tally = tally_of(RunSeries(SHORT, CAMPAIGN.system, seed=2, runs=6, first=4))
    trials = run_block(SHORT, CAMPAIGN.system, run_seeds(2, 6, first=4))
    errors = np.array([trial.errors_m for trial in trials])
    np.testing.assert_allclose(tally.rmse_m, np.sqrt(np.mean(errors**2, axis=0)))
    np.testing.assert_allclose(tally.final_errors_m, errors[:, -1])
    np.testing.assert_allclose(tally.mean_nees, np.mean([t.nees for t in trials], axis=0))
    inside = [t.errors_m <= t.r95_m for t in trials]
    np.testing.assert_array_equal(tally.coverage, np.mean(inside, axis=0))
    assert tally.range_offset_m[0] == 0.0
    assert (tally.rmse_bound_m[3:] > 0.0).all()
    assert tally.rmse_bound_m[0] > 10.0 * tally.rmse_bound_m[-1]


@pytest.mark.slow
def test_processes_change_nothing() -> None:
    other = RunSeries(SHORT, System("ekf", "passive"), seed=2, runs=30)
    alone = tallies_of([CAMPAIGN, other], 1)
    shared = tallies_of([CAMPAIGN, other], 2)
    assert [tally.runs for tally in alone] == [60, 30]
    for one, two in zip(alone, shared, strict=True):
        for name in RunTally._fields:
            assert np.array_equal(getattr(one, name), getattr(two, name)), name


def test_a_tally_comes_back_from_its_bytes() -> None:
    parts = [tally_of(block) for block in CAMPAIGN.blocks()]
    whole = joined_in_order(parts)
    again = joined_in_order(unpacked(part.packed()) for part in parts)
    assert (whole.runs, again.runs) == (60, 60)
    for name in RunTally._fields[1:]:
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
