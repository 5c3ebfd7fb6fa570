"""Contents of a flight's event log, sorted for its report.

The module also reads, shows and combines searched areas of flights.
"""

from __future__ import annotations

import argparse
import base64
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec

from companion.area_handoff import GEOJSON, PNG, RECORD, TEXT, area_files, geojson_of, result_fields
from companion.domain import PositionAccuracy, radii_text
from companion.errors import ConfigError, decoding_problem
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point
from companion.guard.gate import GuardReason
from companion.io.files import plain, read_file, write_bytes_atomic
from companion.search.searched_area import SearchState
from companion.search.searched_flight import SearchedFlight, combined_area, gaps_of, statement
from companion.view.history import FlightTrack

SUMMARY_KINDS = ("text", "phase", "answer", "autopilot_text", "bound", "result")
"""Kinds of events in the report's table."""

Line = Mapping[str, object]
Number = Annotated[float, msgspec.Meta(ge=-3.4e38, le=3.4e38)]
"""Range of single precision, as in MAVLink. Beyond it, and infinite, a number was damaged."""
Metres = Annotated[float, msgspec.Meta(ge=-4e7, le=4e7)]
"""Coordinate or radius in m: the Earth is 40,000 km around."""
Scale = Annotated[float, msgspec.Meta(ge=0.5, le=2.0)]
EastNorth = tuple[Metres, Metres]
Polygons = tuple[list[EastNorth], list[list[EastNorth]]]
MIN_CORNERS = 3
GUARD_WORDS = {reason.name.lower(): reason.value for reason in GuardReason}


class EstimatePoint(
    msgspec.Struct,
    frozen=True,
    rename={
        "time_s": "t_s",
        "range_innovation_m": "range_innovation",
    },
):
    """One estimate, made from its line of the event log."""

    time_s: Number
    position_enu_m: EastNorth
    r95_m: Metres
    state: str = ""
    sensor_enu_m: Annotated[tuple[Metres, ...], msgspec.Meta(min_length=2)] | None = None
    range_offset_m: Number | None = None
    range_innovation_m: Number | None = None
    nis: Number | None = None
    covariance_m2: tuple[tuple[Number, Number], tuple[Number, Number]] | None = None
    emitter_id: int | None = None
    """Id of the emitter; None if the log does not separate emitters."""
    absolute_r95_m: Metres | None = None
    """Absolute R95; None if the log is older than the absolute radius."""

    @property
    def radii(self) -> str:
        """Absolute and relative R95 as one phrase."""
        if self.absolute_r95_m is None:
            return f"R95 {self.r95_m:.1f} m relative"
        return radii_text(self.absolute_r95_m, self.r95_m)


class _WaypointLine(msgspec.Struct):
    position_enu_m: EastNorth


class _PositionLine(msgspec.Struct):
    position_enu_m: tuple[Metres, Metres, Metres]


class _OriginLine(msgspec.Struct):
    """The bounds of a `LocalOrigin`: on the Earth, in a frame whose scale is near one."""

    latitude_deg: Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
    altitude_m: Metres
    offset_enu_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    scale_en: tuple[Scale, Scale] = (1.0, 1.0)


