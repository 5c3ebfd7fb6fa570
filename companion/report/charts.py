"""The drawings of a flight's report: its map, values over time, and histograms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from markupsafe import Markup

from companion.geometry.polygons import Point, ellipse_95
from companion.report.flight_summary import EstimatePoint
from companion.report.svg import SvgPlot, square_around

MAP_SIZE = 640.0
CHART_SIZE = (560.0, 220.0)
BINS = 50
ELLIPSES = 8
"""Shown of each emitter, evenly over the flight; the newer, the stronger."""
ELLIPSE_CORNERS = 90
FAINTEST = 0.2
MAP_MARGIN_M = 10.0


@dataclass(frozen=True, slots=True)
class Chart:
    """A drawing with its heading and how to read it."""

    title: str
    note: str
    svg: Markup


@dataclass(frozen=True, slots=True)
class TimeCurve:
    """Points of (time_s, value) and their class in `page.css`."""

    points: Sequence[Point]
    style: str
    is_dotted: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLayers:
    """What the map shows; places are local east and north, metres."""

    track_enu_m: Sequence[Point]
    estimates: Sequence[EstimatePoint]
    """Of all emitters, in the order of time; each emitter's last one is marked."""
    waypoints_enu_m: Sequence[Point] = ()
    fence_enu_m: Sequence[Point] = ()
    keep_outs_enu_m: Sequence[Sequence[Point]] = ()
    area_enu_m: Sequence[Point] = ()
    truth_enu_m: Mapping[str, Point] = field(default_factory=dict)
    """Where emitters truly are, by what the map calls them."""


def flight_map(layers: MapLayers) -> Markup:
    """The track, the waypoints, and the shrinking 95 % ellipses, as large as what was flown."""
    flown = [*layers.track_enu_m, *layers.waypoints_enu_m, *layers.area_enu_m]
    flown += [*layers.truth_enu_m.values(), *(point.place_enu_m for point in layers.estimates)]
    bounds = square_around(flown or layers.fence_enu_m or [(0.0, 0.0)], MAP_MARGIN_M)
    west, east, south, north = bounds
    drawing = SvgPlot(MAP_SIZE, MAP_SIZE - 16.0, (west, east), (south, north), "Map of the flight")
    for corners, style in ((layers.area_enu_m, "area"), (layers.fence_enu_m, "fence")):
        if corners:
            drawing.area(corners, style)
    for keep_out in layers.keep_outs_enu_m:
        drawing.area(keep_out, "obstacle")
    by_name = _estimates_by_name(layers.estimates)
    for points in by_name.values():
        _draw_ellipses(drawing, points, east - west)
    drawing.line(layers.track_enu_m, "track")
    drawing.dots(layers.waypoints_enu_m, "waypoint", 3.0)
    for name, place in layers.truth_enu_m.items():
        drawing.cross(place, "truth", name)
    for name, points in by_name.items():
        last = points[-1]
        drawing.circle(last.place_enu_m, last.r95_m, "radius", f"{name}, R95 {last.r95_m:.2f} m")
        if last.absolute_r95_m is not None:
            about = f"{name}, absolute R95 {last.absolute_r95_m:.2f} m"
            drawing.circle(last.place_enu_m, last.absolute_r95_m, "absolute", about)
        drawing.cross(last.place_enu_m, "place", name)
    return Markup(drawing.svg())


def _estimates_by_name(points: Sequence[EstimatePoint]) -> dict[str, list[EstimatePoint]]:
    emitters = {point.emitter_id for point in points if point.emitter_id is not None}
    by_name: dict[str, list[EstimatePoint]] = {}
    for point in points:
        is_one = len(emitters) < 2 or point.emitter_id is None
        by_name.setdefault("estimate" if is_one else f"estimate of {point.emitter_id}", []).append(
            point
        )
    return by_name


def _draw_ellipses(drawing: SvgPlot, points: Sequence[EstimatePoint], width_m: float) -> None:
    """How the estimate shrank; an ellipse that is larger than the map would only tint it."""
    chosen = [point for point in points if point.covariance_m2 is not None]
    last = len(chosen) - 1
    if last >= ELLIPSES:
        chosen = [chosen[round(last * number / (ELLIPSES - 1))] for number in range(ELLIPSES)]
    for number, point in enumerate(chosen):
        if point.covariance_m2 is None or 2.0 * point.r95_m > width_m:
            continue
        corners = ellipse_95(point.place_enu_m, point.covariance_m2).corners_enu_m(ELLIPSE_CORNERS)
        strength = FAINTEST + (1.0 - FAINTEST) * number / max(1, len(chosen) - 1)
        drawing.area(corners, "ellipse", strength)


@dataclass(frozen=True, slots=True)
class TimeCharts:
    """Draws values over the seconds of one flight."""

    ended_s: float
    marks: Sequence[tuple[float, str]] = ()
    """(time_s, name) of vertical lines, such as the steps of a mission."""

    def draw(
        self,
        title: str,
        note: str,
        *curves: TimeCurve,
        span: Point | None = None,
        is_log: bool = False,
    ) -> Chart | None:
        """The chart; None: nothing to draw. The `span` of a logarithmic axis is above 0."""
        values = [value for curve in curves for _, value in curve.points]
        if not values:
            return None
        low, high = min(values), max(values)
        if span is None:
            span = (low / 1.5, high * 1.5) if is_log else (low - 0.5, high + 0.5)
        time_s = (0.0, max(self.ended_s, 1.0))
        drawing = SvgPlot(*CHART_SIZE, time_s, span, title, is_log=is_log)
        for mark_s, name in self.marks:
            drawing.mark(mark_s, "step", name)
        for curve in curves:
            if curve.is_dotted:
                drawing.dots(curve.points, curve.style)
            else:
                drawing.line(curve.points, curve.style)
        return Chart(title, note, Markup(drawing.svg()))


def histogram(
    title: str,
    note: str,
    values: Sequence[float],
    density: Callable[[Sequence[float]], list[float]] | None = None,
) -> Chart | None:
    """How often each value was seen, beside the expected density; None: there are no values."""
    if not values:
        return None
    low, high = min(values), max(values) + 1e-6
    width = (high - low) / BINS
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int((value - low) / width))] += 1
    expected: list[Point] = []
    if density is not None:
        places = [low + (high - low) * step / 200 for step in range(201)]
        heights = (len(values) * width * height for height in density(places))
        expected = list(zip(places, heights, strict=True))
    top = max([*counts, *(height for _, height in expected)]) * 1.05
    drawing = SvgPlot(*CHART_SIZE, (low, high), (0.0, top), title)
    for number, count in enumerate(counts):
        left, right = low + number * width, low + (number + 1) * width
        drawing.area([(left, 0.0), (left, count), (right, count), (right, 0.0)], "bar")
    if expected:
        drawing.line(expected, "limit")
    return Chart(title, note, Markup(drawing.svg()))
