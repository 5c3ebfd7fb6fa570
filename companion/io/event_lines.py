"""Reads the event log back."""

from __future__ import annotations

import json
from pathlib import Path

from companion.errors import ConfigError


def event_lines(path: Path) -> list[dict[str, object]]:
    """The event log; a torn last line (a power cut) is left out.

    Raises:
        ConfigError: It cannot be read, or a line in its midst is no JSON.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    values: list[dict[str, object]] = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ConfigError(f"{path}: line {number}: {error}") from error
    return values
