"""The report of a flight as an HTML page; complete in itself: no network, no scripts.

Every page about one flight is made here. A `FlightPage` holds the common contents: heading and
verdict, figures, the map, charts and the table of events. `render_page` fills `page.html.j2` with
it, or a template of another package that says `{% extends "page.html.j2" %}` and adds sections in
the blocks `verdicts` (before the map) and `sections` (before the events). The blocks see `page` and
the values passed by name; the classes `passed`, `failed`, `dim`, `number`, `state` and `scroll` of
`page.css` serve their tables. The drawings come from `companion.report.charts`; their styles are
`track`, `estimate`, `radius`, `truth`, `limit`, `residual` and `step`. A page that is not about one
flight uses `page_environment` and includes `page.css`.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from companion import __version__
from companion.config.schema import CompanionConfig
from companion.estimation.filters.target_filter import threshold
from companion.flight_setup import FlightFacts, open_flight
from companion.geometry.polygons import CHI2_95_TWO, Point
from companion.handoff import mgrs_text, utc_text
from companion.io.files import EVENTS, REPORT, check_writable, write_text_atomic
from companion.io.log_files import damage_text, event_lines
from companion.report.charts import (
    Chart,
    MapLayers,
    TimeCharts,
    TimeCurve,
    flight_map,
    histogram,
    no_pictures,
    pictures_of,
)
from companion.report.flight_summary import (
    EventRow,
    FlightSummary,
    Line,
    radii_of_line,
    report_of,
    summarize_events,
)
from companion.web.settings import check_tiles

MIN_M = 1e-3
"""Smallest value of a logarithmic axis, which has no zero."""
MAX_EVENTS = 500
"""Rows of the table of events; the event log has all."""
QUICK_BYTES = 3_000_000
"""Largest event log, a quarter of an hour, whose report takes well under a second."""

COUNTER_NAMES = {
    "loss": "share of frames lost",
    "received": "frames received",
    "lost": "frames lost",
    "late": "frames late",
    "duplicates": "frames received twice",
    "overtaken": "frames out of order",
    "tick_s": "control tick, s",
    "missed_ticks": "control ticks missed",
    "stalls": "control loop stalls",
    "undecodable": "frames not decodable",
    "strangers": "frames from unknown peers",
    "moves": "changes of the autopilot's address",
    "echoes": "own frames received back",
    "setpoints": "setpoints sent",
    "setpoint_rate_hz": "setpoint rate at the end, Hz",
    "accepted": "measurements accepted",
    "refused": "measurements rejected",
    "measured": "measurements",
    "rate_hz": "measurements at the end, Hz",
    "silent_s": "silent at the end, s",
    "age_s": "delay of the last measurement, s",
    "resync_bytes": "bytes not recognised",
    "thinned": "measurements skipped, above rate_max_hz",
    "clock_restarts": "restarts of its clock",
    "line_losses": "losses of its connection",
    "restarts": "restarts of the autopilot",
}
"""Meaning of the counters in the event log; others keep their own names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPage:
    """Contents of the report of one flight."""

    kind: str
    """Line above the heading, for example "Flight report"."""
    name: str
    verdict: str
    is_passed: bool
    about: str = ""
    """Sentence below the heading; empty: none."""
    facts: Sequence[tuple[str, str]]
    """Figures below the heading: name and value of each."""
    map: Markup
    map_note: str
    charts: Sequence[Chart | None]
    """Charts of the page; None entries are omitted."""
    events: Sequence[EventRow]
    """Events in the order of time; the first `MAX_EVENTS` are shown."""
    footer: str
    began_unix_s: float | None = None
    """Unix time at zero of the flight's own; None: an invented time, which has no date."""


def page_environment(package: str) -> Environment:
    """Return the template environment: the package's `templates` first, then ours."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("companion.report")]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )


def render_page(
    page: FlightPage, template: str, package: str = "companion.report", **more: object
) -> str:
    """Return the page as text; `more` are the values of the template's own blocks, by name."""
    charts = [chart for chart in page.charts if chart is not None]
    events = page.events[:MAX_EVENTS]
    found = page_environment(package).get_template(template)
    began_s = page.began_unix_s
    clock = None if began_s is None else lambda time_s: utc_text(began_s + time_s)[11:19]
    return found.render(page=page, charts=charts, events=events, clock=clock, **more)


