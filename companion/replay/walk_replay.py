"""`companion replay`: the flying estimator, fed from a recorded ranging walk.

A CSV file has a row per answer of an emitter, in any order, with `t_s`, `agent_x_m`, `agent_y_m`,
and at least one of `range_m`, `bearing_rad`, `elevation_rad` and `power_dbm` (an empty cell or NaN
means "not measured"). x is east, y is north, a bearing is counter-clockwise from east. Optional are
`target_id` of several emitters, `agent_z_m` (the target's height is then estimated), `own_sigma_m`
(standard deviation per axis of the agent's position), `own_yaw_sigma_rad` (of the yaw that the
bearings were turned by), and `target_x_m` and `target_y_m`, the truth, for the error alone. The
accuracies of a whole walk may stand in a JSON object next to it (`walk.json` of `walk.csv`).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TextIO

import msgspec

from companion.domain import (
    GNSS_VERTICAL_RATIO,
    MAX_COORDINATE_M,
    NonNegative,
    PositionAccuracy,
    PositionEnu,
    RangingMeasurement,
    TargetEstimate,
)
from companion.errors import ConfigError, decoding_problem
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.rivals import Observability
from companion.io.files import open_file, read_bytes

REQUIRED = ("t_s", "agent_x_m", "agent_y_m")
MEASURED = ("range_m", "bearing_rad", "elevation_rad", "power_dbm")
COLUMNS = (
    *(*REQUIRED, "target_id", *MEASURED, "agent_z_m", "own_sigma_m", "own_yaw_sigma_rad"),
    *("target_x_m", "target_y_m"),
)
UNITS = {"ft": ("m", "0.3048"), "feet": ("m", "0.3048"), "deg": ("rad", "pi / 180")}
"""Unit of a walk and factor, for the ends of other columns' names."""
FROM_DEGREES = (
    "from degrees, lat0 and lon0 of a point on the site: agent_x_m = (lon - lon0) * 111320 * "
    "cos(lat0), agent_y_m = (lat - lat0) * 111320"
)
SEPARATORS = ",;\t"
"""A spreadsheet writes semicolons where the comma separates decimals."""
PROGRESS_ROWS = 2000
STOREY_M = 3.0
"""Standard deviation of an unconfigured target height: a storey higher or lower."""
FARTHEST_M = 4e7
"""The Earth is 40,000 km around."""
ESTIMATED = (
    *("r95_m", "settled_r95_m", "absolute_r95_m", "alternative_enu_m", "range_offset_m"),
    *("range_scale", "height_m", "height_sigma_m"),
)
"""Fields of the estimate that `--json` contains unchanged."""

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class WalkRow:
    """One row of a recorded walk."""

    target_id: str
    measurement: RangingMeasurement
    agent_enu_m: PositionEnu
    truth_enu_m: tuple[float, float] | None
    own: PositionAccuracy | None = None
    """Accuracy of the agent's position; None: not stated."""
    yaw_sigma_rad: float = 0.0
    """Standard deviation of the yaw that the bearing was turned by."""


@dataclass(slots=True)
class _Replayed:
    tracker: TargetTracker
    rows: int = 0
    last_s: float = 0.0
    truth_enu_m: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class TargetResult:
    """Result of the replay for one target."""

    target_id: str
    rows: int
    accepted: int
    refused: Mapping[str, int] = field(default_factory=dict)
    estimate: TargetEstimate | None = None
    truth_enu_m: tuple[float, float] | None = None
    observability: Observability | None = None
    budget_m: Mapping[str, float] = field(default_factory=dict)
    """R95 after each term that widens it, metres."""

    @property
    def state(self) -> str:
        """`searching`, `ambiguous`, `localised` or `diverged`."""
        return "searching" if self.estimate is None else self.estimate.state.value

    @property
    def error_m(self) -> float | None:
        """Distance of the estimate from the truth, m; None if either is unknown."""
        if self.estimate is None or self.truth_enu_m is None:
            return None
        return math.dist(self.estimate.position_enu_m, self.truth_enu_m)

    def as_json(self) -> dict[str, object]:
        """Return plain values for `--json`."""
        estimate, seen = self.estimate, self.observability
        return {
            "target_id": self.target_id,
            "n": self.rows,
            "accepted": self.accepted,
            "refused": dict(self.refused),
            "state": self.state,
            "east_m": None if estimate is None else estimate.position_enu_m[0],
            "north_m": None if estimate is None else estimate.position_enu_m[1],
            **{name: getattr(estimate, name, None) for name in ESTIMATED},
            "bilateral_share": None if seen is None else seen.bilateral_share,
            "ercm_min_eigenvalue": None if seen is None else seen.min_eigenvalue,
            "is_collinear": None if seen is None else seen.is_collinear,
            "error_m": self.error_m,
            "r95_budget_m": dict(self.budget_m),
        }