class _FenceLine(msgspec.Struct):
    polygon_enu_m: Annotated[list[EastNorth], msgspec.Meta(min_length=MIN_CORNERS)]
    keep_out_enu_m: list[list[EastNorth]] = []


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the table of events."""

    time_s: float
    kind: str
    text: str


@dataclass(slots=True)
class FlightSummary:
    """Contents of a flight's event log for its report."""

    estimates: list[EstimatePoint] = field(default_factory=list)
    track: FlightTrack = field(default_factory=FlightTrack)
    """Track of the vehicle, metres from the origin."""
    measured_enu_m: list[Point] = field(default_factory=list)
    """Vehicle positions at measurements, the only ones in a log without a track."""
    origin: LocalOrigin | None = None
    """The last origin of the local frame."""
    waypoints_enu_m: list[Point] = field(default_factory=list)
    events: list[EventRow] = field(default_factory=list)
    """Events whose kind is in `SUMMARY_KINDS`."""
    fence: Polygons | None = None
    """The guard's last fence, and its keep-outs, local east and north."""
    guard: Counter[str] = field(default_factory=Counter)
    """Interventions of the guard, by reason."""
    links: list[Line] = field(default_factory=list)
    """The counters of the links, in order."""
    radios: dict[int, Line] = field(default_factory=dict)
    """Last figures of each radio with a native format, by its number."""
    results: list[Line] = field(default_factory=list)
    """The first report of each emitter, in order."""
    ended_s: float = 0.0

    @property
    def track_enu_m(self) -> list[Point]:
        """Track of the vehicle, metres from the origin."""
        return self.track.line or self.measured_enu_m

    @property
    def last(self) -> EstimatePoint | None:
        """The last estimate; None if there is none."""
        return self.estimates[-1] if self.estimates else None


def summarize_events(lines: Iterable[Line]) -> FlightSummary:
    """Return the summary of an event log's lines in JSON's own types; skip unknown kinds."""
    summary = FlightSummary()
    for line in lines:
        time_s = _read(line.get("t_s"), Number) or 0.0
        summary.ended_s = max(summary.ended_s, time_s)
        kind = str(line.get("kind"))
        if kind in SUMMARY_KINDS:
            row = EventRow(time_s, kind.replace("_", " "), event_text(kind, line))
            summary.events.append(row)
        if kind == "radio":
            summary.radios[_read(line.get("number"), int) or 0] = line
        match kind:
            case "position" if (position := _read(line, _PositionLine)) is not None:
                summary.track.add(position.position_enu_m[:2])
            case "origin" if _read(line, _OriginLine) is not None:
                summary.origin = _read(line, LocalOrigin) or summary.origin
        _take_line(summary, kind, line)
    return summary


def _take_line(summary: FlightSummary, kind: str, line: Line) -> None:
    match kind:
        case "estimate":
            point = _read(line, EstimatePoint)
            if point is not None:
                summary.estimates.append(point)
                if point.sensor_enu_m is not None:
                    summary.measured_enu_m.append((point.sensor_enu_m[0], point.sensor_enu_m[1]))
        case "waypoint" if (waypoint := _read(line, _WaypointLine)) is not None:
            summary.waypoints_enu_m.append(waypoint.position_enu_m)
        case "guard":
            names = _read(line.get("reasons"), list[str]) or []
            summary.guard.update(GUARD_WORDS.get(name, name) for name in names)
        case "fence" if (fence := _read(line, _FenceLine)) is not None:
            keep_outs = [area for area in fence.keep_out_enu_m if len(area) >= MIN_CORNERS]
            summary.fence = (fence.polygon_enu_m, keep_outs)
        case "link":
            summary.links.append(line)
        case "result":
            emitter_id = line.get("emitter_id")
            if all(result.get("emitter_id") != emitter_id for result in summary.results):
                summary.results.append(line)


def _read(value: object, kind: type[T]) -> T | None:
    """Return a value of the log converted to a type; None if it does not match."""
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, OverflowError):
        return None


def radii_of_line(r95_m: float, line: Line) -> str:
    """Return both radii of a result, and the GNSS accuracy in the absolute one.

    A log that is older than the absolute radius has only the relative one.
    """
    absolute_m = _read(line.get("absolute_r95_m"), float)
    own_m = _read(line.get("own_sigma_m"), float)
    if absolute_m is None or own_m is None:
        return f"R95 {r95_m:.2f} m relative"
    own = PositionAccuracy(own_m, is_reported=line.get("own_sigma_told") is True)
    return radii_text(absolute_m, r95_m, own, decimals=2)


