from __future__ import annotations

import pytest

from tests.unit.tools.study.reporting.invented import row
from tools.study.reporting.tables import count_verdicts, short, tables_of, verdict_of
from tools.study.systems import System

REACTIVE = System("asymmetric_huber", "reactive")
LATCHED = System("map", "latched")


@pytest.mark.parametrize(
    ("ours", "paper", "ci95", "verdict"),
    [
        ("0.2", "0.41", "0.18..0.22", "ahead"),
        ("0.4", "0.41", "0.38..0.42", "level"),
        ("0.5", "0.41", "0.48..0.52", "behind"),
        ("0.2", "", "0.18..0.22", ""),
    ],
)
def test_who_is_ahead_in_rmse(ours: str, paper: str, ci95: str, verdict: str) -> None:
    assert verdict_of(row(REACTIVE, ours, paper, ci95=ci95)) == verdict


@pytest.mark.parametrize(
    ("ours", "paper", "verdict"),
    [("58", ">500", "ahead"), (">500", "58", "behind"), (">500", ">500", "level")],
)
def test_never_is_later_than_any_step(ours: str, paper: str, verdict: str) -> None:
    assert verdict_of(row(REACTIVE, ours, paper, metric="steps_to_2.5m")) == verdict


def test_honesty_is_to_be_inside_of_the_band() -> None:
    assert verdict_of(row(LATCHED, "2.1", metric="nees_final", bound="1.7..2.3")) == "inside"
    assert verdict_of(row(LATCHED, "2.4", metric="nees_final", bound="1.7..2.3")) == "outside"


def test_worst_run_and_diverged_stand_beside_the_rmse() -> None:
    (table,) = tables_of(
        [
            row(LATCHED, "0.01234", ci95="0.0111..0.0136", bound="0.01"),
            row(LATCHED, "2.5", metric="worst_final_m"),
            row(LATCHED, "3", metric="diverged_runs"),
            row(LATCHED, "0.0101", metric="median_final_m"),
        ]
    )
    ((cell,),) = table.groups["Latched"].values()
    assert cell.ours == "0.012"
    assert cell.notes == ("0.011 to 0.014", "worst 2.50", "3 diverged", "median 0.010")
    assert table.has_bound
    assert not table.has_paper


def test_rows_stand_by_planner_and_columns_by_value() -> None:
    tables = tables_of(
        [row(s, "0.1", value=v) for v in ("0.5", "1.5") for s in (REACTIVE, LATCHED)]
    )
    assert list(tables[0].groups) == ["Reactive", "Latched"]
    assert tables[0].values == ("0.5", "1.5")


def test_a_system_that_was_not_flown_at_a_value_leaves_its_cell_empty() -> None:
    (table,) = tables_of([row(REACTIVE, "0.1"), row(LATCHED, "0.2", value="0.5")])
    assert table.groups["Reactive"][REACTIVE.label][1].ours == ""


def test_verdicts_are_counted() -> None:
    tables = tables_of(
        [row(REACTIVE, "0.2", "0.4"), row(LATCHED, "0.5", "0.4"), row(LATCHED, "0.1", value="0.5")]
    )
    assert count_verdicts(tables) == {"ahead": 1, "level": 0, "behind": 1, "diverged": 0}


@pytest.mark.parametrize("metric", ["final_rmse_m", "steps_to_2.5m"])
@pytest.mark.parametrize(("diverged", "verdict"), [("0", "level"), ("1", "diverged")])
def test_no_side_is_ahead_where_one_run_decides_the_rmse(
    metric: str, diverged: str, verdict: str
) -> None:
    """One of 200 runs that ends 161 m off makes the RMSE 11.4 m, and its interval holds 0.21 m."""
    (table,) = tables_of(
        [
            row(REACTIVE, "11.4", "0.21", ci95="0.15..19.7", metric=metric),
            row(REACTIVE, diverged, metric="diverged_runs"),
        ]
    )
    ((cell,),) = table.groups["Reactive"].values()
    assert cell.verdict == verdict
    assert count_verdicts([table])["diverged"] == int(diverged)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("0.021345", "0.021"),
        ("0.21345", "0.213"),
        ("12.345", "12.3"),
        ("0.0", "0"),
        ("17", "17"),
        (">500", ">500"),
        ("1234.5", "1234"),
    ],
)
def test_numbers_have_the_digits_that_can_be_compared(text: str, shown: str) -> None:
    assert short(text) == shown
