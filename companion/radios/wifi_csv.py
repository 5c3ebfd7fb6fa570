"""Wi-Fi ranges in CSV: firmware of the ESP32, and apps of Android.

There is no standard of either. Sources: GTEC-UDC/esp32s2-ftm-tag; Android's `RangingResult`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import RadioKind, RadioReading
from companion.radios.fields import (
    NUMBERS,
    ONE_WAY_M_PER_S,
    SKIPPED,
    FieldDecoder,
    columns,
    complain_of,
    number,
    ratio,
    whole,
)
from companion.radios.wifi_ftm import MAC, complain_of_unsigned


class FtmCsvOptions(Params, frozen=True):
    """How the columns of an FTM firmware's CSV are called."""

    columns: tuple[Annotated[str, msgspec.Meta(max_length=40)], ...] = ()
    """In order, `emitter`, `range_cm`, `rtt_ns` and so on, `_` for one that is not read; none:
    the known ones are told apart by themselves."""
    delimiter: Annotated[str, msgspec.Meta(min_length=1, max_length=1)] = ","


class FtmCsvDecoder(FieldDecoder):
    """CSV of ESP32 firmware: GTEC's columns, the known variants without a header, or given ones."""

    Options = FtmCsvOptions
    longest_line = 16_384
    _WORDS = re.compile(r"FTM Data: Raw RTT = .{1,40} Distance = (-?[0-9]{1,9}\.[0-9]+) meters")
    _MAC_FIRST = re.compile(
        rf"({MAC.pattern}) *, *(-?[0-9]{{1,9}}\.?[0-9]*) *m *, *[0-9.]+ *ns *, *([0-9]{{1,3}}) *"
    )
    _BARS = re.compile(r"(-?[0-9.]{1,12})\|([0-9.]{1,12})\|-?[0-9.]{1,6}")
    FRAME_COLUMNS = 6

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        assert isinstance(self.options, FtmCsvOptions)
        self._names = list(self.options.columns)
        self._delimiter = self.options.delimiter
        problem = complain_of(self._names) if self._names else None
        if problem is not None:
            raise ConfigError(f"ftm_csv: columns: {problem}")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One row."""
        if self._names:
            return self._given(line)
        if found := self._WORDS.search(line):
            return self._unsigned({"range_m": found[1]})
        if found := self._MAC_FIRST.fullmatch(line.strip()):
            return self._unsigned({"emitter": found[1].lower(), "range_m": found[2]})
        if found := self._BARS.fullmatch(line.strip()):
            return self._bars(found[1], found[2])
        return self._gtec(line)

    def _given(self, line: str) -> list[RadioReading]:
        cells = columns(line, self._delimiter)
        if len(cells) < len(self._names):
            return self.passed_over(line)
        named = dict(zip(self._names, cells, strict=False))
        numbers = [named[name] for name in self._names if name in NUMBERS and named[name]]
        if numbers and not any(number(cell) is not None for cell in numbers):
            return self.passed_over(line)
        return self.read_fields({name: named[name] for name in named if name not in SKIPPED})

    def _unsigned(self, texts: Mapping[str, str], factor: float = 1.0) -> list[RadioReading]:
        (name,) = set(texts) - {"emitter"}
        value = number(texts[name])
        problem = complain_of_unsigned(None if value is None else value * factor)
        return self.refused(problem) if problem is not None else self.read_fields(texts)

    def _bars(self, distance: str, rtt_ns: str) -> list[RadioReading]:
        """The distance's unit is nowhere said: it is the one that agrees with the round trip."""
        value, rtt = number(distance), number(rtt_ns)
        if value is None or rtt is None:
            return self.refused("torn row")
        expected_m = rtt * 1e-9 * ONE_WAY_M_PER_S
        for name, factor in (("range_m", 1.0), ("range_cm", 0.01)):
            if abs(value * factor - expected_m) <= 0.3 + 0.05 * expected_m:
                return self._unsigned({name: distance}, factor)
        return self.refused("distance and round trip time do not agree")

    def _gtec(self, line: str) -> list[RadioReading]:
        """`anchorId,rtt_est,rtt_raw,dist[,own_dist],numFrames,` and six columns a frame."""
        cells = columns(line.rstrip(" ,"))
        for head in (5, 6):
            count = whole(cells[head - 1], 64) if len(cells) >= head else None
            if count is not None and len(cells) == head + self.FRAME_COLUMNS * count:
                if whole(cells[1]) is None or whole(cells[2]) is None:
                    break
                return self._unsigned({"emitter": cells[0], "range_cm": cells[3]}, 0.01)
        if len(cells) > 5 and number(cells[1]) is not None:
            return self.refused("torn row")
        return self.passed_over(line)


class AndroidRttOptions(Params, frozen=True):
    """What an app's CSV leaves open."""

    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Of the timestamp; auto: by the column's name, else by the magnitude of a time since 1970."""
    header: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    """The first line of a file that is followed from its end, or has none."""


