"""`sim-link mission run`: arguments, progress on a terminal, JUnit XML and exit codes.

In JUnit XML, as continuous integration reads it, a flight is a suite and an expectation a case; an
unfinished flight, or one without a report, has a case with an error.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TextIO
from xml.etree import ElementTree

from companion.arguments import number_in
from companion.entry import is_interrupt
from companion.errors import ConfigError
from companion.io.files import check_writable, write_text_atomic
from sim_link.lab.mission import batch
from sim_link.lab.mission.conditions import FlightSituation
from sim_link.lab.mission.results import MissionResult
from sim_link.lab.mission.steps import StepRunner
from sim_link.lab.pool import LOCAL

REFRESH_S = 0.1


class PlainProgress:
    """A line for every flight and, where it is detailed, one when a step of the only one begins."""

    def __init__(self, total: int, output: TextIO, *, is_detailed: bool) -> None:
        self._output, self._total, self._is_detailed = output, total, is_detailed
        self._done = self._step = 0
        self.display: AbstractContextManager[object] = nullcontext()

    def say(self, line: str) -> None:
        """Print a line."""
        print(line, file=self._output, flush=True)

    def moved(self, runner: StepRunner, situation: FlightSituation) -> None:
        """Print the step of a mission when it changes."""
        number, total, name = runner.progress
        if not self._is_detailed or number == self._step:
            return
        self._step = number
        self.say(f"{situation.mission.time_s:7.1f} s  step {number}/{total} {name}")

    def finished(self, result: MissionResult) -> None:
        """Handle the end of a flight."""
        self._done += 1
        self._step = 0
        self.say(flight_line(result, self._done, self._total))
        for verdict in result.failed:
            self.say(f"     {verdict.name}: {verdict.found}")
        for line in filter(None, (result.error, result.pace, result.doubt)):
            self.say(f"     {line}")


class LiveProgress(PlainProgress):
    """The same with a line that is redrawn in place; `ImportError`: rich is not installed."""

    def __init__(self, total: int, output: TextIO) -> None:
        super().__init__(total, output, is_detailed=False)
        from rich.console import Console
        from rich.live import Live

        self._console = Console(file=output)
        self.display = self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._due_s = 0.0

    def moved(self, runner: StepRunner, situation: FlightSituation) -> None:
        """Redraw the line now and then."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + REFRESH_S
        from rich.text import Text

        self._live.update(Text(state_line(runner, situation), no_wrap=True), refresh=True)

    def say(self, line: str) -> None:
        """Print a line above the live one."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def progress_for(total: int, jobs: int, output: TextIO | None = None) -> PlainProgress:
    """Return a progress display for the output: live on a terminal with rich, or plain."""
    stream = sys.stdout if output is None else output
    if stream.isatty():
        try:
            return LiveProgress(total, stream)
        except ImportError:
            pass
    return PlainProgress(total, stream, is_detailed=jobs == 1 and total == 1)


def state_line(runner: StepRunner, situation: FlightSituation) -> str:
    """Format the state of a flight in a line."""
    number, total, name = runner.progress
    vehicle, companion, estimate = situation.vehicle, situation.companion, situation.estimate
    parts = [
        f"{situation.mission.time_s:7.1f} s  step {number}/{total} {name}",
        companion.phase or "no companion",
        f"vehicle in {vehicle.mode or '?'}",
    ]
    if vehicle.height_m is not None:
        parts.append(f"height {vehicle.height_m:.1f} m")
    if estimate.r95_m is not None:
        parts.append(f"{estimate.state}, relative R95 {estimate.r95_m:.2f} m")
    return ", ".join(parts)


def flight_line(result: MissionResult, number: int, total: int) -> str:
    """Format the result of a flight in a line."""
    skipped = result.record.skipped
    verdict = "PASS" if result.is_passed else "SKIP" if skipped else "FAIL"
    line = f"{verdict} [{number}/{total}] {result.title}: "
    if not result.verdicts:
        return line + (skipped or "not flown to its end")
    line += f"{result.record.ended_s:.1f} s"
    last = result.last_estimate
    if last is not None:
        line += f", error {result.error_m(last):.2f} m, relative R95 {last.r95_m:.2f} m"
    return f"{line}, {result.how}, {result.times_real_time:.0f}x"


def junit_xml(results: Sequence[MissionResult]) -> str:
    """Return the document, its flights in the order of the results."""
    root = ElementTree.Element("testsuites", name="missions")
    for result in results:
        root.append(_suite(result))
    cases = [verdict for result in results for verdict in result.verdicts]
    root.set("tests", str(sum(_count(result) for result in results)))
    root.set("failures", str(sum(not verdict.is_met for verdict in cases)))
    root.set("errors", str(sum(bool(result.error) for result in results)))
    root.set("time", f"{sum(result.record.wall_s for result in results):.3f}")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _suite(result: MissionResult) -> ElementTree.Element:
    suite = ElementTree.Element(
        "testsuite",
        name=_clean(result.title),
        file=_clean(result.file),
        tests=str(_count(result)),
        failures=str(len(result.failed)),
        errors=str(int(bool(result.error))),
        skipped=str(int(bool(result.record.skipped))),
        time=f"{result.record.wall_s:.3f}",
    )
    properties = ElementTree.SubElement(suite, "properties")
    last = result.last_estimate
    values = {
        "seed": result.seed,
        "how": result.how,
        "flown_s": f"{result.record.ended_s:.1f}",
        "distance_m": f"{result.record.distance_m:.1f}",
        "final_error_m": result.final_error_m,
        "r95_m": None if last is None else last.r95_m,
        "report": result.report or None,
    }
    for name, value in {
        name: str(value) for name, value in values.items() if value is not None
    }.items():
        ElementTree.SubElement(properties, "property", name=name, value=_clean(value))
    for number, verdict in enumerate(result.verdicts):
        case = _case(suite, result, verdict.name, result.record.wall_s if number == 0 else 0.0)
        if not verdict.is_met:
            failure = ElementTree.SubElement(case, "failure", message=_clean(verdict.found))
            failure.text = _clean(f"{verdict.name}: {verdict.found}")
    for kind, why in (("error", result.error), ("skipped", result.record.skipped)):
        if why:
            case = _case(suite, result, "flight and report", 0.0)
            ElementTree.SubElement(case, kind, message=_clean(why))
    return suite


def _case(
    suite: ElementTree.Element, result: MissionResult, name: str, time_s: float
) -> ElementTree.Element:
    return ElementTree.SubElement(
        suite,
        "testcase",
        classname=_clean(f"{result.mission.name}.{result.flavour}.seed {result.seed}"),
        name=_clean(name),
        time=f"{time_s:.3f}",
    )


def _count(result: MissionResult) -> int:
    """Return the number of cases: expectations, errors and reasons for skipping."""
    return len(result.verdicts) + bool(result.error) + bool(result.record.skipped)


def _clean(text: str) -> str:
    """Return the text without characters that XML 1.0 forbids."""
    return "".join(c if c.isprintable() else " " for c in text)


LOCKSTEP = "lockstep"
MAX_SPEED = 1000.0
EXIT_PASSED, EXIT_FAILED, EXIT_BAD_INPUT = 0, 1, 2

DESCRIPTION = """\
Fly mission scripts and report pass or fail like a test.