def event_text(kind: str, line: Line) -> str:
    """Return the text of an event for the table of events."""
    if kind in ("text", "autopilot_text"):
        return str(line.get("text"))
    if kind == "phase":
        return f"{line.get('old')} → {line.get('new')} ({line.get('trigger')})"
    if kind == "result":
        r95_m = _read(line.get("r95_m"), float) or 0.0
        emitter_id = line.get("emitter_id")
        emitter = "" if emitter_id is None else f"emitter {emitter_id}, "
        return f"reported: {emitter}{line.get('state')}, {radii_of_line(r95_m, line)}"
    fields = {name: value for name, value in line.items() if name not in ("t_s", "kind")}
    return ", ".join(f"{name} {value}" for name, value in fields.items())


def read_searched(flight: Path) -> SearchedFlight:
    """Return the searched area of a flight in a folder; raise `ConfigError` if there is none."""
    directory = flight if flight.is_dir() else flight.parent
    path = directory / RECORD
    if not flight.exists():
        raise ConfigError(f"{flight}: there is no such file or folder")
    if not path.exists():
        raise ConfigError(
            f"{directory}: has no {RECORD}; it had contact at once, or the flight is older"
        )
    try:
        return msgspec.json.decode(read_file(path), type=SearchedFlight)
    except (msgspec.DecodeError, ValueError) as error:
        problem = f"not a record of a searched area: {decoding_problem(error)}"
        raise ConfigError(f"{path}: {problem}") from error


def combined_state(flights: list[SearchedFlight], path: Path) -> SearchState | None:
    """Return the combined state of flights, or None; a `ConfigError` names the first one's file."""
    try:
        return combined_area(flights)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def run(arguments: argparse.Namespace) -> int:
    """Run `companion area`; return the exit code."""
    if arguments.area_command == "show":
        return _show(arguments)
    return _merge(arguments)


def _show(arguments: argparse.Namespace) -> int:
    flight = read_searched(arguments.flight)
    state = combined_state([flight], arguments.flight)
    if arguments.json:
        print(json.dumps(plain(result_fields(flight, state)), indent=2))
        return 0
    print(statement(flight, state))
    if flight.learnt is not None:
        reach_m, sigma_db = flight.learnt.reach_m, flight.learnt.reach_sigma_db
        shown = f"{{reach_m: {reach_m:g}, reach_sigma_db: {sigma_db:g}}}"
        print(f"reach by the first contact, to paste: search: {{detection: {shown}}}")
    for gap in [] if state is None else gaps_of(state):
        print(f"gap: {gap.name}, {100.0 * gap.poa:.0f} % of the probability")
    return 0


def _merge(arguments: argparse.Namespace) -> int:
    """Combine flights over the area of the first one."""
    flights = [read_searched(each) for each in arguments.flights]
    state = combined_state(flights, arguments.flights[0])
    first = flights[0]
    if state is None or first.origin is None:
        raise ConfigError(
            f"{arguments.flights[0]}: has no reach or no origin, so nothing can be combined with it"
        )
    reported = tuple(sorted({n for each in flights for n in each.reported}))
    together = msgspec.structs.replace(
        first,
        listened_s=sum(each.listened_s for each in flights),
        ended_unix_s=max(each.ended_unix_s for each in flights),
        is_radio_heard=all(each.is_radio_heard for each in flights),
        reported=reported,
        heard=tuple(sorted({n for each in flights for n in each.heard} - set(reported))),
    )
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{arguments.out}: cannot be created ({error.strerror})") from error
    files = area_files(together, state)
    del files[RECORD]  # its looks are in the flights' own
    files[GEOJSON] = geojson_of(flights, state, first.origin).encode()
    for name, content in files.items():
        write_bytes_atomic(arguments.out / name, content)
    print(f"{len(flights)} flights: {statement(together, state)}")
    return 0


def report_of(directory: Path) -> tuple[str, str] | None:
    """Return the sentence and the map as a data URL, or None without a search."""
    if not (directory / TEXT).exists():
        return None
    text = read_file(directory / TEXT).decode(errors="replace").strip()
    if not (directory / PNG).exists():
        return text, ""
    encoded = base64.b64encode(read_file(directory / PNG)).decode()
    return text, f"data:image/png;base64,{encoded}"
