"""What the demonstration shows while it flies: the terminal's one screen, or plain lines.

The flight journal also keeps what the demonstration draws.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

from companion.guidance.commands import Severity
from companion.io.logs.flight_recorder import FlightJournal
from companion.link.endpoint import CompanionEndpoint
from companion.view.console import PERIOD_S, plain_line
from companion.view.snapshot import TimeToGo, flight_snapshot

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


REFRESH_S = 0.15
"""Wall seconds between two pictures of the live view."""


class LiveScreen:
    """The screen of `companion.view.screen`, redrawn in place."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(), auto_refresh=False)
        self._next_wall_s = 0.0
        self._time_to_go: TimeToGo | None = None

    def __enter__(self) -> LiveScreen:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(
        self, endpoint: CompanionEndpoint, journal: RecordingJournal, now_s: float
    ) -> None:
        """Draw it anew, if it is time."""
        from companion.view.terminal import screen

        wall_s = time.monotonic()
        if wall_s < self._next_wall_s and not endpoint.is_finished:
            return
        self._next_wall_s = wall_s + REFRESH_S
        params, estimate = endpoint.session.params, endpoint.session.estimate
        if self._time_to_go is None:
            self._time_to_go = TimeToGo(params.stop_radius_m, params.stop_confirm_s)
        to_go_s = self._time_to_go.observe(now_s, None if estimate is None else estimate.r95_m)
        self._live.update(
            screen(
                flight_snapshot(endpoint, now_s, to_go_s, tuple(journal.texts)), "companion demo"
            ),
            refresh=True,
        )


class PlainLines:
    """A line now and then, where the output is no terminal or rich is not installed."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def __enter__(self) -> PlainLines:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, endpoint: CompanionEndpoint, _: RecordingJournal, now_s: float) -> None:
        """Print a line, if it is time."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        say(plain_line(endpoint.session.status(now_s)))


def best_screen() -> LiveScreen | PlainLines:
    """The live screen on a terminal, lines elsewhere."""
    if sys.stdout.isatty():
        try:
            return LiveScreen()
        except ImportError:
            say("for the live view: pip install 'companion-guidance[demo]'")
    return PlainLines()


def say(line: str) -> None:
    """Print a line now."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
