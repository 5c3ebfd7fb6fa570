"""`companion radio calibrate`: reads a recording and prints its calibration.

With `--beside` it measures only the range offset, with the emitter at the antenna: the reported
range at a known short distance, less that distance, is the radio's constant: the delay of an SDR,
of cables and of boards. It is kept for this one radio.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from companion.arguments import TEST_NAMES
from companion.config.radios import RadioConfig, radio_setups
from companion.config.schema import load_config, with_radios
from companion.domain import PositionEnu, RangingMeasurement
from companion.errors import CompanionError, ConfigError
from companion.flight_setup import radio_links
from companion.geometry.coordinates import LocalOrigin
from companion.io.checkpoints import KeptOffset, keep_offset, radio_key
from companion.io.files import check_writable, write_json_atomic
from companion.io.links.transports import check_exposure, parse_flight_link
from companion.io.radio_recording import RadioBytes, RecordedOrigin, TimedPose, read_radio_recording
from companion.io.shell import Clock, Shell
from companion.io.state_directory import state_directory
from companion.link.interface import LinkRole, RadioSettings, RadioSetup
from companion.link.radio_stage import RadioStage
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.radio_tools.calibration import CalibrationRun, RunWindow, calibrate
from companion.radio_tools.calibration_text import as_json, verdict, yaml_to_paste
from companion.radio_tools.recorder import record_radios
from companion.replay.walk_replay import read_walk

EXIT_REFUSED = 1


def run(arguments: argparse.Namespace) -> int:
    """Read, fit and print; return 1 if a part was refused."""
    if arguments.beside is not None:
        code, text = _offset_beside(arguments)
        print(text, file=sys.stderr if code else sys.stdout)
        return code
    if arguments.json is not None:
        check_writable(arguments.json)
    windows = [_window(text) for text in arguments.tests]
    if arguments.csv is not None:
        if arguments.file is not None or arguments.radios:
            raise ConfigError("--from-csv: contains everything; omit FILE and --radio")
        found = _of_csv(arguments.csv)
    else:
        if arguments.file is None:
            raise ConfigError("give a FILE of `companion radio record`, or --from-csv FILE")
        if (arguments.point is None) == (arguments.point_enu is None):
            raise ConfigError(
                "specify the emitter's position: --point LAT,LON,AMSL or --point-enu E,N,U"
            )
        point = _numbers(arguments.point or arguments.point_enu, arguments.point is not None)
        if arguments.radios:
            _record(arguments)
        found = _of_recording(arguments.file, point, is_geodetic=arguments.point is not None)
    done = calibrate(_chosen(found, arguments.emitter, windows))
    print(verdict(done))
    pasted = yaml_to_paste(done)
    if pasted:
        print(pasted)
    if arguments.json is not None:
        write_json_atomic(arguments.json, as_json(done))
    return EXIT_REFUSED if done.refusals else 0


def _window(text: str) -> RunWindow:
    name, at, span = text.partition("@")
    low, dash, high = span.partition("-")
    try:
        if name not in TEST_NAMES or bool(at) != bool(dash):
            raise ValueError(text)
        window = RunWindow(name, float(low) if at else -math.inf, float(high) if at else math.inf)
    except ValueError:
        raise ConfigError(
            f"--test {text}: give {', '.join(TEST_NAMES)}, or for example turn@0-90"
        ) from None
    if window.from_s >= window.to_s:
        raise ConfigError(f"--test {text}: ends before it begins")
    return window


def _numbers(text: str, is_geodetic: bool) -> tuple[float, ...]:
    option = "--point" if is_geodetic else "--point-enu"
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    shown = "LAT,LON[,AMSL]" if is_geodetic else "E,N,U"
    if len(numbers) not in ((2, 3) if is_geodetic else (3,)) or not all(
        map(math.isfinite, numbers)
    ):
        raise ConfigError(f"{option} {text}: give {shown} as numbers")
    if is_geodetic and not (abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 180.0):
        raise ConfigError(f"{option} {text}: there is no such latitude or longitude")
    return numbers


@dataclass(slots=True)
class _Found:
    """Content of a file: measurements by radio and emitter, poses, and the emitter's position."""

    source: Path
    point_enu_m: PositionEnu
    began_s: float = 0.0
    poses: list[TimedPose] = field(default_factory=list)
    measurements: dict[tuple[str, int], list[RangingMeasurement]] = field(default_factory=dict)
    names: dict[int, str] = field(default_factory=dict)

    def add(self, radio: str, measurement: RangingMeasurement) -> None:
        """Add a measurement."""
        self.measurements.setdefault((radio, measurement.emitter_id), []).append(measurement)


