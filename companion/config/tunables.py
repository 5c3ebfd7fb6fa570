"""The configuration's parameters that a ground station may change.

A change follows the configuration's own rules: the whole configuration with the new value is made
and checked as if it came from a file. Speeds may be lowered remotely and raised again, but not
above the file's; charges reserved for the way home may be raised and lowered again, but not below
the file's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from companion.config.schema import CompanionConfig, inconsistency
from companion.errors import ConfigError, in_words, located
from companion.guidance.commands import Tuning, When
from companion.link.gcs_services import TunableSpec
from companion.mav.payloads import ParamType, nearest_real32
from companion.planning.planner import Planner

BuildPlanner = Callable[[CompanionConfig], Planner[Any]]


@dataclass(frozen=True, slots=True)
class Tunable:
    """A parameter and its path in the configuration."""

    name: str
    path: str
    when: When = When.ANY_TIME
    is_ceiling: bool = False
    """True if the file's value is the maximum."""
    is_floor: bool = False
    """True if the file's value is the minimum."""
    choices: tuple[str, ...] = ()
    """The values of a choice, by number; empty for a real number."""

    @property
    def spec(self) -> TunableSpec:
        """The parameter as a ground station sees it."""
        kind = ParamType.INT32 if self.choices else ParamType.REAL32
        return TunableSpec(self.name, kind, self.when)


_CROSSING = "planner.latched_crossing"
TUNABLES = (
    Tunable("CMP_ALTITUDE", "mission.altitude_m"),
    Tunable("CMP_BAT_CRIT", "mission.battery_critical_pct", is_floor=True),
    Tunable("CMP_BAT_LOW", "mission.battery_low_pct", is_floor=True),
    Tunable("CMP_BAT_RESERVE", "limits.battery_reserve_pct", is_floor=True),
    Tunable("CMP_CLIMB", "limits.climb_mps", is_ceiling=True),
    Tunable("CMP_FENCE_MARGIN", "limits.fence_margin_m", When.NEVER),
    Tunable(
        "CMP_ON_FOUND", "mission.on_localised", When.DISARMED, choices=("hold", "return", "land")
    ),
    Tunable("CMP_OVER_MAX", f"{_CROSSING}.overshoot_max_m"),
    Tunable("CMP_OVER_MIN", f"{_CROSSING}.overshoot_min_m"),
    Tunable("CMP_RANGING_TMO", "mission.ranging_timeout_s", When.DISARMED),
    Tunable("CMP_SPEED", "limits.speed_mps", is_ceiling=True),
    Tunable("CMP_STOP_RADIUS", "mission.stop_radius_m"),
    Tunable("CMP_STOP_TIME", "mission.stop_confirm_s"),
)
"""Parameters in the order of their indices, which is that of their names."""


class Tunables:
    """The parameters of one run; a `companion.link.gcs_services.TunableBook`."""

    specs: Sequence[TunableSpec] = tuple(tunable.spec for tunable in TUNABLES)

    def __init__(self, config: CompanionConfig, build_planner: BuildPlanner) -> None:
        self.file = config
        self._build_planner = build_planner
        self.config = config
        self.changed: dict[str, float] = {}
        """Values that differ from the file, by name."""

    def value_at(self, index: int) -> float:
        """Return a value; see `TunableBook`."""
        return _value(TUNABLES[index], self.config)

    def change(self, index: int, value: float) -> Tuning:
        """Change a value, or raise `ConfigError` with the reason; see `TunableBook`."""
        tunable = TUNABLES[index]
        of_file = _value(tunable, self.file)
        if value == nearest_real32(of_file):
            value = of_file
        if tunable.is_ceiling and value > of_file:
            raise ConfigError(f"{value:g} is above the configuration's {of_file:g}")
        if tunable.is_floor and value < of_file:
            raise ConfigError(f"{value:g} is below the configuration's {of_file:g}")
        self.config = _with_value(self.config, tunable, value)
        self.changed[tunable.name] = value
        if value == of_file:
            del self.changed[tunable.name]
        return self.tuning

    @property
    def tuning(self) -> Tuning:
        """Current settings for the session."""
        config = self.config
        return Tuning(config.mission, config.limits.guard_limits(), self._build_planner(config))

    def restore(self, values: Mapping[str, float]) -> list[str]:
        """Restore changes of an earlier run, by name; return the reasons for refused ones."""
        problems: dict[str, str] = {}
        pending = dict(values)
        while pending:
            problems = {name: why for name in pending if (why := self._objection(name, values))}
            if len(problems) == len(pending):
                break
            pending = {name: values[name] for name in problems}  # one may depend on another
        return [f"{name}{why}" for name, why in problems.items()]

    def _objection(self, name: str, values: Mapping[str, float]) -> str:
        """Restore one value; return the reason if it is refused, else an empty text."""
        index = next((n for n, tunable in enumerate(TUNABLES) if tunable.name == name), None)
        if index is None or TUNABLES[index].when is When.NEVER:
            return " is not a parameter that can be changed"
        try:
            self.change(index, values[name])
        except ConfigError as error:
            return f": {error}"
        return ""


def _value(tunable: Tunable, config: CompanionConfig) -> float:
    value: Any = config
    for part in tunable.path.split("."):
        value = getattr(value, part)
    return tunable.choices.index(value) if tunable.choices else float(value)


def _with_value(config: CompanionConfig, tunable: Tunable, value: float) -> CompanionConfig:
    """Return the configuration with one value changed; `ConfigError` if that breaks its rules."""
    plain: Any = value
    if tunable.choices:
        if value not in range(len(tunable.choices)):
            names = ", ".join(f"{number} {word}" for number, word in enumerate(tunable.choices))
            raise ConfigError(f"{value:g} is none of {names}")
        plain = tunable.choices[int(value)]
    raw = msgspec.to_builtins(config)
    *sections, key = tunable.path.split(".")
    owner = raw
    for section in sections:
        owner = owner[section]
    owner[key] = plain
    try:
        changed = msgspec.convert(raw, CompanionConfig, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(in_words(located(error)[1])) from None
    problem = inconsistency(changed)
    if problem is not None:
        raise ConfigError(problem)
    return changed
