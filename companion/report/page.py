"""The flight report as a page with its drawings; complete in itself: no network, no scripts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from companion import __version__
from companion.config.schema import CompanionConfig
from companion.domain import Point
from companion.estimation.filters.losses import asymmetric_huber_loss, threshold
from companion.flight_setup import FlightFacts, open_flight
from companion.geometry.polygons import CHI2_95_TWO, ellipse_95
from companion.io.files import EVENTS, REPORT, write_text_atomic
from companion.io.logs.log_files import event_lines
from companion.report.flight_summary import EstimatePoint, FlightSummary, Line, summarize_events
from companion.report.svg import Drawing, square_around

MAP_SIZE = 640.0
CHART_SIZE = (560.0, 220.0)
BINS = 50
ELLIPSES = 8
"""Shown on the map, evenly over the flight; the newer, the stronger."""
ELLIPSE_CORNERS = 90
FAINTEST = 0.2
LEAST_M = 1e-3
"""A logarithmic axis has no zero."""


@dataclass(frozen=True, slots=True)
class Chart:
    """A drawing with its heading and how to read it."""

    title: str
    note: str
    svg: str


def flight_map(story: FlightSummary, config: CompanionConfig) -> str:
    """The track, the estimates and their shrinking ellipses, inside the fence."""
    limits = config.limits
    points = [*story.track_enu_m, *(point.place_enu_m for point in story.estimates)]
    points += [place for _, place, _ in story.waypoints]
    fence, keep_outs = fence_of(story, config)
    west, east, south, north = square_around(points or fence or limits.fence_enu_m, 10.0)
    drawing = Drawing(MAP_SIZE, MAP_SIZE - 16.0, (west, east), (south, north), "Map of the flight")
    if fence:
        drawing.area(fence, "fence")
    for polygon in keep_outs:
        drawing.area(polygon, "obstacle")
    _ellipses(drawing, story, east - west)
    drawing.line(story.track_enu_m, "track")
    drawing.dots([place for _, place, _ in story.waypoints], "waypoint", 3.0)
    last = story.last
    if last is not None:
        drawing.circle(last.place_enu_m, last.r95_m, "radius", f"R95 {last.r95_m:.2f} m")
        drawing.cross(last.place_enu_m, "place", "estimate")
    return drawing.svg()


def fence_of(
    story: FlightSummary, config: CompanionConfig
) -> tuple[Sequence[Point], Sequence[Sequence[Point]]]:
    """The fence that the guard kept, and its keep-outs; empty where nobody knows.

    A log without it is of a flight that never knew one, or of an earlier version: then the
    configuration's counts, which has only a default where the fence comes from elsewhere.
    """
    limits = config.limits
    if story.fence is not None:
        return story.fence
    return limits.fence_enu_m if limits.is_fence_local else (), limits.keep_out_enu_m


def _ellipses(drawing: Drawing, story: FlightSummary, width_m: float) -> None:
    """How the estimate shrank; an ellipse that is larger than the map would only tint it."""
    spread = _spread([p for p in story.estimates if p.covariance_m2 is not None])
    for number, point in enumerate(spread):
        if point.covariance_m2 is None or 2.0 * point.r95_m > width_m:
            continue
        corners = ellipse_95(point.place_enu_m, point.covariance_m2).corners_enu_m(ELLIPSE_CORNERS)
        strength = FAINTEST + (1.0 - FAINTEST) * number / max(1, len(spread) - 1)
        drawing.area(corners, "ellipse", strength)


def charts(story: FlightSummary, config: CompanionConfig) -> list[Chart]:
    """R95, offset, residuals, their histogram beside the fitted loss, and NIS."""
    found = [
        _over_time(
            story,
            [(p.time_s, max(p.r95_m, LEAST_M)) for p in story.estimates],
            "R95",
            "metres over seconds, logarithmic",
            is_log=True,
        )
    ]
    offsets = [(p.time_s, v) for p in story.estimates if (v := p.range_offset_m) is not None]
    found.append(_over_time(story, offsets, "Range offset", "metres over seconds"))
    residuals = [(p.time_s, v) for p in story.estimates if (v := p.range_innovation_m) is not None]
    found.append(_over_time(story, residuals, "Range residuals", "metres over seconds", dots=True))
    found.append(_histogram([value for _, value in residuals], config))
    found.append(_nis(story))
    return [chart for chart in found if chart is not None]


def _over_time(
    story: FlightSummary,
    points: list[Point],
    title: str,
    note: str,
    *,
    is_log: bool = False,
    dots: bool = False,
) -> Chart | None:
    if not points:
        return None
    values = [value for _, value in points]
    low, high = min(values), max(values)
    span = (low / 1.5, high * 1.5) if is_log else (low - 0.5, high + 0.5)
    drawing = Drawing(*CHART_SIZE, _time_span(story), span, title, is_log=is_log)
    if dots:
        drawing.dots(points, "estimate")
    else:
        drawing.line(points, "radius")
    return Chart(title, note, drawing.svg())


def _histogram(values: list[float], config: CompanionConfig) -> Chart | None:
    """How often a range was how much too long, and what the filter's loss expects."""
    if not values:
        return None
    low, high = min(values), max(values) + 1e-6
    width = (high - low) / BINS
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int((value - low) / width))] += 1
    places = [low + (high - low) * step / 200 for step in range(201)]
    expected = [
        (x, len(values) * width * y) for x, y in zip(places, _density(places, config), strict=True)
    ]
    top = max([*counts, *(y for _, y in expected)]) * 1.05
    drawing = Drawing(*CHART_SIZE, (low, high), (0.0, top), "Histogram of range residuals")
    for number, count in enumerate(counts):
        left, right = low + number * width, low + (number + 1) * width
        drawing.area([(left, 0.0), (left, count), (right, count), (right, 0.0)], "bar")
    drawing.line(expected, "error")
    note = "how many over metres; line: what the filter's loss expects of them"
    return Chart("Residuals and fitted loss", note, drawing.svg())


