"""The command `companion replay`, by the kind of the recording.

The bytes of a radio recording are decoded again and pass through the flying estimator.

Each emitter has a filter of its own. Without an autopilot in the recording the vehicle positions
are unknown, and only the radios' measurements are listed.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from companion.config.radios import RadioConfig, radio_setups, replayed_radios
from companion.config.schema import CompanionConfig, load_config
from companion.domain import (
    DEFAULT_GNSS_SIGMA_M,
    Attitude,
    EstimateState,
    PositionAccuracy,
    RangingMeasurement,
    VehicleState,
)
from companion.errors import EXIT_FAILED, ConfigError
from companion.estimation.target_estimate import aside_of_m
from companion.guidance.emitters import EmitterQueue, QueueParams
from companion.guidance.measurements import RangingListener
from companion.guidance.vehicle_track import VehicleTrack
from companion.io.files import check_writable, write_json_atomic
from companion.io.log_files import damage_text
from companion.io.radio_recording import (
    RadioBytes,
    TimedPose,
    is_radio_recording,
    read_radio_recording,
)
from companion.link.radio_stage import RadioStage
from companion.replay.flight_replay import FlightReplay, Pace, replay_flight, replay_on_map
from companion.replay.walk_replay import (
    TargetResult,
    WalkAccuracy,
    replay_walk,
    result_of,
    stated_accuracy,
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
            raise ConfigError("--speed: a walk is replayed as fast as possible; leave it out")
        if settings is not None:
            raise ConfigError("--web: a walk has no map; leave it out")
        return _replay_walk(arguments, config or CompanionConfig())
    if arguments.own_sigma is not None or arguments.explain:
        raise ConfigError("--own-sigma, --explain: only of a recorded walk (.csv); leave them out")
    if is_radio_recording(arguments.file):
        return _replay_recording(arguments, config or CompanionConfig())

    def report(replay: FlightReplay) -> None:
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
    if arguments.speed is not None or arguments.web is not None:
        raise ConfigError("--speed, --web: a radio recording is replayed at once; leave them out")
    replay = replay_recording(arguments.file, config)
    print("\n".join(replay.radios))
    if replay.targets:
        print(_table(replay.targets, config.estimation.localised_r95_m))
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in replay.targets]}
        write_json_atomic(arguments.json, value)
    return 0


def _replay_walk(arguments: argparse.Namespace, config: CompanionConfig) -> int:
    def progress(rows: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{rows} rows", end="", file=sys.stderr, flush=True)

    if arguments.json is not None and arguments.json.resolve() == arguments.file.resolve():
        raise ConfigError(f"--json: {arguments.json} is the walk; choose another file")
    beside = arguments.file.with_suffix(".json")
    is_beside = arguments.json is not None and arguments.json.resolve() == beside.resolve()
    if is_beside and stated_accuracy(arguments.file) != WalkAccuracy():
        raise ConfigError(f"--json: {beside} describes the walk; choose another file")
    try:
        results = replay_walk(arguments.file, config.tracking, progress, arguments.own_sigma)
    finally:
        if sys.stderr.isatty():
            print("\r", end="", file=sys.stderr)
    print(_table(results, config.estimation.localised_r95_m))
    if arguments.explain:
        print(_explanation(results))
    if not config.tracking.is_range_calibrated:
        print("uncalibrated: range offset unknown, so nothing is localised; set offset_steps")
    if arguments.json is not None:
        value = {"file": arguments.file.name, "targets": [r.as_json() for r in results]}
        write_json_atomic(arguments.json, value)
    return 0


END_S = 10.0
"""Time after the last record by which every waiting measurement is due."""


class _Target:
    """One emitter's filter and measurements."""

    def __init__(self, config: CompanionConfig, emitter_id: int, track: VehicleTrack) -> None:
        self.queue = EmitterQueue(config.tracking, QueueParams(listed=(emitter_id,)))
        self.listener = RangingListener(self.queue, track)
        self.ranges_m: list[float] = []
        self.count = 0

    def take(self, measurement: RangingMeasurement) -> None:
        """Queue a measurement, which waits for the vehicle position."""
        self.count += 1
        if measurement.range_m is not None:
            self.ranges_m.append(measurement.range_m)
        self.listener.receive(measurement)


@dataclass(frozen=True, slots=True)
class RadioReplay:
    """Result of a recording."""

    radios: list[str]
    """Lines of the report: one for each radio, and for each emitter without positions."""
    targets: list[TargetResult] = field(default_factory=list)
    """Results of each target; empty without any position."""


def replay_recording(path: Path, config: CompanionConfig) -> RadioReplay:
    """Decode and estimate; radios of `config` replace the recording's settings by name."""
    damaged: list[int] = []
    header, records = read_radio_recording(path, damaged.append)
    recorded = [
        RadioConfig(name=r.name, url=r.url, settings=dict(r.settings), options=dict(r.options))
        for r in header.radios
    ]
    stages = [RadioStage(setup) for setup in radio_setups(replayed_radios(recorded, config.radios))]
    track = VehicleTrack()
    targets: dict[int, _Target] = {}
    own: PositionAccuracy | None = None
    now_s, poses = 0.0, 0
    for record in records:
        if isinstance(record, RadioBytes):
            now_s = max(now_s, record.t_s)
            for measurement in stages[record.radio].receive(record.data, record.t_s):
                number = measurement.emitter_id
                if number not in targets:
                    targets[number] = _Target(config, number, track)
                targets[number].take(measurement)
        elif isinstance(record, TimedPose):
            poses += 1
            _add_pose(track, record)
            own = (
                own
                if record.sigma_m is None
                else PositionAccuracy(record.sigma_m, is_reported=True)
            )
            for target in targets.values():
                target.listener.fuse_due(max(now_s, record.t_s), own)
    if poses:
        for target in targets.values():
            target.listener.fuse_due(now_s + END_S, own)
    lines = [*filter(None, [damage_text(path, "line", damaged)]), *_radio_lines(stages)]
    if not poses:
        return RadioReplay([*lines, *_lines_without_positions(targets)])
    results = [
        result_of(target.queue.current, str(number), target.count, now_s)
        for number, target in sorted(targets.items())
    ]
    return RadioReplay([*lines, *map(_refusals, results)], results)


