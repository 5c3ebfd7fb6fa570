"""The flight's events as JSON lines, one record each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from companion.io.background_file import BackgroundFile
from companion.io.files import plain


class EventLog:
    """Writes records from a background thread; never raises and never waits once it is open.

    Args:
        path: The `.jsonl` file; its directory exists. An existing one is continued.

    Raises:
        CompanionError: The file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = BackgroundFile(path)

    @property
    def dropped(self) -> int:
        """Records lost to a slow or full disk."""
        return self._file.dropped

    def write(self, record: Mapping[str, object]) -> None:
        """Record one event; NaN and infinity become null, control characters are escaped."""
        line = json.dumps(plain(record), allow_nan=False, separators=(",", ":"))
        self._file.append(line.encode("ascii") + b"\n")

    def close(self) -> None:
        """Write what is queued, for one second at most, and close."""
        self._file.close()
