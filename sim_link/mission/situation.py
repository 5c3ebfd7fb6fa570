"""What is known of a flight at a moment, and what a condition may ask about it.

The runner in memory and the one of real processes fill in the same record, so that a script means
the same in both. What is not known (yet) is None.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from companion.domain import EstimateState, FlightMode, LandedState, WaypointReason
from companion.guidance.authority.state_machine import Phase


@dataclass(slots=True)
class VehicleSeen:
    """The vehicle, as the operator's telemetry shows it."""

    mode: str | None = None
    is_armed: bool | None = None
    is_ready: bool | None = None
    is_failsafe: bool | None = None
    landed: str | None = None
    height_m: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    speed_mps: float | None = None
    climb_mps: float | None = None
    home_distance_m: float | None = None
    distance_m: float | None = None
    battery: float | None = None
    has_fix: bool | None = None


@dataclass(slots=True)
class CompanionSeen:
    """The companion, as its event log shows it."""

    phase: str | None = None
    is_in_control: bool | None = None
    waypoint: str | None = None
    measurements: int = 0
    refused: int = 0
    ranging_age_s: float | None = None
    reported: int = 0
    violations: int = 0


@dataclass(slots=True)
class EstimateSeen:
    """The companion's estimate of the target that it looks for now."""

    emitter: int | None = None
    state: str | None = None
    r95_m: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    error_m: float | None = None
    range_offset_m: float | None = None
    bearing_offset_deg: float | None = None


@dataclass(slots=True)
class MissionSeen:
    """The mission itself."""

    time_s: float = 0.0
    step_time_s: float = 0.0


@dataclass(slots=True)
class Situation:
    """Everything that a condition may ask about."""

    vehicle: VehicleSeen = field(default_factory=VehicleSeen)
    companion: CompanionSeen = field(default_factory=CompanionSeen)
    estimate: EstimateSeen = field(default_factory=EstimateSeen)
    mission: MissionSeen = field(default_factory=MissionSeen)
    companion_texts: list[str] = field(default_factory=list)
    autopilot_texts: list[str] = field(default_factory=list)


class Kind(Enum):
    """What a value is, so that only like is compared with like."""

    NUMBER = "a number"
    TRUTH = "true or false"
    WORD = "a word"


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One thing that a condition may ask about."""

    kind: Kind
    what: str
    words: tuple[str, ...] = ()
    """What a word may be."""


def _number(what: str) -> FieldInfo:
    return FieldInfo(Kind.NUMBER, what)


def _truth(what: str) -> FieldInfo:
    return FieldInfo(Kind.TRUTH, what)


def _word(what: str, words: type[Enum]) -> FieldInfo:
    names = tuple(str(w.value if isinstance(w.value, str) else w.name.lower()) for w in words)
    return FieldInfo(Kind.WORD, what, names)


FIELDS: dict[str, FieldInfo] = {
    "vehicle.mode": _word("the autopilot's flight mode", FlightMode),
    "vehicle.is_armed": _truth("whether the motors may turn"),
    "vehicle.is_ready": _truth("whether it can be armed, or is"),
    "vehicle.is_failsafe": _truth("whether the autopilot shows a failsafe"),
    "vehicle.landed": _word("where it says it is", LandedState),
    "vehicle.height_m": _number("above home"),
    "vehicle.east_m": _number("of the local origin"),
    "vehicle.north_m": _number("of the local origin"),
    "vehicle.speed_mps": _number("horizontal"),
    "vehicle.climb_mps": _number("upwards"),
    "vehicle.home_distance_m": _number("horizontal"),
    "vehicle.distance_m": _number("flown so far"),
    "vehicle.battery": _number("charge, 0 to 1"),
    "vehicle.has_fix": _truth("whether the satellites give a position"),
    "companion.phase": _word("who flies, see flying.md", Phase),
    "companion.is_in_control": _truth("whether the vehicle obeys its setpoints"),
    "companion.waypoint": _word("why it flies where it flies", WaypointReason),
    "companion.measurements": _number("ranging measurements used"),
    "companion.refused": _number("ranging measurements refused"),
    "companion.ranging_age_s": _number("since the last measurement that was used"),
    "companion.reported": _number("targets reported"),
    "companion.violations": _number(
        "of the invariants, so far; with real processes 0 until the end"
    ),
    "estimate.emitter": _number("id of the emitter that is looked for now"),
    "estimate.state": _word("how much is known", EstimateState),
    "estimate.r95_m": _number("radius that holds the target with 95 % probability"),
    "estimate.east_m": _number("of the local origin"),
    "estimate.north_m": _number("of the local origin"),
    "estimate.error_m": _number("distance from the true emitter"),
    "estimate.range_offset_m": _number("as estimated"),
    "estimate.bearing_offset_deg": _number("as estimated, counter-clockwise positive"),
    "mission.time_s": _number("since the mission began"),
    "mission.step_time_s": _number("since this step began"),
}
"""What a condition may ask about, by the name it has there."""
