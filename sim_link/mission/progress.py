"""What people see while missions fly: a live line on a terminal, plain lines anywhere else."""

from __future__ import annotations

import os
import sys
import time
from types import TracebackType
from typing import TextIO

from sim_link.mission.situation import Situation
from sim_link.mission.steps import StepRunner
from sim_link.mission.summary import Summary

REFRESH_S = 0.1


class PlainProgress:
    """A line when a step begins, where there is no terminal, and one for every flight.

    Args:
        total: Flights to be flown.
        output: Where the lines go.
        is_detailed: Whether steps are told, too; there is one flight at a time then.
    """

    def __init__(self, total: int, output: TextIO, *, is_detailed: bool) -> None:
        self._total = total
        self._output = output
        self._is_detailed = is_detailed
        self._done = 0
        self._step = 0
        self._is_heard = True

    def __enter__(self) -> PlainProgress:
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End."""

    def moved(self, runner: StepRunner, situation: Situation) -> None:
        """Time has passed."""
        number, total, name = runner.progress
        if not self._is_detailed or number == self._step:
            return
        self._step = number
        self.say(f"{situation.mission.time_s:7.1f} s  step {number}/{total} {name}")

    def finished(self, summary: Summary) -> None:
        """A flight is over."""
        self._done += 1
        self._step = 0
        self.say(flight_line(summary, self._done, self._total))
        for verdict in summary.failed:
            self.say(f"     {verdict.name}: {verdict.found}")
        if summary.error:
            self.say(f"     {summary.error}")
        if summary.doubt:
            self.say(f"     {summary.doubt}")

    def say(self, line: str) -> None:
        """Print a line, as long as somebody reads."""
        if not self._is_heard:
            return
        try:
            self._output.write(f"{line}\n")
            self._output.flush()
        except BrokenPipeError:
            self._is_heard = False
            if self._output is sys.stdout:  # what it still holds is not to be tried at the exit
                sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  stays open


class LiveProgress(PlainProgress):
    """The same with a line that is redrawn in place (rich).

    Raises:
        ImportError: rich is not installed.
    """

    def __init__(self, total: int, output: TextIO) -> None:
        super().__init__(total, output, is_detailed=False)
        from rich.console import Console
        from rich.live import Live

        self._console = Console(file=output)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._due_s = 0.0

    def __enter__(self) -> LiveProgress:
        """Begin to draw."""
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the terminal as it was."""
        self._live.stop()

    def moved(self, runner: StepRunner, situation: Situation) -> None:
        """Redraw the line now and then."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + REFRESH_S
        from rich.text import Text

        self._live.update(Text(state_line(runner, situation), no_wrap=True), refresh=True)

    def say(self, line: str) -> None:
        """Print a line above the live one."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def progress_for(total: int, jobs: int, output: TextIO | None = None) -> PlainProgress:
    """What suits the output: live on a terminal with rich, plain lines otherwise.

    Args:
        total: Flights to be flown.
        jobs: How many at once.
        output: Where to; None: standard output.
    """
    stream = sys.stdout if output is None else output
    if stream.isatty():
        try:
            return LiveProgress(total, stream)
        except ImportError:
            pass
    return PlainProgress(total, stream, is_detailed=jobs == 1 and total == 1)


def state_line(runner: StepRunner, situation: Situation) -> str:
    """Where a flight stands, in a line."""
    number, total, name = runner.progress
    vehicle, companion, estimate = situation.vehicle, situation.companion, situation.estimate
    parts = [
        f"{situation.mission.time_s:7.1f} s  step {number}/{total} {name}",
        companion.phase or "no companion",
        f"vehicle in {vehicle.mode or '?'}",
    ]
    if vehicle.height_m is not None:
        parts.append(f"height {vehicle.height_m:.1f} m")
    if estimate.r95_m is not None:
        parts.append(f"{estimate.state}, R95 {estimate.r95_m:.2f} m")
    return ", ".join(parts)


def flight_line(summary: Summary, number: int, total: int) -> str:
    """How a flight ended, in a line."""
    verdict = "PASS" if summary.is_passed else "FAIL"
    if not summary.is_flown:
        return f"{verdict} [{number}/{total}] {summary.title}: not flown to its end"
    line = f"{verdict} [{number}/{total}] {summary.title}: {summary.time_s:.1f} s"
    if summary.final_error_m is not None and summary.r95_m is not None:
        line += f", error {summary.final_error_m:.2f} m, R95 {summary.r95_m:.2f} m"
    return f"{line}, {summary.how}, {summary.times_real_time:.0f}x"
