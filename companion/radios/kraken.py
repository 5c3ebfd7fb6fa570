"""KrakenSDR: the bearing to any transmitter, from the two files of its web server.

`DOA_value.html` is one line a channel, `doa.xml` one document of the first channel. Both have the
angle about the array, without any heading: the lines clockwise from its front, the document
counter-clockwise. Source: krakenrf/krakensdr_doa, `kraken_sdr_signal_processor.py`; krakensdr_docs.

Invalid files are detected here, because no later stage can: the files stay unchanged while no
emitter transmits, they are written in place while they are read, and a receiver that has just been
tuned returns nonsense.
"""

from __future__ import annotations

import math
import re
import zlib
from dataclasses import dataclass
from typing import Annotated

import msgspec

from companion.domain import Params
from companion.radios.decoder import LineDecoder, RadioDecoder, RadioReading
from companion.radios.fields import columns, number

HEAD_FIELDS = 17
POWERS = 360
"""Fields after those: the power seen in each degree."""
BEST_CONFIDENCE = 99.0
OLD_CONFIDENCE = 2.0
"""Largest confidence that firmware of 2022 and 2023 reports."""
FIRST_EPOCH_MS, LAST_EPOCH_MS = 1.0e12, 1.0e13
"""Range of a clock that has been set: 2001 to 2286."""
LONGEST_CPI_MS = 60_000.0
AWAY_MS = 10_000.0
"""Time after which a frequency that is missing while another is heard counts as not tuned."""
STILL_S = 5.0
"""Time without a change after which a page is reported; it is read more often than it changes."""
MIN_HZ = 1e6
"""Lowest plausible frequency: receivers begin at 24 MHz, so a smaller number has another unit."""
MAX_CHANNELS = 64
OVERDRIVEN = {"1", "true"}
HEADINGS = {"GPS", "Compass"}
"""Sources of the heading; `Compass` since the suite of 2026."""
MARKS = len(b"<DATA>") + len(b"</DATA>")


class KrakenOptions(Params, frozen=True):
    """Conditions under which a KrakenSDR's results are used."""

    min_confidence: Annotated[float, msgspec.Meta(ge=0.0, le=BEST_CONFIDENCE)] = 10.0
    """Minimum confidence, of 99; below it the direction is noise."""
    best_confidence: Annotated[float, msgspec.Meta(gt=0.0, le=BEST_CONFIDENCE)] | None = None
    """The scale that the receiver reports on; null: 99, or 1 of the suite of 2026. Firmware of 2022
    and 2023 reports 0.4 to 2: set 2."""
    settle_s: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 2.0
    """Time for which a new frequency is not used: tuning, calibration."""
    accept_line_array: bool = False
    """True to use a line array's bearing although it cannot distinguish front from back."""


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one channel."""

    time_ms: float
    """Time of the end of the integration."""
    azimuth_deg: float
    confidence: float
    frequency_hz: float
    latency_ms: float
    is_line_array: bool = False
    is_overdriven: bool = False
    checksum: int | None = None
    """Checksum of the fields that are measured, for the suite of 2026, whose time is that of the
    request; it stays the same while the squelch is closed. None: an earlier suite, or `doa.xml`."""

    @property
    def name(self) -> str:
        """Return the frequency in whole hertz."""
        return f"{self.frequency_hz:.0f}"


@dataclass(slots=True)
class _Channel:
    last_ms: float
    heard_s: float
    """Time of its first arrival, on the companion's clock."""
    valid_from_ms: float
    checksum: int | None = None
    is_parallel: bool = False
    """True if another frequency had a result of the same time: no tuning between them."""


