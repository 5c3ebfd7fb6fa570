"""Conditions of missions: `estimate.r95_m < 1 and vehicle.mode == hold`.

A field is compared with a number, a word or another field; comparisons are joined by `and` and `or`
(`and` first) and turned round by `not`. What is not known is neither true nor false (Kleene's
logic): `and` with something false is false, `or` with something true is true, everything else with
an unknown is unknown, and an unknown condition does not hold.

A `FlightSituation` is what is known of a flight at a moment; what is not known (yet) is None. The
runner in memory and the one of real processes fill in the same one, so that a script means the same
in both. What is said of its fields is what documentation and errors say of them.
"""

from __future__ import annotations

import difflib
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, get_args, get_type_hints

from companion.domain import EstimateState, FlightMode, LandedState, WaypointReason
from companion.guidance.phases import Phase


class Kind(Enum):
    """Type of a value, so that only like is compared with like."""

    NUMBER = "a number"
    TRUTH = "true or false"
    WORD = "a word"


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One thing that a condition may ask about."""

    kind: Kind
    what: str
    words: tuple[str, ...] = ()


def _word(what: str, words: type[Enum]) -> FieldInfo:
    names = tuple(str(w.value if isinstance(w.value, str) else w.name.lower()) for w in words)
    return FieldInfo(Kind.WORD, what, names)


Number = float | None
Truth = bool | None
Word = str | None


@dataclass(slots=True)
class VehicleSeen:
    """The vehicle, as the operator's telemetry shows it."""

    mode: Annotated[Word, _word("the autopilot's flight mode", FlightMode)] = None
    is_armed: Annotated[Truth, "whether the motors may turn"] = None
    is_ready: Annotated[Truth, "whether it can be armed, or is"] = None
    is_failsafe: Annotated[Truth, "whether the autopilot shows a failsafe"] = None
    landed: Annotated[Word, _word("where it says it is", LandedState)] = None
    height_m: Annotated[Number, "above home"] = None
    east_m: Annotated[Number, "of the local origin"] = None
    north_m: Annotated[Number, "of the local origin"] = None
    speed_mps: Annotated[Number, "horizontal"] = None
    climb_mps: Annotated[Number, "upwards"] = None
    home_distance_m: Annotated[Number, "horizontal"] = None
    distance_m: Annotated[Number, "flown so far"] = None
    battery: Annotated[Number, "charge, 0 to 1"] = None
    has_fix: Annotated[Truth, "whether the satellites give a position"] = None


@dataclass(slots=True)
class CompanionSeen:
    """The companion, as its event log shows it."""

    phase: Annotated[Word, _word("who flies, see flying.md", Phase)] = None
    is_in_control: Annotated[Truth, "whether the vehicle obeys its setpoints"] = None
    waypoint: Annotated[Word, _word("why it flies where it flies", WaypointReason)] = None
    measurements: Annotated[int, "ranging measurements used"] = 0
    refused: Annotated[int, "ranging measurements refused"] = 0
    ranging_age_s: Annotated[Number, "since the last measurement that was used"] = None
    reported: Annotated[int, "targets reported"] = 0
    violations: Annotated[int, "of the invariants, so far; with real processes 0 until the end"] = 0


@dataclass(slots=True)
class EstimateSeen:
    """The companion's estimate of the target that it looks for now."""

    emitter: Annotated[int | None, "id of the emitter that is looked for now"] = None
    state: Annotated[Word, _word("how much is known", EstimateState)] = None
    r95_m: Annotated[Number, "radius that holds the target with 95 % probability"] = None
    east_m: Annotated[Number, "of the local origin"] = None
    north_m: Annotated[Number, "of the local origin"] = None
    error_m: Annotated[Number, "distance from the true emitter"] = None
    range_offset_m: Annotated[Number, "as estimated"] = None
    bearing_offset_deg: Annotated[Number, "as estimated, counter-clockwise positive"] = None


@dataclass(slots=True)
class MissionSeen:
    """Times of the mission."""

    time_s: Annotated[float, "since the mission began"] = 0.0
    step_time_s: Annotated[float, "since this step began"] = 0.0


@dataclass(slots=True)
class FlightSituation:
    """Everything that a condition may ask about."""

    vehicle: VehicleSeen = field(default_factory=VehicleSeen)
    companion: CompanionSeen = field(default_factory=CompanionSeen)
    estimate: EstimateSeen = field(default_factory=EstimateSeen)
    mission: MissionSeen = field(default_factory=MissionSeen)
    companion_texts: list[str] = field(default_factory=list)
    autopilot_texts: list[str] = field(default_factory=list)


def _infos() -> Iterator[tuple[str, FieldInfo]]:
    for part in (VehicleSeen, CompanionSeen, EstimateSeen, MissionSeen):
        for name, hint in get_type_hints(part, include_extras=True).items():
            (what,) = hint.__metadata__
            kind = Kind.TRUTH if bool in get_args(hint.__origin__) else Kind.NUMBER
            info = what if isinstance(what, FieldInfo) else FieldInfo(kind, what)
            yield f"{part.__name__.removesuffix('Seen').lower()}.{name}", info


FIELDS: dict[str, FieldInfo] = dict(_infos())
"""Fields that a condition may refer to, by name."""