def report_page(
    summary: FlightSummary,
    facts: FlightFacts,
    name: str,
    tiles: Path | None = None,
    searched: tuple[str, str] | None = None,
) -> str:
    """Return the page of a recorded flight as text, its map on the `tiles` of a folder.

    `searched` is the sentence about the searched area, and its map as a data URL.
    """
    fence, keep_outs = fence_of(summary, facts.config)
    pictures = no_pictures
    if tiles is not None and summary.origin is not None:
        pictures = partial(pictures_of, tiles, summary.origin)
    layers = MapLayers(
        track_enu_m=summary.track_enu_m,
        estimates=summary.estimates,
        waypoints_enu_m=summary.waypoints_enu_m,
        fence_enu_m=fence,
        keep_outs_enu_m=keep_outs,
        pictures=pictures,
    )
    page = FlightPage(
        kind="Flight report",
        name=name,
        verdict=searched[0] if searched and summary.last is None else verdict_of(summary),
        is_passed=bool(summary.results),
        facts=_figures(summary, facts),
        map=flight_map(layers),
        map_note=_map_note(layers),
        charts=charts_of(summary, facts.config),
        events=summary.events,
        footer=f"companion {__version__}, flown with {facts.version} on Python {facts.python}; "
        f"run it again with: companion replay {shlex.quote(name)}",
        began_unix_s=facts.started_unix_s,
    )
    return render_page(
        page,
        "flight.html.j2",
        searched=searched,
        budgets=[budget_of(line) for line in summary.results if line.get("r95_budget_m")],
        guard=summary.guard.most_common(),
        link_rows=_rows(summary.links[-1]) if summary.links else [],
        radios=[(str(line.get("name")), _rows(line)) for line in summary.radios.values()],
    )


def _map_note(layers: MapLayers) -> str:
    """Return the legend of the map."""
    signs = {
        "blue: the track": layers.track_enu_m,
        "red: 95 % ellipses over time, newer ones stronger, and the last R95, dashed the "
        "absolute one": layers.estimates,
        "gold: waypoints": layers.waypoints_enu_m,
        "dashed green: the fence": layers.fence_enu_m,
        "red areas: keep-outs": layers.keep_outs_enu_m,
    }
    drawn = "; ".join(words for words, points in signs.items() if points)
    return f"North is up; {drawn}." if drawn else "North is up."


def verdict_of(summary: FlightSummary) -> str:
    """Return the flight's result as a phrase."""
    if summary.results:
        radii_m = [(result.get("r95_m"), result) for result in summary.results]
        texts = [
            radii_of_line(r95_m, result) for r95_m, result in radii_m if isinstance(r95_m, float)
        ]
        return f"localised, {'; '.join(texts)}" if texts else "localised"
    if summary.last is None:
        is_silent = bool(summary.links) and not summary.links[-1].get("refused")
        return "the emitter was never heard" if is_silent else "no measurement was used"
    return f"not reported: {summary.last.state}, {summary.last.radii}"


def _figures(summary: FlightSummary, facts: FlightFacts) -> list[tuple[str, str]]:
    began = utc_text(facts.started_unix_s).replace("T", " ").replace("Z", " UTC")
    rows = [("Begun", began), ("Recorded", f"{summary.ended_s:.0f} s")]
    for result in summary.results:
        latitude_deg, longitude_deg = result.get("latitude_deg"), result.get("longitude_deg")
        if isinstance(latitude_deg, float) and isinstance(longitude_deg, float):
            emitter = f" {result.get('emitter_id')}" if len(summary.results) > 1 else ""
            radius_m = result.get("absolute_r95_m", result.get("r95_m"))
            rows += _position_rows((latitude_deg, longitude_deg), radius_m, emitter)
    if summary.last is not None:
        east_m, north_m = summary.last.position_enu_m
        if summary.origin is not None and not summary.results:
            position_deg = summary.origin.geodetic_from_enu((east_m, north_m, 0.0))[:2]
            rows += _position_rows(position_deg, summary.last.absolute_r95_m or summary.last.r95_m)
        rows.append(("Last estimate", f"east {east_m:.2f} m, north {north_m:.2f} m"))
    rows.append(("Estimates", str(len(summary.estimates))))
    rows.append(("Estimator", facts.config.estimation.kind))
    return [*rows, ("Planner", str(facts.config.planner.flown))]


def _position_rows(
    position_deg: Point, radius_m: object, emitter: str = ""
) -> list[tuple[str, str]]:
    """Return rows of a position in degrees, and as MGRS no finer than its radius, or none."""
    if abs(position_deg[0]) > 90.0 or abs(position_deg[1]) > 180.0:
        return []
    known_m = radius_m if isinstance(radius_m, float) else 1.0
    return [
        (f"Position{emitter}", f"{position_deg[0]:.7f}, {position_deg[1]:.7f}"),
        (f"Grid{emitter}", mgrs_text(position_deg, known_m)),
    ]


def fence_of(
    summary: FlightSummary, config: CompanionConfig
) -> tuple[Sequence[Point], Sequence[Sequence[Point]]]:
    """Return the fence that the guard kept, and its keep-outs; empty if unknown.

    A log without a fence is from a flight without one, or from an earlier version: then the
    configured one is used, which is only a default if the fence comes from another source.
    """
    limits = config.limits
    if summary.fence is not None:
        return summary.fence
    return limits.fence_enu_m if limits.is_fence_local else (), limits.keep_out_enu_m


def huber_cumulative(sigma: float, k_long: float, k_short: float, value: float) -> float:
    """Return the probability of less than a value, with the density exp(-loss).

    The loss is the asymmetric one of Huber: two tails, and a Gaussian between them.
    """
    u, long, short = value / sigma, _tail(k_long), _tail(k_short)
    core = _half_core(k_long) + _half_core(k_short)
    if u < -k_short:
        below = math.exp(k_short * (u + 0.5 * k_short)) / k_short
    elif u <= k_long:
        below = short + _half_core(k_short) + _half_core(u)
    else:
        below = short + core + long - math.exp(k_long * (0.5 * k_long - u)) / k_long
    return below / (short + core + long)