class _Channels:
    """Last result of each frequency, against repeated and early results."""

    def __init__(self, settle_s: float) -> None:
        self._settle_ms = 1000.0 * settle_s
        self._seen: dict[str, _Channel] = {}

    def unchanged_s(self, result: Result, now_s: float) -> float | None:
        """Return for how long a frequency has had the same result; None if the result is new."""
        before = self._seen.get(result.name)
        if before is None:
            return None
        is_same = result.time_ms == before.last_ms
        if result.checksum is not None:
            is_same = result.checksum == before.checksum
        return now_s - before.heard_s if is_same else None

    def problem_of(self, result: Result, now_s: float) -> str | None:
        """Return the reason not to use a new result of a frequency, or None."""
        name, time_ms = result.name, result.time_ms
        channel = self._next(self._seen.pop(name, None), time_ms, now_s)
        channel.checksum = result.checksum
        self._seen[name] = channel
        if len(self._seen) > MAX_CHANNELS:
            del self._seen[next(iter(self._seen))]
        return "just tuned to this frequency" if time_ms < channel.valid_from_ms else None

    def _next(self, before: _Channel | None, time_ms: float, now_s: float) -> _Channel:
        """Return the channel's next state; a frequency is new after another was received."""
        others = self._seen.values()
        beside = [one for one in others if one.last_ms == time_ms]
        for one in beside:
            one.is_parallel = True
        is_parallel = bool(beside) or (before is not None and before.is_parallel)
        if before is None:
            start_ms = time_ms + (self._settle_ms if others else 0.0)
            if beside:
                start_ms = max(one.valid_from_ms for one in beside)
        elif time_ms < before.last_ms:  # the clock was set back
            start_ms = time_ms
        elif is_parallel or time_ms - before.last_ms <= AWAY_MS:
            start_ms = before.valid_from_ms
        else:
            is_replaced = any(one.last_ms > before.last_ms for one in others)
            start_ms = time_ms + (self._settle_ms if is_replaced else 0.0)
        return _Channel(time_ms, now_s, start_ms, is_parallel)


class KrakenDecoder(RadioDecoder):
    """Base of the KrakenSDR decoders: selects new results of sufficient quality."""

    Options = KrakenOptions
    options: KrakenOptions
    may_be_unsettled = True
    """True if results may be from a receiver that was being tuned."""

    def begin(self) -> None:
        """Begin without channels: another receiver may answer next."""
        super().begin()
        self._channels = _Channels(self.options.settle_s if self.may_be_unsettled else 0.0)

    def readings_of(self, result: Result | str, now_s: float) -> list[RadioReading]:
        """Return the reading of a result, if it is new and good enough; else count the reason."""
        self.counts.frames += 1
        if isinstance(result, Result):
            unchanged_s = self._channels.unchanged_s(result, now_s)
            if unchanged_s is not None and unchanged_s < STILL_S:
                return []
            problem: str | None = "page does not change: no transmission"
            if unchanged_s is None:
                problem = self._problem_of(result, now_s)
        else:
            problem = result
        if problem is not None:
            self.counts.refuse(problem)
            return []
        assert isinstance(result, Result)
        return [
            RadioReading(
                emitter=f"{result.frequency_hz / 1e6:.4f}",
                device_time_s=None
                if result.checksum is not None
                else (result.time_ms - result.latency_ms / 2.0) / 1000.0,
                azimuth_rad=math.radians(result.azimuth_deg),
                quality=min(self._quality(result), 1.0),
            )
        ]

    def _quality(self, result: Result) -> float:
        best = self.options.best_confidence
        if best is None:
            best = BEST_CONFIDENCE if result.checksum is None else 1.0
        return result.confidence / best

    def _problem_of(self, result: Result, now_s: float) -> str | None:
        if not FIRST_EPOCH_MS <= result.time_ms <= LAST_EPOCH_MS:
            return "time is none"
        if not 0.0 <= result.latency_ms <= LONGEST_CPI_MS:
            return "latency is out of bounds"
        if not 0.0 <= result.azimuth_deg <= 360.0:
            return "bearing is out of bounds"
        if not MIN_HZ < result.frequency_hz < 1e11:
            return "frequency is out of bounds"
        tuned = self._channels.problem_of(result, now_s)
        if tuned is not None:
            return tuned
        if result.is_overdriven:
            return "receiver is overdriven"
        if result.is_line_array and not self.options.accept_line_array:
            return "line array: front or back is not known"
        if self._quality(result) * BEST_CONFIDENCE >= self.options.min_confidence:
            return None
        if self.options.best_confidence is None and result.confidence <= OLD_CONFIDENCE:
            return "low confidence (firmware of 2022 or 2023? then set best_confidence to 2)"
        return "low confidence"


