"""Console helpers of the command-line tools: argument types, one-line errors, progress.

A long run shows a bar with the remaining time on a terminal, and a line now and then elsewhere.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import monotonic
from typing import NoReturn, TextIO, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sim_link.lab.pool import LOCAL, open_pool

EXIT_BAD_INPUT = 2
Item = TypeVar("Item")
Result = TypeVar("Result")


class OneLineParser(argparse.ArgumentParser):
    """Parser that reports errors in one line, without the usage in front of it."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        name = self.prog.replace(".py", "")
        self.exit(EXIT_BAD_INPUT, f"{name}: {message} (--help shows how)\n")


def positive(text: str) -> int:
    """Return a whole number of at least 1.

    Raises:
        argparse.ArgumentTypeError: It is less, or no number.
    """
    return _at_least(1, text)


def non_negative(text: str) -> int:
    """Return a whole number of at least 0.

    Raises:
        argparse.ArgumentTypeError: It is less, or no number.
    """
    return _at_least(0, text)


def _at_least(least: int, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if value < least:
        raise argparse.ArgumentTypeError(f"must be at least {least}")
    return value


LINE_EVERY_S = 15.0

OnDone = Callable[[float], None]
"""Called with the work done, in the unit of the total."""


@contextmanager
def shown(total: float, stream: TextIO) -> Iterator[OnDone]:
    """Show progress on a stream while work is done.

    Args:
        total: Of the work, in any unit that is proportional to time.
    """
    if not stream.isatty():
        yield Lines(total, stream, monotonic).done
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(file=stream)) as progress:
        task = progress.add_task("runs", total=total)
        yield lambda share: progress.advance(task, share)


def done_by(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    cost: Callable[[Item], float] = lambda _: 1.0,
    backend: str = LOCAL,
) -> list[Result]:
    """Return the result of each item in order, by several processes; stderr shows the progress."""
    found: dict[int, Result] = {}
    with (
        open_pool(backend, min(jobs, len(items))) as pool,
        shown(sum(map(cost, items)), sys.stderr) as on_done,
    ):
        for position, result in pool.results(work, items):
            found[position] = result
            on_done(cost(items[position]))
    return [found[position] for position in range(len(items))]


class Lines:
    """Progress in lines of text, the first after some time.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, total: float, stream: TextIO, clock: Callable[[], float]) -> None:
        self._total = total
        self._stream = stream
        self._clock = clock
        self._done = 0.0
        self._begun_s = self._said_s = clock()

    def done(self, share: float) -> None:
        """Add finished work to the progress line."""
        self._done += share
        now_s = self._clock()
        if now_s - self._said_s < LINE_EVERY_S:
            return
        self._said_s = now_s
        left_s = (now_s - self._begun_s) * (self._total - self._done) / self._done
        print(
            f"{self._done / self._total:4.0%} done, about {span_text(left_s)} left",
            file=self._stream,
            flush=True,
        )


def span_text(seconds: float) -> str:
    """Return a span of time in words."""
    whole = round(seconds)
    return f"{whole} s" if whole < 100 else f"{whole // 60} min {whole % 60:02d} s"
