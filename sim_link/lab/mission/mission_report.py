"""What is told of mission flights: the summary of each, lines for many, and the HTML page of one.

The few numbers of a run that are kept of many.

The report of one flight: a page with verdicts, track, estimate, residuals and events.

The page is complete in itself: no network, no scripts; it follows the reader's light or dark theme.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from companion import __version__
from companion.domain import Point
from companion.report.svg import Drawing, square_around
from sim_link.lab.mission.results import (
    EstimatePoint,
    ExpectationVerdict,
    FlightRecord,
    MissionResult,
    true_places,
)
from sim_link.lab.mission.script import Mission
from sim_link.lab.monitor.monitor import TITLES

BUSY_S = 0.2
"""Processes that wait so long for their turn cost setpoints and positions."""


@dataclass(frozen=True, slots=True)
class Summary:
    """One run, small enough to be kept of hundreds."""

    name: str
    flavour: str
    file: str
    seed: int
    how: str
    verdicts: tuple[ExpectationVerdict, ...]
    time_s: float
    distance_m: float
    final_error_m: float | None
    r95_m: float | None
    closest_approach_m: float | None
    wall_s: float
    cpu_s: float = 0.0
    """Processor time; 0 where several processes flew."""
    late_s: float = 0.0
    """How late a turn came at most, in seconds of flight, where several processes flew."""
    is_interrupted: bool = False
    report: str = ""
    """Where the report is; empty: there is none."""
    error: str = ""
    """Why it did not come to an end, or has no report; empty: nothing went wrong."""

    @property
    def title(self) -> str:
        """What reports call it."""
        return f"{self.name} ({self.flavour}), seed {self.seed}"

    @property
    def failed(self) -> tuple[ExpectationVerdict, ...]:
        """Verdicts that are not met."""
        return tuple(verdict for verdict in self.verdicts if not verdict.is_met)

    @property
    def is_passed(self) -> bool:
        """Whether all are met, and nothing went wrong."""
        return not self.failed and not self.error

    @property
    def is_flown(self) -> bool:
        """Whether it came to an end."""
        return bool(self.verdicts)

    @property
    def is_inside_r95(self) -> bool | None:
        """Whether the true emitter is within R95 of the last estimate."""
        if self.final_error_m is None or self.r95_m is None:
            return None
        return self.final_error_m <= self.r95_m

    @property
    def doubt(self) -> str:
        """Why a failure may be the machine's, and what to do; empty: nothing says so."""
        if self.is_passed or self.late_s <= BUSY_S:
            return ""
        return (
            f"this computer was too busy: a turn came {self.late_s:.1f} s of flight late; "
            "try a lower --speed, or lockstep"
        )

    @property
    def times_real_time(self) -> float:
        """Simulated seconds per second."""
        return self.time_s / self.wall_s if self.wall_s > 0.0 else math.inf


def summary_of(result: MissionResult) -> Summary:
    """The summary of a run."""
    record, mission = result.record, result.mission
    point = record.last_estimate(mission.emitter.emitter_id)
    return Summary(
        name=mission.name,
        flavour=result.flavour,
        file=result.file,
        seed=result.seed,
        how=result.how,
        verdicts=result.verdicts,
        time_s=record.ended_s,
        distance_m=record.distance_m,
        final_error_m=result.final_error_m,
        r95_m=None if point is None else point.r95_m,
        closest_approach_m=record.closest_approach_m,
        wall_s=record.wall_s,
        cpu_s=record.cpu_s,
        late_s=record.late_s,
        is_interrupted=record.is_interrupted,
    )


def campaign_lines(summaries: list[Summary]) -> list[str]:
    """What a campaign came to, in lines for people: each mission, then all of them."""
    names = list(dict.fromkeys((s.name, s.flavour) for s in summaries))
    lines = [_mission_line([s for s in summaries if (s.name, s.flavour) == n]) for n in names]
    passed = sum(summary.is_passed for summary in summaries)
    flown_s, wall_s = sum(s.time_s for s in summaries), sum(s.wall_s for s in summaries)
    cpu_s = sum(s.cpu_s for s in summaries)
    speed = f", {flown_s / wall_s:.0f} times real time" if wall_s > 0.0 else ""
    if cpu_s > 0.0:
        speed += f" ({flown_s / cpu_s:.0f} by processor time)"
    return [
        *lines,
        f"{passed} of {len(summaries)} flights passed; {flown_s:.0f} s flown in {wall_s:.1f} s "
        f"of flying{speed}",
    ]


