"""Vocabulary of text fields: names of columns or of groups in an expression, with their units.

It serves every text format whose columns the user names: the quantity and its unit, as in
`range_cm`, `rtt_ns`, `azimuth_deg`, `quality_percent`. Formats of a known make name their columns
by it too, so that units are converted to metres, seconds and radians in one module.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields

from companion.radios.decoder import AngleFrame, LineDecoder, RadioReading

LIGHT_MPS = 299_792_458.0
ONE_WAY_M_PER_S = LIGHT_MPS / 2.0
"""Metres of range for each second of a round trip."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
_WHOLE = re.compile(r"0|[1-9][0-9]{0,18}")
_HEXADECIMAL = re.compile(r"[0-9a-f]{1,12}")
_LIKE_HEXADECIMAL = re.compile(r"0[0-9]+|[0-9]+[eE][0-9]+")
"""Whole numbers in a form that only a hexadecimal field without letters has."""
_TRUE, _FALSE = {"1", "true", "yes", "los"}, {"0", "false", "no", "nlos"}


@dataclass(frozen=True, slots=True)
class Unit:
    """Quantity and unit of a name."""

    attribute: str
    factor: float = 1.0
    """Factor from the quantity to the reading's unit."""


def _in_units(name: str, attribute: str, **factors: float) -> dict[str, Unit]:
    return {f"{name}_{unit}": Unit(attribute, factor) for unit, factor in factors.items()}


_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ANGLES = {"deg": math.pi / 180.0, "rad": 1.0}
_RTT = {"us": 1e-6 * ONE_WAY_M_PER_S, "ns": 1e-9 * ONE_WAY_M_PER_S, "ps": 1e-12 * ONE_WAY_M_PER_S}

NUMBERS: Mapping[str, Unit] = {
    **_in_units("time", "device_time_s", **_TIMES),
    **_in_units("age", "age_s", **_TIMES),
    **_in_units("range", "range_m", **_LENGTHS),
    **_in_units("rtt", "range_m", **_RTT),
    **_in_units("range_sigma", "range_sigma_m", **_LENGTHS),
    **_in_units("azimuth", "azimuth_rad", **_ANGLES),
    **_in_units("azimuth_sigma", "azimuth_sigma_rad", **_ANGLES),
    **_in_units("elevation", "elevation_rad", **_ANGLES),
    **_in_units("elevation_sigma", "elevation_sigma_rad", **_ANGLES),
    "quality": Unit("quality"),
    "quality_percent": Unit("quality", 0.01),
    **_in_units("power", "power_dbm", dbm=1.0, db=1.0),
}
"""Names of numbers; `rtt` is the round-trip time."""
WORDS = ("emitter", "line_of_sight")
"""Names of words."""
HEX = "_hex"
"""Suffix of a name whose field is an unsigned hexadecimal integer."""
HEX_NAMES = frozenset(
    name + HEX for name, unit in NUMBERS.items() if unit.attribute not in ("quality", "power_dbm")
)
NAMES = frozenset(NUMBERS) | frozenset(WORDS) | HEX_NAMES
POWERS = frozenset({"rssi", "rssi_dbm", "rss", "power", "signal", "snr", "snr_db"})
"""Names of levels, some of them relative to an unknown one."""
NAME_OF_POWER = "name it power_dbm, or power_db with power_offset_db if it is relative to something"
SKIPPED = ("", "_", "skip")
"""Names of a column that is not read."""

