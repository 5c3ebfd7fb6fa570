"""The language of conditions: `estimate.r95_m < 1 and vehicle.mode == hold`.

Theory of operation. Python's own parser reads the text into a tree, so precedence, chained
comparisons and parentheses are Python's; nothing is ever evaluated by Python. The tree is
translated, once and with types, into closures over a `FlightSituation`. An unknown value is neither
true nor false (Kleene's logic): `and` with something false is false, `or` with something true is
true, everything else with an unknown is unknown, and an unknown condition does not hold.

A `FlightSituation` is the known state of a flight at one time; unknown values are None. The runner
in memory and that of real processes fill the same record, so that a script means the same in both.
The docstrings of its fields are used in documentation and errors.
"""

from __future__ import annotations

import ast
import difflib
import operator
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, get_args, get_type_hints

from companion.domain import EstimateState, FlightMode, LandedState, WaypointReason
from companion.guidance.phases import Phase


class Kind(Enum):
    """Type of a value; only values of one type are compared."""

    NUMBER = "a number"
    TRUTH = "true or false"
    WORD = "a word"


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """Field that a condition may refer to."""

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
    """Vehicle state as shown by the operator's telemetry."""

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
    """Companion state as shown by its event log."""

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
    """The companion's estimate of the current target."""

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
    """All values that a condition may refer to."""

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

COMPARISONS: dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
EQUALITIES = (ast.Eq, ast.NotEq)
ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
TRUTHS = {"true": True, "false": False}
SPEAKERS = {"said": "companion_texts", "autopilot_said": "autopilot_texts"}
MAX_LENGTH = 1000


class ConditionError(ValueError):
    """Invalid condition; the message gives the position in the text and the known names."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Parsed condition."""

    text: str
    _get: Getter

    def holds(self, situation: FlightSituation) -> bool:
        """Return True if the condition holds now; an unknown value does not hold."""
        return self._get(situation) is True

    def is_false(self, situation: FlightSituation) -> bool:
        """Return True if the condition is known not to hold."""
        return self._get(situation) is False


@dataclass(frozen=True, slots=True)
class _Part:
    """Part of a condition: its type, and the getter of its value."""

    kind: Kind
    get: Getter
    node: ast.expr
    words: tuple[str, ...] = ()
    """Possible values of a field that is a word."""
    word: str | None = None
    """Literal word of an operand that is not a field."""


