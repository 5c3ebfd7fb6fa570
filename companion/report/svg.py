"""SVG drawings of a flight, made of text alone: map, and values over time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from companion.geometry.polygons import Point

MARGIN = 44.0
"""Around the plot, for the ticks."""
MAX_POINTS = 1500
"""Most points of a curve; more cannot be distinguished."""


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
        self._parts.append(f'<polyline class="{style}" points="{self._places(points)}"/>')

    def area(self, corners: Iterable[Point], style: str, opacity: float = 1.0) -> None:
        """Add a polygon."""
        faint = "" if opacity == 1.0 else f' opacity="{opacity:.2f}"'
        self._parts.append(f'<polygon class="{style}"{faint} points="{self._places(corners)}"/>')

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

    def cross(self, place: Point, style: str, name: str) -> None:
        """Add a cross with a name."""
        cx, cy = self.x.at(place[0]), self.y.at(place[1])
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

    def _places(self, points: Iterable[Point]) -> str:
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
    places = list(points)
    east = [p[0] for p in places]
    north = [p[1] for p in places]
    half = max(max(east) - min(east), max(north) - min(north)) / 2.0 + margin
    cx, cy = (max(east) + min(east)) / 2.0, (max(north) + min(north)) / 2.0
    return cx - half, cx + half, cy - half, cy + half
