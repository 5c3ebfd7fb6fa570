from __future__ import annotations

import pytest

from tools.benches.planner_bench import (
    FILTER_ALONE,
    FIM,
    LATCHED,
    LIMITS_MS,
    MAP_LATCHED,
    REACTIVE,
    SYSTEMS,
    bench_planners,
    cost_ratio,
    decision_of,
    filterpy_of,
    step_cost,
    step_of,
)
from tools.study.case import Case
from tools.study.systems import System

COSTS_US = {
    step_of(REACTIVE.label): 3.0,
    decision_of(REACTIVE.label): 0.5,
    filterpy_of(REACTIVE.label): 20.0,
    step_of(FIM.label): 15.1,
    decision_of(FIM.label): 12.5,
    filterpy_of(FIM.label): 20.0,
    step_of(FILTER_ALONE.label): 2.0,
    filterpy_of(FILTER_ALONE.label): 20.0,
}


def test_limits_are_met_at_their_value() -> None:
    reactive, fim, alone = (
        step_cost(system, COSTS_US, is_compiled=True) for system in (REACTIVE, FIM, FILTER_ALONE)
    )
    assert (reactive.limit_ms, reactive.is_met) == (0.003, True)
    assert (fim.limit_ms, fim.is_met) == (0.015, False)
    assert (alone.limit_ms, alone.is_met, alone.decision_ms) == (None, None, None)
    assert reactive.ratio == pytest.approx(3.0 / 20.0)
    assert fim.decision_ms == pytest.approx(0.0125)
    assert fim.paper_ms == 0.281


def test_plain_python_is_not_judged() -> None:
    cost = step_cost(REACTIVE, COSTS_US, is_compiled=False)
    assert (cost.limit_ms, cost.is_met) == (None, None)


def test_the_ratio_is_told_by_step_and_by_decision() -> None:
    ratio = cost_ratio(COSTS_US)
    assert ratio.steps == pytest.approx(15.1 / 3.0)
    assert ratio.decisions == pytest.approx(25.0)
    assert ratio.paper == 23.0


def test_every_system_is_timed() -> None:
    bench = bench_planners(1, Case(steps=12))
    assert [cost.system for cost in bench.costs] == [system.label for system in SYSTEMS]
    assert all(cost.step_ms > 0.0 < cost.filterpy_update_ms for cost in bench.costs)
    decides = {cost.system for cost in bench.costs if cost.decision_ms is not None}
    assert decides == {s.label for s in SYSTEMS if s.planner != "passive" and s != MAP_LATCHED}
    assert bench.numba is None  # as tests run, see conftest
    assert {cost.limit_ms for cost in bench.costs} == {None}
    assert set(LIMITS_MS) <= set(SYSTEMS)


def test_only_what_is_asked_for_is_reported() -> None:
    bench = bench_planners(1, Case(steps=12), [LATCHED])
    assert [cost.system for cost in bench.costs] == ["Proposed (Latched)"]
    assert bench.fim_over_reactive.steps > 0.0
    assert bench.sighted_us > 0.0


def test_a_system_without_kernels_is_refused() -> None:
    with pytest.raises(ValueError, match="tracker"):
        bench_planners(1, Case(steps=12), [System("tracker", "latched")])
