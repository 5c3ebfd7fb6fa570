"""Timing advance of base stations: srsRAN_4G, srsRAN Project and OpenAirInterface.

A phone that attaches sends a preamble, and the station answers by how much earlier to send: the
round trip, in steps. That is an absolute range. Later measurements of the station are only the
deviation from the commanded advance, and are refused.

Sources: 3GPP TS 36.211 and 38.211 (Ts = 1/30.72 MHz; a step of 16 Ts, halved with each numerology);
srsran/srsRAN_4G and srsran/srsRAN_Project logs and metrics; OAI's `[RAPROC]` lines.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import RadioReading
from companion.radios.fields import ONE_WAY_M_PER_S, FieldDecoder, number

LTE_STEP_S = 16.0 / 30.72e6
MAX_STEPS = 3846
"""Largest timing advance of a random access response, TS 38.213 4.2."""
RESOLUTION_OF_PHY_LOG_M = 0.1e-6 * ONE_WAY_M_PER_S
MAX_UES = 64

Numerology = Annotated[int, msgspec.Meta(ge=0, le=4)]
Metres = Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)]


class CellOptions(Params, frozen=True):
    """Properties of the cell that a station's log lacks."""

    multipath_sigma_m: Metres = 20.0
    """Sigma of the site's detours, in quadrature to the step's own; 10 to 50 m are usual."""
    offset_steps: Annotated[float, msgspec.Meta(ge=-100.0, le=MAX_STEPS)] = 0.0
    """Steps that the station reports of a phone next to its antenna: the delay of its radio."""
    name: Literal["rnti", "none"] = "rnti"
    """Name of the emitter: the station's number for the phone, which changes with each attach;
    `none`: any phone that answers is the configured emitter."""


class SrsRan4gOptions(CellOptions, frozen=True):
    """Selects one of the two logs of an attach."""

    log: Literal["mac", "phy"] = "mac"
    """`RACH:` lines of the console or MAC log, in steps; `PRACH:` lines of the PHY log, finer."""


class NrOptions(CellOptions, frozen=True):
    """Properties of the station's carrier."""

    numerology: Numerology | None = None
    """Numerology of the carrier: 0 is 15 kHz, 1 is 30 kHz, and so on; null: by the log."""


class SrsRanOptions(NrOptions, frozen=True):
    """Selects the metrics of srsRAN Project that are used as a range."""

    loop_is_off: bool = False
    """True if the station corrects no timing after the attach: `ta_cmd_offset_threshold` below 0.
    Otherwise `ta_ns` is only the remainder, and no range."""
    applied_steps: Annotated[int, msgspec.Meta(ge=0, le=MAX_STEPS)] = 0
    """The timing advance that the phone was given with the attach, in steps; `ta_ns` adds to it."""


class _Cell(FieldDecoder):
    """Common part of the stations' decoders."""

    Options = CellOptions
    options: CellOptions

    def reading(
        self, range_m: float, step_m: float, rnti: int | None = None, time_s: float | None = None
    ) -> RadioReading:
        """Return a range that is uniform within a step, plus the detours of the site."""
        return RadioReading(
            emitter=None if rnti is None or self.options.name == "none" else f"0x{rnti:x}",
            device_time_s=time_s,
            range_m=range_m - self.options.offset_steps * step_m,
            range_sigma_m=math.hypot(step_m / math.sqrt(12.0), self.options.multipath_sigma_m),
        )

    def of_steps(self, steps: int, step_m: float, rnti: int | None = None) -> list[RadioReading]:
        """Return the middle of the step, because the station rounds down."""
        if not 0 <= steps <= MAX_STEPS:
            return self.refused("timing advance is out of bounds")
        return self.understood(self.reading((steps + 0.5) * step_m, step_m, rnti))


def step_m(numerology: int = 0) -> float:
    """Return the one-way distance of one step of the timing advance, metres."""
    return LTE_STEP_S * ONE_WAY_M_PER_S / float(2**numerology)


