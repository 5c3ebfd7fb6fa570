"""Wi-Fi ranges in CSV: firmware of the ESP32, and apps of Android.

Columns are recognised by their names: `Distance (mm)`, `distanceMm` and `AP1 RTT(mm)` are ranges in
millimetres, `distance` is one of unknown unit, and a name with more than a quantity, a unit and
their usual prefixes (`true distance`) is none. Neither has a standard; only Android's own class
always prints itself in one form.

Sources: GTEC-UDC/esp32s2-ftm-tag; Android's `RangingResult`, its `toString`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import RadioReading
from companion.radios.fields import (
    HEX,
    NOT_VALID,
    NUMBERS,
    ONE_WAY_M_PER_S,
    SKIPPED,
    FieldDecoder,
    columns,
    dbm,
    is_marked_invalid,
    number,
    problem_of,
    ratio,
    whole,
)
from companion.radios.wifi_ftm import MAC, problem_of_unsigned

LENGTHS = ("mm", "cm", "m", "km", "ft")
SUCCESSES = ("", "0", "success", "status_success", "ok")
"""Spellings of success: Android's number, the name of its constant, and those of apps."""
NO_NAME = "row without its emitter's name"
DATES = {10: "s", 13: "ms", 16: "us", 19: "ns"}
"""Digits of a time since 1970 in this century to its unit; a time since boot has fewer."""


class FtmCsvOptions(Params, frozen=True):
    """Names of the columns of an FTM firmware's CSV."""

    columns: tuple[Annotated[str, msgspec.Meta(max_length=40)], ...] = ()
    """Columns in order, as `emitter`, `range_cm`, `_` for unread; empty: those recognised."""
    delimiter: Annotated[str, msgspec.Meta(min_length=1, max_length=1)] = ","


class FtmCsvDecoder(FieldDecoder):
    """Decoder of ESP32 firmware's CSV: GTEC's columns, known headerless variants, or given ones."""

    Options = FtmCsvOptions
    options: FtmCsvOptions
    longest_line = 16_384
    _WORDS = re.compile(r"FTM Data: Raw RTT = .{1,40} Distance = (-?[0-9]{1,9}\.[0-9]+) meters")
    _MAC_FIRST = re.compile(
        rf"({MAC.pattern}) *, *(-?[0-9]{{1,9}}\.?[0-9]*) *m *, *[0-9.]+ *ns *, *([0-9]{{1,3}}) *"
    )
    _BARS = re.compile(r"(-?[0-9.]{1,12})\|([0-9.]{1,12})\|(-[0-9.]{1,6}|0)")
    FRAME_COLUMNS = 6

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._names = list(self.options.columns)
        self.has_stamps = self.options.delimiter == " "
        problem = problem_of(self._names) if self._names else None
        if problem is not None:
            raise ConfigError(f"ftm_csv: columns: {problem}")

    def begin(self) -> None:
        """Begin without a header: another radio may print next."""
        super().begin()
        self._bars_unit: tuple[str, float] | None = None
        self._problem: str | None = None
        """Contradiction between the printed header and the given columns."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of a row."""
        if self._names:
            return self._given(line)
        if found := self._WORDS.search(line):
            return self._unsigned({"range_m": found[1]})
        if found := self._MAC_FIRST.fullmatch(line.strip()):
            return self._unsigned({"emitter": found[1].lower(), "range_m": found[2]})
        if found := self._BARS.fullmatch(line.strip()):
            return self._bars(found[1], found[2], found[3])
        return self._gtec(line)

    def _given(self, line: str) -> list[RadioReading]:
        cells, count = columns(line, self.options.delimiter), len(self._names)
        if len(cells) < count or (self.options.delimiter == "," and ";" in line):
            return self.passed_over(line)
        is_cut = len(cells) > count and self._names[-1] in NUMBERS and "." not in cells[count - 1]
        if is_cut and self.options.delimiter == "," and cells[count].isdecimal():
            return self.refused("decimal comma? If not, name the next column, too (`_`)")
        named = dict(zip(self._names, cells, strict=False))
        numbers = [n for n in self._names if n.removesuffix(HEX) in NUMBERS and named[n]]
        if numbers and not any(n.endswith(HEX) or number(named[n]) is not None for n in numbers):
            self._problem = _contradiction(named) or self._problem
            return self.passed_over(line)
        if self._problem is not None or is_marked_invalid(line):
            return self.refused(self._problem or NOT_VALID)
        if named.get("emitter") == "":
            return self.refused(NO_NAME)
        return self.read_fields({name: named[name] for name in named if name not in SKIPPED})

    def _unsigned(self, texts: Mapping[str, str], factor: float = 1.0) -> list[RadioReading]:
        (name,) = set(texts) - {"emitter", "power_dbm"}
        value = number(texts[name])
        problem = problem_of_unsigned(None if value is None else value * factor)
        return self.refused(problem) if problem is not None else self.read_fields(texts)

    def _bars(self, distance: str, rtt_ns: str, power: str) -> list[RadioReading]:
        """Read a distance in the one unit that agrees with the round trip, once only one does."""
        value, rtt = number(distance), number(rtt_ns)
        if value is None or rtt is None:
            return self.refused("torn row")
        expected_m = rtt * 1e-9 * ONE_WAY_M_PER_S
        fitting = [
            (name, factor)
            for name, factor in (("range_m", 1.0), ("range_cm", 0.01))
            if abs(value * factor - expected_m) <= 0.3 + 0.05 * expected_m
        ]
        if self._bars_unit in fitting or len(fitting) == 1:
            self._bars_unit = self._bars_unit or fitting[0]
            if self._bars_unit in fitting:
                name, factor = self._bars_unit
                texts = {name: distance} | ({"power_dbm": power} if dbm(power) is not None else {})
                return self._unsigned(texts, factor)
        reason = "distance may be in m or cm" if len(fitting) > 1 else ""
        return self.refused(reason or "distance and round trip time do not agree")

    def _gtec(self, line: str) -> list[RadioReading]:
        """Read `anchorId,rtt_est,rtt_raw,dist[,own_dist],numFrames,` and six columns a frame."""
        cells = columns(line.rstrip(" ,"))
        for head in (5, 6):
            count = whole(cells[head - 1], 64) if len(cells) >= head else None
            if count is not None and len(cells) == head + self.FRAME_COLUMNS * count:
                if whole(cells[1]) is None or whole(cells[2]) is None:
                    break
                if not cells[0]:
                    return self.refused(NO_NAME)
                texts = {"emitter": cells[0], "range_cm": cells[3]}
                powers = [dbm(cell) for cell in cells[head + 1 :: self.FRAME_COLUMNS]]
                known = [power for power in powers if power is not None]
                if known:
                    texts["power_dbm"] = f"{sum(known) / len(known):.1f}"
                return self._unsigned(texts, 0.01)
        if len(cells) > 5 and number(cells[1]) is not None:
            return self.refused("torn row")
        return self.passed_over(line)


