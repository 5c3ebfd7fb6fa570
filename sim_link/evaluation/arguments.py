"""Arguments that the tools share: a parser that complains in one line, and whole numbers."""

from __future__ import annotations

import argparse
from typing import NoReturn

EXIT_BAD_INPUT = 2


class OneLineParser(argparse.ArgumentParser):
    """Complains in one line, without the usage in front of it."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        name = self.prog.replace(".py", "")
        self.exit(EXIT_BAD_INPUT, f"{name}: {message} (--help shows how)\n")


def positive(text: str) -> int:
    """A whole number of at least 1.

    Raises:
        argparse.ArgumentTypeError: It is less, or none.
    """
    return _at_least(1, text)


def non_negative(text: str) -> int:
    """A whole number of at least 0.

    Raises:
        argparse.ArgumentTypeError: It is less, or none.
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
