"""What the commands share at a console: complaints in one line, and the end by Ctrl-C."""

from __future__ import annotations

import argparse
from typing import NoReturn

from companion.errors import ConfigError


class ComplaintParser(argparse.ArgumentParser):
    """Raises what argparse would print, so that every complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ConfigError(f"{message} ({self.prog} --help shows how)")


def is_interrupt(error: BaseException | None) -> bool:
    """Whether it comes of a Ctrl-C: compiled code turns that into a SystemError of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
