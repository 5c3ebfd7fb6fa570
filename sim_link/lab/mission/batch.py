"""Many flights, every script with every seed, and reports: lines for many, the HTML page of one."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec

from companion import __version__
from companion.config.schema import CompanionConfig
from companion.errors import CompanionError, ConfigError
from companion.flight_setup import build_endpoint, build_planner
from companion.geometry.polygons import Point
from companion.io.files import plain, write_bytes_atomic, write_text_atomic
from companion.io.links.transports import TcpClient, make_link, parse_transport
from companion.kernel import IS_COMPILED_ON_CALL
from companion.report.charts import Chart, MapLayers, TimeCharts, TimeCurve, flight_map, histogram
from companion.report.flight_summary import EventRow, event_text
from companion.report.page import MIN_M, FlightPage, render_page
from companion.warm_up import warm_up as fly_in_circles
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import FlavourName
from sim_link.lab.lockstep import MemoryJournal
from sim_link.lab.mission.in_memory import Progress, fly_in_memory
from sim_link.lab.mission.processes import check_faults, check_installed, vehicle_fault_of
from sim_link.lab.mission.results import (
    FlightRecord,
    MissionResult,
    flight_name,
    how_flown,
    true_positions,
)
from sim_link.lab.mission.script import Mission
from sim_link.lab.mission.script_file import flown_config, load_mission
from sim_link.lab.monitor.monitor import TITLES
from sim_link.lab.pool import LOCAL, WorkerLostError, open_pool

SHOWN_EVENTS = ("step", "step ended", "fault", "phase", "text", "result", "answer", "bound")
MAP_NOTE = (
    "Blue: the vehicle; red: 95 % ellipses over time and the last R95; violet: where emitters "
    "truly are; gold: waypoints; dashed grey: the area; dashed green: the companion's fence, where "
    "it is in the picture; red areas: obstacles and keep-outs."
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
    """Return the events for people, in order of time."""
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
    """Return every invariant's name, title, count and extent, or None and why it was not judged."""
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
    truth = true_positions(mission)
    return MapLayers(
        track_enu_m=[position[:2] for _, position in record.track],
        estimates=record.estimates,
        waypoints_enu_m=[position for _, position, _ in record.waypoints],
        fence_enu_m=limits.fence_enu_m,
        keep_outs_enu_m=[*(o.corners_enu_m for o in mission.obstacles), *limits.keep_out_enu_m],
        area_enu_m=[(0.0, 0.0), (east_m, 0.0), (east_m, north_m), (0.0, north_m)],
        truth_enu_m={f"emitter {emitter}": position for emitter, position in truth.items()},
    )


def _charts(result: MissionResult) -> list[Chart | None]:
    record, points = result.record, result.record.estimates
    marks = [(s.started_s, f"{s.title} at {s.started_s:.1f} s") for s in record.steps]
    over_time = TimeCharts(record.ended_s, marks)
    radii = [(p.time_s, max(p.r95_m, MIN_M)) for p in points]
    errors = [(p.time_s, max(result.error_m(p), MIN_M)) for p in points]
    residuals: list[Point] = [
        (p.time_s, p.range_innovation_m) for p in points if p.range_innovation_m is not None
    ]
    heights = [(time_s, position[2]) for time_s, position in record.track]
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


@dataclass(frozen=True, slots=True)
class FlightTask:
    """One flight of a batch."""

    mission: Mission
    file: str
    seed: int
    reports: Path | None
    """Folder of the reports; None if no reports are written."""
    speed: float | None = None
    """Speed in times real time, with real processes; None: lockstep."""
    connect: str | None = None
    """Link to a vehicle that runs already."""

    @property
    def misfit(self) -> str:
        """Reason why the task cannot be flown, if known before it starts; empty: none."""
        if self.connect is not None:
            return vehicle_fault_of(self.mission)
        return self.mission.misfit(self.mission.autopilot.flavour)

    @property
    def flight_name(self) -> str:
        """Name of the flight's folder while the autopilot is still unknown."""
        flavour = self.mission.autopilot.flavour if self.connect is None else "vehicle"
        return flight_name(self.mission.name, flavour, self.how, self.seed)

    @property
    def how(self) -> str:
        """Wording of the flight's speed and link; see `how_flown`."""
        return how_flown(self.speed, self.connect)