def replay_walk(
    path: Path,
    params: TrackerParams,
    progress: Progress | None = None,
    own_sigma_m: float | None = None,
) -> list[TargetResult]:
    """Run one tracker per target over a walk; `own_sigma_m` replaces the walk's own accuracy."""
    targets: dict[str, _Replayed] = {}
    rows = read_walk(path, own_sigma_m)
    params = with_unknown_height(params, rows)
    east_m, north_m = origin_of(rows)
    for number, row in enumerate(rows):
        target = targets.get(row.target_id)
        if target is None:
            emitter_id = row.measurement.emitter_id
            target = targets[row.target_id] = _Replayed(TargetTracker(params, emitter_id))
        target.rows += 1
        target.last_s = row.measurement.measured_at_s
        target.truth_enu_m = row.truth_enu_m
        measurement = row.measurement
        if row.yaw_sigma_rad > 0.0:
            sigma_rad = math.hypot(math.radians(params.filter.bearing_sigma_deg), row.yaw_sigma_rad)
            measurement = replace(measurement, bearing_sigma_rad=sigma_rad)
        east, north, up = row.agent_enu_m
        agent_enu_m = (east - east_m, north - north_m, up)
        target.tracker.fuse(measurement, agent_enu_m, target.last_s, row.own)
        if progress is not None and number % PROGRESS_ROWS == 0:
            progress(number)
    if not targets:
        raise ConfigError(f"{path}: has no rows below its header")
    results = []
    for target_id, target in targets.items():
        result = result_of(target.tracker, target_id, target.rows, target.last_s)
        results.append(_moved(replace(result, truth_enu_m=target.truth_enu_m), (east_m, north_m)))
    return results


def origin_of(rows: Sequence[WalkRow]) -> tuple[float, float]:
    """Return the point that the estimator counts metres from: 0, 0 unless a grid's is too far.

    Eastings and northings of a national grid are farther than a flight's frame is large.
    """
    far = (abs(metres) > MAX_COORDINATE_M for row in rows for metres in row.agent_enu_m[:2])
    return rows[0].agent_enu_m[:2] if any(far) else (0.0, 0.0)


def _moved(result: TargetResult, shift_m: tuple[float, float]) -> TargetResult:
    """Return a result whose positions are shifted."""
    estimate = result.estimate
    if estimate is None or shift_m == (0.0, 0.0):
        return result
    (east, north), other = estimate.position_enu_m, estimate.alternative_enu_m
    moved = replace(
        estimate,
        position_enu_m=(east + shift_m[0], north + shift_m[1]),
        alternative_enu_m=other and (other[0] + shift_m[0], other[1] + shift_m[1]),
    )
    return replace(result, estimate=moved)


def with_unknown_height(params: TrackerParams, rows: Sequence[WalkRow]) -> TrackerParams:
    """Return the parameters for these rows; in a walk with heights the target's is unknown.

    It is estimated about the configured one, unless its standard deviation is configured as well.
    """
    has_heights = any(row.agent_enu_m[2] != 0.0 for row in rows)
    if not has_heights or params.filter.target_height_sigma_m > 0.0:
        return params
    change = msgspec.structs.replace
    return change(params, filter=change(params.filter, target_height_sigma_m=STOREY_M))


