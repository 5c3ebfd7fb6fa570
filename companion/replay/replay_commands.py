"""`companion replay`: by the kind of the recording."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from companion.config.schema import CompanionConfig, load_config
from companion.errors import EXIT_FAILED, ConfigError
from companion.io.files import check_writable, write_json_atomic
from companion.io.radio_recording import is_radio_recording
from companion.replay.flight_replay import FlightReplay, Pace, replay_flight, replay_on_map
from companion.replay.walk_replay import (
    WalkAccuracy,
    explanation,
    replay_walk,
    stated_accuracy,
    table,
)
from companion.web.settings import requested_settings


def run(arguments: argparse.Namespace) -> int:
    """Replay a flight, a walk or a radio's recording, and return the exit code."""
    config = None if arguments.config is None else load_config(arguments.config)
    if arguments.json is not None:
        check_writable(arguments.json)
    settings = requested_settings(arguments)
    if arguments.file.suffix.lower() == ".csv":
        if arguments.speed is not None:
            raise ConfigError("--speed: a walk is replayed as fast as it goes; leave it out")
        if settings is not None:
            raise ConfigError("--web: a walk has no map; leave it out")
        return _replay_walk(arguments, config or CompanionConfig())
    if arguments.own_sigma is not None or arguments.explain:
        raise ConfigError("--own-sigma, --explain: only of a recorded walk (.csv); leave them out")
    if is_radio_recording(arguments.file):
        return _replay_recording(arguments, config or CompanionConfig())

    def report(replay: FlightReplay) -> None:
        """Print the comparison, and write the figures if requested."""
        print(replay.table())
        print(replay.verdict, flush=True)
        if arguments.json is not None:
            value = {**replay.as_json(), "exact": replay.is_exact}
            write_json_atomic(arguments.json, value)

    if settings is not None:
        speed = arguments.speed or 1.0
        say = partial(print, flush=True)  # a script may wait for the line
        replay = replay_on_map(arguments.file, config, say, settings, speed, report)
    else:
        pace = None if arguments.speed is None else Pace(arguments.speed)
        replay = replay_flight(arguments.file, config, print, pace)
        report(replay)
    return EXIT_FAILED if replay.is_failed else 0


def _replay_recording(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    from companion.replay.radio_replay import replay_recording

    if arguments.speed is not None or arguments.web is not None:
        raise ConfigError("--speed, --web: a radio recording is replayed at once; leave them out")
    replay = replay_recording(arguments.file, config)
    print("\n".join(replay.radios))
    if replay.targets:
        print(table(replay.targets, config.estimation.localised_r95_m))
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in replay.targets]}
        write_json_atomic(arguments.json, value)
    return 0


def _replay_walk(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    def progress(rows: int) -> None:
        """Show the number of rows on a terminal."""
        if sys.stderr.isatty():
            print(f"\r{rows} rows", end="", file=sys.stderr, flush=True)

    beside = arguments.file.with_suffix(".json")
    is_beside = arguments.json is not None and arguments.json.resolve() == beside.resolve()
    if is_beside and stated_accuracy(arguments.file) != WalkAccuracy():
        raise ConfigError(f"--json: {beside} describes the walk; choose another file")
    results = replay_walk(arguments.file, config.tracking, progress, arguments.own_sigma)
    if sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    print(table(results, config.estimation.localised_r95_m))
    if arguments.explain:
        print(explanation(results))
    if not config.tracking.is_range_calibrated:
        print("uncalibrated: range offset unknown, so nothing is localised; set offset_steps")
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in results]}
        write_json_atomic(arguments.json, value)
    return 0
