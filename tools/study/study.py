"""Studies as data: the systems and cases to fly, the paper's values, and the results.

A study is one or more sweeps of the canonical case; a sweep's values are set at dotted fields of
the case, or each is a variant with overrides of its own. A cell is one system in one case; its
result is a tally, and from that rows of tables. A study may also be a collection of others.
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec

from companion.config.schema import CrossingKind, PatternKind
from companion.domain import NonNegative, Params, Positive
from companion.errors import ConfigError, decoding_problem
from tools.study.case import Case
from tools.study.systems import (
    FILTER_LABELS,
    FilterName,
    PlannerName,
    System,
    system_named,
)
from tools.study.trials import RunTally

Metric = Literal[
    "final_rmse_m",
    "steps_to_2.5m",
    "worst_final_m",
    "range_offset_m",
    "bound_ratio",
    "rmse_ratio",
    "rmse_after_steps_m",
    "nees",
    "coverage",
    "cost_ms_per_step",
]
"""Metric of a cell; `reporting.study_tables` has the definitions."""
FigureName = Literal["losses", "rmse", "offsets", "tracks", "gradients", "sensitivity"]
"""Figures of the report, see `reporting.figures`."""
Value = float | int | str | bool | None
"""Value that a sweep assigns to a field; tables show its `value_text`."""
PaperValue = float | int | str | None
"""A number as the paper prints it, ">500", or nothing where it prints none."""
Overrides = dict[str, Any]
Count = Annotated[int, msgspec.Meta(ge=1)]


class SystemGrid(Params, frozen=True):
    """Every filter with every planner."""

    filters: tuple[FilterName, ...]
    planners: tuple[PlannerName, ...]


Systems = SystemGrid | tuple[str, ...]
"""A grid, or names like "asymmetric_huber/latched"."""


class Sweep(Params, frozen=True):
    """Rows of a table: one parameter and its values; fields of None are the study's."""

    parameter: str
    table: str | None = None
    varies: tuple[str, ...] = ()
    """Dotted fields of the case that a value is set at."""
    values: tuple[Value, ...] = ()
    variants: dict[str, Overrides] = msgspec.field(default_factory=dict)
    """Overrides of the case by the value's name, instead of `varies` and `values`."""
    case: Overrides = msgspec.field(default_factory=dict)
    """Overrides of the canonical case for all values."""
    systems: Systems | None = None
    metrics: tuple[Metric, ...] | None = None
    after_steps: tuple[Count, ...] = ()
    """Numbers of steps for `rmse_after_steps_m`, one for each value."""
    paper: dict[str, dict[Metric, tuple[PaperValue, ...]]] = msgspec.field(default_factory=dict)
    """The paper's number of each system and metric, one for each value."""


ConfigKind = Literal["configured", "unconfigured"]


class FlightGrid(Params, frozen=True):
    """Flights of the whole companion, in every combination of radio, configuration and planner."""

    cut_s: dict[str, Positive]
    """Time in s after which a flight without a report ends, by scenario of `scenarios/field`."""
    configs: tuple[ConfigKind, ...] = ("configured", "unconfigured")
    """Configurations: the scenario's preset of `companion/field`, or the defaults."""
    planners: tuple[CrossingKind | PatternKind, ...] = ("latched_crossing",)
    ring_m: tuple[Positive, Positive] = (25.0, 90.0)
    """Smallest and largest distance of the emitter from home."""
    height_spread_m: NonNegative = 2.0
    """Largest difference in height from the scenario."""


class Study(Params, frozen=True):
    """Set of sweeps that are run and reported together."""

    table: str
    title: str
    note: str = ""
    runs: Count = 200
    """Runs of every cell, unless the command line overrides it."""
    systems: Systems = ()
    metrics: tuple[Metric, ...] = ()
    sweeps: tuple[Sweep, ...] = ()
    figures: tuple[FigureName, ...] = ()
    studies: tuple[str, ...] = ()
    """Names of other studies: this one is their collection."""
    flights: FlightGrid | None = None
    """Flights instead of `sweeps`."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One system in one case, with its cell of the tables."""

    sweep: Sweep
    index: int
    """Index of the value in the sweep."""
    table: str
    parameter: str
    value: str
    case: Case
    system: System


def cells_of(study: Study) -> list[Cell]:
    """Return a study's cells in the order of its tables; a `ConfigError` names a wrong sweep."""
    cells: list[Cell] = []
    for number, sweep in enumerate(study.sweeps):
        where = f"$.sweeps[{number}]"
        systems = systems_of(study.systems if sweep.systems is None else sweep.systems, where)
        labelled = cases_of(sweep, where)
        _check_paper(sweep, systems, where)
        metrics = study.metrics if sweep.metrics is None else sweep.metrics
        is_needed = "rmse_after_steps_m" in metrics
        _check_length("after_steps", sweep.after_steps, len(labelled), where, required=is_needed)
        cells += [
            Cell(sweep, index, sweep.table or study.table, sweep.parameter, value, case, system)
            for (index, (value, case)), system in itertools.product(enumerate(labelled), systems)
        ]
    return cells


def systems_of(systems: Systems, where: str) -> list[System]:
    """Return the systems of a grid or list; a ConfigError for none, duplicates or unknown ones."""
    if isinstance(systems, SystemGrid):
        found = [System(*pair) for pair in itertools.product(systems.filters, systems.planners)]
    else:
        found = [system_named(name, f"{where}.systems[{i}]: ") for i, name in enumerate(systems)]
    if not found:
        raise ConfigError(f"{where}.systems: at least one system is needed")
    _refuse_twice([system.label for system in found], f"{where}.systems")
    return found


