"""The terminal's one screen: what an operator wants to know, in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from companion.domain import EstimateState
from companion.estimation.innovation_noise import TrackerHealth
from companion.guidance.commands import Severity
from companion.guidance.states import IN_CONTROL, Phase
from companion.guidance.status import EmitterStatus, GuidanceStatus
from companion.view.moment import Moment, Told

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
SEVERITY_STYLE = {Severity.ERROR: "bold red", Severity.WARNING: "yellow"}
WIDTH = 78
"""Of the whole screen, so that it fits an 80-column terminal and does not jump."""
OLD_AFTER_S = {"autopilot": 1.0, "position": 0.5, "ranging": 5.0}
"""Ages that are shown as too old."""
BAR_WIDTH = 30
BAR_FULL_M = 50.0


def screen(moment: Moment, title: str) -> Panel:
    """The whole screen for one moment.

    Args:
        moment: What to show.
        title: Above it, before the time.
    """
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", justify="right", no_wrap=True)
    grid.add_column(min_width=52)
    for name, value in _rows(moment):
        grid.add_row(name, value)
    title = f"{title}, {moment.status.time_s:.0f} s"
    return Panel(Group(grid, *_texts(moment.texts)), title=title, width=WIDTH)


def _rows(moment: Moment) -> list[tuple[str, Text]]:
    status = moment.status
    link = Text("lost", "bold red") if status.is_link_lost else Text("good", "green")
    rates = f", {moment.bad_frames} bad frames, {moment.setpoint_rate_hz:.0f} setpoints/s"
    link.append(rates, "default")
    phase = Text(status.phase.value, PHASE_STYLE.get(status.phase, "default"))
    if status.detail:
        phase.append(f"  {status.detail}", "default")
    armed = "armed" if status.is_armed else "disarmed"
    height = "-" if status.height_m is None else f"{status.height_m:.1f} m"
    refused = sum(status.refused.values())
    guard = "; ".join(status.guard) if status.phase in IN_CONTROL else ""
    return [
        ("phase", phase),
        ("vehicle", Text(f"{status.mode.value}, {armed}, height {height}")),
        ("flown", Text(f"{status.distance_m:.0f} m")),
        ("distance", Text(_distance(status))),
        *_estimate_rows(status, moment.stop_radius_m),
        ("to go", Text(_time_to_go(moment.time_to_go_s))),
        *_emitter_rows(status.emitters),
        ("reflected", Text(_reflected(status.health))),
        ("ranging", Text(f"{status.accepted} used, {refused} refused")),
        ("ages", _ages(moment)),
        ("link", link),
        ("guard", Text(guard or "-")),
    ]


def _time_to_go(time_to_go_s: float | None) -> str:
    return "-" if time_to_go_s is None else f"about {time_to_go_s:.0f} s"


def _ages(moment: Moment) -> Text:
    """How old each input is; what is too old to be flown on is red."""
    text = Text()
    for name, age_s in moment.ages_s.items():
        is_old = age_s is None or age_s > OLD_AFTER_S.get(name, math.inf)
        age = "never" if age_s is None else f"{age_s:.1f} s"
        text.append(f"{', ' if text else ''}{name} ")
        text.append(age, "bold red" if is_old else "green")
    return text


def _emitter_rows(emitters: Sequence[EmitterStatus]) -> list[tuple[str, Text]]:
    """A row for each emitter, where there are several."""
    if len(emitters) < 2:
        return []
    rows = []
    for emitter in emitters:
        words = "reported" if emitter.is_reported else "now" if emitter.is_current else "waiting"
        if emitter.estimate is not None:
            words += f", {emitter.estimate.state.value}, R95 {emitter.estimate.r95_m:.1f} m"
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
        return [("estimate", nothing), ("R95", Text("-")), ("offsets", Text("-"))]
    east, north = estimate.position_enu_m
    where = Text(estimate.state.value, STATE_STYLE[estimate.state])
    where.append(f"  east {east:.2f} m, north {north:.2f} m", "default")
    # On a logarithmic scale each halving of the radius looks the same.
    share = math.log(max(estimate.r95_m, 0.1) / 0.1) / math.log(BAR_FULL_M / 0.1)
    length = round(BAR_WIDTH * min(max(share, 0.0), 1.0))
    is_enough = estimate.r95_m <= stop_radius_m
    bar = Text(f"{estimate.r95_m:6.2f} m  ", "bold green" if is_enough else "default")
    bar.append("█" * length, "green" if is_enough else "yellow")
    bar.append("░" * (BAR_WIDTH - length), "dim")
    offsets = (
        f"range {estimate.range_offset_m:+.2f} m, "
        f"bearing {math.degrees(estimate.bearing_offset_rad):+.2f} deg"
    )
    return [("estimate", where), ("R95", bar), ("offsets", Text(offsets))]


def _texts(texts: Sequence[Told]) -> list[Text]:
    lines = [
        Text(f"{time_s:6.1f} s  {text}", SEVERITY_STYLE.get(severity, "default"))
        for time_s, severity, text in texts
    ]
    return [Text(), *lines] if lines else []
