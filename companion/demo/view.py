"""The live one-screen view: what an operator wants to know, in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from companion.domain import EstimateState
from companion.estimation.innovation_noise import TrackerHealth
from companion.guidance.commands import Severity
from companion.guidance.states import IN_CONTROL, Phase
from companion.guidance.status import GuidanceStatus

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
BAR_WIDTH = 30
BAR_FULL_M = 50.0


def screen(
    status: GuidanceStatus,
    texts: Iterable[tuple[float, Severity, str]],
    setpoint_rate_hz: float,
    bad_frames: int,
    stop_radius_m: float,
) -> Panel:
    """The whole screen for one moment."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", justify="right", no_wrap=True)
    grid.add_column(min_width=52)
    for name, value in _rows(status, setpoint_rate_hz, bad_frames, stop_radius_m):
        grid.add_row(name, value)
    title = f"companion demo, {status.time_s:.0f} s"
    return Panel(Group(grid, Text(), *_texts(texts)), title=title, width=WIDTH)


def _rows(
    status: GuidanceStatus, setpoint_rate_hz: float, bad_frames: int, stop_radius_m: float
) -> list[tuple[str, Text]]:
    link = Text("lost", "bold red") if status.is_link_lost else Text("good", "green")
    link.append(f", {bad_frames} bad frames, {setpoint_rate_hz:.0f} setpoints/s", "default")
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
        *_estimate_rows(status, stop_radius_m),
        ("reflected", Text(_reflected(status.health))),
        ("ranging", Text(f"{status.accepted} used, {refused} refused")),
        ("link", link),
        ("guard", Text(guard or "-")),
    ]


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


def _texts(texts: Iterable[tuple[float, Severity, str]]) -> list[Text]:
    return [
        Text(f"{time_s:6.1f} s  {text}", SEVERITY_STYLE.get(severity, "default"))
        for time_s, severity, text in texts
    ]
