"""Radios whose lines have a few fixed forms, each a row: an expression and its fields.

The groups of an expression are named by the vocabulary of `companion.radios.fields`, so that units,
torn numbers and missing values are treated as in every text format. Another module of this kind is
a class of such rows and a record in `kinds.yaml`.

Sources: nrfconnect/sdk-nrf and zephyr, samples of Bluetooth channel sounding; REYAX, AT command
guide of the RYUW122; Ai-Thinker BU01 (M5Stack Unit UWB documentation) and BU03 (AT+DISTANCE);
pozyxLabs/Pozyx-Arduino-library `ready_to_range`, pozyxLabs/Pozyx-Python-library `pozyx_serial.py`;
Lora-net/SWSD003 `lr11xx/apps/rttof`; charlieh0tel/rotaryclub `kn5r-format.md` and `src/output`;
SiliconLabs `bt_cs_soc_initiator` and `bt_cs_host_initiator`; APRS 1.2c, appendix 1 (Agrelo).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import RadioReading
from companion.radios.fields import FieldDecoder, problem_of_spans
from companion.radios.wifi_ftm import MAC


@dataclass(frozen=True, slots=True)
class LineForm:
    """One form of a radio's lines."""

    pattern: re.Pattern[str]
    """Regular expression, each match of which is a reading; it needs named groups."""
    refused: str = ""
    """Reason why such a line cannot be used; empty if it can."""


def form(pattern: str, refused: str = "") -> LineForm:
    """Return the form of a pattern, its literal first, which `re` searches for without a try."""
    literal_first = re.sub(r"^\\b(\w+)(?![\w?*+{])", r"\1(?<=\\b\1)", pattern)
    return LineForm(re.compile(literal_first), refused)


