"""Trials are named, run, added up and judged; an exception is a finding."""

from __future__ import annotations

import multiprocessing
import time

import pytest

from companion.errors import ConfigError
from tools.campaign import runner
from tools.campaign.flights import Part, Trial, TrialOutcome, frames_each
from tools.campaign.runner import (
    AMOUNTS,
    PARTS,
    PROMISED,
    SIZES,
    CampaignTally,
    judge,
    report,
    run_all,
    run_one,
    trial_named,
    trials_of,
)


def roll(trial: Trial) -> TrialOutcome:
    """Trial n fails for every fifth n, and breaks at 7."""
    if trial.seed == 7:
        raise ZeroDivisionError("seven")
    if trial.seed == 99:
        raise KeyboardInterrupt
    findings = ("a fifth",) if trial.seed % 5 == 0 else ()
    n = float(trial.seed)
    return TrialOutcome(trial, findings, {"sum": n}, {"most": n}, {"least": n})


def dice(count: int) -> list[Trial]:
    """Trials 1 to `count`."""
    return [Trial("dice", seed) for seed in range(1, count + 1)]


@pytest.fixture(autouse=True)
def _dice_are_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "PARTS", {**PARTS, "dice": Part("dice", "numbers", run=roll)})


def test_a_part_is_counted_in_trials_with_seeds_of_their_own() -> None:
    frames = Part("dice", "numbers", run=roll, cost_s=2.0, base_cost_s=1.0, split=frames_each(100))
    assert Part("dice", "numbers", run=roll).trials(2.0, 3) == [
        Trial("dice", 3_000_000),
        Trial("dice", 3_000_001),
    ]
    assert [trial.size for trial in frames.trials(150, 1)] == [0.75, 0.75]
    assert frames.cost(Trial("dice", 1, 0.75)) == 2.5


def test_figures_are_added_up_and_findings_name_their_trial() -> None:
    tally = run_all(dice(6), jobs=1)
    assert tally.trials == 6
    assert (tally.sums["sum"], tally.most["most"], tally.least["least"]) == (21.0, 6.0, 1.0)
    assert [(each.trial, each.what) for each in tally.findings] == [("dice:5", "a fifth")]
    summary = report(tally, {"campaign": "ci"}, "replay")
    assert summary["violations"] == 1
    assert summary["findings"] == [
        {"trial": "dice:5", "what": "a fifth", "replay": "replay dice:5"}
    ]


@pytest.mark.parametrize("order", [1, -1])
def test_an_extreme_names_its_trial_and_of_equals_the_first(order: int) -> None:
    tally = CampaignTally()
    values_m = [0.5, 0.2, 0.2]
    for seed, value in list(enumerate(values_m, start=1))[::order]:
        tally.add(
            TrialOutcome(
                Trial("dice", seed), most={"gap_s": value}, least={"closest_approach_m": value}
            )
        )
    summary = report(tally, {}, "replay")
    assert (summary["closest_approach_m"], summary["gap_s"]) == (0.2, 0.5)
    assert summary["reached_in"] == {"closest_approach_m": "dice:2", "gap_s": "dice:1"}


def test_an_exception_is_a_finding_with_its_place() -> None:
    outcome = run_one(Trial("dice", 7))
    assert outcome.findings == ("ZeroDivisionError: seven",)
    assert any("test_runner" in line for line in outcome.story)


def test_an_interruption_keeps_what_was_found() -> None:
    trials = [*dice(5), Trial("dice", 99), Trial("dice", 100)]
    with pytest.raises(KeyboardInterrupt) as caught:
        run_all(trials, jobs=1)
    (tally,) = caught.value.args
    assert isinstance(tally, CampaignTally)
    assert tally.trials == 5
    assert len(tally.findings) == 1


def test_a_report_has_every_promised_figure_and_null_for_what_was_not_flown() -> None:
    tally = CampaignTally()
    tally.add(TrialOutcome(Trial("gaps", 1), most={"max_gap_s": 0.25}))
    summary = report(tally, {}, "replay")
    assert set(PROMISED) <= set(summary)
    assert summary["max_gap_s"] == 0.25
    assert summary["missions"] is None
    assert summary["violations"] == 0


@pytest.mark.slow
def test_several_processes_find_what_one_finds() -> None:
    trials = [Trial("reaction", 1), Trial("reaction", 2)]
    alone, together = run_all(trials, jobs=1), run_all(trials, jobs=2)
    assert alone.sums == pytest.approx(together.sums)
    assert alone.most == pytest.approx(together.most)
    assert alone.least == pytest.approx(together.least)


@pytest.mark.parametrize("trial", [Trial("dice", 3), Trial("gaps", 1_000_002, 0.25)])
def test_a_trial_is_found_by_its_name(trial: Trial) -> None:
    assert trial_named(trial.name) == trial


def test_a_number_alone_is_a_mission() -> None:
    assert trial_named("12") == Trial("missions", 12)


@pytest.mark.parametrize(
    "text", ["", "x", "nothing:1", "dice:x", "dice:1:2:3", "dice:-1", "dice:1:0"]
)
def test_what_names_no_trial_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        trial_named(text)


@pytest.mark.parametrize("size", SIZES)
def test_every_size_runs_every_part_with_seeds_of_its_own(size: str) -> None:
    trials = trials_of(size, 1)
    assert {trial.part for trial in trials} == {
        part for part, amounts in AMOUNTS.items() if amounts[SIZES.index(size)]
    }
    assert len({trial.name for trial in trials}) == len(trials)
    assert {trial.name for trial in trials}.isdisjoint(t.name for t in trials_of(size, 2))
    assert {trial.part for trial in trials_of(size, 1, ["override"])} == {"override"}


def test_a_rate_of_false_losses_is_judged_over_hours() -> None:
    rare, often = CampaignTally(), CampaignTally()
    rare.sums.update(hours_30_pct=20.0, false_losses_30_pct=1.0)
    often.sums.update(hours_30_pct=20.0, false_losses_30_pct=2.0)
    judge(rare)
    judge(often)
    assert rare.findings == []
    assert len(often.findings) == 1


@pytest.mark.slow
def test_an_interruption_does_not_wait_for_what_still_runs() -> None:
    """The trial that runs along with the first one would take an hour."""
    days = [Trial("soak", seed, 1000.0) for seed in range(3)]

    def interrupt(_: TrialOutcome) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        run_all([Trial("reaction", 1), *days], jobs=2, on_done=interrupt)
    assert caught.value.args[0].trials == 1
    give_up_s = time.monotonic() + 120.0
    while multiprocessing.active_children():  # the pool's own thread waits for them, too
        assert time.monotonic() < give_up_s, "a worker goes on"
        time.sleep(0.05)
