"""What the event log tells of a flight, sorted for its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from companion.domain import Point
from companion.guard.gate import GuardReason

SUMMARY_KINDS = ("text", "phase", "answer", "autopilot_text", "bound", "result")
"""Kinds of events that people read."""

Line = Mapping[str, object]
Polygons = tuple[list[Point], list[list[Point]]]
LEAST_CORNERS = 3
GUARD_WORDS = {reason.name.lower(): reason.value for reason in GuardReason}


@dataclass(frozen=True, slots=True)
class EstimatePoint:
    """One estimate."""

    time_s: float
    place_enu_m: Point
    r95_m: float
    state: str
    range_offset_m: float | None
    range_innovation_m: float | None
    range_weight: float | None
    nis: float | None
    covariance_m2: tuple[Point, Point] | None


@dataclass(frozen=True, slots=True)
class SummaryLine:
    """One line for people."""

    time_s: float
    kind: str
    text: str


@dataclass(slots=True)
class FlightSummary:
    """A flight as its event log tells it."""

    estimates: list[EstimatePoint] = field(default_factory=list)
    track_enu_m: list[Point] = field(default_factory=list)
    """Where the vehicle was when it measured."""
    waypoints: list[tuple[float, Point, str]] = field(default_factory=list)
    """(time_s, place, why)"""
    told: list[SummaryLine] = field(default_factory=list)
    fence: Polygons | None = None
    """The fence that the guard kept last, and its keep-outs, local east and north."""
    guard: Counter[str] = field(default_factory=Counter)
    """Interventions of the guard, by reason."""
    links: list[Line] = field(default_factory=list)
    """The counters of the links, in order."""
    results: list[Line] = field(default_factory=list)
    """What was reported of each emitter first, in order."""
    ended_s: float = 0.0

    @property
    def last(self) -> EstimatePoint | None:
        """The last estimate."""
        return self.estimates[-1] if self.estimates else None


def summarize_events(lines: Iterable[Line]) -> FlightSummary:
    """The story that an event log tells; unknown kinds are passed over."""
    story = FlightSummary()
    for line in lines:
        time_s = _number(line.get("t_s")) or 0.0
        story.ended_s = max(story.ended_s, time_s)
        kind = str(line.get("kind"))
        if kind == "estimate":
            _take_estimate(story, line, time_s)
        elif kind == "waypoint" and (place := _point(line.get("position_enu_m"))) is not None:
            story.waypoints.append((time_s, place, f"{line.get('reason')}: {line.get('detail')}"))
        elif kind == "guard":
            story.guard.update(_guard_words(line.get("reasons")))
        elif kind == "fence":
            story.fence = _fence(line) or story.fence
        elif kind == "link":
            story.links.append(line)
        elif kind == "result" and line.get("emitter_id") not in _reported(story):
            story.results.append(line)
        if kind in SUMMARY_KINDS:
            story.told.append(SummaryLine(time_s, kind.replace("_", " "), _phrase(kind, line)))
    return story


def _reported(story: FlightSummary) -> list[object]:
    return [result.get("emitter_id") for result in story.results]


def _take_estimate(story: FlightSummary, line: Line, time_s: float) -> None:
    place, r95_m = _point(line.get("position_enu_m")), _number(line.get("r95_m"))
    if place is None or r95_m is None:
        return
    sensor = _point(line.get("sensor_enu_m"))
    if sensor is not None:
        story.track_enu_m.append(sensor)
    point = EstimatePoint(
        time_s=time_s,
        place_enu_m=place,
        r95_m=r95_m,
        state=str(line.get("state")),
        range_offset_m=_number(line.get("range_offset_m")),
        range_innovation_m=_number(line.get("range_innovation")),
        range_weight=_number(line.get("range_weight")),
        nis=_number(line.get("nis")),
        covariance_m2=_covariance(line.get("covariance_m2")),
    )
    story.estimates.append(point)


def _phrase(kind: str, line: Line) -> str:
    if kind in ("text", "autopilot_text"):
        return str(line.get("text"))
    if kind == "phase":
        return f"{line.get('old')} → {line.get('new')} ({line.get('trigger')})"
    if kind == "result":
        r95_m = _number(line.get("r95_m")) or 0.0
        return f"reported: {_of(line)}{line.get('state')}, R95 {r95_m:.2f} m"
    shown = {name: value for name, value in line.items() if name not in ("t_s", "kind")}
    return ", ".join(f"{name} {value}" for name, value in shown.items())


def _of(line: Line) -> str:
    emitter_id = line.get("emitter_id")
    return "" if emitter_id is None else f"emitter {emitter_id}, "


def _guard_words(reasons: object) -> list[str]:
    names = reasons if isinstance(reasons, list) else []
    return [GUARD_WORDS.get(str(name), str(name)) for name in names]


def _fence(line: Line) -> Polygons | None:
    polygon, keep_outs = _corners(line.get("polygon_enu_m")), line.get("keep_out_enu_m")
    if len(polygon) < LEAST_CORNERS:
        return None
    found = [_corners(corners) for corners in keep_outs] if isinstance(keep_outs, list) else []
    return polygon, [corners for corners in found if len(corners) >= LEAST_CORNERS]


def _corners(value: object) -> list[Point]:
    points = [_point(corner) for corner in value] if isinstance(value, list) else []
    return [point for point in points if point is not None]


def _number(value: object) -> float | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and isinstance(value, int | float) else None


def _point(value: object) -> Point | None:
    if not isinstance(value, list) or len(value) < 2:
        return None
    east, north = _number(value[0]), _number(value[1])
    return None if east is None or north is None else (east, north)


def _covariance(value: object) -> tuple[Point, Point] | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    first, second = _point(value[0]), _point(value[1])
    return None if first is None or second is None else (first, second)
