"""What the demonstration shows while it flies: the terminal's one screen, or plain lines."""

from __future__ import annotations

import sys
import time

from companion.demo.recording import RecordingJournal
from companion.link.endpoint import CompanionEndpoint
from companion.view.moment import moment_of
from companion.view.plain import PERIOD_S, plain_line
from companion.view.time_to_go import TimeToGo

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
        from companion.view.screen import screen

        wall_s = time.monotonic()
        if wall_s < self._next_wall_s and not endpoint.is_finished:
            return
        self._next_wall_s = wall_s + REFRESH_S
        params, estimate = endpoint.session.params, endpoint.session.estimate
        if self._time_to_go is None:
            self._time_to_go = TimeToGo(params.stop_radius_m, params.stop_confirm_s)
        to_go_s = self._time_to_go.observe(now_s, None if estimate is None else estimate.r95_m)
        self._live.update(
            screen(moment_of(endpoint, now_s, to_go_s, tuple(journal.texts)), "companion demo"),
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
