"""Figures of flights in the field: shares with their intervals, medians, tables and the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.run_study import write_flights
from tools.study.reporting.field_report import (
    drawing_of,
    markdown_of,
    summary_of,
    wilson,
)
from tools.study.study import FlightRow, Study

NOBODY = FlightRow(
    radio="phone",
    config="configured",
    planner="latched_crossing",
    seed=9,
    is_reported=False,
    time_s=300.0,
    state=None,
    error_m=None,
    absolute_error_m=None,
    r95_m=None,
    absolute_r95_m=None,
    east_m=1.0,
    north_m=2.0,
    flown_m=0.0,
)


def row(seed: int, error_m: float, *, is_reported: bool = True) -> FlightRow:
    return FlightRow(
        radio="phone",
        config="configured",
        planner="latched_crossing",
        seed=seed,
        is_reported=is_reported,
        time_s=60.0 + seed,
        state="localised",
        error_m=error_m,
        absolute_error_m=error_m + 1.0,
        r95_m=2.0,
        absolute_r95_m=4.0,
        east_m=1.0,
        north_m=2.0,
        flown_m=100.0,
    )


FLOWN = [row(1, 1.0), row(2, 1.5), row(3, 3.5), row(4, 7.0), row(5, 9.0, is_reported=False), NOBODY]


@pytest.mark.parametrize(
    ("count", "of", "low", "high"),
    [(95, 100, 0.8882, 0.9785), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (0, 0, 0.0, 1.0)],
)
def test_wilsons_interval(count: int, of: int, low: float, high: float) -> None:
    assert wilson(count, of) == pytest.approx((low, high), abs=1e-4)


def test_a_cell_says_what_was_reported_and_what_of_that_is_true() -> None:
    found = {row.metric: row.ours for row in summary_of(FLOWN)}
    assert found == {
        "flights": "6",
        "reported": "0.66667",
        "coverage": "0.5",
        "absolute_coverage": "0.5",
        "beyond_3_r95": "0.25",
        "error_m": "2.5",
        "r95_m": "2",
        "r95_over_error_95": "0.309",
        "absolute_error_m": "3.5",
        "absolute_r95_m": "4",
        "time_s": "63.5",
        "cut_error_m": "9",
    }


def test_without_any_report_nothing_is_said_of_reports() -> None:
    rows = summary_of([NOBODY])
    assert [row.metric for row in rows if row.ours] == ["flights", "reported"]
    assert "| latched_crossing, configured | 1 | 0 % |  |" in markdown_of(rows)


def test_a_page_has_a_table_for_each_radio() -> None:
    lines = markdown_of(summary_of(FLOWN)).splitlines()
    assert lines[0] == "### phone"
    assert lines[4].startswith(
        "| latched_crossing, configured | 6 | 67 % | 63.5 | 2.5 | 2 | 50 % (15 to 85)"
    )
    assert lines[2].count("|") == lines[3].count("|") == lines[4].count("|")


def test_one_of_many_is_not_rounded_to_none() -> None:
    rows = [row(seed, 7.0 if seed == 1 else 1.0) for seed in range(200)]
    assert "| 0.5 % |" in markdown_of(summary_of(rows))


@pytest.mark.slow
def test_files_of_flights(tmp_path: Path) -> None:
    write_flights(Study(table="field", title="In the field"), FLOWN, 1, tmp_path)
    assert (tmp_path / "flights.csv").read_text().splitlines()[0].startswith("radio,config,planner")
    page = (tmp_path / "report.html").read_text()
    assert "In the field" in page
    assert "6\N{NO-BREAK SPACE}runs of each system" in page
    assert "leaves open" not in page
    assert (tmp_path / "figures" / "field.png").stat().st_size > 1000
    write_flights(Study(table="field", title="In the field"), [], 1, tmp_path)


def test_the_figure_takes_flights_without_any_report() -> None:
    assert drawing_of([NOBODY]).name == "field"