def parse_condition(text: str) -> Condition:
    """Return the condition of a text; raises a `ConditionError` if it is invalid."""
    if len(text) > MAX_LENGTH:
        raise ConditionError(f"longer than {MAX_LENGTH} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the parser's remarks about style are not for people
            tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        column = getattr(error, "offset", None) or 1
        raise ConditionError(f"`{text}`: not a condition (column {column})") from None
    try:
        part = _truth_of(tree.body)
    except RecursionError:
        raise ConditionError("nested too deeply") from None
    return Condition(text.strip(), part.get)


def _lifted(function: Callable[..., Value], *parts: _Part) -> Getter:
    """Return the function of the parts' values; unknown where one of them is."""
    getters = tuple(part.get for part in parts)

    def get(situation: FlightSituation) -> Value:
        """Return the function's value; None if a part is unknown."""
        values: list[Any] = [getter(situation) for getter in getters]
        return None if None in values else function(*values)

    return get


def _truth_of(node: ast.expr) -> _Part:
    """Return a boolean part; `ConditionError`: it has another type."""
    return _part_of_kind(node, Kind.TRUTH, "compare it with something")


def _part(node: ast.expr) -> _Part:
    match node:
        case ast.BoolOp():
            return _logic(node)
        case ast.UnaryOp(op=ast.Not()):
            return _Part(Kind.TRUTH, _lifted(operator.not_, _truth_of(node.operand)), node)
        case ast.UnaryOp(op=ast.USub()):
            return _Part(Kind.NUMBER, _lifted(operator.neg, _number_of(node.operand)), node)
        case ast.Compare():
            return _comparison(node)
        case ast.BinOp():
            if type(node.op) not in ARITHMETIC:
                raise _problem(node, "calculates with something else than + - *")
            combine = ARITHMETIC[type(node.op)]
            return _Part(
                Kind.NUMBER, _lifted(combine, _number_of(node.left), _number_of(node.right)), node
            )
        case ast.Constant():
            return _constant(node)
        case ast.Name() | ast.Attribute():
            return _named(node)
        case ast.Call():
            return _call(node)
    raise _problem(node, "is not part of the language of conditions")


def _logic(node: ast.BoolOp) -> _Part:
    getters = [_truth_of(value).get for value in node.values]
    decisive = isinstance(node.op, ast.Or)

    def get(situation: FlightSituation) -> Value:
        """Return Kleene's `and` or `or` of the parts, by the decisive value."""
        is_unknown = False
        for getter in getters:
            value = getter(situation)
            if value is decisive:
                return decisive
            is_unknown = is_unknown or value is None
        return None if is_unknown else not decisive

    return _Part(Kind.TRUTH, get, node)


def _comparison(node: ast.Compare) -> _Part:
    parts = [_part(each) for each in (node.left, *node.comparators)]
    triples = zip(parts, node.ops, parts[1:], strict=False)
    getters = [_one_comparison(left, op, right, node) for left, op, right in triples]
    if len(getters) == 1:
        return _Part(Kind.TRUTH, getters[0], node)

    def get(situation: FlightSituation) -> Value:
        values = [getter(situation) for getter in getters]
        if False in values:
            return False
        return None if None in values else True

    return _Part(Kind.TRUTH, get, node)


def _one_comparison(left: _Part, op: ast.cmpop, right: _Part, node: ast.expr) -> Getter:
    if type(op) not in COMPARISONS:
        raise _problem(node, "compares with something else than < <= > >= == !=")
    symbol, compare = COMPARISONS[type(op)]
    _check_words(left, right)
    _check_words(right, left)
    if left.kind is not right.kind:
        raise _problem(node, f"compares {left.kind.value} with {right.kind.value}")
    if left.kind is not Kind.NUMBER and not isinstance(op, EQUALITIES):
        raise _problem(node, f"{left.kind.value} has no order; use == or != in place of {symbol}")
    return _lifted(compare, left, right)


def _check_words(part: _Part, other: _Part) -> None:
    """Raise `ConditionError` for a word that the other side cannot equal, or an unknown one."""
    if part.word is None:
        return
    if not other.words:
        raise _unknown(part)
    if part.word not in other.words:
        raise _problem(other.node, f"is never `{part.word}`; it is one of {', '.join(other.words)}")


def _number_of(node: ast.expr) -> _Part:
    return _part_of_kind(node, Kind.NUMBER, "a number is needed here")


def _part_of_kind(node: ast.expr, kind: Kind, advice: str) -> _Part:
    part = _part(node)
    if part.word is not None:
        raise _unknown(part)
    if part.kind is not kind:
        raise _problem(node, f"is {part.kind.value}; {advice}")
    return part


def _constant(node: ast.Constant) -> _Part:
    value = node.value
    if isinstance(value, bool):
        return _Part(Kind.TRUTH, lambda _: value, node)
    if isinstance(value, int | float):
        if not abs(value) <= sys.float_info.max:
            raise ConditionError("a number in it is too large")
        number = float(value)
        return _Part(Kind.NUMBER, lambda _: number, node)
    if isinstance(value, str):
        return _Part(Kind.WORD, lambda _: value, node, word=value)
    raise _problem(node, "is not a number, word, true or false")


def _named(node: ast.Name | ast.Attribute) -> _Part:
    name = ast.unparse(node)
    info = FIELDS.get(name)
    if info is not None:
        return _Part(info.kind, operator.attrgetter(name), node, info.words)
    if isinstance(node, ast.Name):
        if name in TRUTHS:
            return _Part(Kind.TRUTH, lambda _: TRUTHS[name], node)
        return _Part(Kind.WORD, lambda _: name, node, word=name)
    hint = did_you_mean(name, FIELDS, 0.5) or f"; known are {', '.join(FIELDS)}"
    raise _problem(node, f"is not known{hint}")


def _call(node: ast.Call) -> _Part:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if node.keywords or len(node.args) != 1 or name not in ("abs", *SPEAKERS):
        raise _problem(node, "is not a function here: abs(), said() and autopilot_said() are")
    if name == "abs":
        return _Part(Kind.NUMBER, _lifted(abs, _number_of(node.args[0])), node)
    argument = node.args[0]
    if not (isinstance(argument, ast.Constant) and isinstance(argument.value, str)):
        raise _problem(node, f'needs a text in quotes: {name}("LOCALISED")')
    part, texts_of = argument.value, operator.attrgetter(SPEAKERS[name])
    return _Part(Kind.TRUTH, lambda s: any(part in text for text in texts_of(s)), node)


def _unknown(part: _Part) -> ConditionError:
    return _problem(part.node, f"is not known here{did_you_mean(str(part.word), FIELDS, 0.4)}")


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return a hint at the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f"; did you mean {close[0]}?" if close else ""


def _problem(node: ast.expr, text: str) -> ConditionError:
    return ConditionError(f"`{ast.unparse(node)}` {text}")
