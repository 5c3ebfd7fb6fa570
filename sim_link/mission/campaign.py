"""Many flights: every script with every seed, one after the other or several at once."""

from __future__ import annotations

import concurrent.futures
import importlib.util
import multiprocessing
import shutil
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from companion.config.schema import CompanionConfig
from companion.errors import CompanionError, ConfigError
from companion.io.files import write_bytes_atomic, write_text_atomic
from companion.run import build_endpoint, prepare
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import FlavourName
from sim_link.lockstep.journal import Notes
from sim_link.mission.in_memory import Progress, fly_in_memory
from sim_link.mission.mavsdk_operator import check_installed
from sim_link.mission.process_faults import check_faults
from sim_link.mission.result import MissionResult, flight_name, how_flown
from sim_link.mission.script import Mission
from sim_link.mission.script_file import flown_config, load_mission
from sim_link.mission.summary import Summary, summary_of


@dataclass(frozen=True, slots=True)
class FlightTask:
    """One flight that is to be flown."""

    mission: Mission
    file: str
    seed: int
    reports: str | None
    """The folder of the reports; None: none are wanted."""
    speed: float | None = None
    """Times real time, with real processes; None: lockstep."""
    connect: str | None = None
    """The link to a vehicle that is there already."""

    @property
    def flight_name(self) -> str:
        """What its folder is called while it is flown, when nobody knows yet who answers."""
        flavour = self.mission.autopilot.flavour if self.connect is None else "vehicle"
        how = how_flown(self.speed, self.connect)
        return flight_name(self.mission.name, flavour, how, self.seed)


def check_reports() -> None:
    """Make sure, before any flight, that reports can be made.

    Raises:
        ConfigError: A package is missing; the message says how to get it.
    """
    if importlib.util.find_spec("jinja2") is None:
        text = "reports need jinja2: pip install 'companion-guidance[mission]'"
        raise ConfigError(f"--report: {text}")


@dataclass(frozen=True, slots=True)
class Campaign:
    """What is to be flown."""

    files: Sequence[Path]
    seeds: Sequence[int] = (0,)
    jobs: int = 1
    autopilot: FlavourName | None = None
    """In place of the scripts' own."""
    reports: Path | None = None
    speed: float | None = None
    connect: str | None = None

    def tasks(self) -> list[FlightTask]:
        """Every flight, checked as far as that can be done without flying.

        Raises:
            ConfigError: A script is wrong; nothing was started.
        """
        loaded = [(path, mission) for path in self.files for mission in self._load(path)]
        for path, mission in loaded:
            check_flyable(mission, str(path))
            if self.speed is not None:
                check_faults(mission, str(path), is_our_vehicle=self.connect is None)
        if self.speed is not None:
            check_installed()
        tasks = [
            FlightTask(
                mission=mission,
                file=str(path),
                seed=seed,
                reports=None if self.reports is None else str(self.reports),
                speed=self.speed,
                connect=self.connect,
            )
            for path, mission in loaded
            for seed in self.seeds
        ]
        if self.reports is not None:
            _check_names(tasks)
        return tasks

    def _load(self, path: Path) -> list[Mission]:
        """The script, once for every autopilot that it is to be flown on."""
        mission = load_mission(path)
        flavours = flavours_of(mission, str(path))
        if self.connect is not None:
            return [mission]
        wanted = flavours if self.autopilot is None else (self.autopilot,)
        return [with_autopilot(mission, flavour) for flavour in wanted]


def flavours_of(mission: Mission, name: str) -> tuple[FlavourName, ...]:
    """The autopilots that a script is to be flown on.

    Raises:
        ConfigError: It lists one twice.
    """
    flavours = tuple(mission.autopilots or (mission.autopilot.flavour,))
    for flavour in set(flavours):
        if flavours.count(flavour) > 1:
            raise ConfigError(f"{name}: $.autopilots: {flavour} is listed more than once")
    return flavours


