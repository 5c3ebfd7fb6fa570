from __future__ import annotations

import msgspec

from tools.benches.planner_bench import costs_of
from tools.study.study import Study, StudyResult


def _result(metrics: list[str]) -> StudyResult:
    fields = {
        "table": "t",
        "title": "T",
        "systems": ["asymmetric_huber/reactive", "map/passive"],
        "metrics": metrics,
        "sweeps": [
            {
                "parameter": "p",
                "case": {"steps": 8},
                "varies": ["channel.p_nlos"],
                "values": [0.9],
                "paper": {"Proposed (Reactive)": {"cost_ms_per_step": [0.012]}},
            }
        ],
    }
    return StudyResult(msgspec.convert(fields, Study), 1, 1, ())


def test_costs_stand_beside_the_papers_and_filterpys() -> None:
    rows = costs_of([_result(["cost_ms_per_step"])], rounds=1)
    assert [(row.system, row.metric, row.paper) for row in rows] == [
        ("Proposed (Reactive)", "cost_ms_per_step", "0.012"),
        ("Proposed (Reactive)", "decision_ms", ""),
        ("Proposed (Reactive)", "filterpy_update_ms", ""),
    ]
    assert all(float(row.ours) > 0.0 for row in rows)


def test_nothing_is_timed_that_nobody_asked_for() -> None:
    assert costs_of([_result(["final_rmse_m"])]) == []
