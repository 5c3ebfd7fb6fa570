"""`companion replay`: the flying estimator, fed from a recorded ranging walk.

A CSV file has a row per answer of an emitter, with the columns `t_s`, `agent_x_m`, `agent_y_m`,
`target_id`, and at least one of `range_m`, `bearing_rad` and `elevation_rad` (an empty cell means
"not measured"). x is east, y is north, a bearing is counter-clockwise from east. `agent_z_m` is
optional; so are `target_x_m` and `target_y_m`, which only serve to say how wrong the estimate is.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from companion.domain import PositionEnu, RangingMeasurement, TargetEstimate
from companion.errors import ConfigError
from companion.estimation.target_estimate import aside_of_m
from companion.estimation.tracker import TargetTracker, TrackerParams
from companion.estimation.window.sandwich import Observability

REQUIRED = ("t_s", "agent_x_m", "agent_y_m", "target_id")
MEASURED = ("range_m", "bearing_rad", "elevation_rad")
PROGRESS_ROWS = 2000
FARTHEST_M = 4e7
"""The Earth is 40,000 km around."""
ESTIMATED = (
    *("r95_m", "alternative_enu_m", "range_offset_m"),
    *("range_scale", "height_m", "height_sigma_m"),
)
"""What `--json` takes from the estimate as it is."""

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class WalkRow:
    """One row of a recorded walk."""

    target_id: str
    measurement: RangingMeasurement
    agent_enu_m: PositionEnu
    truth_enu_m: tuple[float, float] | None


@dataclass(slots=True)
class _Replayed:
    tracker: TargetTracker
    rows: int = 0
    last_s: float = 0.0
    truth_enu_m: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class TargetResult:
    """What the replay says of one target."""

    target_id: str
    rows: int
    accepted: int
    refused: Mapping[str, int] = field(default_factory=dict)
    estimate: TargetEstimate | None = None
    truth_enu_m: tuple[float, float] | None = None
    observability: Observability | None = None

    @property
    def state(self) -> str:
        """`searching`, `ambiguous`, `localised` or `diverged`."""
        return "searching" if self.estimate is None else self.estimate.state.value

    @property
    def error_m(self) -> float | None:
        """Distance of the estimate from the truth, where the file has it."""
        if self.estimate is None or self.truth_enu_m is None:
            return None
        return math.dist(self.estimate.position_enu_m, self.truth_enu_m)

    def as_json(self) -> dict[str, object]:
        """Plain values for `--json`."""
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
        }


def replay_walk(
    path: Path, params: TrackerParams, progress: Progress | None = None
) -> list[TargetResult]:
    """Run one tracker per target over a recorded walk, telling the progress now and then."""
    targets: dict[str, _Replayed] = {}
    for number, row in enumerate(read_walk(path)):
        target = targets.get(row.target_id)
        if target is None:
            emitter_id = row.measurement.emitter_id
            target = targets[row.target_id] = _Replayed(TargetTracker(params, emitter_id))
        target.rows += 1
        target.last_s = row.measurement.measured_at_s
        target.truth_enu_m = row.truth_enu_m
        target.tracker.fuse(row.measurement, row.agent_enu_m, target.last_s)
        if progress is not None and number % PROGRESS_ROWS == 0:
            progress(number)
    if not targets:
        raise ConfigError(f"{path}: has no rows below its header")
    return [_result(target_id, target) for target_id, target in targets.items()]


def _result(target_id: str, target: _Replayed) -> TargetResult:
    tracker = target.tracker
    if tracker.params.window.enabled:
        tracker.optimize(tracker.params.window.starts)
    return TargetResult(
        target_id=target_id,
        rows=target.rows,
        accepted=tracker.accepted,
        refused={reason.value: count for reason, count in tracker.rejected.items()},
        estimate=tracker.estimate(target.last_s),
        truth_enu_m=target.truth_enu_m,
        observability=tracker.health.observability,
    )


def read_walk(path: Path) -> Iterator[WalkRow]:
    """The rows of a recorded walk; a `ConfigError` names the line that is wrong."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            _check_header(path, reader.fieldnames)
            numbers: dict[str, int] = {}
            for row in reader:
                yield _walk_row(row, f"{path}: line {reader.line_num}", numbers)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text; expected a CSV file") from error
    except csv.Error as error:
        raise ConfigError(f"{path}: not a CSV file: {error}") from error


def _check_header(path: Path, names: object) -> None:
    present = list(names) if isinstance(names, list) else []
    missing = [name for name in REQUIRED if name not in present]
    if missing:
        raise ConfigError(f"{path}: line 1: missing column {', '.join(missing)}")
    if not any(name in present for name in MEASURED):
        raise ConfigError(f"{path}: line 1: needs a column {' or '.join(MEASURED)}")


def _walk_row(row: Mapping[str, str | None], place: str, numbers: dict[str, int]) -> WalkRow:
    target_id = row.get("target_id")
    if not target_id:
        raise ConfigError(f"{place}: target_id is empty")
    t_s, east, north = (_needed(row, name, place) for name in REQUIRED[:3])
    up = _number(row, "agent_z_m", place) or 0.0
    truth_east, truth_north = (_number(row, f"target_{axis}_m", place) for axis in "xy")
    if not all(abs(metres) <= FARTHEST_M for metres in (east, north, up)):
        raise ConfigError(f"{place}: agent_x_m, agent_y_m, agent_z_m: no place on the Earth")
    truth = None if truth_east is None or truth_north is None else (truth_east, truth_north)
    return WalkRow(
        target_id=target_id,
        measurement=RangingMeasurement(
            emitter_id=numbers.setdefault(target_id, len(numbers)),
            measured_at_s=t_s,
            range_m=_number(row, "range_m", place),
            bearing_enu_rad=_bearing(row, place),
            elevation_rad=_number(row, "elevation_rad", place),
        ),
        agent_enu_m=(east, north, up),
        truth_enu_m=truth,
    )


def _number(row: Mapping[str, str | None], name: str, place: str) -> float | None:
    text = row.get(name)
    if text is None or not text.strip():
        return None
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{place}: {name} is not a number: `{text}`") from None


def _bearing(row: Mapping[str, str | None], place: str) -> float | None:
    """A bearing, from -pi to pi; what is counted from 0 to 2 pi in the file is turned there."""
    value = _number(row, "bearing_rad", place)
    if value is None or not math.pi < abs(value) <= 2.0 * math.pi:
        return value
    return math.remainder(value, 2.0 * math.pi)


def _needed(row: Mapping[str, str | None], name: str, place: str) -> float:
    value = _number(row, name, place)
    if value is None or not math.isfinite(value):
        raise ConfigError(f"{place}: {name} must be a finite number")
    return value


def table(results: list[TargetResult]) -> str:
    """The results as lines of text, with median and worst error where the truth is known."""
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
            hint = f"walk {aside_of_m(estimate):.0f} m to the side to tell"
            lines.append(f"{'':<27}  {'or':<10} {east:9.2f} {north:9.2f}  {hint}")
    errors = sorted(result.error_m for result in results if result.error_m is not None)
    if errors:
        middle = 0.5 * (errors[(len(errors) - 1) // 2] + errors[len(errors) // 2])
        lines.append(f"median error {middle:.2f} m, worst {errors[-1]:.2f} m")
    return "\n".join(lines)
