"""Runs trials on several processes, and adds up what they found."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field

from sim_link.campaign.parts import PARTS
from sim_link.campaign.trial import Finding, Outcome, Trial

AHEAD = 2
"""Trials per process that wait their turn, so that an interruption need not finish many."""


@dataclass(slots=True)
class Tally:
    """What all trials so far found and measured."""

    trials: int = 0
    findings: list[Finding] = field(default_factory=list)
    sums: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)
    least: dict[str, float] = field(default_factory=dict)
    reached_in: dict[str, str] = field(default_factory=dict)
    """The trial of each greatest and least figure; of equals the first by name."""

    def add(self, outcome: Outcome) -> None:
        """One more trial."""
        self.trials += 1
        name = outcome.trial.name
        self.findings += [Finding(name, what) for what in outcome.findings]
        for key, value in outcome.sums.items():
            self.sums[key] = self.sums.get(key, 0.0) + value
        for key, value in outcome.most.items():
            self._reach(self.most, -1.0, key, value, name)
        for key, value in outcome.least.items():
            self._reach(self.least, 1.0, key, value, name)

    def _reach(
        self, figures: dict[str, float], sign: float, key: str, value: float, name: str
    ) -> None:
        rank = (sign * value, name)
        if key not in figures or rank < (sign * figures[key], self.reached_in[key]):
            figures[key], self.reached_in[key] = value, name

    def figures(self) -> Mapping[str, float]:
        """All figures, and the number of findings as `violations`."""
        return {
            **self.sums,
            **self.most,
            **self.least,
            "violations": float(len(self.findings)),
            "trials": float(self.trials),
        }


def run_one(trial: Trial) -> Outcome:
    """Run a trial; an exception is a finding like any other."""
    try:
        return PARTS[trial.part].run(trial)
    except Exception as error:
        where = traceback.format_exc(limit=-4)
        what = f"{type(error).__name__}: {error}"
        return Outcome(trial, (what,), story=tuple(where.splitlines()))


def run_all(
    trials: Sequence[Trial], jobs: int, on_done: Callable[[Outcome], None] | None = None
) -> Tally:
    """Run trials and add them up; an interruption ends early and keeps what was found.

    Args:
        trials: In the order of their start.
        jobs: Processes; 1 runs them in this one.
        on_done: Told of every trial that is done.

    Raises:
        KeyboardInterrupt: With the tally so far as its argument.
    """
    tally = Tally()
    try:
        with closing(_outcomes(trials, jobs)) as outcomes:
            for outcome in outcomes:
                tally.add(outcome)
                if on_done is not None:
                    on_done(outcome)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(tally) from None
    return tally


def _outcomes(trials: Sequence[Trial], jobs: int) -> Generator[Outcome, None, None]:
    if jobs <= 1:
        yield from map(run_one, trials)
        return
    coming = iter(trials)
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker)
    running: set[Future[Outcome]] = set()
    try:
        while True:
            while len(running) < jobs * AHEAD:
                trial = next(coming, None)
                if trial is None:
                    break
                running.add(pool.submit(run_one, trial))
            if not running:
                break
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in multiprocessing.active_children():  # a trial may have hours to go
            worker.terminate()
        raise
    pool.shutdown()


def _begin_worker() -> None:
    """Ctrl-C reaches the whole group, and only the parent answers it; flights keep quiet."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.disable(logging.CRITICAL)