OVERFLOWS = frozenset({0x7FFF, 0xFFFF, 0x7FFF_FFFF, 0xFFFF_FFFF})
"""Whole numbers with all their bits set, which firmware prints where it has no range."""
_CODES = OVERFLOWS | {10**digits - 1 for digits in range(4, 10)}
"""Codes for no range: those numbers, and ones of nines only."""
_STEPS_PER_M = (1.0, 10.0, 100.0, 1000.0)
"""Units in which firmware counts before it prints metres."""
_UNIT_WORDS = {
    **{word: word for word in ("m", "cm", "mm", "km", "ft", "s", "ms", "us", "ns", "ps")},
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("sec", "seconds"), "s"),
    **{"deg": "deg", "degrees": "deg", "\N{DEGREE SIGN}": "deg", "rad": "rad", "nsec": "ns"},
    **{"feet": "ft", "usec": "us", "msec": "ms", "psec": "ps"},
    **{word: word for word in ("yd", "yard", "yards", "mi", "mile", "miles", "inch", "inches")},
    **{word: word for word in ("dm", "um", "nm", "gon", "grad", "mil", "mils", "mrad")},
    **{word: word for word in ("dbm", "db", "dbfs", "dbw", "dbuv", "dbmv", "mw", "uw", "nw")},
}
"""Words for a unit behind a number, and the unit as names of the vocabulary end, if any does."""
_MICRO = "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"
_MICRO_AS_U = dict.fromkeys(map(ord, _MICRO), "u")
_UNIT_BEHIND = re.compile(
    r"([ \t]{0,3}[\[(]?)([^\W\d_]++(?:/[a-z]++)?|\N{DEGREE SIGN})(?!\s*[=:])|(['\"](?=\s|$)|%)"
)
"""A mark of feet, inches or percent, or a word that does not itself name what follows."""
_ABBREVIATIONS = "|".join(word for word in _UNIT_WORDS if 1 < len(word) < 5 and word.isascii())
_UNIT_BEFORE = re.compile(
    rf"[\[(][ \t]?(?P<b>{'|'.join(map(re.escape, _UNIT_WORDS))})[ \t]?[\])][\"']?[ \t]*[:=]?[ \t]*$"
    rf"|(?:_(?P<u>{_ABBREVIATIONS}|m)|[a-z](?P<c>(?-i:{_ABBREVIATIONS.title()}))"
    rf"|(?:^|[^\W\d][ ]|[/|,;(\"'])(?P<w>{_ABBREVIATIONS}))[\"']?[ \t]*[:=][ \t]*[\"']?$",
    re.IGNORECASE,
)
"""Unit in the name before a number: `Dist (cm):`, `range_cm=`, `"rangeMm":`, `in cm:`."""
_SIDE_BEHIND = re.compile(
    r" ?(?:\N{DEGREE SIGN}|deg(?:rees)?)?[ \t]{0,2}"
    r"(?:(?i:left|right|port|starboard|east|west|north|south)|[LRNESW])\b(?!\s*[=:])"
)
"""Side to which an angle without a sign is counted."""
_COMPOUND_BEHIND = re.compile(
    r" ?(?:(?:m|ft|feet|foot|') ?[0-9]+(?:\.[0-9]+)? ?(?:(?:cm|mm|in(?:ch(?:es)?)?)\b|\")|m[0-9]"
    r"|(?:\N{DEGREE SIGN}|deg) ?[0-9]+(?:\.[0-9]+)? ?(?:min\b|\N{PRIME}|'))",
    re.IGNORECASE,
)
"""Rest of a quantity in two units: 5 ft 3 in, 3 m 20 cm, 45 degrees 30 minutes."""
_LIMIT_BEFORE = re.compile(
    "(?:[<\N{LESS-THAN OR EQUAL TO}\N{GREATER-THAN OR EQUAL TO}]=?"
    r"|^[^<]*(?:(?<=\w=)|(?<=[:(,\s])|^)>=?)[ ]?$"
)
"""Sign of more or less before a number; an arrow or the end of a tag is none."""
_SIGN_BEFORE = re.compile(r"(?:^|[^0-9A-Za-z+/])[-\N{MINUS SIGN}\N{EN DASH}]$")
_NUMBER_BEFORE = re.compile(r"[0-9][.,]?$")
_NUMBER_BEHIND = re.compile(r"[0-9]|\.[0-9]|[eE][+-]?[0-9]|#(?:INF|IND|QNAN|SNAN)")
_GROUPS_BEHIND = re.compile(r"(?:[ ][0-9]{3})+(?:[.,][0-9]+)? ?([^\W\d_]+)")
_COMMA_BEHIND = re.compile(
    "[,'_\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{ARABIC DECIMAL SEPARATOR}"
    "\N{ARABIC THOUSANDS SEPARATOR}\N{FULLWIDTH COMMA}\N{FULLWIDTH FULL STOP}]\\d"
)
_WORD_BEFORE, _WORD_BEHIND = re.compile(r"\w$"), re.compile(r"\w")
"""Neighbours that hexadecimal digits must not have."""

