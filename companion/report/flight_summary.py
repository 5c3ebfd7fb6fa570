"""What the event log of a flight holds, sorted for its report."""

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
    """One estimate as the event log has it."""

    time_s: float
    place_enu_m: Point
    r95_m: float
    state: str
    range_offset_m: float | None = None
    range_innovation_m: float | None = None
    nis: float | None = None
    covariance_m2: tuple[Point, Point] | None = None
    emitter_id: int | None = None
    """None: the log does not separate emitters."""


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the table of events."""

    time_s: float
    kind: str
    text: str


@dataclass(slots=True)
class FlightSummary:
    """What the event log of a flight holds for its report."""

    estimates: list[EstimatePoint] = field(default_factory=list)
    track_enu_m: list[Point] = field(default_factory=list)
    """Where the vehicle was when it measured."""
    waypoints: list[tuple[float, Point, str]] = field(default_factory=list)
    """(time_s, place, why)"""
    events: list[EventRow] = field(default_factory=list)
    """Those of `SUMMARY_KINDS`."""
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
    """The summary of an event log; unknown kinds are passed over.

    Args:
        lines: Its lines in JSON's own types (see `companion.io.files.plain`): `t_s`, `kind` and
            the fields of that kind.
    """
    summary = FlightSummary()
    for line in lines:
        time_s = _number(line.get("t_s")) or 0.0
        summary.ended_s = max(summary.ended_s, time_s)
        kind = str(line.get("kind"))
        if kind in SUMMARY_KINDS:
            row = EventRow(time_s, kind.replace("_", " "), event_text(kind, line))
            summary.events.append(row)
        _take_line(summary, kind, line, time_s)
    return summary


def _take_line(summary: FlightSummary, kind: str, line: Line, time_s: float) -> None:
    match kind:
        case "estimate":
            _take_estimate(summary, line, time_s)
        case "waypoint" if (place := _point(line.get("position_enu_m"))) is not None:
            reason = f"{line.get('reason')}: {line.get('detail')}"
            summary.waypoints.append((time_s, place, reason))
        case "guard":
            summary.guard.update(_guard_words(line.get("reasons")))
        case "fence":
            summary.fence = _fence(line) or summary.fence
        case "link":
            summary.links.append(line)
        case "result":
            emitter_id = line.get("emitter_id")
            if all(result.get("emitter_id") != emitter_id for result in summary.results):
                summary.results.append(line)


def _take_estimate(summary: FlightSummary, line: Line, time_s: float) -> None:
    place, r95_m = _point(line.get("position_enu_m")), _number(line.get("r95_m"))
    if place is None or r95_m is None:
        return
    sensor = _point(line.get("sensor_enu_m"))
    if sensor is not None:
        summary.track_enu_m.append(sensor)
    emitter_id = line.get("emitter_id")
    point = EstimatePoint(
        time_s=time_s,
        place_enu_m=place,
        r95_m=r95_m,
        state=str(line.get("state")),
        range_offset_m=_number(line.get("range_offset_m")),
        range_innovation_m=_number(line.get("range_innovation")),
        nis=_number(line.get("nis")),
        covariance_m2=_covariance(line.get("covariance_m2")),
        emitter_id=emitter_id if isinstance(emitter_id, int) else None,
    )
    summary.estimates.append(point)


def event_text(kind: str, line: Line) -> str:
    """An event in words, for the table of events."""
    if kind in ("text", "autopilot_text"):
        return str(line.get("text"))
    if kind == "phase":
        return f"{line.get('old')} → {line.get('new')} ({line.get('trigger')})"
    if kind == "result":
        r95_m = _number(line.get("r95_m")) or 0.0
        emitter_id = line.get("emitter_id")
        emitter = "" if emitter_id is None else f"emitter {emitter_id}, "
        return f"reported: {emitter}{line.get('state')}, R95 {r95_m:.2f} m"
    fields = {name: value for name, value in line.items() if name not in ("t_s", "kind")}
    return ", ".join(f"{name} {value}" for name, value in fields.items())


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
