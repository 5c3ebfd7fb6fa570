"""The `companion` command: its subcommands, console output and exit codes.

Each subcommand imports its modules when it runs, so that `--help` and small commands start fast.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from typing import TypeAlias

from companion.arguments import argument_parser, check_order_of_options
from companion.errors import EXIT_BAD_INPUT, EXIT_FAILED, CompanionError
from companion.view.log_lines import set_up_logging

Command: TypeAlias = Callable[[argparse.Namespace], int]


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
    loaders = {
        "demo": _demo,
        "replay": _replay,
        "report": _report,
        "area": _area,
        "doctor": _doctor,
        "radio": _radio,
        "config": _config,
        "setup": _setup,
        "tiles": _tiles,
        "warm-up": _warm_up,
    }
    command = loaders.get(arguments.command, _fly)()
    on_loaded()
    return command(arguments)


def _fly() -> Command:
    from companion.flight_commands import fly_vehicle

    return fly_vehicle


def _demo() -> Command:
    from companion.flight_commands import fly_demo

    return fly_demo


def _replay() -> Command:
    from companion.replay.replay_commands import run

    return run


def _report() -> Command:
    from companion.report.page import run

    return run


def _area() -> Command:
    from companion.report.flight_summary import run

    return run


def _doctor() -> Command:
    from companion.doctor.examination import run

    return run


def _radio() -> Command:
    from companion.radio_tools.radio_commands import run

    return run


def _config() -> Command:
    from companion.setup_tools.config_commands import run

    return run


def _setup() -> Command:
    from companion.setup_tools.setup_commands import run

    return run


def _tiles() -> Command:
    from companion.setup_tools.config_commands import run_tiles

    return run_tiles


def _warm_up() -> Command:
    from companion.flight_commands import warm_up

    return warm_up