class KrakenLinesDecoder(KrakenDecoder, LineDecoder):
    """Decoder of `DOA_value.html`: a line a channel of 17 fields, and the power of each degree."""

    longest_line = 16_384
    has_stamps = False

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of one channel's line; a torn one has another number of fields."""
        cells = columns(line.rstrip(" ,"))
        if len(cells) < 2:
            self.counts.pass_over(line)
            return []
        return self.readings_of(_result_of_cells(cells), received_s)


def _result_of_cells(cells: list[str]) -> Result | str:
    if len(cells) not in (HEAD_FIELDS, HEAD_FIELDS + POWERS) or cells[12] not in HEADINGS:
        return "torn line"
    time_ms, azimuth_deg, confidence, power_db, frequency_hz = map(number, cells[:5])
    latency_ms = number(cells[6])
    if time_ms is None or azimuth_deg is None or confidence is None or power_db is None:
        return "torn line"
    if frequency_hz is None or latency_ms is None:
        return "torn line"
    is_suite = cells[6] == "0"  # earlier ones print a measured latency, with its decimals
    return Result(
        time_ms,
        azimuth_deg,
        confidence,
        frequency_hz,
        latency_ms,
        is_line_array=cells[5] == "ULA",
        checksum=zlib.crc32(",".join(cells[1:]).encode()) if is_suite else None,
    )


class KrakenXmlDecoder(KrakenDecoder):
    """Decoder of `doa.xml`: one document of the first channel; its angle is counter-clockwise."""

    longest_document = 8192
    _ELEMENT = re.compile(r"<([A-Z_]{2,32})>\s*([^<>]{1,40}?)\s*</\1>")

    def begin(self) -> None:
        """Begin without a partial document."""
        super().begin()
        self._rest = b""

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        """Cut into documents, from `<DATA>` to `</DATA>`, and read each."""
        readings: list[RadioReading] = []
        *documents, self._rest = (self._rest + data).split(b"</DATA>")
        for document in documents:
            readings += self._read(document, received_s)
        excess = len(self._rest) - self.longest_document - MARKS
        if excess > 0:
            self.counts.resync_bytes += excess
            self._rest = self._rest[excess:]
        self.counts.readings += len(readings)
        return readings

    def _read(self, document: bytes, now_s: float) -> list[RadioReading]:
        before, start, body = document.rpartition(b"<DATA>")
        is_one = bool(start) and len(body) <= self.longest_document
        self.counts.resync_bytes += len(before if is_one else document)
        if not is_one:
            return []
        text = body.decode("utf-8", errors="replace")
        return self.readings_of(_result_of_elements(dict(self._ELEMENT.findall(text))), now_s)


def _result_of_elements(elements: dict[str, str]) -> Result | str:
    time_ms, theta_deg = number(elements.get("TIME")), number(elements.get("DOA"))
    confidence = number(elements.get("CONF"))
    frequency_mhz = number(elements.get("FREQUENCY"))
    latency_ms = number(elements.get("LATENCY", "0"))  # programs that speak DF-Aggregator send none
    if time_ms is None or theta_deg is None or confidence is None:
        return "torn document"
    if frequency_mhz is None or latency_ms is None:
        return "torn document"
    return Result(
        time_ms,
        theta_deg,
        confidence / 100.0,
        frequency_mhz * 1e6,
        latency_ms,
        is_overdriven=elements.get("ADC_OVERDRIVE", "0").lower() in OVERDRIVEN,
    )
