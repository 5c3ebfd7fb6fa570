"""The drawings of a flight's report: its map, values over time, and histograms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import sub

from markupsafe import Markup

from companion.geometry.polygons import Point, ellipse_95
from companion.report.basemap import Picture
from companion.report.flight_summary import EstimatePoint
from companion.report.svg import SvgPlot, square_around

MAP_SIZE = 640.0
CHART_SIZE = (560.0, 220.0)
BINS = 50
LEAST_SPAN = 1e-3
"""Least span of the axis of a histogram whose values are all the same."""
ELLIPSES = 8
"""Shown of each emitter, evenly over the flight; the newer, the stronger."""
ELLIPSE_CORNERS = 90
FAINTEST = 0.2
MAP_MARGIN_M = 10.0


Bounds = tuple[float, float, float, float]
"""West, east, south and north of a map."""


def no_pictures(bounds: Bounds) -> Sequence[Picture]:
    """Return no pictures for a map without a background."""
    del bounds
    return ()


@dataclass(frozen=True, slots=True)
class Chart:
    """A drawing with its heading and a note that explains it."""

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
    """Contents of the map; places are local east and north, metres."""

    track_enu_m: Sequence[Point]
    estimates: Sequence[EstimatePoint]
    """Estimates of all emitters, in the order of time; each emitter's last one is marked."""
    waypoints_enu_m: Sequence[Point] = ()
    fence_enu_m: Sequence[Point] = ()
    keep_outs_enu_m: Sequence[Sequence[Point]] = ()
    area_enu_m: Sequence[Point] = ()
    truth_enu_m: Mapping[str, Point] = field(default_factory=dict)
    """True positions of emitters, by their labels on the map."""
    pictures: Callable[[Bounds], Sequence[Picture]] = no_pictures
    """Background of the map."""


def flight_map(layers: MapLayers) -> Markup:
    """Draw the track, the waypoints, and the shrinking 95 % ellipses, as large as the flight."""
    flown = [*layers.track_enu_m, *layers.waypoints_enu_m, *layers.area_enu_m]
    flown += [*layers.truth_enu_m.values(), *(point.place_enu_m for point in layers.estimates)]
    bounds = square_around(flown or layers.fence_enu_m or [(0.0, 0.0)], MAP_MARGIN_M)
    west, east, south, north = bounds
    drawing = SvgPlot(MAP_SIZE, MAP_SIZE - 16.0, (west, east), (south, north), "Map of the flight")
    for picture in layers.pictures(bounds):
        drawing.picture(picture.url, picture.north_west_enu_m, picture.south_east_enu_m)
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
        drawing.circle(
            last.place_enu_m, last.r95_m, "radius", f"{name}, R95 {last.r95_m:.2f} m relative"
        )
        if last.absolute_r95_m is not None:
            about = f"{name}, R95 {last.absolute_r95_m:.2f} m absolute"
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
    """Draw the shrinking estimate; an ellipse larger than the map would only tint it."""
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
        """Return the chart; None without points. The `span` of a logarithmic axis is above 0."""
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


TRIMMED_SHARE = 0.02
"""Share of the values, on either side, that the axis of a histogram may leave out."""


def histogram(
    title: str,
    note: str,
    values: Sequence[float],
    cumulative: Callable[[float], float] | None = None,
) -> Chart | None:
    """Draw the frequency of the values; None: there are no values.

    A line shows the expected frequency by the `cumulative` probability, of whole bars, so that both
    have one scale, however narrow the distribution. A few distant values would squeeze all others
    into one bar, so the outermost bars contain all values beyond them, too.
    """
    if not values:
        return None
    ordered, beyond = sorted(values), int(TRIMMED_SHARE * len(values))
    low, high = ordered[beyond], ordered[-1 - beyond]
    if high - low < LEAST_SPAN:
        low, high = low - 0.5 * LEAST_SPAN, high + 0.5 * LEAST_SPAN
    width = (high - low) / BINS
    edges = [low + width * number for number in range(BINS + 1)]
    counts = [0] * BINS
    for value in values:
        counts[max(0, min(BINS - 1, int((value - low) / width)))] += 1
    bars = list(zip(edges, edges[1:], counts, strict=False))
    expected: list[Point] = []
    if cumulative is not None:
        below = [0.0, *map(cumulative, edges[1:-1]), 1.0]
        for left, right, share in zip(edges, edges[1:], map(sub, below[1:], below), strict=False):
            expected += [(left, len(values) * share), (right, len(values) * share)]
    top = max([*counts, *(height for _, height in expected)]) * 1.05
    drawing = SvgPlot(*CHART_SIZE, (low, high), (0.0, top), title)
    for left, right, count in bars:
        drawing.area([(left, 0.0), (left, count), (right, count), (right, 0.0)], "bar")
    if expected:
        drawing.line(expected, "limit")
    if ordered[0] < low or ordered[-1] > high:
        note += f"; the outermost bars have all beyond them ({ordered[0]:.3g} to {ordered[-1]:.3g})"
    return Chart(title, note, Markup(drawing.svg()))
