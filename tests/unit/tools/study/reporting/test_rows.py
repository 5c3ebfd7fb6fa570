from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from tools.study.reporting.study_tables import (
    ratio_interval,
    resamples,
    rmse_interval_m,
    rows_of,
)
from tools.study.study import CellResult, ResultRow, Study, StudyResult, cells_of
from tools.study.trials import RunTally

STEPS, RUNS = 30, 40


def _tally(rmse_m: float, bound_m: float = 0.5) -> RunTally:
    """Return a tally of equal runs: 10 m off for ten steps, then the given error."""
    squared = np.full(STEPS, RUNS * rmse_m**2)
    squared[:10] = RUNS * 100.0
    ones = np.ones(STEPS)
    return RunTally(
        runs=RUNS,
        squared_m2=squared,
        bound_m2=RUNS * bound_m**2 * ones,
        nees=RUNS * 2.0 * ones,
        inside=RUNS * np.linspace(0.9, 1.0, STEPS),
        range_offset_m=RUNS * 5.25 * ones,
        bearing_offset_rad=ones,
        final_errors_m=np.full(RUNS, rmse_m),
    )


def _result(tallies: dict[str, RunTally], metrics: list[str], **sweep: Any) -> StudyResult:
    fields = {
        "table": "noise",
        "title": "Noise",
        "systems": list(tallies),
        "metrics": metrics,
        "sweeps": [{"parameter": "step_m", "varies": ["step_m"], "values": [5.0], **sweep}],
    }
    study = msgspec.convert(fields, Study)
    cells = [
        CellResult.of(cell, tally)
        for cell, tally in zip(cells_of(study), tallies.values(), strict=True)
    ]
    return StudyResult(study, RUNS, 1, tuple(cells))


def _rows(metric: str, tally: RunTally, **sweep: Any) -> list[ResultRow]:
    return rows_of(_result({"asymmetric_huber/passive": tally}, [metric], **sweep))


@pytest.mark.parametrize(
    ("metric", "name", "ours", "ci95", "bound"),
    [
        ("final_rmse_m", "final_rmse_m", "0.75", "0.75..0.75", "0.5"),
        ("steps_to_2.5m", "steps_to_2.5m", "11", "", "1"),
        ("worst_final_m", "worst_final_m", "0.75", "", ""),
        ("final_rmse_m", "median_final_m", "0.75", "", ""),
        ("final_rmse_m", "diverged_runs", "0", "", ""),
        ("range_offset_m", "range_offset_m", "5.25", "", ""),
        ("bound_ratio", "bound_ratio", "1.5", "1.5..1.5", "1"),
    ],
)
def test_a_metric_says_what_its_runs_say(
    metric: str, name: str, ours: str, ci95: str, bound: str
) -> None:
    (row,) = [row for row in _rows(metric, _tally(0.75)) if row.metric == name]
    assert row == ResultRow(
        "noise", "step_m", "5.0", "Proposed (Passive)", name, "", ours, ci95, bound
    )


def test_what_never_settles_is_more_than_all_steps() -> None:
    assert [row.ours for row in _rows("steps_to_2.5m", _tally(3.0))] == [">30"]


def test_runs_that_end_far_off_are_counted() -> None:
    rows = _rows("final_rmse_m", _tally(2.6))
    assert [row.ours for row in rows if row.metric == "diverged_runs"] == ["40"]


def test_after_the_papers_steps_beside_the_bound_there() -> None:
    (row,) = _rows("rmse_after_steps_m", _tally(0.75), after_steps=[5])
    assert (row.metric, row.ours, row.bound) == ("rmse_after_5_steps_m", "10", "0.5")


def test_honesty() -> None:
    final, mean = _rows("nees", _tally(0.75))
    assert (final.ours, mean.ours) == ("2", "2")
    low, high = map(float, final.bound.split(".."))
    assert 1.3 < low < 2.0 < high < 2.8
    least, mean, most = _rows("coverage", _tally(0.75))
    assert (least.metric, mean.metric, most.metric) == (
        "coverage_min",
        "coverage_mean",
        "coverage_max",
    )
    assert float(least.ours) == pytest.approx(0.9 + 0.1 * 20 / 29, abs=1e-4)
    assert (most.ours, most.bound) == ("1", "0.93..0.97")


def test_an_unknown_bound_is_left_empty() -> None:
    unknown = _tally(0.75, math.nan)
    assert [row.bound for row in _rows("final_rmse_m", unknown)] == 3 * [""]
    assert [row.bound for row in _rows("steps_to_2.5m", unknown)] == [""]
    assert _rows("bound_ratio", unknown) == []


def test_each_system_beside_proposed_with_the_same_planner() -> None:
    tallies = {
        "asymmetric_huber/fim": _tally(0.2),
        "huber/fim": _tally(0.5),
        "huber/passive": _tally(0.5),
    }
    (row,) = rows_of(_result(tallies, ["rmse_ratio"]))
    assert (row.system, row.ours, row.ours_ci95) == ("Huber (FIM)", "2.5", "2.5..2.5")


def test_the_paper_stands_beside_ours() -> None:
    paper = {"Proposed (Passive)": {"final_rmse_m": [0.35], "steps_to_2.5m": [">500"]}}
    rows = _rows("final_rmse_m", _tally(1.0), paper=paper)
    assert [row.paper for row in rows] == ["0.35", "", ""]
    assert [row.paper for row in _rows("steps_to_2.5m", _tally(1.0), paper=paper)] == [">500"]
    assert [row.paper for row in _rows("worst_final_m", _tally(1.0), paper=paper)] == [""]


def test_a_filter_that_the_paper_names_alone_gets_a_row_of_that_name() -> None:
    rows = _rows("range_offset_m", _tally(1.0), paper={"Proposed": {"range_offset_m": [5.5]}})
    assert [(row.system, row.paper, row.ours) for row in rows] == [
        ("Proposed (Passive)", "", "5.25"),
        ("Proposed", "5.5", "5.25"),
    ]


def test_the_interval_of_an_rmse_holds_it() -> None:
    errors = np.abs(np.random.default_rng(5).standard_normal(400))
    interval = rmse_interval_m(errors)
    assert interval is not None
    low, high = interval
    rmse = float(np.sqrt(np.mean(errors**2)))
    assert low < rmse < high
    assert (high - low) / 3.92 == pytest.approx(1.0 / np.sqrt(2.0 * 400), rel=0.2)


def test_pairs_make_the_interval_of_a_ratio_narrow() -> None:
    rng = np.random.default_rng(5)
    ours = np.abs(rng.standard_normal(400))
    paired = ratio_interval(1.1 * ours, ours)
    alone = ratio_interval(1.1 * np.abs(rng.standard_normal(400)), ours)
    assert paired == pytest.approx((1.1, 1.1))
    assert alone is not None
    assert alone[1] - alone[0] > 0.1


def test_no_interval_of_what_is_not_finite() -> None:
    assert rmse_interval_m(np.array([1.0, np.nan])) is None
    assert ratio_interval(np.array([1.0, 2.0]), np.array([1.0, np.inf])) is None


def test_every_resample_has_as_many_runs() -> None:
    assert set(resamples(25).sum(axis=1)) == {25.0}
