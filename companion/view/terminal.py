"""The flight in a terminal: one text screen that is redrawn.

Theory of operation. A terminal may be stopped (Ctrl-S) or hang (SSH), and then a write never
returns. So the flight only puts the newest moment into a slot; a daemon thread draws it, and
moments between are not drawn. Log lines go above the screen by the same console, so that they stay
in the terminal's history.
"""

from __future__ import annotations

import io
import math
import sys
import threading
import time
from collections.abc import Sequence
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from companion.domain import EstimateState
from companion.errors import printable
from companion.estimation.innovations import TrackerHealth
from companion.guidance.messages import radii_of
from companion.guidance.phases import IN_CONTROL, Phase
from companion.guidance.session import EmitterStatus, GuidanceStatus
from companion.link.endpoint import CompanionEndpoint
from companion.run import FlightView
from companion.view.snapshot import FlightSnapshot, TimeToGo, flight_snapshot

PHASE_STYLE = {
    Phase.NORMAL: "bold green",
    Phase.DEGRADED: "bold yellow",
    Phase.HOLD: "bold yellow",
    Phase.YIELD: "bold red",
    Phase.FINISHED: "bold cyan",
}
STATE_STYLE = {
    EstimateState.SEARCHING: "yellow",
    EstimateState.AMBIGUOUS: "magenta",
    EstimateState.LOCALISED: "bold green",
    EstimateState.DIVERGED: "bold red",
}
WIDTH = 78
"""Width of the whole screen, which fits an 80-column terminal and does not jump."""
OLD_AFTER_S = {"autopilot": 1.0, "position": 0.5, "ranging": 5.0}
"""Ages that are shown as too old."""
BAR_WIDTH = 30
BAR_FULL_M = 50.0


