"""A flight journal that also keeps what the demonstration draws."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path

from companion.guidance.commands import Severity
from companion.io.journal import FlightJournal

SHOWN_TEXTS = 5


class RecordingJournal(FlightJournal):
    """Keeps the estimates, the waypoints and the latest texts in memory as well."""

    def __init__(
        self, directory: Path, started_unix_s: float, max_bytes: int | None = None
    ) -> None:
        super().__init__(directory, started_unix_s, max_bytes)
        self.estimates: list[tuple[float, float, float, float]] = []
        """(time_s, east_m, north_m, r95_m)"""
        self.crossings: list[tuple[float, float, float]] = []
        """(time_s, east_m, north_m) of every crossing point chosen."""
        self.texts: deque[tuple[float, Severity, str]] = deque(maxlen=SHOWN_TEXTS)
        self.is_quiet = False
        """Whether a live view shows the texts already."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an event, on disk and for the picture."""
        super().record(kind, fields, now_s)
        place = fields.get("position_enu_m")
        if not isinstance(place, tuple):
            return
        if kind == "estimate":
            r95_m = fields.get("r95_m")
            if isinstance(r95_m, float):
                self.estimates.append((now_s, place[0], place[1], r95_m))
        elif kind == "waypoint":
            self.crossings.append((now_s, place[0], place[1]))

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Keep a text, and print it where no live view shows it."""
        self.texts.append((now_s, severity, text))
        if self.is_quiet:
            fields = {"severity": severity.name.lower(), "text": text}
            super().record("text", fields, now_s)
        else:
            super().text(severity, text, now_s)