ZERO_POWER = "power of exactly 0 dBm: nothing received"
NOT_VALID = "the line says itself that it is not valid"
_FAILURE = (
    r"(?:time[_ -]?(?:d[_ ])?out|invalid|not[_ ]valid|fail(?:ed|ure)?|error|lost|stale"
    r"|no[_ ](?:lock|fix|signal|response|answer)|out[_ ]of[_ ]range)"
)
_INVALID_STATUS = re.compile(
    rf"\b(?:status|state|result|error|err)[\"']?\s*[:=]\s*[\"']?(?:\w+[_ -])?{_FAILURE}\b"
    r"|\b(?:is_?)?(?:valid|success)[\"']?\s*[:=]\s*[\"']?(?:0|false|no)(?![\w.])"
    rf"|(?:^|[,;\t|(\[])\s*[\"']?(?:[a-z]+_)?{_FAILURE}[\"']?\s*(?:[,;\t|)\]]|$)"
    r"|\b(?-i:INVALID|NOT VALID)\b",
    re.IGNORECASE,
)
"""Status words instead of a value, in a separate cell, or in capitals."""

_SIGMAS = frozenset(field.name for field in fields(RadioReading) if "_sigma_" in field.name)
_ANGLE_NAMES = ("azimuth_rad", "elevation_rad")
_ANGLES_BY_UNIT = {name for name, unit in NUMBERS.items() if unit.attribute in _ANGLE_NAMES}
_MEASURED = frozenset({"range_m", "power_dbm", *_ANGLE_NAMES})


def number(text: str | None) -> float | None:
    """Return the finite number in plain decimal notation, or None."""
    if text is None or not _NUMBER.fullmatch(text := text.strip()):
        return None
    value = float(text)
    return value if math.isfinite(value) else None


def whole(text: str | None, largest: int = 2**32 - 1) -> int | None:
    """Return the whole number from 0 to `largest`, or None."""
    if text is None or not _WHOLE.fullmatch(text := text.strip()):
        return None
    value = int(text)
    return value if value <= largest else None


def _hexadecimal(text: str) -> float | None:
    text = text.strip().lower().removeprefix("0x")
    return float(int(text, 16)) if _HEXADECIMAL.fullmatch(text) else None


def dbm(text: str | None) -> float | None:
    """Return a received power; None where firmware prints 0, or something else, for none."""
    value = number(text)
    return value if value is not None and value < 0.0 else None


def ratio(part: int | None, of_all: int | None) -> float | None:
    """Return a quality, good ones over all; None if unknown or meaningless."""
    if part is None or not of_all or part > of_all:
        return None
    return part / of_all


