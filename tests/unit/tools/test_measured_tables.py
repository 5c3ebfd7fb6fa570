"""Figures in the pages are those that were measured."""

from __future__ import annotations

import pytest

from tools.release.measured_tables import TABLES, Table, campaign_rows, process_rows


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_a_page_has_the_figures_of_its_json(table: Table) -> None:
    text = table.page.read_text(encoding="utf-8")
    assert table.written(text) == text, "run tools/release/measured_tables.py"


def test_a_page_without_marks_is_reported() -> None:
    with pytest.raises(ValueError, match="has no `<!-- measured: process -->`"):
        TABLES[0].written("# Install\n")


def test_a_use_is_a_row() -> None:
    use = {"client": "pymavlink", "resident_mb": 53.6, "processor_pct": 3.14}
    assert process_rows([use])[-1] == "| pymavlink, listening | 54 MB | 3.1 % |"


def test_a_campaign_has_a_row_for_each_part_that_was_flown_with_what_was_found() -> None:
    findings = [{"trial": "stop:7", "what": "late"}, {"trial": "kill:3", "what": "engaged"}]
    run = {"campaign": "ci", "seed": 9, "stops": 1200, "stops_in_control": 30, "findings": findings}
    head, _, row = campaign_rows([{**run, "stop_hold_s": 0.05, "stop_exit_s": 0.1}])
    assert head == "| `--campaign ci --seed 9` | result | findings |"
    parts = row.strip("| ").split(" | ")
    assert parts[0] == "1,200 stops, 30 of them in control"
    assert parts[2:] == ["1"]
