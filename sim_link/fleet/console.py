"""What the commands share at a console: complaints in one line, and the end by Ctrl-C."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn, TextIO

from companion.errors import ConfigError


class ComplaintParser(argparse.ArgumentParser):
    """Raises what argparse would print, so that every complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ConfigError(f"{message} ({self.prog} --help shows how)")


class LinePrinter:
    """Lines on an output, until nobody reads them any more."""

    def __init__(self, output: TextIO) -> None:
        self._output = output
        self._is_heard = True

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


def is_interrupt(error: BaseException | None) -> bool:
    """Whether it comes of a Ctrl-C: compiled code turns that into a SystemError of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