def columns(line: str, delimiter: str = ",") -> list[str]:
    """Return the cells of a line, quoted ones whole, without surrounding blanks."""
    try:
        (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except (csv.Error, ValueError):
        return []
    return [cell.strip() for cell in cells]


def emitter_name(text: str) -> str | int | None:
    """Return an emitter, a number if it is of decimal digits, else a name; None if empty."""
    text = text.strip()
    if not text:
        return None
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 6 else text[:64]


def problem_of(names: list[str]) -> str | None:
    """Return the error in names that a user has given, or None."""
    for name in names:
        if name in POWERS:
            return f"`{name}`: {NAME_OF_POWER}"
        if name not in NAMES and name not in SKIPPED:
            return f"`{name}` is not a quantity with a unit; there are {', '.join(sorted(NAMES))}"
    plain = [name.removesuffix(HEX) for name in names]
    targets = [NUMBERS[name].attribute if name in NUMBERS else name for name in plain]
    for name, target in zip(names, targets, strict=True):
        if name in NAMES and targets.count(target) > 1:
            return f"`{name}` says what another one says too"
    if not _MEASURED & set(targets):
        return "neither a range, an angle nor a power is among them"
    return None


def is_overflow(raw: float) -> bool:
    """Return True if whole millimetres or centimetres are firmware's code for no value."""
    return raw in OVERFLOWS


def is_overflow_m(range_m: float) -> bool:
    """Return True if metres are such a code, converted from any unit: 655.35 or 999.99."""
    return any(
        round(range_m * steps) in _CODES
        and math.isclose(range_m, round(range_m * steps) / steps, rel_tol=1e-9)
        for steps in _STEPS_PER_M
    )


def is_marked_invalid(line: str) -> bool:
    """Return True if a line's own status marks its values as invalid."""
    return _INVALID_STATUS.search(line) is not None


def problem_of_spans(found: re.Match[str]) -> str | None:
    """Return the error in the positions of a match's groups in their line, or None.

    An omitted sign, a number cut in two where the expression ends, or a different unit before or
    behind it: each would be another value that looks valid.
    """
    for name, text in found.groupdict().items():
        if name.removesuffix(HEX) not in NUMBERS or not text or not text.strip():
            continue
        problem = (
            _problem_before(found, name)
            or _problem_of_cut(found, name)
            or _problem_behind(found, name)
        )
        if problem is not None:
            return f"{name} {problem}"
    return None


def _unit_in(name: str) -> str:
    """Return the unit by the end of a name; empty if it has none."""
    plain = name.removesuffix(HEX)
    return plain.rpartition("_")[2] if "_" in plain else ""


def _problem_before(found: re.Match[str], name: str) -> str | None:
    """Return the error indicated by the characters before a number, or None."""
    before, unit = found.string[: found.start(name)], _unit_in(name)
    if _SIGN_BEFORE.search(before) and found[name][0] not in "+-":
        return "leaves out the sign before it"
    if _LIMIT_BEFORE.search(before):
        return "says only a limit"
    named = _UNIT_BEFORE.search(before) if unit in _UNIT_WORDS else None
    word = _UNIT_WORDS[named[named.lastgroup or 0].lower()] if named is not None else unit
    return f"stands behind `{word}`" if word != unit else None


def _problem_of_cut(found: re.Match[str], name: str) -> str | None:
    """Return the error of an expression that ends within a number or quantity, or None."""
    line, text, is_hex = found.string, found[name], name.endswith(HEX)
    start, end = found.span(name)
    before = _WORD_BEFORE if is_hex else _NUMBER_BEFORE
    behind = _WORD_BEHIND if is_hex else _NUMBER_BEHIND
    is_cut = start == found.start() and before.search(line[:start]) is not None
    is_cut = is_cut or (end == found.end() and behind.match(line, end) is not None)
    groups = _GROUPS_BEHIND.match(line, end) if len(text) < 4 else None
    if is_cut or (groups and _UNIT_WORDS.get(groups[1].lower()) == _unit_in(name)):
        return "is part of a longer number"
    if "." in text:
        return None
    if end == found.end() and _COMMA_BEHIND.match(line, end):
        return f"ends at `{line[end]}` before digits: if it separates, include it"
    return "goes on in a smaller unit" if _COMPOUND_BEHIND.match(line, end) else None


def _problem_behind(found: re.Match[str], name: str) -> str | None:
    """Return the error indicated by the side or unit after a number, or None."""
    line, end, unit = found.string, found.end(name), _unit_in(name)
    if name in _ANGLES_BY_UNIT and _SIDE_BEHIND.match(line, end):
        return "is followed by a side: its sign is not known"
    word = _unit_of(_UNIT_BEHIND.match(line, end))
    return f"is followed by `{word}`" if word is not None and unit and word != unit else None


def _unit_of(behind: re.Match[str] | None) -> str | None:
    """Return the unit after a number; None if there is none; a word glued to it is unknown."""
    if behind is None:
        return None
    if behind[3]:
        return "percent" if behind[3] == "%" else behind[3]
    word = behind[2].lower().translate(_MICRO_AS_U)
    is_unknown_unit = not behind[1] or not word.isascii() or "/" in word
    return _UNIT_WORDS.get(word, word if is_unknown_unit else None)


class FieldDecoder(LineDecoder):
    """Decoder whose lines consist of named fields."""

    has_stamps = False

    def understood(self, reading: RadioReading) -> list[RadioReading]:
        """Count a frame with one reading; return the reading."""
        self.counts.frames += 1
        return [reading]

    def refused(self, reason: str) -> list[RadioReading]:
        """Count a frame that was understood but cannot be used."""
        self.counts.frames += 1
        self.counts.refuse(reason)
        return []

    def no_reading(self) -> list[RadioReading]:
        """Count a frame that was understood but has no measurement of use."""
        self.counts.frames += 1
        return []

    def passed_over(self, line: str) -> list[RadioReading]:
        """Count a line that is not of the format: consoles print much else."""
        self.counts.pass_over(line)
        return []

    def distinct(self, readings: list[RadioReading]) -> list[RadioReading]:
        """Return the readings of a line if no emitter has two ranges in it."""
        ranged = [each.emitter for each in readings if each.range_m is not None]
        if len(set(ranged)) == len(ranged):
            return readings
        self.counts.refuse("several ranges of one emitter in a line")
        return []

    def read_fields(
        self, texts: Mapping[str, str | None], frame: AngleFrame = AngleFrame.DEVICE
    ) -> list[RadioReading]:
        """Return the reading of fields named by the vocabulary; empty ones are not measured."""
        values: dict[str, float] = {}
        for name, text in texts.items():
            unit = NUMBERS.get(name.removesuffix(HEX))
            if unit is None or text is None or not text.strip():
                continue
            if name.endswith(HEX):
                value = _hexadecimal(text)
            elif _LIKE_HEXADECIMAL.fullmatch(text.strip()):
                return self.refused(f"{name} may be hexadecimal: name it {name}{HEX} if it is")
            else:
                value = number(text)
            if value is None:
                comma = ": a decimal point is needed" if "," in text else ""
                return self.refused(f"{name} is not a number{comma}")
            if unit.attribute == "range_m" and is_overflow(value):
                return self.refused(f"{name} is {value:.0f}: all bits set, no range")
            values[unit.attribute] = value * unit.factor
        problem = _problem_of_values(values)
        if problem is None and _drop_zeros(values, is_dbm="power_dbm" in texts):
            problem = ZERO_POWER
        if problem is not None:
            return self.refused(problem)
        word = (texts.get("line_of_sight") or "").strip().lower()
        return self.understood(
            RadioReading(
                emitter=emitter_name(texts.get("emitter") or ""),
                line_of_sight=True if word in _TRUE else False if word in _FALSE else None,
                frame=frame,
                **values,
            )
        )


def _drop_zeros(values: dict[str, float], *, is_dbm: bool) -> bool:
    """Delete zeros that firmware prints for no value; return True if nothing measured is left."""
    for name in _SIGMAS | ({"power_dbm"} if is_dbm else set()):
        if values.get(name) == 0.0:
            del values[name]
    return not _MEASURED & set(values)


def _problem_of_values(values: Mapping[str, float]) -> str | None:
    if not _MEASURED & set(values):
        return "neither range, angle nor power"
    if any(values[name] < 0.0 for name in _SIGMAS & set(values)):
        return "sigma is negative"
    if any(abs(values.get(name, 0.0)) > math.tau + 1e-9 for name in _ANGLE_NAMES):
        return "angle is beyond a full turn"
    if not 0.0 <= values.get("quality", 0.0) <= 1.0:
        return "quality is out of bounds"
    if values.get("age_s", 0.0) < 0.0:
        return "age is negative"
    return None