class FormDecoder(FieldDecoder):
    """Decoder of lines of a few forms; the first that matches is used."""

    forms: ClassVar[tuple[LineForm, ...]]
    introduction: ClassVar[re.Pattern[str] | None] = None
    """Pattern of a line that identifies the module."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings of the first matching form."""
        if self.introduction is not None and self.introduction.search(line):
            self.counts.is_introduced = True
        for each in self.forms:
            if each.pattern.search(line) is None:
                continue
            if each.refused:
                return self.refused(each.refused)
            if not each.pattern.groups:
                return self.no_reading()
            found = each.pattern.finditer(line)
            return self.distinct([reading for match in found for reading in self._read(match)])
        return self.passed_over(line)

    def _read(self, match: re.Match[str]) -> list[RadioReading]:
        problem = problem_of_spans(match)
        return self.refused(problem) if problem else self.read_match(match.groupdict())

    def read_match(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a match; some radios complete the fields first."""
        return self.read_fields(fields)


_AT_STATUS = form(r"^(?:AT\+.*|\+?(?:OK|READY)|\+[A-Za-z_]{2,16}=[^,]*)\s*$")
"""Commands that are echoed, and answers to them that are not a measurement."""


class ChannelSoundingDecoder(FormDecoder):
    """Distances of Nordic's and Zephyr's samples by phases; those by round trips are metres off.

    Silicon Labs' initiators filter both, and print the address of the connection's reflector.
    """

    forms = (
        form(rf"\[(?P<handle>[0-9]{{1,3}})\] BT Address: (?P<peer>{MAC.pattern})\b"),
        form(
            r"(?:\[(?P<handle>[0-9]{1,3})\] |\b)Measurement (?:main mode )?result: "
            r"(?P<range_mm>[0-9]{1,10}) mm\b"
        ),
        form(
            r"\bMeasurement (?:(?:main|sub) mode )?(?:result|likeliness): |\bRSSI distance: "
            r"|\bRaw (?:main|sub) mode distance: |Ranging Counter = |Estimation in progress: "
        ),
        form(r"istance estimates on antenna path [1-9]: ifft: "),
        form(r"istance estimates on antenna path 0: ifft: (?P<range_m>-?[0-9.]{1,12}), phase_"),
        form(r"istance estimates: median: [0-9.]{1,12}m, update: (?P<range_m>-?[0-9.]{1,12})m\b"),
        form(r"Phase-Based Ranging method: (?P<range_m>-?[0-9.]{1,12}) meters"),
        form(r"(?:path 0: ifft:|Phase-Based Ranging method:) -?nan", "no distance by phases"),
        form(r"Round-Trip Timing method: "),
    )

    def begin(self) -> None:
        """Begin without connections."""
        super().begin()
        self._peers: dict[str, str] = {}

    def read_match(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a match, named by its connection's address or number if it has."""
        handle, peer = fields.get("handle"), fields.get("peer")
        if handle is not None and peer is not None:
            self._peers[handle] = peer
            return self.no_reading()
        if handle is None and self._peers:
            return self.refused("line without its connection")
        return self.read_fields({**fields, "emitter": self._peers.get(handle or "", handle)})


class TagOptions(Params, frozen=True):
    """Selects the tag that a module ranges to."""

    tag: str = ""
    """Address of up to 8 characters; empty: only unrequested output is read."""


class Ryuw122Decoder(FormDecoder):
    """Decoder of the REYAX RYUW122 as anchor: it queries one tag at a time, centimetres."""

    Options = TagOptions
    options: TagOptions
    forms = (
        form(
            r"\+ANCHOR_RCV= ?(?P<emitter>[^,]{1,12}),[0-9]{1,3},(?:(?!\+ANCHOR).){0,40},"
            r" ?0*(?P<range_cm>-?[0-9]{1,7}) ?cm(?:$|\s|, ?(?P<power_dbm>-[0-9]{1,3})?)"
        ),
        form(r"\+ANCHOR_RCV", "torn line"),
        form(r"\+TAG_RCV=", "a tag measures no distance: set the module here to the anchor's role"),
        form(r"\+ERR=[0-9]", "the module reports an error"),
        _AT_STATUS,
    )
    introduction = re.compile(r"\+VER=RYUW122")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        if not re.fullmatch(r"[!-+\--~]{0,8}", self.options.tag):
            raise ConfigError("ryuw122: tag: its AT+ADDRESS, up to 8 characters without a comma")

    def request(self) -> bytes:
        """Return the query of the tag, which it answers with the distance."""
        return f"AT+ANCHOR_SEND={self.options.tag},4,PING\r\n".encode() if self.options.tag else b""


class Bu01Decoder(FormDecoder):
    """Decoder of the Ai-Thinker BU01 as tag: a line per anchor, once ranging is switched on."""

    forms = (form(r"\ban(?P<emitter>[0-9]):\s?(?P<range_m>-?[0-9]{1,6}\.[0-9]+) ?m"), _AT_STATUS)

    def hello(self) -> bytes:
        """Switch ranging on, which is off after a reset."""
        return b"AT+switchdis=1\r\n"


class Bu03Decoder(FormDecoder):
    """Decoder of the Ai-Thinker BU03 and BU04, which report the distance when asked; metres."""

    forms = (
        form(r"\bdistance: ?(?P<range_m>-?[0-9]{1,6}\.[0-9]+)(?![0-9.])"),
        form(r"\bdistance:", "torn line"),
        form(r"^ERR(?:OR)?\b", "the module reports an error"),
        _AT_STATUS,
    )


class PozyxOptions(Params, frozen=True):
    """Selects the other Pozyx that is ranged to over USB."""

    tag: str = ""
    """Network id in hexadecimal, as printed on the device; empty: no requests are sent."""


class PozyxDecoder(FormDecoder):
    """Decoder of Pozyx by the lines of its Arduino sketches, or by queries over its USB port.

    The port answers a function with `D,`, its status, and its data: a range is u32 milliseconds,
    u32 millimetres and i16 dBm. The query reads the last range, and then requests a new one, so
    that after a failed ranging the previous range is repeated and skipped as a duplicate.
    """

    Options = PozyxOptions
    options: PozyxOptions
    forms = (
        form(
            r"(?P<time_ms>[0-9]{1,10}) ?ms, (?P<range_mm>[0-9]{1,10}) ?mm,"
            r" (?P<power_dbm>-?[0-9]{1,5}) ?dBm"
        ),
        form(
            r"(?P<emitter>0x[0-9A-Fa-f]{3,4}): (?P<range_mm>[0-9]{1,10})mm,"
            r" (?P<power_db>-?[0-9]{1,5})dB"
        ),
        form(r"^D,01(?P<data>[0-9A-Fa-f]{20})\s*$"),
        form(r"^ERROR: ranging|^D,00", "ranging failed"),
        form(r"^D,(?:[0-9A-Fa-f]{2}){0,9}\s*$"),
    )
    introduction = re.compile(r"^\s*D,43\s*$")  # the register WHO_AM_I
    GET_RANGE, DO_RANGING = "c7", "b5"

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        if not re.fullmatch(r"(?:(?:0[xX])?[0-9A-Fa-f]{4})?", self.options.tag):
            raise ConfigError("pozyx: tag: the network id on the other device, such as 0x6951")

    def request(self) -> bytes:
        """Return both queries about the configured device."""
        digits = self.options.tag[-4:].lower()
        if not digits:
            return b""
        swapped = digits[2:] + digits[:2]
        return f"F,{self.GET_RANGE},{swapped},11\rF,{self.DO_RANGING},{swapped},1\r".encode()

    def read_match(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a sketch's fields, or of an answer's bytes."""
        data = fields.get("data")
        if data is None:
            return self.read_fields(fields)
        raw = bytes.fromhex(data)
        time_ms, range_mm = (int.from_bytes(raw[at : at + 4], "little") for at in (0, 4))
        if not range_mm:
            return self.refused("no range yet")
        return self.understood(
            RadioReading(
                emitter=self.options.tag or None,
                device_time_s=time_ms / 1000.0,
                range_m=range_mm / 1000.0,
                power_dbm=float(int.from_bytes(raw[8:10], "little", signed=True)) or None,
            )
        )


class Lr11xxDecoder(FormDecoder):
    """Decoder of the ranging example in Semtech's SDK for the LR1110 and LR1120; whole metres."""

    forms = (
        form(
            r"RTToF result: Distance: (?P<range_m>-?[0-9]{1,10})m,"
            r" RSSI: (?P<power_dbm>-[0-9]{1,3})?"
        ),
        form(r"RTTOF request (?:timeout|discarded)", "no answer"),
    )


class DopplerDecoder(FormDecoder):
    """Decoder of Doppler direction finders: KN5R-RDF sentences, and other formats of rotaryclub.

    Degrees clockwise from the array's own zero. KN5R-RDF has no sentence for silence: its quality,
    the mean length of the phase vectors, drops to that of noise. Agrelo's `%BBB/Q`, which PicoDopp
    and others print, has whole degrees and a quality from 0 to 9.
    """

    forms = (
        form(r"^Bearing: .*(?:\[no signal\]|NO SIG)", "no signal"),
        form(r'"signal_present": ?false', "no signal"),
        form(r"^[0-9]{4}-[0-9]{2}-[^,]*Z?(?:,[^,]*){6},false,", "no signal"),
        form(
            r'"bearing":(?P<azimuth_deg>-?[0-9.]+),"raw":[^,]*,"confidence":(?P<quality>[0-9.]+),'
            r'"snr_db":[^,]*,"bearing_uncertainty_deg":(?:null|(?P<azimuth_sigma_deg>[0-9.]+)),'
        ),
        form(
            r"^Bearing: +(?P<azimuth_deg>-?[0-9.]+)\N{DEGREE SIGN} (?:(?!Bearing:).)*?"
            r"conf(?:idence)?: (?P<quality>[0-9.]+)"
        ),
        form(
            r"^[0-9]{4}-[0-9]{2}-[^,]*,(?P<azimuth_deg>-?[0-9.]+),[^,]*,(?P<quality>[0-9.]+),"
            r"[^,]*,(?P<azimuth_sigma_deg>[0-9.]*),[^,]*,true,"
        ),
        form(r"^C(?P<azimuth>[0-9]{4})(?P<magnitude>[0-9]{3})[0-9]{3}(?P<epoch>[0-9]{15})\s*$"),
        form(r"^%(?P<azimuth>[0-9]{3})/(?P<grade>[0-9])\s*$"),
        form(r"^[SBT][0-9]{10,}"),
    )
    MAX_MAGNITUDE, MAX_GRADE = 999.0, 9.0
    TENTHS = 10.0

    def read_match(self, fields: Mapping[str, str | None]) -> list[RadioReading]:
        """Return the reading of a match; a sentence's digits are tenths and thousandths."""
        if grade := fields.get("grade"):
            quality = f"{float(grade) / self.MAX_GRADE:.4f}"
            return self.read_fields({"azimuth_deg": f"{fields['azimuth']}.0", "quality": quality})
        if fields.get("epoch") is None:
            return self.read_fields(fields)
        azimuth, magnitude, epoch = (
            float(fields[name] or "nan") for name in ("azimuth", "magnitude", "epoch")
        )
        return self.read_fields(
            {
                "azimuth_deg": f"{azimuth / self.TENTHS:.1f}",
                "quality": f"{magnitude / self.MAX_MAGNITUDE:.4f}",
                "time_ms": f"{epoch:.0f}.0",
            }
        )