Value = float | bool | str | None
Getter = Callable[[FlightSituation], Value]

COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
EQUALITIES = ("==", "!=")
TRUTHS = {"true": True, "false": False}
SPEAKERS = {"said": "companion_texts", "autopilot_said": "autopilot_texts"}
MAX_LENGTH = 1000
OUTSIDE_QUOTES = r'(?=(?:[^"]*"[^"]*")*[^"]*$)'
OR, AND = (re.compile(rf"\s{word}\s{OUTSIDE_QUOTES}") for word in ("or", "and"))
CLAUSE = re.compile(
    r"(?P<negation>not\s+)?(?:"
    r'(?P<speaker>said|autopilot_said)\(\s*"(?P<text>[^"]*)"\s*\)'
    r"|(?P<field>[a-z][a-z0-9_.]*)"
    r'(?:\s*(?P<symbol>[<>]=?|[=!]=)\s*(?P<value>"[^"]*"|[-+.\w]+))?)',
    re.ASCII,
)


class ConditionError(ValueError):
    """A condition is wrong; the message says where in the text and what is known instead."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition that is ready to be asked."""

    text: str
    _alternatives: tuple[tuple[Getter, ...], ...]
    """The clauses of each alternative, which hold together."""

    def holds(self, situation: FlightSituation) -> bool:
        """Return True if the condition holds now; an unknown value does not hold."""
        return self._truth(situation) is True

    def is_false(self, situation: FlightSituation) -> bool:
        """Return True if the condition is known not to hold."""
        return self._truth(situation) is False

    def _truth(self, situation: FlightSituation) -> Value:
        return _combined(
            (
                _combined((get(situation) for get in clauses), False)
                for clauses in self._alternatives
            ),
            True,
        )


def _combined(values: Iterable[Value], decisive: bool) -> Value:
    """Return the decisive value if it is among the values; unknown if one of the others is."""
    found = set(values)
    if decisive in found:
        return decisive
    return None if None in found else not decisive


def parse_condition(text: str) -> Condition:
    """Return the condition of a text; raises a `ConditionError` if it is invalid."""
    if len(text) > MAX_LENGTH:
        raise ConditionError(f"longer than {MAX_LENGTH} characters")
    alternatives = [AND.split(alternative) for alternative in OR.split(text)]
    return Condition(text.strip(), tuple(tuple(map(_clause, each)) for each in alternatives))


def _clause(text: str) -> Getter:
    match = CLAUSE.fullmatch(text.strip())
    if match is None:
        raise ConditionError(f"`{text.strip()}` is no comparison, as `vehicle.height_m > 3` is")
    if match["speaker"]:
        part, texts_of = match["text"], operator.attrgetter(SPEAKERS[match["speaker"]])
        get: Getter = lambda situation: any(part in said for said in texts_of(situation))  # noqa: E731
    else:
        get = _comparison(text.strip(), match)
    if not match["negation"]:
        return get
    return lambda situation: None if (value := get(situation)) is None else not value


def _comparison(text: str, match: re.Match[str]) -> Getter:
    """Return whether a field compares as stated; unknown where a value is."""
    info, left = _field(match["field"]), operator.attrgetter(match["field"])
    if match["symbol"] is None:
        if info.kind is not Kind.TRUTH:
            raise ConditionError(
                f"`{match['field']}` is {info.kind.value}; compare it with something"
            )
        get: Getter = left
        return get
    kind, right = _right_side(match["value"], info)
    if kind is not info.kind:
        raise ConditionError(f"`{text}` compares {info.kind.value} with {kind.value}")
    if kind is not Kind.NUMBER and match["symbol"] not in EQUALITIES:
        raise ConditionError(
            f"`{text}`: {kind.value} has no order; use == or != in place of {match['symbol']}"
        )
    compare = COMPARISONS[match["symbol"]]

    def compared(situation: FlightSituation) -> Value:
        values = (left(situation), right(situation))
        return None if None in values else compare(*values)

    return compared


def _right_side(text: str, compared_with: FieldInfo) -> tuple[Kind, Getter]:
    """Return kind and value of what a field is compared with: another field, or a constant."""
    if text in FIELDS:
        return FIELDS[text].kind, operator.attrgetter(text)
    if text in TRUTHS:
        return Kind.TRUTH, lambda _: TRUTHS[text]
    try:
        number = float(text)
    except ValueError:
        pass
    else:
        if not math.isfinite(number):
            raise ConditionError(f"`{text}` is no finite number")
        return Kind.NUMBER, lambda _: number
    word = text.strip('"')
    if compared_with.words and word not in compared_with.words:
        words = ", ".join(compared_with.words)
        raise ConditionError(f"it is never `{word}`; it is one of {words}")
    if not compared_with.words:
        _field(word)
    return Kind.WORD, lambda _: word


def _field(name: str) -> FieldInfo:
    if name not in FIELDS:
        hint = did_you_mean(name, FIELDS, 0.4) or f"; known are {', '.join(FIELDS)}"
        raise ConditionError(f"`{name}` is not known here{hint}")
    return FIELDS[name]


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return a hint at the most similar of the known names; empty where none is."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f"; did you mean {close[0]}?" if close else ""
