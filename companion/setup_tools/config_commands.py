"""`companion config`: each value with its origin, and the schema for editors."""

from __future__ import annotations

import argparse
import json
import sys

from companion.config.origins import (
    DEFAULT,
    Shown,
    as_json,
    as_yaml,
    json_schema,
    notes_of,
    shown_values,
)
from companion.config.schema import load_config, with_fence, with_radios, with_signing_key


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    if arguments.config_command == "schema":
        _say(json_schema())
        return 0
    values = _values(arguments)
    if arguments.changed:
        values = [each for each in values if each.origin != DEFAULT]
    if arguments.json:
        _say(json.dumps(as_json(values), indent=2))
    else:
        _say("\n".join([*notes_of(arguments.config), *as_yaml(values)]))
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
