"""`companion radio`: its arguments, and what each of its commands does."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from companion.errors import ConfigError
from companion.radios.catalogue import known_radios, radio_kind

COMMANDS = "{list}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `companion radio` understands."""
    commands = parser.add_subparsers(dest="radio_command", metavar=COMMANDS, required=True)
    commands.add_parser("list", help="every radio that can be chosen, and what it gives")


def run(arguments: argparse.Namespace) -> int:
    """Do it; the exit code."""
    commands: dict[str, Callable[[argparse.Namespace], int]] = {"list": _list}
    return commands[arguments.radio_command](arguments)


def _list(arguments: argparse.Namespace) -> int:
    del arguments
    rows = [("name", "gives", "emitter must carry", "transport", "what")]
    broken = []
    for name, origin in known_radios().items():
        try:
            kind = radio_kind(name)
        except ConfigError as error:
            broken.append(str(error))
            continue
        title = kind.title if origin == "built in" else f"{kind.title} (from {origin})"
        rows.append((name, kind.gives, kind.emitter, kind.transport, title))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for row in rows:
        cells = [f"{cell:<{width}}" for cell, width in zip(row[:4], widths, strict=True)]
        print("  ".join([*cells, row[4]]).rstrip())
    for problem in broken:
        print(f"broken: {problem}")
    return 0
