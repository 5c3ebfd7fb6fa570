from __future__ import annotations

import numpy as np
import pytest

from tools.study.case import Case
from tools.study.systems import System
from tools.study.trials import RunSeries, RunTally
from tools.verify_estimation import (
    PARTS,
    bound_figure,
    bound_systems,
    lawnmower_figures,
    lawnmower_systems,
    verified,
)

STEPS = 60


def _tally(
    rmse_m: float = 0.2,
    bound_m: float = 0.19,
    offset_m: float = 5.5,
    runs: int = 200,
) -> RunTally:
    ones = np.ones(STEPS)
    return RunTally(
        runs,
        runs * rmse_m**2 * ones,
        runs * bound_m**2 * ones,
        runs * 2.0 * ones,
        runs * 0.95 * ones,
        runs * offset_m * ones,
        0.0 * ones,
        np.full(runs, rmse_m),
    )


def test_the_lawnmower_asks_for_rmse_rank_and_offset() -> None:
    series = [RunSeries(case, system, 1, 200) for case, system in lawnmower_systems()]

    def verdicts(*tallies: RunTally) -> list[bool | None]:
        every = [*tallies, *(_tally() for _ in series[len(tallies) :])]
        return [
            f.is_met for f in lawnmower_figures(list(zip(series, every, strict=True))) if f.limit
        ]

    assert verdicts(_tally(), _tally(0.3)) == [True, True, True]
    assert verdicts(_tally(0.36, offset_m=1.5), _tally(0.3)) == [False, False, False]


def test_the_bound_is_that_of_the_own_tracks() -> None:
    campaign = RunSeries(Case(), System("tracker", "fim"), 1, 200)
    assert bound_figure(campaign, _tally(0.25, 0.2)).is_met
    assert not bound_figure(campaign, _tally(0.27, 0.2)).is_met


def test_the_bound_is_asked_for_in_every_regime() -> None:
    sigmas = {case.channel.range_sigma_m for case, _ in bound_systems()}
    assert sigmas == {0.5, 1.5, 2.5}


def test_parts_can_be_measured_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RunSeries] = []

    def fake(campaigns: list[RunSeries], jobs: int) -> list[RunTally]:
        del jobs
        asked.extend(campaigns)
        return [_tally() for _ in campaigns]

    monkeypatch.setattr("tools.verify_estimation.tallies_of", fake)
    figures = verified(["bound"], 200, 1, 1)
    assert {figure.part for figure in figures} == {"bound"}
    assert len(asked) == len(bound_systems())
    assert {f.part for f in verified(PARTS, 200, 1, 1)} == set(PARTS)