def _tail(k: float) -> float:
    return math.exp(-0.5 * k * k) / k if math.isfinite(k) else 0.0


def _half_core(u: float) -> float:
    return math.sqrt(0.5 * math.pi) * math.erf(u / math.sqrt(2.0))


def charts_of(summary: FlightSummary, config: CompanionConfig) -> list[Chart | None]:
    """Return charts of R95, offset, residuals, their histogram with the fitted loss, and NIS."""
    noise = config.estimation.filter
    thresholds = threshold(noise.range_k_long), threshold(noise.range_k_short)
    expected = partial(huber_cumulative, noise.range_sigma_m, *thresholds)
    over_time = TimeCharts(summary.ended_s)
    points = summary.estimates
    radii = [(p.time_s, max(p.r95_m, MIN_M)) for p in points]
    offsets = _known((p.time_s, p.range_offset_m) for p in points)
    residuals = _known((p.time_s, p.range_innovation_m) for p in points)
    metres = "metres over seconds"
    return [
        over_time.draw(
            "R95, relative", f"{metres}, logarithmic", TimeCurve(radii, "radius"), is_log=True
        ),
        over_time.draw("Range offset", metres, TimeCurve(offsets, "radius")),
        over_time.draw("Range residuals", metres, TimeCurve(residuals, "residual", is_dotted=True)),
        histogram(
            "Residuals and fitted loss",
            "bars: number of residuals over metres; line: number that the filter's loss expects",
            [value for _, value in residuals],
            expected,
        ),
        _nis_chart(over_time, _known((p.time_s, p.nis) for p in points)),
    ]


def _known(points: Iterable[tuple[float, float | None]]) -> list[Point]:
    return [(at_s, value) for at_s, value in points if value is not None and math.isfinite(value)]


def _nis_chart(over_time: TimeCharts, points: list[Point]) -> Chart | None:
    if not points:
        return None
    limit = CHI2_95_TWO
    top = max(limit * 2.0, sorted(v for _, v in points)[int(0.98 * (len(points) - 1))] * 1.2)
    share = sum(value <= limit for _, value in points) / len(points)
    return over_time.draw(
        "NIS",
        f"over seconds; {100 * share:.0f} % under the line, 95 % are expected of range and bearing",
        TimeCurve(
            [(time_s, min(value, top)) for time_s, value in points], "residual", is_dotted=True
        ),
        TimeCurve([(0.0, limit), (max(over_time.ended_s, 1.0), limit)], "limit"),
        span=(0.0, top),
    )


def write_report(
    flight: Path,
    output: Path | None = None,
    tiles: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write the report of a flight (its folder, or a file in it), and return its path.

    By default it is in the folder. Its map lies on `tiles` (`z/x/y.png`), if there are any. `say`
    gets a line for each damaged log, the rest of which is reported.
    """
    found = open_flight(flight)
    older = found.directory / "events.old.jsonl"  # rotated out when the log reached half its cap
    lines: list[Line] = []
    for part in (older, found.path(EVENTS)):
        damaged: list[int] = []
        lines += event_lines(part, damaged.append) if part.exists() or part != older else ()
        if damaged:
            say(damage_text(part, "line", damaged))
    name = found.directory.resolve().name
    searched = report_of(found.directory)
    page = report_page(summarize_events(lines), found.facts, name, tiles, searched)
    path = found.path(REPORT) if output is None else output
    write_text_atomic(path, page)
    return path


def run(arguments: argparse.Namespace) -> int:
    """Write the report that the command line asks for, and print its path."""
    if arguments.web_tiles is not None:
        check_tiles(arguments.web_tiles)
    if arguments.output is not None:
        check_writable(arguments.output)
    print(write_report(arguments.flight, arguments.output, arguments.web_tiles, _warn))
    return 0


def _warn(text: str) -> None:
    print(f"companion: {text}", file=sys.stderr)


def is_quick(flight: Path) -> bool:
    """Return True if the report of a flight is made in about a second."""
    try:
        return (flight / EVENTS).stat().st_size <= QUICK_BYTES
    except OSError:
        return False


def budget_of(result: Line) -> tuple[str, list[tuple[str, str]]]:
    """Return heading and rows of a result's R95 after each term that widens it."""
    emitter_id, terms = result.get("emitter_id"), result.get("r95_budget_m")
    of = "" if emitter_id is None else f" of emitter {emitter_id}"
    rows = terms.items() if isinstance(terms, Mapping) else ()
    return f"Budget of R95{of}", [(str(term), _value_text(radius_m)) for term, radius_m in rows]


def _rows(line: Line) -> list[tuple[str, str]]:
    return [
        (COUNTER_NAMES.get(name, name.replace("_", " ")), _value_text(value))
        for name, value in line.items()
        if name not in ("t_s", "kind", "links", "number", "name")
    ]


def _value_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_value_text(count)}" for name, count in value.items()) or "none"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
