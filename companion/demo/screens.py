"""What the demonstration shows while it flies: the terminal's one screen, or plain lines."""

from __future__ import annotations

import sys
import time

from companion.demo.recording import RecordingJournal
from companion.link.endpoint import CompanionEndpoint

REFRESH_S = 0.15
"""Wall seconds between two pictures of the live view."""
PLAIN_REFRESH_S = 15.0
"""Seconds of the flight between two lines where there is no terminal."""


class LiveScreen:
    """The one-screen view of `companion.demo.view`, redrawn in place."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(), auto_refresh=False)
        self._next_wall_s = 0.0

    def __enter__(self) -> LiveScreen:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(
        self, endpoint: CompanionEndpoint, journal: RecordingJournal, now_s: float
    ) -> None:
        """Draw it anew, if it is time."""
        from companion.demo.view import screen

        wall_s = time.monotonic()
        if wall_s < self._next_wall_s and not endpoint.is_finished:
            return
        self._next_wall_s = wall_s + REFRESH_S
        self._live.update(
            screen(
                endpoint.session.status(now_s),
                journal.texts,
                endpoint.setpoint_rate_hz(now_s),
                endpoint.bad_frames,
                endpoint.session.params.stop_radius_m,
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
        self._next_s = now_s + PLAIN_REFRESH_S
        status = endpoint.session.status(now_s)
        line = f"{now_s:7.1f} s  {status.phase.value}, flown {status.distance_m:.0f} m"
        if status.estimate is not None:
            line += f", {status.estimate.state.value} R95 {status.estimate.r95_m:.1f} m"
        say(line)


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