class AndroidRttDecoder(FieldDecoder):
    """CSV of a Wi-Fi RTT app, by its header; names as apps and Android's own API have them."""

    Options = AndroidRttOptions
    _COLUMNS: Mapping[str, str] = {
        "bssid": "emitter",
        "mac": "emitter",
        "macaddress": "emitter",
        "distancemm": "range_mm",
        "distancem": "range_m",
        "rangem": "range_m",
        "rangemm": "range_mm",
        "range": "range_m",
        "distance": "range_m",
        "dist": "range_m",
        "stddevmm": "range_sigma_mm",
        "distancestddevmm": "range_sigma_mm",
        "stdmm": "range_sigma_mm",
        "stddevm": "range_sigma_m",
        "stdm": "range_sigma_m",
        "std": "range_sigma_m",
        "stddev": "range_sigma_m",
        "attempted": "attempted",
        "numattempted": "attempted",
        "numattemptedmeasurements": "attempted",
        "successful": "successful",
        "numsuccessful": "successful",
        "numsuccessfulmeasurements": "successful",
        "status": "status",
        "is80211mc": "two_sided",
        "is80211mcresponder": "two_sided",
        "is80211mcmeasurement": "two_sided",
        "twosided": "two_sided",
        "onesided": "one_sided",
    }
    _TIME = re.compile(r"(?:ranging)?time(?:stamp)?(s|ms|millis|us|micros|ns|nanos)?")
    _UNITS: Mapping[str, str] = {"millis": "ms", "micros": "us", "nanos": "ns"}

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        assert isinstance(self.options, AndroidRttOptions)
        self._time_unit = self.options.time_unit
        self._header: list[str] = []
        self._delimiter = ","
        if self.options.header and not self._is_header(self.options.header):
            raise ConfigError("android_rtt: header: no column of it is a distance")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """The header, or a row."""
        line = line.lstrip("\ufeff")
        if not line.strip():
            return []
        if self._is_header(line):
            return []
        if not self._header:
            return self.refused("row before the header")
        cells = columns(line, self._delimiter)
        if len(cells) != len(self._header):
            return self.refused("torn row")
        row = dict(zip(self._header, cells, strict=True))
        problem = self._complain_of(row)
        return self.refused(problem) if problem is not None else self._read(row)

    def _is_header(self, line: str) -> bool:
        delimiter = max(",;\t", key=line.count)
        names = [self._name(cell) for cell in columns(line, delimiter)]
        if not {"range_m", "range_mm"} & set(names):
            return False
        self._header = ["" if name in names[:index] else name for index, name in enumerate(names)]
        self._delimiter = delimiter
        return True

    def _name(self, cell: str) -> str:
        word = re.sub(r"[^a-z0-9]", "", cell.lower())
        if found := self._TIME.fullmatch(word):
            unit = self._UNITS.get(found[1] or "", found[1])
            return f"time_{unit}" if unit else "time"
        return self._COLUMNS.get(word.removeprefix("get"), "")

    @staticmethod
    def _complain_of(row: Mapping[str, str]) -> str | None:
        status = row.get("status", "").lower()
        if status == "2":
            return "one-sided: the access point has no 802.11mc"
        if status not in ("", "0", "success"):
            return "status is a failure"
        if row.get("two_sided", "").lower() in ("0", "false", "no"):
            return "one-sided: the access point has no 802.11mc"
        if row.get("one_sided", "").lower() in ("1", "true", "yes"):
            return "one-sided: the access point has no 802.11mc"
        return "no measurement succeeded" if number(row.get("successful")) == 0.0 else None

    def _read(self, row: Mapping[str, str]) -> list[RadioReading]:
        texts = {name: text for name, text in row.items() if name in NUMBERS or name == "emitter"}
        texts["emitter"] = texts.get("emitter", "").lower()
        quality = ratio(whole(row.get("successful")), whole(row.get("attempted")))
        if quality is not None:
            texts["quality"] = f"{quality:.6f}"
        for name in [name for name in row if name == "time" or name.startswith("time_")]:
            texts.pop(name, None)
            texts[f"time_{self._unit_of(name, row[name])}"] = row[name]
        return self.read_fields(texts)

    def _unit_of(self, name: str, text: str) -> str:
        if self._time_unit != "auto":
            return self._time_unit
        if name != "time":
            return name.removeprefix("time_")
        value = number(text) or 0.0
        return "s" if value < 1e11 else "ms" if value < 1e14 else "us" if value < 1e17 else "ns"


FTM_CSV = RadioKind(
    name="ftm_csv",
    decoder=FtmCsvDecoder,
    title="ESP32 Wi-Fi FTM, CSV of GTEC's and other firmware",
    gives="range",
    emitter="an FTM responder: an ESP32 or an access point that answers",
    transport="serial:115200",
    needs_emitter=True,
    defaults={"range_sigma_m": 1.0},
)
ANDROID_RTT = RadioKind(
    name="android_rtt",
    decoder=AndroidRttDecoder,
    title="Android Wi-Fi RTT, CSV of an app",
    gives="range",
    emitter="an access point with 802.11mc",
    transport="file",
    defaults={"range_sigma_m": 1.0},
)
