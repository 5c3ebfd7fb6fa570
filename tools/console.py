"""Console helpers of the command-line tools: arguments, one-line errors, progress, no logs.

A long run shows a bar with the remaining time on a terminal, and a line now and then elsewhere.
"""

from __future__ import annotations

import argparse
import csv
import io
import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from time import monotonic
from typing import NoReturn, TextIO, TypeVar

from rich.console import Console
from rich.progress import Progress

from companion.arguments import RaisingParser
from sim_link.lab.pool import LOCAL, open_pool

EXIT_BAD_INPUT = 2
Item = TypeVar("Item")
Result = TypeVar("Result")


class OneLineParser(RaisingParser):
    """Parser that reports errors in one line, without the usage in front of it."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        name = self.prog.replace(".py", "")
        self.exit(EXIT_BAD_INPUT, f"{name}: {message} (--help shows how)\n")


def at_least(least: int, text: str) -> int:
    """Return a whole number that is at least `least`, or raise an ArgumentTypeError."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if value < least:
        raise argparse.ArgumentTypeError(f"must be at least {least}")
    return value


positive, non_negative = partial(at_least, 1), partial(at_least, 0)


@contextmanager
def without_logs() -> Iterator[None]:
    """Suppress the logs of flights; also a decorator."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def csv_text(names: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return rows as a CSV file with their header."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    return text.getvalue()


def say(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


LINE_EVERY_S = 15.0

OnDone = Callable[[float], None]
"""Callback with the work done, in the unit of the total."""


@contextmanager
def shown(total: float, stream: TextIO) -> Iterator[OnDone]:
    """Show progress on a stream while work is done.

    Args:
        total: Amount of work, in any unit that is proportional to time.
    """
    if not stream.isatty():
        yield progress_lines(total, stream, monotonic)
        return
    with Progress(console=Console(file=stream)) as progress:
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


def progress_lines(total: float, stream: TextIO, clock: Callable[[], float]) -> OnDone:
    """Return a callback that adds finished work, and occasionally writes a line.

    Args:
        clock: Monotonic seconds.
    """
    done, begun_s = 0.0, clock()
    said_s = begun_s

    def add(share: float) -> None:
        """Add finished work, and print a line if one is due."""
        nonlocal done, said_s
        done, now_s = done + share, clock()
        if now_s - said_s >= LINE_EVERY_S:
            said_s = now_s
            left = span_text((now_s - begun_s) * (total - done) / done)
            print(f"{done / total:4.0%} done, about {left} left", file=stream, flush=True)

    return add


def span_text(seconds: float) -> str:
    """Return the text of a duration."""
    whole = round(seconds)
    return f"{whole} s" if whole < 100 else f"{whole // 60} min {whole % 60:02d} s"