Done = Callable[[int, MissionResult], None]
"""Callback with the index of a task and its result, without the flight's history."""


def check_reports(folder: Path) -> None:
    """Make the folder, and check that reports can be written there; else a `CompanionError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):  # only trying shows it, root may do anything
            pass
    except OSError as error:
        raise CompanionError(f"--report {folder}: cannot be written ({error.strerror})") from error


@dataclass(frozen=True, slots=True)
class MissionBatch:
    """Missions to be flown."""

    files: Sequence[Path]
    seeds: Sequence[int] = (0,)
    autopilot: FlavourName | None = None
    """Autopilot instead of the scripts' own."""
    reports: Path | None = None
    speed: float | None = None
    connect: str | None = None

    def tasks(self) -> list[FlightTask]:
        """Return every flight, checked as far as the ground allows; `CompanionError`: wrong."""
        loaded = [(str(path), mission) for path in self.files for mission in self._load(path)]
        for file, mission in loaded:
            if not mission.misfit(mission.autopilot.flavour):
                check_flyable(mission, file)
            if self.speed is not None and self.connect is None:
                check_faults(mission, file)
        if self.speed is not None:
            check_installed()
        if self.connect is not None:
            asyncio.run(_check_link(self.connect))
        tasks = [
            FlightTask(mission, file, seed, self.reports, self.speed, self.connect)
            for file, mission in loaded
            for seed in self.seeds
        ]
        if self.reports is not None:
            _check_names(tasks)
        return tasks

    def _load(self, path: Path) -> list[Mission]:
        """Return the script once for each autopilot to fly it on."""
        mission = load_mission(path)
        flavours = flavours_of(mission, str(path))
        if self.connect is not None:
            return [with_autopilot(mission, flavours[0])]
        wanted = flavours if self.autopilot is None else (self.autopilot,)
        return [with_autopilot(mission, flavour) for flavour in wanted]


def flavours_of(mission: Mission, name: str) -> tuple[FlavourName, ...]:
    """Return the autopilots that a script is to be flown on; `ConfigError`: it lists one twice."""
    flavours = tuple(mission.autopilots or (mission.autopilot.flavour,))
    for flavour in set(flavours):
        if flavours.count(flavour) > 1:
            raise ConfigError(f"{name}: $.autopilots: {flavour} is listed more than once")
    return flavours


def _check_names(tasks: Sequence[FlightTask]) -> None:
    """Check that no flight overwrites the report of another; `ConfigError`: one would."""
    files: dict[str, str] = {}
    for task in tasks:
        name = task.flight_name
        if name in files:
            raise ConfigError(
                f"{task.file}: $.name: its report would be {name}, which is that of "
                f"{files[name]}; give one of them another name, or fly them with two --report"
            )
        files[name] = task.file


async def _check_link(text: str) -> None:
    """Open the vehicle's link and close it again, before any process is started."""
    spec = parse_transport(text)
    if isinstance(spec, TcpClient):
        return  # waited for as long as it is not there, and a vehicle may serve one client only
    link = make_link(spec, 0, lambda _: None)
    await link.open()
    link.close()


def with_autopilot(mission: Mission, flavour: FlavourName) -> Mission:
    """Return the mission on another autopilot."""
    autopilot = msgspec.structs.replace(mission.autopilot, flavour=flavour)
    return msgspec.structs.replace(mission, autopilot=autopilot)


