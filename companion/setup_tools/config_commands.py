"""`companion config`: each value with its origin, and the schema for editors."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from companion.config.origins import DEFAULT, Shown, as_json, as_yaml, json_schema, shown_values
from companion.config.schema import load_config, with_fence, with_radios, with_signing_key

COMMANDS = "{show,schema}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `companion config` understands."""
    commands = parser.add_subparsers(dest="config_command", metavar=COMMANDS, required=True)
    show = commands.add_parser(
        "show",
        help="every value, and whether it is a default, of a file or of a flag",
        description="Print the configuration that a flight with these arguments would have, as "
        "a file that can be used again, with the origin of each value behind it.",
    )
    for name, place, words in (
        ("--config", "config", "companion configuration"),
        ("--fence", "site", "as in flight"),
        ("--signing-key", "key", "as in flight"),
    ):
        show.add_argument(name, dest=place, metavar="FILE", type=Path, help=words)
    show.add_argument(
        "--radio", metavar="RADIO", action="append", default=[], dest="radios", help="as in flight"
    )
    show.add_argument("--changed", action="store_true", help="only what is no default")
    show.add_argument("--json", action="store_true", help="print a list of path, value, origin")
    commands.add_parser(
        "schema",
        help="print the JSON Schema of configuration files, for editors",
        description="Print the JSON Schema of configuration files, with what each key means.",
    )


def run(arguments: argparse.Namespace) -> int:
    """Do it; the exit code."""
    if arguments.config_command == "schema":
        _say(json_schema())
        return 0
    values = _values(arguments)
    if arguments.changed:
        values = [each for each in values if each.origin != DEFAULT]
    _say(json.dumps(as_json(values), indent=2) if arguments.json else "\n".join(as_yaml(values)))
    return 0


def _values(arguments: argparse.Namespace) -> list[Shown]:
    config = load_config(arguments.config)
    steps = [(str(arguments.config), config)]
    if arguments.site is not None:
        config = with_fence(config, arguments.site)
        steps.append((f"--fence {arguments.site}", config))
    if arguments.key is not None:
        config = with_signing_key(config, arguments.key)
        steps.append((f"--signing-key {arguments.key}", config))
    for radio in arguments.radios:
        config = with_radios(config, [radio])
        steps.append((f"--radio {radio}", config))
    return shown_values(arguments.config, steps)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n" if text else "")
