"""The drawings of a flight report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.config.schema import CompanionConfig
from companion.domain import Point
from companion.estimation.losses import asymmetric_huber_loss, threshold
from companion.geometry.ellipse import CHI2_95_TWO, ellipse_95
from companion.report.drawing import Drawing, square_around
from companion.report.story import EstimatePoint, Story

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


def flight_map(story: Story, config: CompanionConfig) -> str:
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
    story: Story, config: CompanionConfig
) -> tuple[Sequence[Point], Sequence[Sequence[Point]]]:
    """The fence that the guard kept, and its keep-outs; empty where nobody knows.

    A log without it is of a flight that never knew one, or of an earlier version: then the
    configuration's counts, which has only a default where the fence comes from elsewhere.
    """
    limits = config.limits
    if story.fence is not None:
        return story.fence
    return limits.fence_enu_m if limits.is_fence_local else (), limits.keep_out_enu_m


def _ellipses(drawing: Drawing, story: Story, width_m: float) -> None:
    """How the estimate shrank; an ellipse that is larger than the map would only tint it."""
    spread = _spread([p for p in story.estimates if p.covariance_m2 is not None])
    for number, point in enumerate(spread):
        if point.covariance_m2 is None or 2.0 * point.r95_m > width_m:
            continue
        corners = ellipse_95(point.place_enu_m, point.covariance_m2).corners_enu_m(ELLIPSE_CORNERS)
        strength = FAINTEST + (1.0 - FAINTEST) * number / max(1, len(spread) - 1)
        drawing.area(corners, "ellipse", strength)


def charts(story: Story, config: CompanionConfig) -> list[Chart]:
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
    story: Story,
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


def _nis(story: Story) -> Chart | None:
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


def _time_span(story: Story) -> Point:
    return (0.0, max(story.ended_s, 1.0))


def _spread(points: Sequence[EstimatePoint]) -> list[EstimatePoint]:
    if len(points) <= ELLIPSES:
        return list(points)
    last = len(points) - 1
    return [points[round(last * number / (ELLIPSES - 1))] for number in range(ELLIPSES)]