def _add_pose(track: VehicleTrack, pose: TimedPose) -> None:
    track.add(VehicleState(pose.t_s, pose.enu_m, (0.0, 0.0, 0.0)))
    if pose.yaw_rad is not None:
        has_tilt = pose.roll_rad is not None and pose.pitch_rad is not None
        tilt_rad = (pose.roll_rad or 0.0, pose.pitch_rad or 0.0) if has_tilt else None
        track.add_attitude(pose.t_s, Attitude(pose.yaw_rad, tilt_rad))


def _radio_lines(stages: Sequence[RadioStage]) -> list[str]:
    lines = []
    for stage in stages:
        refused: Counter[str] = stage.all_refused
        words = ", ".join(f"{reason} {count}" for reason, count in refused.most_common())
        said = f"{stage.received} bytes, {stage.measured} measurements"
        fate = f"refused: {words}" if words else "none refused"
        lines.append(f"radio {stage.setup.kind.name}: {said}, {fate}")
    return lines


def _refusals(result: TargetResult) -> str:
    words = ", ".join(f"{reason} {count}" for reason, count in result.refused.items())
    return f"emitter {result.target_id}: {f'refused: {words}' if words else 'none refused'}"


def _lines_without_positions(targets: dict[int, _Target]) -> list[str]:
    """Return the measurements of emitters in lines, where positions are unknown."""
    lines = []
    for number, target in sorted(targets.items()):
        ranges_m = target.ranges_m
        middle = f", median range {statistics.median(ranges_m):.2f} m" if ranges_m else ""
        lines.append(f"  emitter {number}: {target.count} measurements{middle}")
    return [*lines, "no estimate: no autopilot was connected, so positions are unknown"]


def _table(results: list[TargetResult], localised_r95_m: float) -> str:
    """Return the results as lines of text, with median and worst error where the truth is known."""
    lines = [
        f"{'target':<12} {'n':>6} {'refused':>7}  {'state':<10} {'east m':>9} {'north m':>9} "
        f"{'R95 m':>7} {'error m':>8}"
    ]
    for result in results:
        estimate = result.estimate
        if estimate is None:
            numbers = f"{'-':>9} {'-':>9} {'-':>7} {'-':>8}"
        else:
            east, north = estimate.position_enu_m
            error = "-" if result.error_m is None else f"{result.error_m:.2f}"
            numbers = f"{east:9.2f} {north:9.2f} {estimate.r95_m:7.2f} {error:>8}"
        refused = sum(result.refused.values())
        lines.append(
            f"{result.target_id:<12} {result.rows:>6} {refused:>7}  {result.state:<10} {numbers}"
        )
        if estimate is not None and estimate.alternative_enu_m is not None:
            east, north = estimate.alternative_enu_m
            hint = f"walk {aside_of_m(estimate):.0f} m to the side to resolve it"
            lines.append(f"{'':<27}  {'or':<10} {east:9.2f} {north:9.2f}  {hint}")
    errors = sorted(result.error_m for result in results if result.error_m is not None)
    if errors:
        middle = 0.5 * (errors[(len(errors) - 1) // 2] + errors[len(errors) // 2])
        lines.append(f"median error {middle:.2f} m, worst {errors[-1]:.2f} m")
    return "\n".join([*lines, *_remarks(results, localised_r95_m)])


def _explanation(results: list[TargetResult]) -> str:
    """Return, for each target, R95 as it grows term by term."""
    lines = []
    for result in results:
        lines.append(f"{result.target_id}: R95 after each term")
        lines += [f"  {radius_m:9.2f} m  {term}" for term, radius_m in result.budget_m.items()]
    return "\n".join(lines)


def _remarks(results: list[TargetResult], localised_r95_m: float) -> Iterator[str]:
    """Yield remarks on refusals, targets that are not localised, and an assumed own accuracy."""
    refused = sum((Counter(result.refused) for result in results), Counter[str]())
    if refused:
        words = ", ".join(f"{reason} {count}" for reason, count in refused.most_common())
        yield f"refused: {words}"
    estimates = {r.target_id: r.estimate for r in results if r.estimate is not None}
    limit_m = localised_r95_m
    for state, radii_of, end in (
        (EstimateState.SEARCHING, "settled_r95_m", f"localised asks for {limit_m:g} m"),
        (EstimateState.LOCALISED, "r95_m", "R95 adds the drift of the vehicle position"),
    ):
        words = ", ".join(
            f"{name} to {estimate.settled_r95_m:.2f} m"
            for name, estimate in estimates.items()
            if estimate.state is state and getattr(estimate, radii_of) > limit_m
        )
        if words:
            yield f"{state.name.lower()}: measurements place {words}; {end}"
    if not all(estimate.own.is_reported for estimate in estimates.values()):
        sigma_m = f"{DEFAULT_GNSS_SIGMA_M:g} m"
        yield f"R95 assumes {sigma_m} for positions of unknown accuracy: see --own-sigma"