def result_of(tracker: TargetTracker, target_id: str, rows: int, now_s: float) -> TargetResult:
    """Optimise once more over the whole window, and return the result."""
    if tracker.params.window.enabled:
        tracker.optimize(tracker.params.window.starts)
    return TargetResult(
        target_id=target_id,
        rows=rows,
        accepted=tracker.accepted,
        refused={reason.value: count for reason, count in tracker.rejected.items()},
        estimate=tracker.estimate(now_s),
        observability=tracker.health.observability,
        budget_m=tracker.budget(now_s),
    )


class WalkAccuracy(msgspec.Struct, frozen=True):
    """Accuracy of all positions of a walk, from the JSON object next to it."""

    own_sigma_m: NonNegative | None = None
    own_yaw_sigma_rad: NonNegative | None = None


def stated_accuracy(path: Path) -> WalkAccuracy:
    """Return the accuracy in the JSON file next to a walk; none without such a file."""
    beside = path.with_suffix(".json")
    try:
        return msgspec.json.decode(read_bytes(beside), type=WalkAccuracy)
    except (FileNotFoundError, NotADirectoryError):
        return WalkAccuracy()
    except OSError as error:
        raise ConfigError(f"{beside}: beside the walk: cannot be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{beside}: beside the walk: {decoding_problem(error)}") from None


def read_walk(path: Path, own_sigma_m: float | None = None) -> list[WalkRow]:
    """Return the rows of a recorded walk by time; a `ConfigError` names the wrong line."""
    stated = stated_accuracy(path)
    if own_sigma_m is not None:
        stated = msgspec.structs.replace(stated, own_sigma_m=own_sigma_m)
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8-sig", newline="") as file:
            above, separator, header = _header(file)
            reader = csv.DictReader(chain([header], file), delimiter=separator)
            present = [name.strip("# ") for name in reader.fieldnames or ()]
            _check_columns(present, f"{path}: line {above + 1}")
            reader.fieldnames, is_named = present, "target_id" in present
            numbers: dict[str, int] = {}
            rows = []
            for row in reader:
                number = above + reader.line_num
                _check_row(row, path, number)
                cells = _cells(row, has_points=separator == ",")
                if own_sigma_m is not None:
                    cells.pop("own_sigma_m", None)
                if any(cells.values()):
                    line = f"{path}: line {number}"
                    cells["target_id"] = cells["target_id"] if is_named else path.stem
                    rows.append(_walk_row(cells, line, numbers, stated))
            return sorted(rows, key=lambda row: row.measurement.measured_at_s)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: not a CSV file in UTF-8: {error}") from error


def _header(file: TextIO) -> tuple[int, str, str]:
    """Return the number of lines above the header, the separator, and the header.

    Lines above it are blank, comments, or Excel's `sep=;`; NumPy writes the header as a comment.
    """
    separator = ""
    for above, line in enumerate(file):
        text = line.strip()
        if text.startswith("sep="):
            separator = text[4:5]
        elif text.strip(SEPARATORS) and (text[0] != "#" or all(each in text for each in REQUIRED)):
            return above, separator or max(SEPARATORS, key=line.count), line
    return 0, ",", ""


def _check_columns(present: Sequence[str], line: str) -> None:
    """Raise ConfigError for columns that no walk can be read from."""
    missing = [name for name in REQUIRED if name not in present]
    if not any(name in present for name in MEASURED):
        missing.append(" or ".join(MEASURED))
    if missing:
        hints = _conversions(present)
        raise ConfigError("; ".join((f"{line}: missing column {', '.join(missing)}", *hints)))
    twice = [name for name in COLUMNS if present.count(name) > 1]
    if twice:
        raise ConfigError(f"{line}: more than one column {', '.join(twice)}")


def _check_row(row: Mapping[str | None, str | list[str] | None], path: Path, line: int) -> None:
    """Raise ConfigError for a row of several lines, or with more cells than columns."""
    for cell in row.values():
        lines = cell.splitlines() if isinstance(cell, str) else []
        if lines and lines != [cell]:
            raise ConfigError(f"{path}: line {line - len(lines) + 1}: a quote is not closed there")
    if any(text.strip() for text in row.get(None) or ()):
        raise ConfigError(f"{path}: line {line}: more cells than columns; write decimals as 1.5")


