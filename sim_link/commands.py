"""The subcommands of `sim-link`: `mission run`, `radio` and `proxy`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NoReturn

from companion.errors import ConfigError
from sim_link.faults import proxy_cli
from sim_link.mission import cli as mission_cli
from sim_link.mission import radio_cli


class _Parser(argparse.ArgumentParser):
    """Raises what argparse would print, so that every complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ConfigError(f"{message} ({self.prog} --help shows how)")


def run_subcommand(argv: Sequence[str]) -> int:
    """Run it.

    Args:
        argv: Arguments without the program's name.

    Returns:
        The exit code.

    Raises:
        CompanionError: Bad input, or something could not be done.
    """
    arguments = _parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="sim-link")
    commands = parser.add_subparsers(required=True, metavar="{mission,radio,proxy}")
    mission = commands.add_parser("mission", help="fly mission scripts")
    kinds = mission.add_subparsers(required=True, metavar="{run}")
    run = kinds.add_parser(
        "run",
        help="fly scripts and tell pass or fail",
        description=mission_cli.DESCRIPTION,
        epilog=mission_cli.EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    mission_cli.add_arguments(run)
    run.set_defaults(run=mission_cli.run)
    radio = commands.add_parser(
        "radio",
        help="a radio payload for a vehicle that has none",
        description=radio_cli.DESCRIPTION,
        epilog=radio_cli.EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    radio_cli.add_arguments(radio)
    radio.set_defaults(run=radio_cli.run)
    proxy = commands.add_parser(
        "proxy",
        help="a bad link between a vehicle and a companion",
        description=proxy_cli.DESCRIPTION,
        epilog=proxy_cli.EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    proxy_cli.add_arguments(proxy)
    proxy.set_defaults(run=proxy_cli.run)
    return parser
