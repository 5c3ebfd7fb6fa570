"""A companion's event log, read while the process that flies writes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

LOGS = "*/events.jsonl"


class EventTail:
    """Reads the companion's event log, in the folder of a flight below `root`, as it is written."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._seen = set(root.glob(LOGS))
        """Logs of an earlier mission, and those already read."""
        self._path: Path | None = None
        self._offset = 0
        self._rest = b""

    def look_for_flight(self) -> bool:
        """Return True if a new flight has begun since the last call.

        Its log is read from now on.
        """
        for path in sorted(self._root.glob(LOGS)):
            if path not in self._seen:
                self._seen.add(path)
                self._path, self._offset, self._rest = path, 0, b""
                return True
        return False

    def take(self) -> list[dict[str, Any]]:
        """Return the events since the last call; a line that is not whole yet waits."""
        if self._path is None:
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines if line]