def check_flyable(mission: Mission, name: str) -> None:
    """Raise `ConfigError` if the flight of a script cannot be built."""
    try:
        SimEndpoint(mission.scenario, 0)
        build_endpoint(flown_config(mission), MemoryJournal())
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from error


def warm_up(tasks: Sequence[FlightTask]) -> None:
    """Compile the kernels of the flights once, before several processes need them."""
    done: list[CompanionConfig] = []
    for config in (flown_config(task.mission) for task in tasks if IS_COMPILED_ON_CALL):
        if config not in done:
            done.append(config)
            fly_in_circles(config.tracking, build_planner(config))


def fly_all(
    tasks: Sequence[FlightTask],
    jobs: int,
    done: Done,
    progress: Progress | None = None,
    backend: str = LOCAL,
) -> None:
    """Fly them, `jobs` at once (1: in this process) or on a backend of `open_pool`.

    `done` gets the position of a task and its result, as they come; `progress` every slice where
    they are flown in this process. `ConfigError`: the backend is not there. After a
    KeyboardInterrupt unfinished flights are not reported.
    """
    jobs = min(jobs, len(tasks))
    is_here = jobs <= 1 and backend == LOCAL
    fly = partial(fly_task, progress=progress) if is_here else fly_task
    left = set(range(len(tasks)))
    try:
        with open_pool(backend, jobs) as pool, closing(pool.results(fly, tasks)) as results:
            for position, result in results:
                left.discard(position)
                done(position, result)
                if result.record.is_interrupted:
                    raise KeyboardInterrupt
    except WorkerLostError as error:
        for position in sorted(left):
            done(position, unflown(tasks[position], str(error)))


def fly_task(task: FlightTask, progress: Progress | None = None) -> MissionResult:
    """Fly one, and write its report; failures of the report become the result's error."""
    if task.misfit:
        record = FlightRecord(autopilot="vehicle" if task.connect else "", skipped=task.misfit)
        return MissionResult(task.mission, task.file, task.seed, task.how, record)
    try:
        result = _fly(task, progress)
    except (CompanionError, OSError) as error:
        return unflown(task, str(error))
    kept = result.without_history()
    if task.reports is None or kept.record.skipped:
        return kept
    try:
        if task.speed is not None:
            _rename_folder(task.reports / task.flight_name, result.flight_name)
        return replace(kept, report=write_report(task.reports, result))
    except CompanionError as error:
        return replace(kept, error=str(error))


def unflown(task: FlightTask, error: str) -> MissionResult:
    """Return the result of a flight that did not come to an end, with the reason."""
    return MissionResult(task.mission, task.file, task.seed, task.how, error=error)


def _fly(task: FlightTask, progress: Progress | None) -> MissionResult:
    if task.speed is None:
        return fly_in_memory(task.mission, task.seed, task.file, progress)
    from sim_link.lab.mission.over_udp import fly_over_udp

    keep = None if task.reports is None else task.reports / task.flight_name
    return fly_over_udp(
        task.mission,
        task.seed,
        task.file,
        speed=task.speed,
        connect=task.connect,
        keep=keep,
        progress=progress,
    )


def _rename_folder(folder: Path, name: str) -> None:
    """Give a flight's folder the name of its report, in place of an earlier one of that name."""
    target = folder.with_name(name)
    if target == folder:
        return
    try:
        if target.exists():
            shutil.rmtree(target)
        folder.rename(target)
    except OSError as error:
        raise CompanionError(f"{target}: cannot be replaced ({error.strerror})") from error


def write_report(folder: Path, result: MissionResult) -> str:
    """Write report and event log of a flight; return the report's path."""
    name = result.flight_name
    path = folder / f"{name}.html"
    if result.record.frames:
        write_bytes_atomic(folder / f"{name}.tlog", result.tlog)
    write_text_atomic(folder / f"{name}.jsonl", result.event_log.decode("ascii"))
    write_text_atomic(path, report_page(result))
    return str(path)