In lockstep (the default) companion and vehicle run in memory on a virtual clock. With --speed they
are processes of their own over UDP, and the operator's side is flown through MAVSDK; --connect
flies a vehicle that is there already, of any make."""
EPILOG = """\
examples:
  sim-link mission run configs/missions/canonical.yaml
  sim-link mission run configs/missions/*.yaml --repeat 20 --jobs 2 --junit missions.xml
  sim-link mission run configs/missions/canonical.yaml --speed 4 --report reports
  sim-link mission run configs/missions/canonical.yaml --connect udpin:127.0.0.1:14540

A script that does not fit the autopilot is skipped, with the reason.

exit code: 0 every expectation is met, 1 one is not, or a flight came to no end or has no report,
2 a script or an argument is wrong (then nothing was started)"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    add = parser.add_argument
    add("files", metavar="FILE", nargs="+", type=Path, help="mission scripts")
    add(
        "--speed",
        metavar="X|lockstep",
        help="seconds of the flight per second, with real processes; default: lockstep",
    )
    autopilot = "in place of the scripts' own; what does not fit it is skipped"
    add("--autopilot", choices=("px4", "ardupilot"), help=autopilot)
    add("--connect", metavar="URL", help="fly the vehicle on this link instead of a simulated one")
    add(
        "--seed", metavar="N", type=number_in(0, kind=int), default=0, help="first seed (default 0)"
    )
    repeat = "number of seeds (default 1)"
    add("--repeat", metavar="N", type=number_in(1, kind=int), default=1, help=repeat)
    add("--jobs", metavar="J", type=number_in(1, kind=int), default=1, help="parallel flights")
    add("--backend", metavar="URL", default=LOCAL, help="fly on a cluster: dask://HOST:PORT")
    add("--junit", metavar="FILE", type=Path, help="write JUnit XML")
    add("--report", metavar="DIR", type=Path, help="write a report and logs of every flight")


def run(arguments: argparse.Namespace) -> int:
    """Fly the missions of the arguments; return the exit code. Errors come before the start."""
    campaign = _campaign(arguments)
    if campaign.reports is not None:
        batch.check_reports(campaign.reports)
    if arguments.junit is not None:
        check_writable(arguments.junit)
    tasks = campaign.tasks()
    progress = progress_for(len(tasks), arguments.jobs)
    results: dict[int, MissionResult] = {}
    try:
        if _is_flown(tasks, arguments, progress, results):
            for line in campaign_lines(_in_order(tasks, results)):
                progress.say(line)
        else:
            done = sum(not result.record.is_interrupted for result in results.values())
            print(f"sim-link: interrupted after {done} of {len(tasks)} flights", file=sys.stderr)
    finally:
        ordered = _in_order(tasks, results)
        if arguments.junit is not None:
            write_text_atomic(arguments.junit, junit_xml(ordered))
    is_fine = all(result.is_passed or result.record.skipped for result in ordered)
    return EXIT_PASSED if is_fine else EXIT_FAILED


EXPLAINED_AFTER_S = 3.0
"""Real time for which kernels of an earlier run are loaded."""


@contextmanager
def _explained() -> Iterator[None]:
    """Explain on standard error why nothing is flown yet, if that lasts."""
    text = "sim-link: compiling kernels, which takes a minute or more the first time"
    note = threading.Timer(EXPLAINED_AFTER_S, lambda: print(text, file=sys.stderr, flush=True))
    note.start()
    try:
        yield
    finally:
        note.cancel()


def _is_flown(
    tasks: Sequence[batch.FlightTask],
    arguments: argparse.Namespace,
    progress: PlainProgress,
    results: dict[int, MissionResult],
) -> bool:

    def done(position: int, result: MissionResult) -> None:
        results[position] = result
        progress.finished(result)

    try:
        with _explained():
            batch.warm_up(tasks)
        with progress.display:
            batch.fly_all(tasks, arguments.jobs, done, progress.moved, arguments.backend)
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        return False
    return True


def _in_order(
    tasks: Sequence[batch.FlightTask], results: dict[int, MissionResult]
) -> list[MissionResult]:
    """Return a result for every task, also for those that were not finished."""
    reason = "interrupted: the campaign ended before this flight was over"
    return [results.get(n) or batch.unflown(task, reason) for n, task in enumerate(tasks)]


def _campaign(arguments: argparse.Namespace) -> batch.MissionBatch:
    if arguments.connect is not None and arguments.autopilot is not None:
        raise ConfigError("--autopilot: with --connect the autopilot is the one that answers")
    if arguments.connect is not None and arguments.jobs > 1:
        raise ConfigError("--jobs: with --connect there is one vehicle")
    speed = _speed(arguments)
    reports = arguments.report
    if arguments.backend != LOCAL:
        if speed is not None:
            raise ConfigError(f"--backend {arguments.backend}: a cluster flies in lockstep only")
        reports = None if reports is None else reports.resolve()  # workers are elsewhere
    return batch.MissionBatch(
        files=arguments.files,
        seeds=range(arguments.seed, arguments.seed + arguments.repeat),
        autopilot=arguments.autopilot,
        reports=reports,
        speed=speed,
        connect=arguments.connect,
    )


def _speed(arguments: argparse.Namespace) -> float | None:
    if arguments.speed in (None, LOCKSTEP):
        if arguments.connect is not None and arguments.speed == LOCKSTEP:
            raise ConfigError("--speed lockstep: not with --connect")
        return None if arguments.connect is None else 1.0
    try:
        speed = float(arguments.speed)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed <= MAX_SPEED:
        raise ConfigError(f"--speed {arguments.speed}: give lockstep, or 0 to {MAX_SPEED:g}")
    return speed


def campaign_lines(results: list[MissionResult]) -> list[str]:
    """Return the summary of a campaign as text: each mission, then all of them."""
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