def _conversions(present: Sequence[str]) -> Iterator[str]:
    """Return how to convert columns in other units into those of a walk."""
    for name in present:
        base, _, unit = name.rpartition("_")
        ours, factor = UNITS.get(unit, ("", ""))
        for column in (f"{base}_{ours}", f"agent_{base}_{ours}"):
            if column in COLUMNS:
                yield f"{column} = {name} * {factor}"
    if any(name.lower().startswith(("lat", "lon", "lng")) for name in present):
        yield FROM_DEGREES


def _cells(row: Mapping[str, str | None], has_points: bool) -> dict[str, str]:
    """Return the cells of a row without spaces about them, their decimals after a point."""
    cells = {name: (row.get(name) or "").strip() for name in COLUMNS}
    if has_points:
        return cells
    return {n: text if n == "target_id" else text.replace(",", ".") for n, text in cells.items()}


def _walk_row(
    row: Mapping[str, str], line: str, numbers: dict[str, int], stated: WalkAccuracy
) -> WalkRow:
    target_id = row["target_id"]
    if not target_id:
        raise ConfigError(f"{line}: target_id is empty")
    t_s, east, north = (_needed(row, name, line) for name in REQUIRED)
    up = _number(row, "agent_z_m", line) or 0.0
    truth_east, truth_north = (_measured(row, f"target_{axis}_m", line) for axis in "xy")
    if not all(abs(metres) <= FARTHEST_M for metres in (east, north, up)):
        raise ConfigError(f"{line}: agent_x_m, agent_y_m, agent_z_m: no position on the Earth")
    truth = None if truth_east is None or truth_north is None else (truth_east, truth_north)
    own_m = _sigma(row, "own_sigma_m", line, stated.own_sigma_m)
    yaw_rad = _sigma(row, "own_yaw_sigma_rad", line, stated.own_yaw_sigma_rad)
    return WalkRow(
        target_id=target_id,
        measurement=RangingMeasurement(
            emitter_id=numbers.setdefault(target_id, len(numbers)),
            measured_at_s=t_s,
            range_m=_measured(row, "range_m", line),
            bearing_enu_rad=_bearing(row, line),
            elevation_rad=_measured(row, "elevation_rad", line),
            power_dbm=_measured(row, "power_dbm", line),
        ),
        agent_enu_m=(east, north, up),
        truth_enu_m=truth,
        own=None
        if own_m is None
        else PositionAccuracy(own_m, GNSS_VERTICAL_RATIO * own_m, is_reported=True),
        yaw_sigma_rad=yaw_rad or 0.0,
    )


def _sigma(row: Mapping[str, str], name: str, line: str, stated: float | None) -> float | None:
    """Return a row's standard deviation, else that of the whole walk, if any."""
    value = _number(row, name, line)
    if value is None:
        return stated
    if not 0.0 <= value < math.inf:
        raise ConfigError(f"{line}: {name} must be finite and not negative")
    return value


def _number(row: Mapping[str, str], name: str, line: str) -> float | None:
    text = row.get(name)
    try:
        return float(text) if text else None
    except ValueError:
        raise ConfigError(f"{line}: {name} is not a number: `{text}`") from None


def _measured(row: Mapping[str, str], name: str, line: str) -> float | None:
    """Return a measured value; None for an empty cell, or for NaN, which arrays write instead."""
    value = _number(row, name, line)
    return None if value is None or math.isnan(value) else value


def _bearing(row: Mapping[str, str], line: str) -> float | None:
    """Return a bearing in [-pi, pi], or None; a file may also count from 0 to 2 pi."""
    value = _measured(row, "bearing_rad", line)
    if value is None or not math.pi < abs(value) <= 2.0 * math.pi:
        return value
    return math.remainder(value, 2.0 * math.pi)


def _needed(row: Mapping[str, str], name: str, line: str) -> float:
    value = _number(row, name, line)
    if value is None or not math.isfinite(value):
        raise ConfigError(f"{line}: {name} must be a finite number")
    return value