def _check_names(tasks: Sequence[FlightTask]) -> None:
    """Make sure that no flight writes over the report of another.

    Raises:
        ConfigError: Two of them have one name.
    """
    files: dict[str, str] = {}
    for task in tasks:
        name = task.flight_name
        if name in files:
            raise ConfigError(
                f"{task.file}: $.name: its report would be {name}, which is that of "
                f"{files[name]}; give one of them another name, or fly them with two --report"
            )
        files[name] = task.file


def with_autopilot(mission: Mission, flavour: FlavourName) -> Mission:
    """The mission on another autopilot."""
    autopilot = msgspec.structs.replace(mission.autopilot, flavour=flavour)
    return msgspec.structs.replace(mission, autopilot=autopilot)


def check_flyable(mission: Mission, name: str) -> None:
    """Build everything that a flight is made of, and throw it away.

    Raises:
        ConfigError: A part of it does not exist or is out of range.
    """
    try:
        SimEndpoint(mission.scenario, 0)
        build_endpoint(flown_config(mission), Notes())
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from error


def warm_up(tasks: Sequence[FlightTask]) -> None:
    """Compile what the flights need, once and before any process needs it at the same time."""
    done: list[CompanionConfig] = []
    for task in tasks:
        config = flown_config(task.mission)
        if config not in done:
            done.append(config)
            prepare(config)


def fly_all(
    tasks: Sequence[FlightTask], jobs: int, progress: Progress | None = None
) -> Iterator[tuple[int, Summary]]:
    """Fly them; the summaries with the positions of their tasks, as they come.

    Args:
        tasks: What to fly.
        jobs: How many at once; 1: in this process.
        progress: Told of every slice where there is one job.

    Raises:
        CompanionError: A process ended by force, or a report cannot be written.
    """
    if jobs <= 1 or len(tasks) <= 1:
        for position, task in enumerate(tasks):
            yield position, fly_task(task, progress)
        return
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(
        min(jobs, len(tasks)), mp_context=context, initializer=_leave_interrupts_to_the_parent
    )
    try:
        waiting = {pool.submit(fly_task, task): n for n, task in enumerate(tasks)}
        for future in concurrent.futures.as_completed(waiting):
            yield waiting[future], future.result()
    except concurrent.futures.BrokenExecutor as error:
        raise CompanionError("a process ended by force; try fewer --jobs") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def fly_task(task: FlightTask, progress: Progress | None = None) -> Summary:
    """Fly one, and write its report.

    Raises:
        CompanionError: A process does not start, or the report cannot be written.
    """
    result = _fly(task, progress)
    summary = summary_of(result)
    if task.reports is None:
        return summary
    return summary.with_report(write_report(Path(task.reports), result))


def _fly(task: FlightTask, progress: Progress | None) -> MissionResult:
    if task.speed is None:
        return fly_in_memory(task.mission, task.seed, task.file, progress)
    from sim_link.mission.over_udp import fly_over_udp

    keep = None if task.reports is None else Path(task.reports) / task.flight_name
    result = fly_over_udp(
        task.mission,
        task.seed,
        task.file,
        speed=task.speed,
        connect=task.connect,
        keep=keep,
        progress=progress,
    )
    if keep is not None:
        _rename_folder(keep, result.flight_name)
    return result


def _rename_folder(folder: Path, name: str) -> None:
    """Give a flight's folder the name of its report, in place of an earlier one of that name.

    Raises:
        CompanionError: That cannot be done.
    """
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
    """Write report and event log of a flight; the place of the report.

    Raises:
        CompanionError: A file cannot be written.
    """
    from sim_link.mission.report import report_page

    name = result.flight_name
    path = folder / f"{name}.html"
    if result.record.frames:
        write_bytes_atomic(folder / f"{name}.tlog", result.tlog)
    write_text_atomic(folder / f"{name}.jsonl", result.event_log.decode("ascii"))
    write_text_atomic(path, report_page(result))
    return str(path)
