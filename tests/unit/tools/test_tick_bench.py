"""The bench of the control tick: every case is flown, and its figures are those of the thread."""

from __future__ import annotations

from tools.benches.tick_bench import EMITTERS, LIMIT_MS, ROOT, TickCase, TickCost, tick_cases


def test_a_case_is_flown_in_a_process_of_its_own() -> None:
    cost = TickCase("plain", "ground", 4, "spread").measured(ROOT, 6.0)
    assert cost.estimates > 4 * 10
    assert 0.0 < cost.tick_p99_ms <= cost.tick_worst_ms <= cost.stretch_worst_ms


def test_there_is_no_phase_of_one_emitter() -> None:
    cases = list(tick_cases(tuple(LIMIT_MS), EMITTERS))
    assert len(cases) == len(set(cases)) == 2 * 2 * (2 * len(EMITTERS) - 1)


def test_a_limit_is_that_of_the_kernels() -> None:
    cost = TickCost("plain", 12.0, 6.0, 24.0, 100)
    assert cost.is_met
    assert not TickCost("compiled", 12.0, 6.0, 24.0, 100).is_met
