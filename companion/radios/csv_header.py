"""Columns of a CSV of ranges, recognised by their names.

`Distance (mm)`, `distanceMm` and `AP1 RTT(mm)` are ranges in millimetres; `distance` is one of
unknown unit. A name with more than a quantity, a unit and their usual prefixes (`true distance`) is
not recognised.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_UNITS = {
    **dict.fromkeys(("mm", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("cm", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("m", "meter", "meters", "metres"), "m"),
    **{unit: unit for unit in ("ns", "ps", "us")},
}
_UNIT = "|".join(sorted(_UNITS, key=len, reverse=True))
_RANGE = re.compile(rf"(.*)(distance|range|dist|rtt)(?:in)?({_UNIT})?")
_SIGMA = re.compile(
    rf"(?:distance|range|dist|rtt)?(?:std|stddev|stdev|sigma|standarddeviation)(?:in)?({_UNIT})?"
)
_PLAIN = {"", "rtt", "ftm", "wifi", "wifirtt", "measured", "estimated", "est", "mean", "avg"}
"""Prefixes of a range that is the row's own."""
_OF_ONE = re.compile(r"(?:ap|anchor|responder|node|tag|rp)?[0-9]{1,5}|(?:ap)?[0-9a-f]{12}")
"""Prefix of a range that has a column for each emitter."""
_OWNER = "(?:ap|accesspoint|anchor|responder|peer|target|wifi)"
_ADDRESS = re.compile(rf"{_OWNER}?(?:bssid|mac(?:addr|address)?)")
_NAME = re.compile(rf"{_OWNER}(?:id|name)?")
_TIME = re.compile(r"(?:ranging)?time(?:stamp)?(s|ms|millis|us|micros|ns|nanos)?")
_TIME_UNITS = {"millis": "ms", "micros": "us", "nanos": "ns"}
_OTHERS = {
    **dict.fromkeys(("attempted", "numattempted", "numattemptedmeasurements"), "attempted"),
    **dict.fromkeys(("successful", "numsuccessful", "numsuccessfulmeasurements"), "successful"),
    "status": "status",
    **dict.fromkeys(
        ("is80211mc", "is80211mcresponder", "is80211mcmeasurement", "twosided"), "two_sided"
    ),
    "onesided": "one_sided",
}


@dataclass(frozen=True, slots=True)
class Column:
    """Column with a recognised meaning."""

    name: str
    """`range`, `range_sigma`, `emitter`, `emitter_name`, `time`, or one of `_OTHERS`."""
    unit: str = ""
    """Empty: the name has none."""
    of: str = ""
    """The emitter that a range is of, where each has a column."""


def column_of(cell: str) -> Column | None:
    """Return the meaning of a header's cell; None if it is not read."""
    word = re.sub(r"[^a-z0-9]", "", cell.lower()).removeprefix("get")
    if found := _TIME.fullmatch(word):
        return Column("time", _TIME_UNITS.get(found[1] or "", found[1] or ""))
    if found := _SIGMA.fullmatch(word):
        return Column("range_sigma", _UNITS.get(found[1] or "", ""))
    if found := _RANGE.fullmatch(word):
        unit = _UNITS.get(found[3] or "", "")
        if found[1] in _PLAIN:
            return Column("range", unit)
        return Column("range", unit, found[1]) if _OF_ONE.fullmatch(found[1]) else None
    if _ADDRESS.fullmatch(word):
        return Column("emitter")
    if _NAME.fullmatch(word):
        return Column("emitter_name")
    return Column(_OTHERS[word]) if word in _OTHERS else None


@dataclass(frozen=True, slots=True)
class Header:
    """Complete header: each meaning once, and the missing or repeated ones."""

    cells: int
    places: dict[str, tuple[int, Column]]
    """Columns by meaning."""
    ranges: tuple[tuple[int, Column], ...]
    """One; or one for each emitter."""
    problem: str | None = None
    """Reason why no row below it can be used."""


def header_of(cells: list[str], *, unit: str | None, is_single: bool) -> Header | None:
    """Return the header made of a line's cells; None if none of them is a range.

    `unit` applies to columns without one; with `is_single` all rows are of one emitter.
    """
    places: dict[str, tuple[int, Column]] = {}
    ranges: list[tuple[int, Column]] = []
    for number, cell in enumerate(cells):
        column = column_of(cell)
        if column is None:
            continue
        if column.name in ("range", "range_sigma") and not column.unit and unit is not None:
            column = Column(column.name, unit, column.of)
        if column.name == "range":
            ranges.append((number, column))
        else:
            places.setdefault(column.name, (number, column))
    if not ranges:
        return None
    with_unit = [each for each in ranges if each[1].unit]
    of_row = [each for each in ranges if not each[1].of]
    known = "emitter" in places or "emitter_name" in places
    problem = None
    if not with_unit:
        problem = "distance has no unit: set unit, mm, cm or m"
    elif of_row and not known and not is_single:
        problem = "no emitter column known: set single_emitter=true if there is one emitter"
    chosen = [each for each in of_row if each[1].unit][:1] if of_row else with_unit
    return Header(len(cells), places, tuple(chosen), problem)
