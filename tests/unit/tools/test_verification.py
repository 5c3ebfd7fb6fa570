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
    honesty_case,
    honesty_figures,
    honesty_systems,
    lawnmower_figures,
    lawnmower_systems,
    verified,
)

STEPS = 60


def _tally(
    rmse_m: float = 0.2,
    bound_m: float = 0.19,
    nees: float = 2.0,
    coverage: float = 0.95,
    offset_m: float = 5.5,
    runs: int = 200,
) -> RunTally:
    ones = np.ones(STEPS)
    return RunTally(
        runs,
        runs * rmse_m**2 * ones,
        runs * bound_m**2 * ones,
        runs * nees * ones,
        runs * coverage * ones,
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


@pytest.mark.parametrize(
    ("nees", "coverage", "verdicts"),
    [
        (2.0, 0.95, [True, True]),
        (1.5, 0.98, [False, False]),
        (2.4, 0.92, [False, False]),
    ],
)
def test_in_known_noise_too_careful_is_wrong_as_well(
    nees: float, coverage: float, verdicts: list[bool]
) -> None:
    campaign = RunSeries(honesty_case(0.0, "fixed"), System("tracker", "passive"), 1, 200)
    figures = honesty_figures(campaign, _tally(nees=nees, coverage=coverage))
    assert [figure.is_met for figure in figures] == verdicts


@pytest.mark.parametrize(("coverage", "is_met"), [(0.99, True), (0.92, False)])
def test_under_nlos_too_careful_is_allowed(coverage: float, is_met: bool) -> None:
    campaign = RunSeries(honesty_case(0.9, "fixed"), System("tracker", "passive"), 1, 200)
    (figure,) = honesty_figures(campaign, _tally(coverage=coverage))
    assert figure.is_met is is_met


def test_of_the_plain_filter_honesty_is_only_reported() -> None:
    campaign = RunSeries(honesty_case(0.0, "prior"), System("huber", "passive"), 1, 200)
    assert {f.is_met for f in honesty_figures(campaign, _tally(nees=30.0))} == {None}


def test_honesty_is_asked_of_known_noise_and_of_the_papers() -> None:
    cases = {(case.channel.p_nlos, case.offsets) for case, _ in honesty_systems()}
    assert cases == {(0.0, "fixed"), (0.0, "prior"), (0.9, "fixed")}


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
