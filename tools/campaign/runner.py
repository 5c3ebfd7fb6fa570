"""The campaign as a whole: its parts, the processes that run them, and the verdict on all."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

from companion.errors import ConfigError
from sim_link.lab.pool import LOCAL, WorkerLostError, open_pool
from tools.campaign import clock_trials, endurance, link_trials, process_trials, random_missions
from tools.campaign.flights import Part, Trial, TrialFinding, TrialOutcome
from tools.console import without_logs

ALL = (
    random_missions.MISSIONS,
    random_missions.OVERRIDES,
    link_trials.GAPS,
    process_trials.KILLS,
    process_trials.STOPS,
    process_trials.SIGNALS,
    link_trials.FLOODS,
    endurance.FUZZING,
    link_trials.REACTIONS,
    clock_trials.CLOCKS,
    endurance.SOAK,
)
PARTS: Mapping[str, Part] = {part.name: part for part in ALL}

SIZES = ("sample", "ci", "long", "release")
AMOUNTS: Mapping[str, tuple[float, float, float, float]] = {
    "missions": (12, 500, 3000, 10_000),
    "override": (20, 2000, 2000, 4000),
    "gaps": (0.01, 0.1, 10.0, 10.0),
    "kill": (6, 200, 400, 1000),
    "stop": (6, 200, 400, 1000),
    "signal": (2, 20, 200, 400),
    "forged": (10_000, 1_000_000, 10_000_000, 10_000_000),
    "fuzz": (5_000, 1_000_000, 10_000_000, 100_000_000),
    "reaction": (6, 100, 500, 2000),
    "clocks": (0, 0, 400, 400),
    "soak": (0.02, 0.2, 24.0, 24.0),
}
"""Amount of each part in a campaign of each size: missions; take-overs; hours at each loss; kills;
stops; signals; frames; frames; cuts; flights; hours."""


def trials_of(size: str, seed: int, only: Sequence[str] = ()) -> list[Trial]:
    """Return the trials of a campaign or some of its parts, the longest first, to end together."""
    check_parts(only)
    trials = [
        trial
        for name, amounts in AMOUNTS.items()
        if not only or name in only
        for trial in PARTS[name].trials(amounts[SIZES.index(size)], seed)
    ]
    return sorted(trials, key=lambda trial: -PARTS[trial.part].cost(trial))


def check_parts(names: Sequence[str]) -> None:
    """Refuse a part that does not exist; the ConfigError names those that do."""
    for name in names:
        if name not in PARTS:
            raise ConfigError(f"there is no part {name!r}; there are {', '.join(PARTS)}")


def trial_named(text: str) -> Trial:
    """Return the trial of `PART:SEED[:SIZE]`, a number alone being a mission's seed."""
    words = text.split(":")
    if len(words) == 1:
        words = ["missions", *words]
    check_parts(words[:1])
    try:
        seed = int(words[1])
        size = float(words[2]) if len(words) > 2 else 1.0
    except (ValueError, IndexError):
        raise ConfigError(f"{text!r} is not a trial: PART:SEED or PART:SEED:SIZE") from None
    if seed < 0 or not 0.0 < size < float("inf") or len(words) > 3:
        raise ConfigError(f"{text!r} is not a trial: PART:SEED or PART:SEED:SIZE")
    return Trial(words[0], seed, size)


@dataclass(slots=True)
class CampaignTally:
    """Findings and figures of all trials so far."""

    trials: int = 0
    findings: list[TrialFinding] = field(default_factory=list)
    sums: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)
    least: dict[str, float] = field(default_factory=dict)
    reached_in: dict[str, str] = field(default_factory=dict)
    """Trial of each highest and lowest figure; the first by name if equal."""

    def add(self, outcome: TrialOutcome) -> None:
        """Add a trial."""
        self.trials += 1
        name = outcome.trial.name
        self.findings += [TrialFinding(name, what) for what in outcome.findings]
        for key, value in outcome.sums.items():
            self.sums[key] = self.sums.get(key, 0.0) + value
        for figures, sign, reached in (
            (self.most, -1.0, outcome.most),
            (self.least, 1.0, outcome.least),
        ):
            for key, value in reached.items():
                rank = (sign * value, name)
                if key not in figures or rank < (sign * figures[key], self.reached_in[key]):
                    figures[key], self.reached_in[key] = value, name

    def figures(self) -> Mapping[str, float]:
        """Return all figures, and the number of findings as `violations`."""
        return {
            **self.sums,
            **self.most,
            **self.least,
            "violations": float(len(self.findings)),
            "trials": float(self.trials),
        }


