"""Reports of mission flights: lines for many, and the HTML page of one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from companion import __version__
from companion.geometry.polygons import Point
from companion.io.files import plain
from companion.report.charts import Chart, MapLayers, TimeCharts, TimeCurve, flight_map, histogram
from companion.report.flight_summary import EventRow, event_text
from companion.report.page import LEAST_M, FlightPage, render_page
from sim_link.lab.mission.results import FlightRecord, MissionResult, true_places
from sim_link.lab.monitor.monitor import TITLES

SHOWN_EVENTS = ("step", "step ended", "fault", "phase", "text", "result", "answer", "bound")
MAP_NOTE = (
    "Blue: the vehicle; red: 95 % ellipses over time and the last R95; violet: where emitters "
    "truly are; gold: waypoints; dashed grey: the area; dashed green: the companion's fence, where "
    "it is in the picture; red areas: obstacles and keep-outs."
)


def campaign_lines(results: list[MissionResult]) -> list[str]:
    """Summarise a campaign in lines for people: each mission, then all of them."""
    runs: dict[tuple[str, str], list[MissionResult]] = {}
    for result in results:
        runs.setdefault((result.mission.name, result.flavour), []).append(result)
    lines = [_mission_line(each) for each in runs.values()]
    passed = sum(result.is_passed for result in results)
    skipped = sum(bool(result.record.skipped) for result in results)
    flown_s, wall_s, cpu_s = _times(results)
    speed = f", {flown_s / wall_s:.0f} times real time" if wall_s > 0.0 else ""
    if cpu_s > 0.0:
        speed += f" ({flown_s / cpu_s:.0f} by processor time)"
    return [
        *lines,
        f"{passed} of {len(results) - skipped} flights passed"
        f"{f', {skipped} skipped' if skipped else ''}; {flown_s:.0f} s flown in {wall_s:.1f} s "
        f"of flying{speed}",
    ]


def _mission_line(runs: list[MissionResult]) -> str:
    if runs[0].record.skipped:
        return f"{runs[0].mission.name} ({runs[0].flavour}): {len(runs)} skipped"
    passed = sum(run.is_passed for run in runs)
    errors = [run.final_error_m for run in runs if run.final_error_m is not None]
    inside = [run.is_inside_r95 for run in runs if run.is_inside_r95 is not None]
    line = f"{runs[0].mission.name} ({runs[0].flavour}): {passed}/{len(runs)} passed"
    if errors:
        line += f", error at most {max(errors):.2f} m, {sum(inside)}/{len(inside)} inside R95"
    flown_s, wall_s, cpu_s = _times(runs)
    if wall_s > 0.0:
        line += f", {flown_s / wall_s:.0f}x"
    return f"{line} ({flown_s / cpu_s:.0f}x by processor time)" if cpu_s > 0.0 else line


def _times(results: list[MissionResult]) -> tuple[float, float, float]:
    records = [result.record for result in results]
    return (
        sum(record.ended_s for record in records),
        sum(record.wall_s for record in records),
        sum(record.cpu_s for record in records),
    )


def report_page(result: MissionResult) -> str:
    """Return the page as text."""
    record, mission, last = result.record, result.mission, result.last_estimate
    rows = [
        ("Flown", f"{record.ended_s:.1f} s, {record.distance_m:.0f} m"),
        ("Flown by", result.how),
    ]
    if last is not None:
        whose = f" of emitter {mission.emitter.emitter_id}" if mission.emitters else ""
        rows.append((f"Final error{whose}", f"{result.error_m(last):.2f} m"))
        rows.append((f"R95{whose}", f"{last.r95_m:.2f} m"))
    if record.closest_approach_m is not None:
        rows.append(("Closest to the fence", f"{record.closest_approach_m:.1f} m"))
    page = FlightPage(
        kind="Mission report",
        name=result.title,
        verdict="passed" if result.is_passed else "failed",
        is_passed=result.is_passed,
        about=result.mission.about,
        facts=[*rows, ("Script", result.file)],
        map=flight_map(_map_layers(result)),
        map_note=MAP_NOTE,
        charts=_charts(result),
        events=events_of(result.record),
        footer=f"sim-link {__version__}",
    )
    return render_page(
        page,
        "mission.html.j2",
        "sim_link.lab.mission",
        result=result,
        record=result.record,
        invariants=invariants_of(result.record),
    )


def events_of(record: FlightRecord) -> list[EventRow]:
    """Return the events that people want to read, in the order of time."""
    rows = [
        EventRow(time_s, kind, _phrase(kind, fields))
        for time_s, kind, fields in record.events
        if kind in SHOWN_EVENTS
    ]
    rows += [
        EventRow(text.time_s, "autopilot", text.text)
        for text in record.texts
        if text.source == "autopilot"
    ]
    rows += [EventRow(v.time_s, "violation", f"{v.invariant}: {v.what}") for v in record.violations]
    return sorted(rows, key=lambda row: row.time_s)


def _phrase(kind: str, fields: Mapping[str, object]) -> str:
    if kind == "step":
        return f"{fields['step']} {fields['name']}: {fields['what']}"
    if kind == "step ended":
        return f"{fields['step']} {fields['name']} {fields['failure'] or 'done'}"
    return event_text(kind, {name: plain(value) for name, value in fields.items()})


def invariants_of(record: FlightRecord) -> list[tuple[str, str, int | None, str]]:
    """Return every invariant: name, title, how often it did not hold, how far that was judged.

    None: it was not judged, and why not.
    """
    counts = Counter(violated.invariant for violated in record.violations)
    scope = record.scope
    return [
        (
            name,
            title,
            counts[name] if name in scope.judged else None,
            scope.judged.get(name) or scope.unjudged.get(name, ""),
        )
        for name, title in TITLES.items()
    ]


def _map_layers(result: MissionResult) -> MapLayers:
    record, mission = result.record, result.mission
    limits = mission.config.limits
    east_m, north_m = mission.area_m
    truth = true_places(mission)
    return MapLayers(
        track_enu_m=[place[:2] for _, place in record.track],
        estimates=record.estimates,
        waypoints_enu_m=[place for _, place, _ in record.waypoints],
        fence_enu_m=limits.fence_enu_m,
        keep_outs_enu_m=[*(o.corners_enu_m for o in mission.obstacles), *limits.keep_out_enu_m],
        area_enu_m=[(0.0, 0.0), (east_m, 0.0), (east_m, north_m), (0.0, north_m)],
        truth_enu_m={f"emitter {emitter}": place for emitter, place in truth.items()},
    )


def _charts(result: MissionResult) -> list[Chart | None]:
    record, points = result.record, result.record.estimates
    marks = [(s.started_s, f"{s.title} at {s.started_s:.1f} s") for s in record.steps]
    over_time = TimeCharts(record.ended_s, marks)
    radii = [(p.time_s, max(p.r95_m, LEAST_M)) for p in points]
    errors = [(p.time_s, max(result.error_m(p), LEAST_M)) for p in points]
    residuals: list[Point] = [
        (p.time_s, p.range_innovation_m) for p in points if p.range_innovation_m is not None
    ]
    heights = [(time_s, place[2]) for time_s, place in record.track]
    return [
        over_time.draw(
            "Error and R95",
            "metres over seconds, logarithmic. Violet: true error; red: R95",
            TimeCurve(radii, "radius"),
            TimeCurve(errors, "truth"),
            is_log=True,
        ),
        over_time.draw(
            "Range residuals",
            "metres over seconds: what a range was longer than expected",
            TimeCurve(residuals, "residual", is_dotted=True),
        ),
        histogram("Their histogram", "how many over metres", [value for _, value in residuals]),
        over_time.draw("Height", "metres over seconds", TimeCurve(heights, "track")),
    ]
