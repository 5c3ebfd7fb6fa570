from __future__ import annotations

import msgspec
import pytest

from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tests.unit.tools.study.reporting.invented import cell, row, study, tally
from tools.study.reporting.claims import Claim, Findings, claims_of
from tools.study.study import CellResult, ResultRow
from tools.study.systems import system_named

PASSIVE, REACTIVE = "asymmetric_huber/passive", "asymmetric_huber/reactive"
FIM, BEST = "asymmetric_huber/fim", "map/latched"


def claim(text: str, *cells: CellResult, rows: tuple[ResultRow, ...] = ()) -> Claim:
    """The one claim that begins like this."""
    claims = claims_of(Findings([study(*cells)], rows, []))
    (found,) = [claim for claim in claims if claim.text.startswith(text)]
    return found


def test_a_run_without_the_claims_cells_judges_none() -> None:
    assert claims_of(Findings([study(cell("ekf/fim", tally(1.0)))], [], [])) == []


@pytest.mark.parametrize(
    ("ours_m", "huber_m", "is_met"), [(0.2, 0.3, True), (0.25, 0.3, False), (0.2, 0.19, False)]
)
def test_the_one_sided_filter_must_beat_paper_and_huber(
    ours_m: float, huber_m: float, is_met: bool
) -> None:
    ours = cell(PASSIVE, tally(ours_m), "p_nlos", "0.1", "p_nlos")
    huber = cell("huber/passive", tally(huber_m), "p_nlos", "0.1", "p_nlos")
    paper = row(ours.system, "", "0.217", value="0.1", table="p_nlos", parameter="p_nlos")
    assert claim("One-sided", ours, huber, rows=(paper,)).is_met is is_met


@pytest.mark.parametrize(
    ("worst_m", "is_met", "words"),
    [(2.4, True, "no run diverged"), (2.6, False, "1 of 200 runs diverged")],
)
def test_a_claim_about_an_rmse_is_missed_where_a_run_diverged_and_tells_the_median(
    worst_m: float, is_met: bool, words: str
) -> None:
    ours = cell(REACTIVE, tally(0.2, worst_m=worst_m), value="0.5")
    paper = row(ours.system, "", "0.21", value="0.5")
    found = claim("Reactive crossing as printed", ours, rows=(paper,))
    assert found.is_met is is_met
    assert found.measured == f"0.200 m, median 0.200 m, {words}"


def test_one_lost_run_of_the_better_planner_does_not_turn_the_reversal_into_better() -> None:
    reactive = cell(REACTIVE, tally(0.2, settled=12, worst_m=161.0), table="obstacle")
    fim = cell(FIM, tally(1.0, settled=30), table="obstacle")
    found = claim("Behind the obstacle", fim, reactive)
    assert found.is_met
    assert "1 of 200 runs diverged" in found.measured


@pytest.mark.parametrize(
    ("final_m", "worst_m", "is_met"), [(0.02, 0.1, True), (0.04, 0.1, False), (0.02, 0.2, False)]
)
def test_the_best_planner_is_judged_by_its_worst_run_too(
    final_m: float, worst_m: float, is_met: bool
) -> None:
    assert claim("Our best O(1)", cell(BEST, tally(final_m, worst_m=worst_m))).is_met is is_met


def test_settling_is_judged_for_each_regime() -> None:
    slow, quick = cell(BEST, tally(0.02, settled=20), value="0.5"), cell(BEST, tally(0.02, 13))
    assert claim("The same, steps", slow, quick).is_met
    later = cell(BEST, tally(0.02, settled=14))
    assert not claim("The same, steps", slow, later).is_met


def test_never_settling_is_missed_in_words() -> None:
    found = claim("The same, steps", cell(BEST, tally(3.0)))
    assert not found.is_met
    assert found.measured.startswith("never")


def test_one_lost_run_of_many_breaks_robustness() -> None:
    kept = cell(BEST, tally(0.02, worst_m=0.9), table="robustness")
    lost = cell(BEST, tally(0.02, worst_m=1.1), table="robustness", value="0.5")
    assert claim("The same, many runs", kept).is_met
    assert not claim("The same, many runs", kept, lost).is_met


def test_the_bound_ratio_is_that_of_the_worst_regime() -> None:
    near = cell(BEST, tally(0.012), value="0.5")
    far = cell(BEST, tally(0.014))
    assert claim("Our best estimator", near).is_met
    assert not claim("Our best estimator", near, far).is_met


def test_consistency_counts_only_noise_as_believed() -> None:
    case = canonical_case(p_nlos=0.0)
    honest = cell("tracker/latched", tally(0.1), table="consistency", case=case)
    proud = msgspec.structs.replace(canonical_case(p_nlos=0.9))
    lost = tally(0.1, worst_m=9.0)
    other = cell("tracker/latched", lost, "consistency", "NLOS", "noise", case=proud)
    assert claim("Consistency", honest, other).measured.endswith("over 1 cells")


def test_the_reversal_needs_fim_both_later_and_worse() -> None:
    reactive = cell(REACTIVE, tally(0.2, settled=12), table="obstacle")
    stalls = cell(FIM, tally(1.0, settled=30), table="obstacle")
    recovers = cell(FIM, tally(0.1, settled=30), table="obstacle")
    assert claim("Behind the obstacle", stalls, reactive).is_met
    half = claim("Behind the obstacle", recovers, reactive)
    assert not half.is_met
    assert half.measured.endswith("later, but not worse")


def test_the_reversal_is_that_of_the_printed_fim_where_it_was_flown() -> None:
    reactive = cell(REACTIVE, tally(0.2, settled=12), table="obstacle")
    ours = cell(FIM, tally(0.1, settled=30), table="obstacle")
    printed = cell("asymmetric_huber/fim_printed", tally(9.0, settled=30), table="obstacle")
    found = claim("Behind the obstacle", ours, printed, reactive)
    assert found.is_met
    assert "Proposed (FIM as printed) never settles, 9.0000 m" in found.measured
    assert "Proposed (FIM) 30 steps" in found.measured


def test_ours_must_beat_every_fim_behind_the_obstacle_in_time_too() -> None:
    others = [
        cell(REACTIVE, tally(0.2, settled=12), table="obstacle"),
        cell(FIM, tally(0.1, settled=30), table="obstacle"),
    ]
    quick, slow = (cell(BEST, tally(0.02, n), table="obstacle") for n in (11, 12))
    assert claim("MAP (Latched) beats", quick, *others).is_met
    assert not claim("MAP (Latched) beats", slow, *others).is_met


def test_costs_are_judged_by_the_dearest_case() -> None:
    reactive, fim = system_named(REACTIVE), system_named(FIM)
    costs = [
        row(reactive, "0.002", metric="cost_ms_per_step"),
        row(reactive, "0.004", metric="cost_ms_per_step", value="2.5"),
        row(fim, "0.010", metric="cost_ms_per_step"),
    ]
    (found,) = claims_of(Findings([], [], costs))
    assert not found.is_met
    assert "0.0040" in found.measured
    assert "a ratio of 2.5 (paper: 23)" in found.measured
