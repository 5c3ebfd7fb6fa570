"""The flight in a terminal: one screen that is redrawn, or a line now and then.

Theory of operation. A terminal may be stopped (Ctrl-S) or hang (SSH), and then a write never
returns. So the flight only leaves the newest moment in a slot; a daemon thread draws it, and
whatever came meanwhile is not drawn. Log lines go above the screen by the same console, so that
they stay in the terminal's history.
"""

from __future__ import annotations

import io
import sys
import threading
import time
from typing import TextIO

from rich.console import Console
from rich.live import Live

from companion.config.schema import CompanionConfig
from companion.link.endpoint import CompanionEndpoint
from companion.link.journal import Journal
from companion.view.moment import Moment, moment_of
from companion.view.screen import screen
from companion.view.time_to_go import TimeToGo

REFRESH_S = 0.5
"""Wall seconds between two pictures; each costs a slow computer some milliseconds."""
CLOSE_S = 0.5
"""Wall seconds that the terminal may take for the last picture."""


class ConsoleStream(io.TextIOBase):
    """A text stream whose lines appear above the screen.

    Args:
        console: Draws the screen.
    """

    def __init__(self, console: Console) -> None:
        self._console = console

    def write(self, text: str) -> int:
        """Print a line as it is: what looks like markup in it is none."""
        line = text.removesuffix("\n")
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        return len(text)


class TerminalView:
    """The screen of one flight; a `companion.run.FlightView`.

    Args:
        config: Of the flight.
        stream: A terminal.
    """

    def __init__(self, config: CompanionConfig, stream: TextIO | None = None) -> None:
        mission = config.mission
        self._time_to_go = TimeToGo(mission.stop_radius_m, mission.stop_confirm_s)
        self.console = Console(file=sys.stderr if stream is None else stream)
        self.stream = ConsoleStream(self.console)
        """For log lines."""
        self._live = Live(
            console=self.console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._next_wall_s = 0.0
        self._newest: Moment | None = None
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
        self._thread.start()

    def listen(self, journal: Journal) -> Journal:
        """Texts reach the terminal as log lines."""
        return journal

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Leave the present moment to be drawn, if it is time.

        Args:
            endpoint: The companion.
            now_s: The present.
        """
        wall_s = time.monotonic()
        if wall_s < self._next_wall_s:
            return
        self._next_wall_s = wall_s + REFRESH_S
        params, estimate = endpoint.session.params, endpoint.session.estimate
        self._time_to_go.aim(params.stop_radius_m, params.stop_confirm_s)
        r95_m = None if estimate is None else estimate.r95_m
        moment = moment_of(endpoint, now_s, self._time_to_go.observe(now_s, r95_m))
        with self._changed:
            self._newest = moment
            self._changed.notify()

    def close(self) -> None:
        """Draw what waits, for a moment at most, and leave the terminal as it was."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        moment = self._take()
        if moment is None:
            return  # the flight never began: the terminal stays as it is
        with self._live:
            while moment is not None:
                self._live.update(screen(moment, "companion"), refresh=True)
                moment = self._take()

    def _take(self) -> Moment | None:
        """The next moment, when there is one; None: there will be no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._is_closed)
            moment, self._newest = self._newest, None
            return moment