def screen(moment: FlightSnapshot, title: str) -> Panel:
    """Return the whole screen for one moment."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", justify="right", no_wrap=True)
    grid.add_column(min_width=52)
    for name, value in _rows(moment):
        value.plain = printable(value.plain)
        grid.add_row(Text(printable(name)), value)
    title = f"{title}, {moment.status.time_s:.0f} s"
    return Panel(grid, title=title, width=WIDTH)


def _rows(moment: FlightSnapshot) -> list[tuple[str, Text]]:
    status, to_go_s = moment.status, moment.time_to_go_s
    link = Text("lost", "bold red") if status.is_link_lost else Text("good", "green")
    rates = f", {moment.bad_frames} bad frames, {moment.setpoint_rate_hz:.0f} setpoints/s"
    link.append(rates, "default")
    phase = Text(status.phase.value, PHASE_STYLE.get(status.phase, "default"))
    if status.detail:
        phase.append(f"  {status.detail}", "default")
    armed = "armed" if status.is_armed else "disarmed"
    height = "-" if status.height_m is None else f"{status.height_m:.1f} m"
    rejected = sum(status.refused.values())
    guard = "; ".join(status.guard) if status.phase in IN_CONTROL else ""
    return [
        ("phase", phase),
        ("do next", Text(moment.next_step, "bold")),
        ("vehicle", Text(f"{status.mode.value}, {armed}, height {height}")),
        ("flown", Text(f"{status.distance_m:.0f} m")),
        ("distance", Text(_distance(status))),
        *([] if moment.searched is None else [("searched", Text(moment.searched))]),
        *_estimate_rows(status, moment.stop_radius_m),
        ("to go", Text("-" if to_go_s is None else f"about {to_go_s:.0f} s")),
        *_emitter_rows(status.emitters),
        ("reflected", Text(_reflected(status.health))),
        ("ranging", Text(f"{status.accepted} used, {rejected} rejected")),
        *((f"radio {name}", Text(words)) for name, words in moment.radios),
        ("ages", _ages(moment)),
        ("link", link),
        ("guard", Text(guard or "-")),
    ]


def _ages(moment: FlightSnapshot) -> Text:
    """Return the age of each input; an age too old for guidance is red."""
    text = Text()
    for name, age_s in moment.ages_s.items():
        is_old = age_s is None or age_s > OLD_AFTER_S.get(name, math.inf)
        age = "never" if age_s is None else f"{age_s:.1f} s"
        text.append(f"{', ' if text else ''}{name} ")
        text.append(age, "bold red" if is_old else "green")
    return text


def _emitter_rows(emitters: Sequence[EmitterStatus]) -> list[tuple[str, Text]]:
    if len(emitters) < 2:
        return []
    rows = []
    for emitter in emitters:
        words = "reported" if emitter.is_reported else "now" if emitter.is_current else "waiting"
        if emitter.estimate is not None:
            words += f", {emitter.estimate.state.value}, {radii_of(emitter.estimate)}"
        style = "bold" if emitter.is_current else "default"
        rows.append((f"emitter {emitter.emitter_id}", Text(words, style)))
    return rows


def _reflected(health: TrackerHealth) -> str:
    text = f"{100 * health.nlos_share:.0f} % of the ranges on the NLOS branch"
    if health.observability is None:
        return text
    return f"{text}; {100 * health.observability.bilateral_share:.0f} % of all are bilateral"


def _distance(status: GuidanceStatus) -> str:
    if status.estimate is None or status.vehicle_enu_m is None:
        return "-"
    ground_m = math.dist(status.estimate.position_enu_m, status.vehicle_enu_m[:2])
    return f"{ground_m:.1f} m from the vehicle to the estimate"


def _estimate_rows(status: GuidanceStatus, stop_radius_m: float) -> list[tuple[str, Text]]:
    estimate = status.estimate
    if estimate is None:
        nothing = Text("nothing heard yet", "dim")
        names = ("R95", "relative", "offsets")
        return [("estimate", nothing), *((name, Text("-")) for name in names)]
    east, north = estimate.position_enu_m
    where = Text(estimate.state.value, STATE_STYLE[estimate.state])
    where.append(f"  east {east:.2f} m, north {north:.2f} m", "default")
    # On a logarithmic scale each halving of the radius looks the same.
    share = math.log(max(estimate.r95_m, 0.1) / 0.1) / math.log(BAR_FULL_M / 0.1)
    length = round(BAR_WIDTH * min(max(share, 0.0), 1.0))
    is_enough = estimate.settled_r95_m <= stop_radius_m
    bar = Text(f"{estimate.r95_m:6.2f} m  ", "bold green" if is_enough else "default")
    bar.append("█" * length, "green" if is_enough else "yellow")
    bar.append("░" * (BAR_WIDTH - length), "dim")
    offsets = (
        f"range {estimate.range_offset_m:+.2f} m, "
        f"bearing {math.degrees(estimate.bearing_offset_rad):+.2f} deg"
    )
    absolute = Text(f"{estimate.absolute_r95_m:6.2f} m  ", "bold")
    absolute.append(f"absolute ({estimate.own.text})", "default")
    return [
        ("estimate", where),
        ("R95", absolute),
        ("relative", bar),
        ("offsets", Text(offsets)),
    ]


REFRESH_S = 0.5
"""Wall seconds between two pictures; each costs a slow computer some milliseconds."""
CLOSE_S = 0.5
"""Wall seconds that the terminal may take for the last picture."""


class ConsoleStream(io.TextIOBase):
    """A text stream whose lines appear above the screen."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def write(self, text: str) -> int:
        """Print a line verbatim, without interpreting markup."""
        line = text.removesuffix("\n")
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        return len(text)


class TerminalView(FlightView):
    """The screen of one flight, above which its texts appear as log lines."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._time_to_go = TimeToGo()
        output = sys.stderr if stream is None else stream
        self.console = Console(file=getattr(output, "unescaped", output))
        self.stream = ConsoleStream(self.console)
        self._live = Live(
            console=self.console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._next_wall_s = 0.0
        self._newest: FlightSnapshot | None = None
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
        self._thread.start()

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Pass the current snapshot to the thread, if a picture is due."""
        wall_s = time.monotonic()
        if wall_s < self._next_wall_s:
            return
        self._next_wall_s = wall_s + REFRESH_S
        to_go_s = self._time_to_go.of_flight(endpoint, now_s)
        moment = flight_snapshot(endpoint, now_s, to_go_s)
        with self._changed:
            self._newest = moment
            self._changed.notify()

    def close(self) -> None:
        """Draw the last moment, within `CLOSE_S`, and restore the terminal."""
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

    def _take(self) -> FlightSnapshot | None:
        """Wait for the next moment and return it; None if the view is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._is_closed)
            moment, self._newest = self._newest, None
            return moment