def run_one(trial: Trial) -> TrialOutcome:
    """Run a trial; an exception is a finding like any other."""
    try:
        return PARTS[trial.part].run(trial)
    except Exception as error:
        where = traceback.format_exc(limit=-4)
        what = f"{type(error).__name__}: {error}"
        return TrialOutcome(trial, (what,), story=tuple(where.splitlines()))


def run_all(
    trials: Sequence[Trial],
    jobs: int,
    on_done: Callable[[TrialOutcome], None] | None = None,
    backend: str = LOCAL,
) -> CampaignTally:
    """Run trials in `jobs` processes, or on a backend, and add them up in their order.

    A trial whose process may have ended by force is a finding, and those after it are not run.
    After an interruption a KeyboardInterrupt has the tally so far as its argument.
    """
    outcomes: dict[int, TrialOutcome] = {}
    lost: list[TrialFinding] = []
    try:
        with (
            open_pool(backend, min(jobs, len(trials))) as pool,
            closing(pool.results(_run_quietly, trials)) as results,
        ):
            for position, outcome in results:
                outcomes[position] = outcome
                if on_done is not None:
                    on_done(outcome)
    except WorkerLostError as error:
        lost = [TrialFinding(trials[n].name, f"lost: {error}") for n in error.positions]
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_tally_of(outcomes)) from None
    tally = _tally_of(outcomes)
    tally.findings += lost
    return tally


@without_logs()
def _run_quietly(trial: Trial) -> TrialOutcome:
    """Return the outcome without its log."""
    return replace(run_one(trial), story=())


def _tally_of(outcomes: Mapping[int, TrialOutcome]) -> CampaignTally:
    tally = CampaignTally()
    for position in sorted(outcomes):
        tally.add(outcomes[position])
    return tally


ENOUGH_HOURS = 5.0
"""Number of hours above which a rate of rare events is judged as a rate."""
JUDGED_LOSS = "30_pct"
PROMISED = (
    "missions",
    "violations",
    "fence_breaches",
    "closest_approach_m",
    "override_late_frames",
    "max_gap_s",
)
"""Figures that every report has; null where nothing of their part was flown."""


def judge(tally: CampaignTally) -> None:
    """Add the findings of the totals."""
    sums = tally.sums
    hours = sums.get(f"hours_{JUDGED_LOSS}", 0.0)
    lost = sums.get(f"false_losses_{JUDGED_LOSS}", 0.0)
    allowed = link_trials.MAX_FALSE_LOSSES_PER_10_H * max(hours, ENOUGH_HOURS) / 10.0
    if lost and lost >= allowed:
        what = f"{lost:.0f} links falsely declared lost in {hours:.1f} h at 30 % loss"
        tally.findings.append(TrialFinding("gaps", what))


def report(tally: CampaignTally, facts: Mapping[str, object], command: str) -> dict[str, object]:
    """Return the campaign as one JSON object: facts of the run, figures, and commands to replay."""
    figures = {
        name: int(value) if value == int(value) and abs(value) < 1e15 else round(value, 6)
        for name, value in sorted(tally.figures().items())
    }
    findings = [
        {"trial": each.trial, "what": each.what, "replay": f"{command} {each.trial}"}
        for each in tally.findings
    ]
    reached_in = dict(sorted(tally.reached_in.items()))
    figures_of_all = {**facts, **dict.fromkeys(PROMISED), **figures}
    return {**figures_of_all, "reached_in": reached_in, "findings": findings}
