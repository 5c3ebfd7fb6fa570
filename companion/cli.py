"""The `companion` command: its subcommands, console output and exit codes.

Each subcommand imports its modules when it runs, so that `--help` and small commands start fast.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import TypeAlias

from companion.arguments import argument_parser
from companion.errors import EXIT_BAD_INPUT, EXIT_FAILED, CompanionError, ConfigError
from companion.view.log_lines import set_up_logging

Command: TypeAlias = Callable[[argparse.Namespace], int]
FLY = "companion.flight_commands:fly_vehicle"
COMMANDS = {
    "demo": "companion.flight_commands:fly_demo",
    "replay": "companion.replay.replay_commands:run",
    "report": "companion.report.page:run",
    "area": "companion.report.flight_summary:run",
    "doctor": "companion.doctor.examination:run",
    "radio": "companion.radio_tools.radio_commands:run",
    "config": "companion.setup_tools.config_commands:run",
    "setup": "companion.setup_tools.setup_commands:run",
    "tiles": "companion.setup_tools.config_commands:run_tiles",
    "warm-up": "companion.flight_commands:warm_up",
}
"""Function of each subcommand, a `Command`."""


def main(argv: Sequence[str] | None = None, on_loaded: Callable[[], object] = lambda: None) -> int:
    """Run the command, and return the exit code.

    0 is success, 1 a failed run, 2 bad input or a link that does not open, 3 a search that came to
    its end with nothing heard. `on_loaded` is called once everything is imported.
    """
    try:
        try:
            return _run(argv, on_loaded)
        finally:  # log lines come before the error below
            for handler in logging.getLogger("companion").handlers:
                handler.close()
    except CompanionError as error:
        for line in str(error).splitlines():
            print(f"companion: {line}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("companion: interrupted", file=sys.stderr)
        return EXIT_FAILED


def _run(argv: Sequence[str] | None, on_loaded: Callable[[], object]) -> int:
    arguments = argument_parser().parse_args(argv)
    set_up_logging(quiet=arguments.quiet)
    check_order_of_options(arguments)
    command: Command = resolve_name(COMMANDS.get(arguments.command, FLY))
    on_loaded()
    return command(arguments)


FLIGHT_OPTIONS = (
    "connect ranging radio gcs cot fence signing_key insecure fresh once "
    "web_control web_token web_open"
)
SHARED_OPTIONS = "config speed web web_tiles"


def check_order_of_options(arguments: argparse.Namespace) -> None:
    """Refuse options of flying in front of a subcommand, which would ignore them."""
    if arguments.command is None:
        return
    attributes = {name: name for name in FLIGHT_OPTIONS.split()}
    attributes |= {name: f"fly_{name}" for name in SHARED_OPTIONS.split()}
    for name, attribute in attributes.items():
        if getattr(arguments, attribute) not in (None, [], False):
            option, word = f"--{name.replace('_', '-')}", arguments.command
            raise ConfigError(f"{option} in front of `{word}` has no effect; put options after it")