def cases_of(sweep: Sweep, where: str) -> list[tuple[str, Case]]:
    """Return a sweep's values, as tables have them, with cases; a ConfigError if it is wrong."""
    if bool(sweep.variants) == bool(sweep.values) or bool(sweep.values) != bool(sweep.varies):
        raise ConfigError(f"{where}: give `varies` and `values`, or `variants`")
    base = overridden(msgspec.to_builtins(Case()), sweep.case, f"{where}.case")
    labelled = [
        (name, overridden(base, changes, f"{where}.variants.{name}"))
        for name, changes in sweep.variants.items()
    ]
    labelled += [(value_text(value), _varied(base, sweep, value, where)) for value in sweep.values]
    _refuse_twice([name for name, _ in labelled], f"{where}.values")
    return [
        (name, _case(fields, f"{where}, {sweep.parameter} {name}")) for name, fields in labelled
    ]


def _refuse_twice(names: Sequence[str], where: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{where}: {twice} is given twice")


def overridden(base: Mapping[str, Any], changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return nested fields with some of them changed; a ConfigError for an unknown key."""
    result = dict(base)
    for key, value in changes.items():
        if key not in base:
            raise ConfigError(f"{where}.{key}: unknown key; {hint(key, base)}")
        if isinstance(base[key], dict) and isinstance(value, dict):
            result[key] = overridden(base[key], value, f"{where}.{key}")
        else:
            result[key] = value
    return result


def names_of(system: System) -> tuple[str, ...]:
    """Return a system's names in tables; the paper means lanes where it names no planner."""
    if system.planner == "passive":
        return system.label, FILTER_LABELS[system.filter]
    return (system.label,)


def value_text(value: Value) -> str:
    """Return a value as tables have it, for example 0.5."""
    if value is None:
        return "none"
    return str(value).lower() if isinstance(value, bool) else str(value)


def hint(name: str, known: Iterable[str]) -> str:
    """Suggest a known name for a misspelt one."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"did you mean `{near[0]}`?" if near else f"known: {', '.join(names)}"


def _varied(base: Mapping[str, Any], sweep: Sweep, value: Value, where: str) -> dict[str, Any]:
    fields = dict(base)
    for number, dotted in enumerate(sweep.varies):
        changes: Any = value
        for key in reversed(dotted.split(".")):
            changes = {key: changes}
        fields = overridden(fields, changes, f"{where}.varies[{number}]: case")
    return fields


def _case(fields: Mapping[str, Any], where: str) -> Case:
    try:
        case = msgspec.convert(fields, Case, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {decoding_problem(error)}") from None
    if not (case.channel.range_sigma_m > 0.0 and case.channel.bearing_sigma_deg > 0.0):
        raise ConfigError(f"{where}: a channel without thermal noise has no bound; give it some")
    return case


def _check_paper(sweep: Sweep, systems: Sequence[System], where: str) -> None:
    labels = [name for system in systems for name in names_of(system)]
    for label, metrics in sweep.paper.items():
        if label not in labels:
            raise ConfigError(f"{where}.paper.{label}: no such system here; {hint(label, labels)}")
        for metric, numbers in metrics.items():
            size = len(sweep.variants or sweep.values)
            _check_length(f"paper.{label}.{metric}", numbers, size, where, required=True)


def _check_length(
    name: str, numbers: Sequence[object], size: int, where: str, *, required: bool
) -> None:
    if len(numbers) != size and (required or numbers):
        raise ConfigError(f"{where}.{name}: {len(numbers)} numbers for {size} values")


@dataclass(frozen=True, slots=True)
class CellResult(Cell):
    """A cell with the result of its runs."""

    tally: RunTally

    @classmethod
    def of(cls, cell: Cell, tally: RunTally) -> CellResult:
        """Return a cell with its tally."""
        return cls(*[*(getattr(cell, name) for name in Cell.__slots__), tally])


@dataclass(frozen=True, slots=True)
class StudyResult:
    """The cells of a study, in the order of its tables."""

    study: Study
    runs: int
    seed: int
    cells: tuple[CellResult, ...]


@dataclass(frozen=True, slots=True)
class ResultRow:
    """One row of results.csv in its written form; empty without a value."""

    table: str
    parameter: str
    value: str
    system: str
    metric: str
    paper: str
    ours: str
    ours_ci95: str
    """The 95 % interval, for example 0.012..0.019."""
    bound: str
    """Bound of every estimator for the same metric; for NEES and coverage the band of a consistent
    one."""


class FlightRow(Params, frozen=True):
    """Result of one flight: a row of flights.csv; None without a value."""

    radio: str
    config: ConfigKind
    planner: str
    seed: int
    is_reported: bool
    time_s: float
    """Time from engaging to the report, or to the cut."""
    state: str | None
    """State of the estimate, like all following fields at the report, else at the end."""
    error_m: float | None
    """Relative error: from the truth as the vehicle's own receiver shows it at that time."""
    absolute_error_m: float | None
    r95_m: float | None
    absolute_r95_m: float | None
    east_m: float
    """Position of the emitter."""
    north_m: float
    flown_m: float