def _of_csv(path: Path) -> _Found:
    """Return the walk of a CSV file: bearings from north, positions of unknown accuracy."""
    found, truths = _Found(path, (0.0, 0.0, 0.0)), Counter[tuple[float, float]]()
    numbers: dict[str, int] = {}
    for row in read_walk(path):
        if row.truth_enu_m is None:
            raise ConfigError(f"{path}: needs columns target_x_m and target_y_m in every row")
        number = numbers.setdefault(row.target_id, len(numbers))
        found.names[number] = row.target_id
        truths[row.truth_enu_m] += 1
        found.add(f"{path.name}", row.measurement)
        found.poses.append(TimedPose(row.measurement.measured_at_s, row.agent_enu_m))
        found.point_enu_m = (*row.truth_enu_m, 0.0)
    if not found.poses:
        raise ConfigError(f"{path}: has no rows below its header")
    if len(truths) > len(numbers):
        raise ConfigError(
            f"{path}: target_x_m, target_y_m change; calibration needs a stationary target"
        )
    found.began_s = min(pose.t_s for pose in found.poses)
    return found


def neutral(setup: RadioSetup) -> RadioSetup:
    """Return the same radio without the corrections that the calibration determines."""
    plain = RadioSettings()
    names = (
        *("range_offset_m", "range_scale", "bearing_sign", "bearing_mount_deg", "lag_s"),
        *("field_of_view_deg", "range_max_m", "max_age_s", "range_sigma_m", "bearing_sigma_deg"),
    )
    changed = {name: getattr(plain, name) for name in names}
    settings = msgspec.structs.replace(setup.settings, **changed, range_min_m=-1e9)
    return RadioSetup(setup.kind, settings, setup.options)


def _of_recording(path: Path, point: Sequence[float], *, is_geodetic: bool) -> _Found:
    header, records = read_radio_recording(path)
    recorded = [
        RadioConfig(name=r.name, url=r.url, settings=dict(r.settings), options=dict(r.options))
        for r in header.radios
    ]
    stages = [RadioStage(neutral(setup)) for setup in radio_setups(recorded)]
    found = _Found(path, (0.0, 0.0, 0.0))
    origin = header.origin
    first_s = math.inf
    for record in records:
        if isinstance(record, RadioBytes):
            first_s = min(first_s, record.t_s)
            for measurement in stages[record.radio].receive(record.data, record.t_s):
                found.add(recorded[record.radio].name, measurement)
        elif isinstance(record, TimedPose):
            first_s = min(first_s, record.t_s)
            found.poses.append(record)
        elif isinstance(record, RecordedOrigin):
            origin = record
    found.began_s = 0.0 if first_s == math.inf else first_s
    if not found.poses:
        raise ConfigError(f"{path}: has no poses; record with --connect, beside the autopilot")
    if not found.measurements:
        refused = sum((stage.all_refused for stage in stages), Counter[str]())
        reasons = ", ".join(f"{reason} {count}" for reason, count in refused.most_common(3))
        raise ConfigError(f"{path}: no radio measured anything ({reasons or 'no bytes'})")
    local = None if origin is None else origin.local
    found.point_enu_m = _point(path, point, local, is_geodetic=is_geodetic)
    return found


def _point(
    path: Path, point: Sequence[float], origin: LocalOrigin | None, *, is_geodetic: bool
) -> PositionEnu:
    if not is_geodetic:
        return (point[0], point[1], point[2])
    if origin is None:
        raise ConfigError(
            f"{path}: the autopilot reported no origin; give --point-enu, metres about its origin"
        )
    height_m = point[2] if len(point) == 3 else origin.altitude_m
    return origin.enu_from_geodetic(point[0], point[1], height_m)


def _chosen(found: _Found, emitter: str | None, windows: Sequence[RunWindow]) -> CalibrationRun:
    """Return the run of the selected emitter, or of the only one."""
    shown = {key: found.names.get(key[1], str(key[1])) for key in found.measurements}
    fitting = [key for key in shown if emitter in (None, shown[key], str(key[1]))]
    listed = ", ".join(
        f"{shown[key]} ({len(values)}, {key[0]})" for key, values in found.measurements.items()
    )
    if not fitting:
        raise ConfigError(f"--emitter {emitter}: {found.source} has {listed}")
    if len(fitting) > 1:
        raise ConfigError(
            f"{found.source}: has several emitters; give --emitter ID, one of {listed}"
        )
    radio, number = fitting[0]
    moved = [RunWindow(w.name, w.from_s + found.began_s, w.to_s + found.began_s) for w in windows]
    values = found.measurements[fitting[0]]
    return CalibrationRun(radio, number, values, found.poses, found.point_enu_m, moved)


