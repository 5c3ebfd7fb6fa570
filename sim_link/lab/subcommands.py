"""The subcommands of `sim-link`: `mission run`, `radio` and `proxy`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from types import ModuleType

from companion.arguments import RaisingParser
from sim_link.lab import radio_command
from sim_link.lab.faults import proxy
from sim_link.lab.mission import mission_cli


def run_subcommand(argv: Sequence[str]) -> int:
    """Run it; return the exit code. `CompanionError`: bad input, or something could not be done."""
    arguments = subcommand_parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def subcommand_parser() -> argparse.ArgumentParser:
    """Return the parser of `sim-link` with a subcommand."""
    parser = RaisingParser(prog="sim-link")
    commands = parser.add_subparsers(required=True, metavar="{mission,radio,proxy}")
    mission = commands.add_parser("mission", help="fly mission scripts")
    kinds = mission.add_subparsers(required=True, metavar="{run}")
    _add(kinds, "run", "fly scripts and report pass or fail", mission_cli)
    _add(commands, "radio", "a radio payload for a vehicle that has none", radio_command)
    _add(commands, "proxy", "a bad link between a vehicle and a companion", proxy)
    return parser


def _add(
    commands: argparse._SubParsersAction[RaisingParser],
    name: str,
    summary: str,
    module: ModuleType,
) -> None:
    """Add a subcommand by its module's DESCRIPTION, EPILOG, `add_arguments` and `run`."""
    parser = commands.add_parser(
        name,
        help=summary,
        description=module.DESCRIPTION,
        epilog=module.EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    parser.set_defaults(run=module.run)