class SrsRan4gDecoder(_Cell):
    """Decoder of srsRAN_4G (LTE): `RACH:` lines of the console, `PRACH:` lines of the PHY log."""

    Options = SrsRan4gOptions
    options: SrsRan4gOptions
    _RACH = re.compile(r"RACH: .*?\boffset=([0-9]{1,6}), temp_crnti=0x([0-9A-Fa-f]{1,4})")
    _PRACH = re.compile(r"PRACH: .*?\boffset=(-?[0-9]{1,5}\.[0-9]+) us\b")
    _MOST = re.compile(r"\bmax_offset=([0-9]{1,5}\.[0-9]+) us\b")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the range of an attach."""
        if self.options.log == "mac" and (found := self._RACH.search(line)):
            return self.of_steps(int(found[1]), step_m(), int(found[2], 16))
        if self.options.log == "phy" and (found := self._PRACH.search(line)):
            most = self._MOST.search(line)
            if most is not None and float(found[1]) > float(most[1]):
                return self.refused("offset is beyond max_offset")
            delay_m = step_m() * self.options.offset_steps
            range_m = float(found[1]) * 1e-6 * ONE_WAY_M_PER_S - delay_m
            reading = self.reading(0.0, RESOLUTION_OF_PHY_LOG_M)
            return self.understood(replace(reading, range_m=range_m))
        return self.passed_over(line)


class SrsRanDecoder(_Cell):
    """Decoder of srsRAN Project (5G): metrics, a JSON document a line, and `RACH ind` log lines."""

    Options = SrsRanOptions
    options: SrsRanOptions
    longest_line = 60_000
    _RACH = re.compile(r"RACH ind: ")
    _PREAMBLE = re.compile(
        r"tc-rnti=0x([0-9A-Fa-f]{1,4})\b[^:]{0,80}?\bTA=(-?[0-9.]{1,20}(?:e-?[0-9]{1,2})?)s"
    )

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        known = self.options.numerology
        steps = self.options.applied_steps or self.options.offset_steps
        if known is None and steps:
            raise ConfigError("srsran: numerology: steps need it; 0: 15 kHz, 1: 30 kHz, ...")
        self._step_m = step_m(known or 0)

    def hello(self) -> bytes:
        """Return the request for metrics on the station's web socket."""
        return b'{"cmd":"metrics_subscribe"}\n'

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings of a metrics document or a log line."""
        if self._RACH.search(line):
            return self._attaches(line)
        start = line.find("{")
        if start < 0 or '"cells"' not in line:
            return self.passed_over(line)
        try:
            document = json.loads(line[start:])
        except (ValueError, RecursionError):
            return self.refused("not JSON")
        return self._metrics(document)

    def _attaches(self, line: str) -> list[RadioReading]:
        readings = []
        for rnti, seconds in self._PREAMBLE.findall(line):
            value = number(seconds)
            if value is None or not 0.0 <= value <= MAX_STEPS * LTE_STEP_S:
                return self.refused("timing advance is out of bounds")
            range_m = value * ONE_WAY_M_PER_S
            readings.append(self.reading(range_m, self._step_m, int(rnti, 16)))
        if not readings:
            return self.refused("torn line")
        self.counts.frames += 1
        return readings

    def _metrics(self, document: object) -> list[RadioReading]:
        if not isinstance(document, dict):
            return self.refused("not a document of metrics")
        self.counts.frames += 1
        time_s = _finite(document.get("timestamp"))
        readings = []
        for cell in _list_in(document, "cells"):
            for ue in _list_in(cell, "ue_list"):
                reading = self._ue(ue, time_s)
                if reading is not None:
                    readings.append(reading)
        return readings[:MAX_UES]

    def _ue(self, ue: object, time_s: float | None) -> RadioReading | None:
        if not isinstance(ue, dict):
            return None
        residual_ns, rnti = _finite(ue.get("ta_ns")), _finite(ue.get("rnti"))
        if residual_ns is None or residual_ns == 0.0:
            self.counts.refuse("not observed")
            return None
        if not self.options.loop_is_off:
            self.counts.refuse("residual: the station corrects the timing (loop_is_off)")
            return None
        if abs(residual_ns) > MAX_STEPS * LTE_STEP_S * 1e9 or rnti is None or rnti % 1.0:
            self.counts.refuse("timing advance is out of bounds")
            return None
        range_m = residual_ns * 1e-9 * ONE_WAY_M_PER_S + self.options.applied_steps * self._step_m
        return self.reading(range_m, self._step_m, int(abs(rnti)) & 0xFFFF, time_s)


def _list_in(value: object, key: str) -> list[object]:
    found = value.get(key) if isinstance(value, dict) else None
    return found if isinstance(found, list) else []


def _finite(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        as_float = float(value)
    except OverflowError:
        return None
    return as_float if math.isfinite(as_float) else None


class OaiDecoder(_Cell):
    """Decoder of OpenAirInterface: attach lines in a gNB's log, and an eNB's `[RAPROC]` lines.

    Since 2024 a gNB prints the distance with the answer to the preamble, rounded to the nearest
    step; then the preamble's own line, which came before it, is the same attach and is not used.
    The first preamble waits for its answer, which may contradict the configured numerology.
    """

    Options = NrOptions
    options: NrOptions
    _RAPROC = re.compile(
        r"Initiating RA procedure with preamble [0-9]{1,3}, energy -?[0-9.]{1,12} dB"
        r"(?: \(I0 -?[0-9.]{1,9}, thres -?[0-9.]{1,9}\))?, delay ([0-9]{1,6})( start symbol)?"
    )
    _ANSWER = re.compile(
        r"timing_offset = ([0-9]{1,6}) \(estimated distance ([0-9]{1,7}\.?[0-9]*) \[m\]\)"
    )
    _ANSWERS = "Generating RA-Msg2 DCI"
    AGREEMENT = 0.05
    """Tolerance in steps: the log's own value is 0.1 % off, steps of numerologies differ by 2."""

    def begin(self) -> None:
        """Begin without the format of the log, because another run may follow."""
        super().begin()
        self._numerology = self.options.numerology
        self._has_distances: bool | None = None
        """True if answers have the distance; None if there was none yet."""
        self._first_steps: int | None = None
        """Delay of a first preamble that has no answer yet."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the range of an attach; only a gNB's line names a start symbol."""
        if found := self._ANSWER.search(line):
            self._has_distances = True
            return self._answer(int(found[1]), float(found[2]))
        if self._ANSWERS in line and self._has_distances is None and self._first_steps is not None:
            self._has_distances = False
            return self.of_steps(self._first_steps, step_m(self._numerology or 0))
        found = self._RAPROC.search(line)
        if not found:
            return self.passed_over(line)
        if self._has_distances:
            return self.no_reading()
        if not found[2]:
            return self.of_steps(int(found[1]), step_m())
        if self._numerology is None:
            return self.refused("numerology is unknown: set it, 0 for 15 kHz, 1 for 30 kHz")
        steps = int(found[1])
        if self._has_distances is None and self._first_steps is None and steps <= MAX_STEPS:
            self._first_steps = steps
            return self.refused("first attach waits for its answer")
        self._has_distances = False
        return self.of_steps(steps, step_m(self._numerology))

    def _answer(self, steps: int, distance_m: float) -> list[RadioReading]:
        if steps > MAX_STEPS:
            return self.refused("timing advance is out of bounds")
        if steps:
            ratio = distance_m / (steps * step_m())
            fitting = [n for n in range(5) if abs(ratio * 2**n - 1.0) <= self.AGREEMENT]
            if not fitting:
                return self.refused("distance and timing offset do not agree")
            if self.options.numerology not in (None, fitting[0]):
                return self.refused(f"the log is of numerology {fitting[0]}: set it")
            self._numerology = fitting[0]
        step = step_m(self._numerology or 0)
        return self.understood(self.reading(steps * step, step))