def _record(arguments: argparse.Namespace) -> None:
    """Make the recording that is then fitted, as `companion radio record` does."""
    if arguments.link is None:
        raise ConfigError("--radio: needs --connect URL, the autopilot that reports the position")
    config = with_radios(load_config(arguments.config), arguments.radios, arguments.config)
    vehicle = parse_flight_link(arguments.link, LinkRole.VEHICLE)
    if not arguments.is_insecure:
        check_exposure(radio_links(config.radios), has_key=False)
        check_exposure([vehicle], has_key=config.link.signing_key_file is not None)
    print(
        f"recording to {arguments.file}: turn, line, circle, blocked run; Ctrl-C ends it",
        file=sys.stderr,
    )
    recorded = record_radios(arguments.file, config, vehicle, arguments.seconds)
    print(
        f"{arguments.file}: {recorded.bytes} bytes of radios, {recorded.poses} poses",
        file=sys.stderr,
    )


LISTEN_S = 20.0
FEWEST = 5
"""Minimum number of ranges for a median; a cell has one for each attach of the phone."""
MAX_BESIDE_M = 20.0
"""Longest distance to the emitter; farther away a reflection may be in the median."""
SIGMA_OF_MAD = 1.4826
MAX_SHOWN = 8
"""Emitters that are named to choose from."""


def robust_sigma(values: Sequence[float]) -> float:
    """Return the standard deviation by the median distance from the median."""
    middle = statistics.median(values)
    return SIGMA_OF_MAD * statistics.median(abs(value - middle) for value in values)


class _Listener(OneShotEndpoint):
    """Collects the uncorrected ranges of a radio."""

    def __init__(self, setup: RadioSetup, end_s: float) -> None:
        super().__init__(end_s)
        self.stage = RadioStage(setup)
        self._ranges_m: dict[int, list[float]] = {}

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Decode received bytes."""
        super().receive(chunk, now_s)
        for found in self.stage.receive(chunk.data, now_s):
            if found.range_m is not None:
                self._ranges_m.setdefault(found.emitter_id, []).append(found.range_m)

    def ranges_of(self, emitter: str | None) -> list[float] | str:
        """Return the ranges of an emitter, the only one if None (a cell's); or why too few."""
        kind, stage = self.stage.setup.kind, self.stage
        numbers = [number for number in self._ranges_m if emitter in (None, str(number))]
        if len(numbers) > 1 and not kind.needs_offset:
            shown = ", ".join(map(str, sorted(numbers)[:MAX_SHOWN]))
            return f"ranges of emitters {shown}: which is beside the antenna? Add --emitter ID"
        ranges_m = [range_m for number in numbers for range_m in self._ranges_m[number]]
        if len(ranges_m) >= FEWEST:
            return ranges_m
        if not stage.received:
            return "nothing heard: check power, cable and address"
        if stage.measured and not self._ranges_m:
            return f"{stage.measured} measurements of {kind.name} without a range: no offset"
        refused = stage.all_refused.most_common(2)
        reasons = ", ".join(f"{reason} {count}" for reason, count in refused) or "none refused"
        recognised = stage.unrecognised or "all recognised"
        return (
            f"{len(ranges_m)} ranges, {FEWEST} are needed ({reasons}; {recognised}); "
            "try --seconds 60"
        )


def _offset_beside(arguments: argparse.Namespace) -> tuple[int, str]:
    """Collect ranges and keep the offset; return the exit code (1: it cannot be) and the report."""
    distance_m = arguments.beside
    if not 0.0 <= distance_m <= MAX_BESIDE_M:
        raise ConfigError(f"--beside {distance_m:g}: give metres from 0 to {MAX_BESIDE_M:g}")
    config = with_radios(load_config(arguments.config), arguments.radios, arguments.config)
    if len(config.radios) != 1:
        raise ConfigError("--beside: name one radio, --radio NAME@URL")
    directory = state_directory(config.process.state_directory, os.environ)
    (link,), (radio,) = radio_links(config.radios), config.radios
    if not arguments.is_insecure:
        check_exposure([link], has_key=False)
    setup = link.spec.radio
    assert setup is not None
    plain = neutral(setup)
    every = msgspec.structs.replace(plain.settings, rate_max_hz=None)
    listener = _Listener(replace(plain, settings=every), arguments.seconds or LISTEN_S)
    Shell(listener, [link.transport], Clock()).run_whole()
    ranges_m = listener.ranges_of(arguments.emitter)
    if isinstance(ranges_m, str):
        return EXIT_REFUSED, ranges_m
    middle_m = statistics.median(ranges_m)
    offset = KeptOffset(
        range_offset_m=round(middle_m - distance_m, 3),
        scatter_m=round(robust_sigma(ranges_m), 3),
        ranges=len(ranges_m),
        unix_s=round(time.time(), 0),
    )
    key = radio_key(radio.name, radio.url or "")
    code = 0
    try:
        kept = f"kept in {keep_offset(directory, key, offset)}"
    except CompanionError as error:
        code, kept = EXIT_REFUSED, f"not kept, so configure it: {error}"
    return code, (
        f"{key}: range offset {offset.range_offset_m:+.2f} m "
        f"(median of {offset.ranges}, scatter {offset.scatter_m:.2f} m); {kept}\n"
        f"settings:\n  range_offset_m: {offset.range_offset_m}"
    )
