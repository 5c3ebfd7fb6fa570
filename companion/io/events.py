"""The flight's events as JSON lines, one record each."""

from __future__ import annotations

import json
from collections.abc import Mapping

from companion.io.background_file import BackgroundLog
from companion.io.files import plain


class EventLog(BackgroundLog):
    """Writes records from a background thread; see `BackgroundLog`."""

    def write(self, record: Mapping[str, object]) -> None:
        """Record one event; NaN and infinity become null, control characters are escaped."""
        line = json.dumps(plain(record), allow_nan=False, separators=(",", ":"))
        self._file.append(line.encode("ascii") + b"\n")