def _density(places: Sequence[float], config: CompanionConfig) -> list[float]:
    """exp(-loss), normalised over the places."""
    noise = config.estimation.filter
    k_long, k_short = threshold(noise.range_k_long), threshold(noise.range_k_short)
    sigma_m = noise.range_sigma_m
    heights = [math.exp(-asymmetric_huber_loss(x / sigma_m, k_long, k_short)) for x in places]
    step = places[1] - places[0]
    return [height / (sum(heights) * step) for height in heights]


def _nis(story: FlightSummary) -> Chart | None:
    points = [(p.time_s, v) for p in story.estimates if (v := p.nis) is not None]
    if not points:
        return None
    band = CHI2_95_TWO
    top = max(band * 2.0, sorted(v for _, v in points)[int(0.98 * (len(points) - 1))] * 1.2)
    drawing = Drawing(*CHART_SIZE, _time_span(story), (0.0, top), "NIS over time")
    drawing.dots([(t, min(v, top)) for t, v in points], "estimate")
    drawing.line([(0.0, band), (_time_span(story)[1], band)], "error")
    share = sum(v <= band for _, v in points) / len(points)
    note = (
        f"over seconds; {100 * share:.0f} % under the line, 95 % are expected of range and bearing"
    )
    return Chart("NIS", note, drawing.svg())


def _time_span(story: FlightSummary) -> Point:
    return (0.0, max(story.ended_s, 1.0))


def _spread(points: Sequence[EstimatePoint]) -> list[EstimatePoint]:
    if len(points) <= ELLIPSES:
        return list(points)
    last = len(points) - 1
    return [points[round(last * number / (ELLIPSES - 1))] for number in range(ELLIPSES)]


MAX_TOLD = 500
"""Lines of the table of events; the event log has all."""
QUICK_BYTES = 3_000_000
"""An event log up to this, a quarter of an hour, is a report in well under a second."""

LINK_WORDS = {
    "loss": "share of frames lost",
    "received": "frames received",
    "lost": "frames lost",
    "late": "frames late",
    "duplicates": "frames received twice",
    "overtaken": "frames overtaken by newer ones",
    "tick_s": "control tick, s",
    "missed_ticks": "control ticks missed",
    "stalls": "times that the computer stood still",
    "undecodable": "frames that could not be read",
    "strangers": "frames of strangers",
    "moves": "times that the autopilot's address changed",
    "echoes": "own frames that came back",
    "setpoints": "setpoints sent",
    "setpoint_rate_hz": "setpoints a second, at the end",
    "accepted": "measurements accepted",
    "refused": "measurements refused",
    "restarts": "restarts of the autopilot",
}
"""What the counters of the event log mean; one that is new has its own name."""


def report_page(story: FlightSummary, facts: FlightFacts, name: str) -> str:
    """The page as text."""
    environment = Environment(
        loader=PackageLoader("companion.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    fence, keep_outs = fence_of(story, facts.config)
    return environment.get_template("flight.html.j2").render(
        name=name,
        story=story,
        facts=facts,
        verdict=verdict_of(story),
        link=story.links[-1] if story.links else None,
        link_rows=_link_rows(story.links[-1]) if story.links else [],
        has_fence=bool(fence),
        has_keep_outs=bool(keep_outs),
        map=Markup(flight_map(story, facts.config)),
        charts=[
            (chart.title, chart.note, Markup(chart.svg)) for chart in charts(story, facts.config)
        ],
        told=story.told[:MAX_TOLD],
        guard=story.guard.most_common(),
        version=__version__,
    )


def verdict_of(story: FlightSummary) -> str:
    """The flight in one phrase."""
    if story.results:
        sizes = [result.get("r95_m") for result in story.results]
        told = " and ".join(f"{r95_m:.2f} m" for r95_m in sizes if isinstance(r95_m, float))
        return f"localised, R95 {told}" if told else "localised"
    if story.last is None:
        return "nothing was heard of the emitter"
    return f"not reported: {story.last.state}, R95 {story.last.r95_m:.1f} m"


def write_report(flight: Path, output: Path | None = None) -> Path:
    """Write the report of a recorded flight; where it is.

    Args:
        flight: The flight's folder, or a file in it.
        output: Where to; None: `report.html` in the folder.

    Raises:
        ConfigError: The flight cannot be read.
        CompanionError: The report cannot be written.
    """
    found = open_flight(flight)
    lines = [*_older(found.directory), *event_lines(found.path(EVENTS))]
    page = report_page(summarize_events(lines), found.facts, found.directory.resolve().name)
    path = found.path(REPORT) if output is None else output
    write_text_atomic(path, page)
    return path


def is_quick(flight: Path) -> bool:
    """Whether the report of a flight is made in about a second."""
    try:
        return (flight / EVENTS).stat().st_size <= QUICK_BYTES
    except OSError:
        return False


def _older(directory: Path) -> list[Line]:
    """What was put aside when the log reached half its cap."""
    path = directory / "events.old.jsonl"
    if not path.exists():
        return []
    lines: list[Line] = list(event_lines(path))
    return lines


def _link_rows(link: Line) -> list[tuple[str, str]]:
    rows = []
    for name, value in link.items():
        if name in ("t_s", "kind", "links"):
            continue
        rows.append((LINK_WORDS.get(name, name.replace("_", " ")), _value_text(value)))
    return rows


def _value_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_value_text(count)}" for name, count in value.items()) or "none"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
