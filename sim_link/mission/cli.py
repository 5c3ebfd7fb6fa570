"""`sim-link mission run`: arguments, lines for people and exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from companion.errors import ConfigError
from companion.io.files import check_writable, write_text_atomic
from companion.kernel import IS_COMPILED
from sim_link.interrupts import is_interrupt
from sim_link.mission.campaign import (
    Campaign,
    FlightTask,
    check_reports,
    fly_all,
    unflown,
    warm_up,
)
from sim_link.mission.junit import junit_xml
from sim_link.mission.progress import PlainProgress, progress_for
from sim_link.mission.summary import Summary, campaign_lines

LOCKSTEP = "lockstep"
MAX_SPEED = 1000.0
EXIT_PASSED, EXIT_FAILED, EXIT_BAD_INPUT = 0, 1, 2

DESCRIPTION = """\
Fly mission scripts and tell pass or fail like a test.

In lockstep (the default) companion and vehicle run in memory on a virtual clock. With --speed they
are processes of their own over UDP, and the operator's side is flown through MAVSDK; --connect
flies a vehicle that is there already, whoever made it."""
EPILOG = """\
examples:
  sim-link mission run configs/missions/canonical.yaml
  sim-link mission run configs/missions/*.yaml --repeat 20 --jobs 2 --junit missions.xml
  sim-link mission run configs/missions/canonical.yaml --speed 4 --report reports
  sim-link mission run configs/missions/canonical.yaml --connect udpin:127.0.0.1:14550

exit code: 0 every expectation is met, 1 one is not, or a flight came to no end or has no report,
2 a script or an argument is wrong (then nothing was started)"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `run`."""
    parser.add_argument("files", metavar="FILE", nargs="+", type=Path, help="mission scripts")
    parser.add_argument(
        "--speed",
        metavar="X|lockstep",
        help="seconds of the flight per second, with real processes; default: lockstep",
    )
    parser.add_argument(
        "--autopilot", choices=("px4", "ardupilot"), help="in place of the scripts' own"
    )
    parser.add_argument(
        "--connect", metavar="URL", help="fly the vehicle on this link instead of a simulated one"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="first seed (default 0)")
    parser.add_argument(
        "--repeat", metavar="N", type=int, default=1, help="with so many seeds (default 1)"
    )
    parser.add_argument("--jobs", metavar="J", type=int, default=1, help="so many at once")
    parser.add_argument("--junit", metavar="FILE", type=Path, help="write JUnit XML")
    parser.add_argument(
        "--report", metavar="DIR", type=Path, help="write a report and logs of every flight"
    )


def run(arguments: argparse.Namespace) -> int:
    """Fly what the arguments say.

    Returns:
        The exit code.

    Raises:
        ConfigError: A script or an argument is wrong; nothing was started.
        CompanionError: A file cannot be written or a link not be opened; nothing was started.
    """
    campaign = _campaign(arguments)
    if campaign.reports is not None:
        check_reports(campaign.reports)
    if arguments.junit is not None:
        check_writable(arguments.junit)
    tasks = campaign.tasks()
    progress = progress_for(len(tasks), campaign.jobs)
    summaries: dict[int, Summary] = {}
    try:
        if _is_flown(tasks, campaign.jobs, progress, summaries):
            for line in campaign_lines(_in_order(tasks, summaries)):
                progress.say(line)
        else:
            done = sum(not summary.is_interrupted for summary in summaries.values())
            print(f"sim-link: interrupted after {done} of {len(tasks)} flights", file=sys.stderr)
    finally:
        ordered = _in_order(tasks, summaries)
        if arguments.junit is not None:
            write_text_atomic(arguments.junit, junit_xml(ordered))
    return EXIT_PASSED if all(summary.is_passed for summary in ordered) else EXIT_FAILED


def _is_flown(
    tasks: Sequence[FlightTask],
    jobs: int,
    progress: PlainProgress,
    summaries: dict[int, Summary],
) -> bool:
    """Fly everything into `summaries`; whether nobody interrupted that."""

    def done(position: int, summary: Summary) -> None:
        """A flight is over."""
        summaries[position] = summary
        progress.finished(summary)

    try:
        if IS_COMPILED and sys.stdout.isatty():
            print("compiling kernels: half a minute the first time")
        warm_up(tasks)
        with progress:
            fly_all(tasks, jobs, done, progress.moved)
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        return False
    return True


def _in_order(tasks: Sequence[FlightTask], summaries: dict[int, Summary]) -> list[Summary]:
    """One for every task, also for those that were not over when the campaign ended."""
    reason = "interrupted: the campaign ended before this flight was over"
    return [summaries.get(n) or unflown(task, reason) for n, task in enumerate(tasks)]


def _campaign(arguments: argparse.Namespace) -> Campaign:
    if arguments.seed < 0:
        raise ConfigError(f"--seed {arguments.seed}: give a number that is not negative")
    for option in ("repeat", "jobs"):
        if getattr(arguments, option) < 1:
            raise ConfigError(f"--{option} {getattr(arguments, option)}: give at least 1")
    if arguments.connect is not None and arguments.autopilot is not None:
        raise ConfigError("--autopilot: with --connect the autopilot is whoever answers")
    if arguments.connect is not None and arguments.jobs > 1:
        raise ConfigError("--jobs: with --connect there is one vehicle")
    return Campaign(
        files=arguments.files,
        seeds=range(arguments.seed, arguments.seed + arguments.repeat),
        jobs=arguments.jobs,
        autopilot=arguments.autopilot,
        reports=arguments.report,
        speed=_speed(arguments),
        connect=arguments.connect,
    )


def _speed(arguments: argparse.Namespace) -> float | None:
    """Times real time; None: lockstep."""
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
