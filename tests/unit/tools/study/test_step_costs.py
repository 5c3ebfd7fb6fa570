from __future__ import annotations

import msgspec
import pytest

from tools.study.case import Case
from tools.study.step_costs import SYSTEMS, costs_ms, costs_of
from tools.study.study import Study, StudyResult
from tools.study.systems import System


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


def test_costs_stand_beside_the_papers() -> None:
    rows = costs_of([_result(["cost_ms_per_step"])], rounds=1)
    assert [(row.system, row.metric, row.paper) for row in rows] == [
        ("Proposed (Reactive)", "cost_ms_per_step", "0.012"),
    ]
    assert all(float(row.ours) > 0.0 for row in rows)


def test_only_requested_cases_are_timed() -> None:
    assert costs_of([_result(["final_rmse_m"])]) == []


def test_every_system_is_timed() -> None:
    costs = costs_ms(Case(steps=12), SYSTEMS, rounds=1)
    assert all(cost_ms > 0.0 for cost_ms in costs)


def test_a_system_without_kernels_is_refused() -> None:
    with pytest.raises(ValueError, match="tracker"):
        costs_ms(Case(steps=12), [System("tracker", "latched")], rounds=1)