def _contradiction(named: Mapping[str, str]) -> str | None:
    """Return the error in given names of columns by what a header calls them, or None."""
    for name, cell in named.items():
        unit, column = name.removesuffix(HEX).rpartition("_")[2], column_of(cell)
        is_length = column is not None and column.unit in LENGTHS and unit in LENGTHS
        if is_length and column is not None and column.unit != unit:
            return f"{name} is in `{column.unit}` by the header"
    return None


_UNITS = {
    **dict.fromkeys(("mm", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("cm", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("m", "meter", "meters", "metres"), "m"),
    **{"km": "km", "ft": "ft", "feet": "ft"},
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
    **dict.fromkeys(("valid", "isvalid", "success", "issuccess"), "valid"),
    **dict.fromkeys(("rssi", "rssidbm", "powerdbm"), "power"),
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
    """Unit; empty: the name has none."""
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
    columns: dict[str, tuple[int, Column]]
    """Columns by meaning."""
    ranges: tuple[tuple[int, Column], ...]
    """Range column, or one for each emitter."""
    problem: str | None = None
    """Reason why no row below it can be used."""


def header_of(cells: list[str], *, unit: str | None, is_single: bool) -> Header | None:
    """Return the header made of a line's cells; None if none of them is a range.

    `unit` applies to columns without one; with `is_single` all rows are from one emitter.
    """
    by_name: dict[str, tuple[int, Column]] = {}
    ranges: list[tuple[int, Column]] = []
    for index, cell in enumerate(cells):
        column = column_of(cell)
        if column is None:
            continue
        if column.name in ("range", "range_sigma") and not column.unit and unit is not None:
            column = Column(column.name, unit, column.of)
        if column.name == "range":
            ranges.append((index, column))
        else:
            by_name.setdefault(column.name, (index, column))
    if not ranges:
        return None
    with_unit = [each for each in ranges if each[1].unit]
    of_row = [each for each in ranges if not each[1].of]
    known = "emitter" in by_name or "emitter_name" in by_name
    problem = None
    if not with_unit:
        problem = "distance has no unit: set unit, mm, cm or m"
    elif of_row and not known and not is_single:
        problem = "no emitter column known: set single_emitter=true if there is one emitter"
    chosen = [each for each in of_row if each[1].unit][:1] if of_row else with_unit
    return Header(len(cells), by_name, tuple(chosen), problem)


class AndroidRttOptions(Params, frozen=True):
    """Properties that an app's CSV leaves open."""

    unit: Literal["mm", "cm", "m", "ns", "ps"] | None = None
    """Unit of distances and deviations whose columns have none in their names."""
    single_emitter: bool = False
    """True: all rows are from one access point, which no column names."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the timestamp; auto: by the column's name, else by its digits if it is a date."""
    header: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    """The first line of a file that is followed from its end, or has none."""


class AndroidRttDecoder(FieldDecoder):
    """Decoder of a Wi-Fi RTT app's CSV, by its header, named as in apps or Android's own API.

    It also reads log lines with results as Android prints them, which are always millimetres.
    """

    Options = AndroidRttOptions
    options: AndroidRttOptions
    _RESULT = re.compile(r"RangingResult: \[(?=status=)")
    _VALUE = re.compile(r"(\w{3,32})=([^,\[\]]*)(?=[,\]])")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._header: Header | None = None
        self._delimiter = ","
        if self.options.header and not self._is_header(self.options.header):
            raise ConfigError("android_rtt: header: no column of it is a distance")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Read the header, a row, or results of a log."""
        _, *results = self._RESULT.split(line)
        if results:
            return [reading for text in results for reading in self._printed(text)]
        if not line.strip():
            return []
        if self._is_header(line):
            return self.no_reading()
        header = self._header
        if header is None:
            return self.refused("row without a header that has a distance")
        cells = columns(line, self._delimiter)
        if len(cells) != header.cells:
            return self.refused(f"row of {len(cells)} cells below a header of {header.cells}")
        row = {name: cells[index] for name, (index, _) in header.columns.items()}
        problem = header.problem or self._problem_of(row)
        return self.refused(problem) if problem is not None else self._read(header, row, cells)

    def _printed(self, text: str) -> list[RadioReading]:
        """Return the reading of one result as the class prints itself."""
        values = dict(self._VALUE.findall(text))
        successful = values.get("numSuccessfulMeasurements", "")
        problem = self._problem_of(
            {
                "status": values.get("status", ""),
                "successful": successful,
                "two_sided": values.get("is80211mcMeasurement", ""),
            }
        )
        if problem is not None:
            return self.refused(problem)
        is_aware = values.get("mac", "null") == "null"
        quality = ratio(whole(successful), whole(values.get("numAttemptedMeasurements")))
        return self.read_fields(
            {
                "emitter": f"peer {values.get('peerHandle', '')}" if is_aware else values["mac"],
                "range_mm": values.get("distanceMm"),
                "range_sigma_mm": values.get("distanceStdDevMm"),
                "quality": None if quality is None else f"{quality:.6f}",
                "power_dbm": None if dbm(values.get("rssi")) is None else values["rssi"],
            }
        )

    def _is_header(self, line: str) -> bool:
        delimiter = max(",;\t", key=line.count)
        cells = columns(line, delimiter)
        if any(number(cell) is not None or MAC.fullmatch(cell) for cell in cells):
            return False  # a row, in which a network may be called `range`
        options = self.options
        header = header_of(cells, unit=options.unit, is_single=options.single_emitter)
        if header is None:
            return False
        self._header, self._delimiter = header, delimiter
        return True

    @staticmethod
    def _problem_of(row: Mapping[str, str]) -> str | None:
        status = row.get("status", "").lower()
        if status == "2":
            return "one-sided: the access point has no 802.11mc"
        if status not in SUCCESSES or row.get("valid", "").lower() in ("0", "false", "no"):
            return "status is a failure"
        if row.get("two_sided", "").lower() in ("0", "false", "no"):
            return "one-sided: the access point has no 802.11mc"
        if row.get("one_sided", "").lower() in ("1", "true", "yes"):
            return "one-sided: the access point has no 802.11mc"
        return "no measurement succeeded" if number(row.get("successful")) == 0.0 else None

    def _read(self, header: Header, row: Mapping[str, str], cells: list[str]) -> list[RadioReading]:
        texts = {"emitter": (row.get("emitter") or row.get("emitter_name") or "").lower()}
        is_named = "emitter" in row or "emitter_name" in row
        if is_named and not texts["emitter"] and not self.options.single_emitter:
            return self.refused(NO_NAME)
        quality = ratio(whole(row.get("successful")), whole(row.get("attempted")))
        if quality is not None:
            texts["quality"] = f"{quality:.6f}"
        if dbm(row.get("power")) is not None:
            texts["power_dbm"] = row["power"]
        if "range_sigma" in row and header.columns["range_sigma"][1].unit in LENGTHS:
            texts[f"range_sigma_{header.columns['range_sigma'][1].unit}"] = row["range_sigma"]
        if "time" in row:
            unit = self._time_unit(header.columns["time"][1].unit, row["time"])
            texts |= {f"time_{unit}": row["time"]} if unit else {}
        readings = []
        for index, column in header.ranges:
            if cells[index]:
                quantity = "range" if column.unit in LENGTHS else "rtt"
                own = {"emitter": column.of} if column.of else {}
                found = {**texts, **own, f"{quantity}_{column.unit}": cells[index]}
                readings += self.read_fields(found)
        if not any(cells[index] for index, _ in header.ranges):
            return self.refused("row without a distance")
        return readings

    def _time_unit(self, unit: str, text: str) -> str:
        """Return the unit of time: given, or of a date of this century; empty: arrival counts."""
        if self.options.time_unit != "auto" or unit:
            return unit if self.options.time_unit == "auto" else self.options.time_unit
        digits = text.partition(".")[0]
        return DATES.get(len(digits), "") if digits.isdecimal() else ""
