"""The drawings of a flight's report: its map, values over time, and histograms.

They are SVG, made of text alone; map tiles from a folder are embedded below the map.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import sub
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

from markupsafe import Markup

from companion.geometry.coordinates import LocalOrigin, corner_of, tile_at
from companion.geometry.polygons import Point, ellipse_95
from companion.report.flight_summary import EstimatePoint
from companion.web.settings import IMAGE_KINDS, MAX_TILE_BYTES, tile_path, zooms_of

MARGIN = 44.0
"""Margin around the plot, for the ticks."""
MAX_POINTS = 1500
"""Maximum number of points of a curve; more cannot be distinguished."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Mapping from values to coordinates of the drawing."""

    low: float
    high: float
    start: float
    end: float
    is_log: bool = False

    def at(self, value: float) -> float:
        """Return the coordinate of a value."""
        low, high = self.low, self.high
        if self.is_log:
            low, high, value = math.log(low), math.log(high), math.log(max(value, low))
        return self.start + (value - low) / (high - low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return round values for labels."""
        if self.is_log:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            decades = [10.0**power for power in range(first, last + 1)]
            return [value for value in decades if self.low <= value <= self.high]
        rough = (self.high - self.low) / 5.0
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough * 0.999)
        first_tick = math.ceil(self.low / step) * step
        count = math.floor((self.high - first_tick) / step) + 1
        return [first_tick + number * step for number in range(count)]


class SvgPlot:
    """A plot with two axes; its title is for screen readers."""

    def __init__(
        self,
        width: float,
        height: float,
        x: tuple[float, float],
        y: tuple[float, float],
        title: str,
        *,
        is_log: bool = False,
    ) -> None:
        self._size = (width, height)
        self._title = title
        self.x = Axis(*x, MARGIN, width - 12.0)
        self.y = Axis(*y, height - 28.0, 12.0, is_log)
        self._parts: list[str] = []
        self._pictures: list[str] = []

    def line(self, points: Iterable[Point], style: str) -> None:
        """Add a curve through points."""
        self._parts.append(f'<polyline class="{style}" points="{self._coordinates(points)}"/>')

    def area(self, corners: Iterable[Point], style: str, opacity: float = 1.0) -> None:
        """Add a polygon."""
        faint = "" if opacity == 1.0 else f' opacity="{opacity:.2f}"'
        self._parts.append(
            f'<polygon class="{style}"{faint} points="{self._coordinates(corners)}"/>'
        )

    def dots(self, points: Iterable[Point], style: str, radius: float = 1.6) -> None:
        """Add a dot at every point, as one path so that thousands stay light."""
        moves = "".join(
            f"M{self.x.at(px):.1f} {self.y.at(py):.1f}h0" for px, py in thin_points(list(points))
        )
        if moves:
            self._parts.append(f'<path class="{style}" stroke-width="{2 * radius:g}" d="{moves}"/>')

    def picture(self, url: str, north_west: Point, south_east: Point) -> None:
        """Add a picture below all other parts, cut at the edges of the plot."""
        left, top = self.x.at(north_west[0]), self.y.at(north_west[1])
        width, height = self.x.at(south_east[0]) - left, self.y.at(south_east[1]) - top
        self._pictures.append(
            f'<image href={quoteattr(url)} x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" '
            f'height="{height:.1f}" preserveAspectRatio="none" clip-path="url(#plot)"/>'
        )

    def circle(self, centre: Point, radius: float, style: str, name: str = "") -> None:
        """Add a circle whose radius is a length of the horizontal axis."""
        scale = (self.x.end - self.x.start) / (self.x.high - self.x.low)
        cx, cy = self.x.at(centre[0]), self.y.at(centre[1])
        title = f"<title>{escape(name)}</title>" if name else ""
        self._parts.append(
            f'<circle class="{style}" cx="{cx:.1f}" cy="{cy:.1f}" r="{scale * radius:.1f}">'
            f"{title}</circle>"
        )

    def cross(self, position: Point, style: str, name: str) -> None:
        """Add a cross with a name."""
        cx, cy = self.x.at(position[0]), self.y.at(position[1])
        self._parts.append(
            f'<path class="{style}" d="M{cx - 6:.1f} {cy:.1f}h12M{cx:.1f} {cy - 6:.1f}v12">'
            f"<title>{escape(name)}</title></path>"
            f'<text class="label" x="{cx + 8:.1f}" y="{cy - 6:.1f}">{escape(name)}</text>'
        )

    def mark(self, value: float, style: str, name: str) -> None:
        """Add a vertical line with a name."""
        px = self.x.at(value)
        self._parts.append(
            f'<path class="{style}" d="M{px:.1f} {self.y.end:.1f}V{self.y.start:.1f}">'
            f"<title>{escape(name)}</title></path>"
        )

    def svg(self) -> str:
        """Return the drawing as an SVG element."""
        width, height = self._size
        x, y = self.x, self.y
        plot = (
            f'<clipPath id="plot"><rect x="{x.start:g}" y="{y.end:g}" '
            f'width="{x.end - x.start:g}" height="{y.start - y.end:g}"/></clipPath>'
        )
        below = plot + "".join(self._pictures) if self._pictures else ""
        return (
            f'<svg viewBox="0 0 {width:g} {height:g}" role="img" '
            f"aria-label={quoteattr(self._title)}>{below}{self._grid()}{''.join(self._parts)}</svg>"
        )

    def _grid(self) -> str:
        x, y = self.x, self.y
        parts = []
        for value in x.ticks():
            px = x.at(value)
            line = f"M{px:.1f} {y.end:.1f}V{y.start:.1f}"
            parts.append(_tick(line, "middle", (px, y.start + 16), value))
        for value in y.ticks():
            py = y.at(value)
            line = f"M{x.start:.1f} {py:.1f}H{x.end:.1f}"
            parts.append(_tick(line, "end", (x.start - 6, py + 4), value))
        return "".join(parts)

    def _coordinates(self, points: Iterable[Point]) -> str:
        return " ".join(
            f"{self.x.at(px):.1f},{self.y.at(py):.1f}" for px, py in thin_points(list(points))
        )


def _tick(line: str, anchor: str, at: Point, value: float) -> str:
    return (
        f'<path class="grid" d="{line}"/><text class="tick" text-anchor="{anchor}" '
        f'x="{at[0]:.1f}" y="{at[1]:.1f}">{value:g}</text>'
    )


def thin_points(points: Sequence[Point]) -> Sequence[Point]:
    """Return at most `MAX_POINTS` points, evenly spaced, the last one always among them."""
    if len(points) <= MAX_POINTS:
        return points
    step = math.ceil(len(points) / MAX_POINTS)
    return [*points[:-1:step], points[-1]]


def square_around(points: Iterable[Point], margin: float) -> tuple[float, float, float, float]:
    """Return west, east, south and north of the square that holds all points."""
    corners = list(points)
    east = [p[0] for p in corners]
    north = [p[1] for p in corners]
    half = max(max(east) - min(east), max(north) - min(north)) / 2.0 + margin
    cx, cy = (max(east) + min(east)) / 2.0, (max(north) + min(north)) / 2.0
    return cx - half, cx + half, cy - half, cy + half


MAP_SIZE = 640.0
CHART_SIZE = (560.0, 220.0)
BINS = 50
MIN_SPAN = 1e-3
"""Minimum span of the axis of a histogram whose values are all the same."""
ELLIPSES = 8
"""Number of ellipses drawn of each emitter, evenly over the flight; the newer, the stronger."""
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
    """Contents of the map; positions are local east and north, metres."""

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
    flown += [*layers.truth_enu_m.values(), *(point.position_enu_m for point in layers.estimates)]
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
    for name, position in layers.truth_enu_m.items():
        drawing.cross(position, "truth", name)
    for name, points in by_name.items():
        last = points[-1]
        drawing.circle(
            last.position_enu_m, last.r95_m, "radius", f"{name}, R95 {last.r95_m:.2f} m relative"
        )
        if last.absolute_r95_m is not None:
            about = f"{name}, R95 {last.absolute_r95_m:.2f} m absolute"
            drawing.circle(last.position_enu_m, last.absolute_r95_m, "absolute", about)
        drawing.cross(last.position_enu_m, "position", name)
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
        corners = ellipse_95(point.position_enu_m, point.covariance_m2).corners_enu_m(
            ELLIPSE_CORNERS
        )
        strength = FAINTEST + (1.0 - FAINTEST) * number / max(1, len(chosen) - 1)
        drawing.area(corners, "ellipse", strength)


@dataclass(frozen=True, slots=True)
class TimeCharts:
    """Draws values over the seconds of one flight."""

    ended_s: float
    marks: Sequence[tuple[float, str]] = ()
    """Vertical lines, such as the steps of a mission: time_s and name of each."""

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
    """Draw the frequency of the values; None if there are no values.

    A line shows the expected frequency by the `cumulative` probability, of whole bars, so that both
    have one scale, however narrow the distribution. A few distant values would squeeze all others
    into one bar, so the outermost bars contain all values beyond them, too.
    """
    if not values:
        return None
    ordered, beyond = sorted(values), int(TRIMMED_SHARE * len(values))
    low, high = ordered[beyond], ordered[-1 - beyond]
    if high - low < MIN_SPAN:
        low, high = low - 0.5 * MIN_SPAN, high + 0.5 * MIN_SPAN
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
        note += (
            f"; the outermost bars include all beyond them ({ordered[0]:.3g} to {ordered[-1]:.3g})"
        )
    return Chart(title, note, Markup(drawing.svg()))


MAX_TILES = 24
"""Maximum number of tiles of a page; at about 20 kB each, as much as the rest of a long report."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture on the map, from its north-western to its south-eastern corner, local metres."""

    url: str
    north_west_enu_m: Point
    south_east_enu_m: Point


def pictures_of(
    folder: Path, origin: LocalOrigin, bounds: tuple[float, float, float, float]
) -> list[Picture]:
    """Return the tiles under a map (west, east, south, north; local metres), finest first."""
    zooms = zooms_of(folder)
    if zooms is None:
        return []
    west, east, south, north = bounds
    first = origin.geodetic_from_enu((west, north, 0.0))[:2]
    last = origin.geodetic_from_enu((east, south, 0.0))[:2]
    for zoom in range(zooms[1], zooms[0] - 1, -1):
        (left, top), (right, bottom) = tile_at(first, zoom), tile_at(last, zoom)
        if (right - left + 1) * (bottom - top + 1) > MAX_TILES:
            continue
        found = [
            _picture(folder, origin, x, y, zoom)
            for x in range(left, right + 1)
            for y in range(top, bottom + 1)
        ]
        if pictures := [each for each in found if each is not None]:
            return pictures
    return []


def _picture(folder: Path, origin: LocalOrigin, x: int, y: int, zoom: int) -> Picture | None:
    try:
        with tile_path(folder, zoom, x, y).open("rb") as file:
            data = file.read(MAX_TILE_BYTES)
    except OSError:
        return None
    kind = next((kind for head, kind in IMAGE_KINDS.items() if data.startswith(head)), None)
    if kind is None:
        return None
    url = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    corners = (corner_of(x, y, zoom), corner_of(x + 1, y + 1, zoom))
    corners_enu_m = [origin.enu_from_geodetic(*corner, origin.altitude_m) for corner in corners]
    return Picture(url, corners_enu_m[0][:2], corners_enu_m[1][:2])