def _mission_line(runs: list[Summary]) -> str:
    passed = sum(run.is_passed for run in runs)
    errors = [run.final_error_m for run in runs if run.final_error_m is not None]
    inside = [run.is_inside_r95 for run in runs if run.is_inside_r95 is not None]
    line = f"{runs[0].name} ({runs[0].flavour}): {passed}/{len(runs)} passed"
    if errors:
        line += f", error at most {max(errors):.2f} m, {sum(inside)}/{len(inside)} inside R95"
    flown_s, cpu_s = sum(run.time_s for run in runs), sum(run.cpu_s for run in runs)
    wall_s = sum(run.wall_s for run in runs)
    if wall_s > 0.0:
        line += f", {flown_s / wall_s:.0f}x"
    return f"{line} ({flown_s / cpu_s:.0f}x by processor time)" if cpu_s > 0.0 else line


MAP_SIZE = 640.0
CHART_SIZE = (640.0, 220.0)
BINS = 40
MAX_EVENTS = 500
"""Lines of the table of events; the event log has all."""
SHOWN_EVENTS = ("step", "step ended", "fault", "phase", "text", "result", "answer", "bound")


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the table of events."""

    time_s: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class InvariantRow:
    """One line of the table of invariants."""

    name: str
    title: str
    violations: int | None
    """None: not judged."""
    note: str
    """How far it was judged, or why not."""


def report_page(result: MissionResult) -> str:
    """The page as text."""
    environment = Environment(
        loader=PackageLoader("sim_link.lab.mission"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    record = result.record
    return environment.get_template("mission.html.j2").render(
        result=result,
        record=record,
        mission=result.mission,
        last=record.last_estimate(result.mission.emitter.emitter_id),
        whose=f" of emitter {result.mission.emitter.emitter_id}" if result.mission.emitters else "",
        map=Markup(_map(result).svg()),
        charts=[(title, note, Markup(svg)) for title, note, svg in _charts(result)],
        events=events_of(record)[:MAX_EVENTS],
        invariants=invariants_of(record),
        version=__version__,
    )


def events_of(record: FlightRecord) -> list[EventRow]:
    """The events that people want to read, in the order of time."""
    rows = [
        EventRow(time_s, kind, _phrase(kind, fields))
        for time_s, kind, fields in record.events
        if kind in SHOWN_EVENTS
    ]
    rows += [
        EventRow(said.time_s, "autopilot", said.text)
        for said in record.texts
        if said.source == "autopilot"
    ]
    rows += [EventRow(v.time_s, "violation", f"{v.invariant}: {v.text}") for v in record.violations]
    return sorted(rows, key=lambda row: row.time_s)


def invariants_of(record: FlightRecord) -> list[InvariantRow]:
    """Every invariant: how often it did not hold, or why that was not judged."""
    counts = Counter(violated.invariant for violated in record.violations)
    scope = record.scope
    return [
        InvariantRow(
            name,
            title,
            counts[name] if name in scope.judged else None,
            scope.judged.get(name) or scope.unjudged.get(name, ""),
        )
        for name, title in TITLES.items()
    ]


def _phrase(kind: str, fields: object) -> str:
    values = dict(fields)  # type: ignore[call-overload]
    match kind:
        case "step":
            return f"{values['step']} {values['name']}: {values['what']}"
        case "step ended":
            return f"{values['step']} {values['name']} {values['failure'] or 'done'}"
        case "phase":
            return f"{values['old']} → {values['new']} ({values['trigger']})"
        case "text":
            return str(values["text"])
    return ", ".join(f"{name} {_short(value)}" for name, value in values.items())


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _map(result: MissionResult) -> Drawing:
    record, mission = result.record, result.mission
    truth = true_places(mission)
    track: list[Point] = [place[:2] for _, place in record.track]
    points = [*track, *truth.values(), (0.0, 0.0), *_area(mission)]
    points += [corner for obstacle in mission.obstacles for corner in obstacle.corners_enu_m]
    west, east, south, north = square_around(points, 10.0)
    drawing = Drawing(MAP_SIZE, MAP_SIZE - 16.0, (west, east), (south, north), "Map of the flight")
    drawing.area(_area(mission), "area")
    drawing.area(mission.config.limits.fence_enu_m, "fence")
    for obstacle in mission.obstacles:
        drawing.area(obstacle.corners_enu_m, "obstacle")
    drawing.line(track, "track")
    drawing.dots([point.position_enu_m for point in record.estimates], "estimate")
    for emitter, place in truth.items():
        drawing.cross(place, "truth", f"emitter {emitter}")
        point = record.last_estimate(emitter)
        if point is not None:
            name = f"estimate of {emitter}, R95 {point.r95_m:.2f} m"
            drawing.circle(point.position_enu_m, point.r95_m, "radius", name)
    return drawing


def _area(mission: Mission) -> list[Point]:
    east, north = mission.area_m
    return [(0.0, 0.0), (east, 0.0), (east, north), (0.0, north)]


def _charts(result: MissionResult) -> list[tuple[str, str, str]]:
    record = result.record
    charts = []
    if record.estimates:
        note = "metres over seconds, logarithmic. Green: true error; orange: R95"
        charts.append(("Error and R95", note, _accuracy(result).svg()))
    ranges = [(p.time_s, p.range_innovation_m) for p in record.estimates]
    known = [(t, v) for t, v in ranges if v is not None]
    if known:
        note = "metres over seconds: what a range was longer than expected"
        charts.append(("Range residuals", note, _residuals(known, record).svg()))
        note = "how many over metres"
        charts.append(("Their histogram", note, _histogram([v for _, v in known]).svg()))
    if record.track:
        charts.append(("Height", "metres over seconds", _height(record).svg()))
    return charts


def _accuracy(result: MissionResult) -> Drawing:
    truth = true_places(result.mission)
    points = result.record.estimates

    def error_m(point: EstimatePoint) -> float:
        """How far an estimate is from its emitter; never 0, for a logarithmic axis."""
        emitter = point.emitter if point.emitter in truth else result.mission.emitter.emitter_id
        return max(math.dist(point.position_enu_m, truth[emitter or 0]), 1e-3)

    errors = [(point.time_s, error_m(point)) for point in points]
    radii = [(point.time_s, max(point.r95_m, 1e-3)) for point in points]
    values = [value for _, value in (*errors, *radii)]
    span = (max(0.01, min(values) / 1.5), max(values) * 1.5)
    drawing = Drawing(*CHART_SIZE, _time_span(result.record), span, "Error and R95", is_log=True)
    _mark_steps(drawing, result.record)
    drawing.line(radii, "radius")
    drawing.line(errors, "error")
    return drawing


def _residuals(known: list[tuple[float, float]], record: FlightRecord) -> Drawing:
    values = [value for _, value in known]
    span = (min(values) - 1.0, max(values) + 1.0)
    drawing = Drawing(*CHART_SIZE, _time_span(record), span, "Range residuals")
    _mark_steps(drawing, record)
    drawing.dots(known, "estimate")
    return drawing


def _histogram(values: list[float]) -> Drawing:
    low, high = min(values), max(values) + 1e-6
    width = (high - low) / BINS
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int((value - low) / width))] += 1
    drawing = Drawing(*CHART_SIZE, (low, high), (0.0, max(counts) * 1.05), "Histogram of residuals")
    for number, count in enumerate(counts):
        left, right = low + number * width, low + (number + 1) * width
        drawing.area([(left, 0.0), (left, count), (right, count), (right, 0.0)], "bar")
    return drawing


def _height(record: FlightRecord) -> Drawing:
    points = [(time_s, place[2]) for time_s, place in record.track]
    top = max(value for _, value in points) * 1.1 + 1.0
    low = min(0.0, *(value for _, value in points))
    drawing = Drawing(*CHART_SIZE, _time_span(record), (low, top), "Height over time")
    _mark_steps(drawing, record)
    drawing.line(points, "track")
    return drawing


def _time_span(record: FlightRecord) -> tuple[float, float]:
    return (0.0, max(record.ended_s, 1.0))


def _mark_steps(drawing: Drawing, record: FlightRecord) -> None:
    for step in record.steps:
        drawing.mark(step.started_s, "step", f"{step.title} at {step.started_s:.1f} s")
