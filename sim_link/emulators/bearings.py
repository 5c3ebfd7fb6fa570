"""Direction finders: KrakenSDR by its two documents and its web socket, u-blox AoA lines.

A KrakenSDR reports the direction twice: clockwise in its table, counter-clockwise (theta) in its
XML. It distinguishes transmitters by frequency alone. The vehicle's heading is not included.

Its suite of 2026 has a web socket (frames of RFC 6455): a channel for each emitter, by its offset
from the centre of the band. It repeats its last result, including the spectrum, while nothing is
received.

Sources: krakenrf, krakensdr_doa `kraken_sdr_signal_processor.py`; u-blox, XPLR-AOA user guide
UBX-21004616; krakenrf/krakensdr_suite, `kraken_doa_v2/NATIVE_APP_API.md`,
`src/message_builders.cpp`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sim_link.emulators.emulator import (
    SIMULATION_BEGAN_S,
    Answer,
    Emulator,
    LineEmulator,
    Round,
    clamped,
    lines,
)

FIRST_HZ, CHANNEL_HZ = 433_920_000, 25_000
"""Frequency of emitter 0, and the steps to the next one, Hz."""
MAX_CONFIDENCE = 99.0
STATION = "S1"
RING = tuple(f"{0.5 + 0.5 * math.cos(math.radians(degree)):.2f}" for degree in range(360))
"""Power of a source at 0 degrees by direction, in degrees, as the receiver prints it."""


@dataclass(frozen=True, slots=True)
class KrakenDirection:
    """Direction found by one receiver of a KrakenSDR."""

    epoch_ms: int
    theta_deg: int
    """Counter-clockwise from the array's front, 0 to 359."""
    confidence: float
    power_db: float
    frequency_hz: int
    latency_ms: float = 0.0
    array: str = "UCA"

    @property
    def row(self) -> str:
        """Return the line of `DOA_value.html`, without its end."""
        head = [
            str(self.epoch_ms),
            str(360 - self.theta_deg),
            f"{self.confidence:.1f}",
            f"{self.power_db:.1f}",
            str(self.frequency_hz),
            self.array,
            f"{self.latency_ms:.1f}",
            STATION,
        ]
        position = ["0.0", "0.0", "0", "0", "GPS", "R", "R", "R", "R"]
        at = -self.theta_deg % 360
        return ", ".join([*head, *position, *RING[at:], *RING[:at]])

    @property
    def xml(self) -> str:
        """`doa.xml` of one receiver."""
        tags = {
            "STATION_ID": STATION,
            "TIME": self.epoch_ms,
            "GPS_TIME": 0,
            "FREQUENCY": f"{self.frequency_hz / 1e6:.6f}",
            "LOCATION": "<LATITUDE>0.0</LATITUDE><LONGITUDE>0.0</LONGITUDE>"
            "<HEADING>0</HEADING><SPEED>0</SPEED>",
            "DOA": self.theta_deg,
            "PWR": f"{self.power_db + 100.0:.1f}",
            "CONF": round(100.0 * self.confidence),
            "LATENCY": round(self.latency_ms),
            "PROCESSING_TIME": 60,
            "ADC_OVERDRIVE": 0,
            "NUM_CORRELATED_SOURCES": 1,
            "SNR_DB": f"{self.power_db + 60.0:.1f}",
        }
        inside = "".join(f"<{tag}>{value}</{tag}>" for tag, value in tags.items())
        return f'<?xml version="1.0" encoding="utf-8"?>\n<DATA>{inside}</DATA>\n'


class Kraken(Emulator):
    """Circular array of five whips; its table is unchanged while nothing is received."""

    name = "kraken"
    title = "KrakenSDR, DOA_value.html"
    antenna = "planar"
    measures = "bearing"
    rate_hz = 2.0
    document: ClassVar[str | None] = "/DOA_value.html"
    epoch_s = SIMULATION_BEGAN_S
    most = 16

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._found: dict[int, KrakenDirection] = {}

    def encode(self, asked: Round) -> bytes:
        """Return the whole document."""
        for answer in asked.heard:
            if answer.azimuth_rad is not None:
                found = self._direction(answer, asked)
                self._found[found.frequency_hz] = found
        epoch_ms = self.device_ms(asked.sent_at_s)
        return "".join(self.text_of(each, epoch_ms) for each in self._found.values()).encode()

    def text_of(self, found: KrakenDirection, epoch_ms: int) -> str:  # noqa: ARG002
        """Return the part of the document for a direction; the suite stamps it with the time."""
        return f"{found.row} \n"

    def _direction(self, answer: Answer, asked: Round) -> KrakenDirection:
        """Return the result; its time is the end, half the latency after the middle."""
        theta_deg = round(-math.degrees(answer.azimuth_rad or 0.0)) % 360
        confidence = max(MAX_CONFIDENCE * answer.quality, 1.0)
        return KrakenDirection(
            self.device_ms(asked.sent_at_s),
            theta_deg,
            confidence,
            max(-100.0, answer.power_dbm + 40.0),
            frequency_hz(answer.emitter_id),
            latency_ms=2e3 * asked.lag_s,
        )

    @classmethod
    def name_on_wire(cls, emitter_id: int) -> str:
        """Return the frequency in megahertz."""
        return f"{frequency_hz(emitter_id) / 1e6:g}"


class KrakenSuite(Kraken):
    """The suite of 2026: whole degrees, confidence to 1, time of the request, no latency.

    While nothing is heard its table repeats the last direction under a new time.
    """

    name = "kraken_suite"
    title = "KrakenSDR suite of 2026, DOA_value.html"

    def text_of(self, found: KrakenDirection, epoch_ms: int) -> str:
        """Return a row whose spectrum has the same noise as its result."""
        bearing_deg = (360 - found.theta_deg) % 360
        noise = np.random.default_rng(found.epoch_ms).uniform(0.0, 0.05, len(RING))
        spectrum = ", ".join(
            f"{10.0 * float(level) + extra:.2f}" for level, extra in zip(RING, noise, strict=True)
        )
        head = (
            f"{epoch_ms}, {bearing_deg}, {found.confidence / MAX_CONFIDENCE:.2f}, "
            f"{found.power_db:.1f}, "
            f"{found.frequency_hz}, {found.array}, 0, {STATION}"
        )
        return f"{head}, 0.000000, 0.000000, 0.0, 0.0, Compass, R, R, R, R, {spectrum} \n"


class KrakenXml(Kraken):
    """Bearings of the first emitter in the XML document of one receiver."""

    name = "kraken_xml"
    title = "KrakenSDR, doa.xml"
    document = "/doa.xml"
    most = 1

    def text_of(self, found: KrakenDirection, epoch_ms: int) -> str:  # noqa: ARG002
        """Return the whole document."""
        return found.xml


def frequency_hz(emitter_id: int) -> int:
    """Return the transmit frequency of an emitter, Hz."""
    return FIRST_HZ + CHANNEL_HZ * emitter_id


def uudf_line(tag: str, azimuth_deg: int, elevation_deg: int, rssi_dbm: int, tail: str) -> str:
    """Return `+UUDF:`; `tail` is everything from the second power on."""
    angles = f"{azimuth_deg},{elevation_deg}"
    return f"+UUDF:{tag},{rssi_dbm},{angles},{tail}"


class Uudf(LineEmulator):
    """A C209 board: whole degrees about its upright, right and up (0: unknown); no range."""

    name = "uudf"
    title = "u-blox C209 and ANNA-B4, +UUDF"
    names = "02000000{0:04X}"
    antenna = "planar"
    measures = "bearing"
    ANCHOR = "CCF9578E0D89"
    CHANNELS = (37, 38, 39)
    banner = lines(["+STARTUP"])

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return a line for a tag whose advertisement was heard, in front."""
        if answer.azimuth_rad is None or abs(answer.azimuth_rad) > 0.5 * math.pi:
            return []
        clock_ms = self.device_ms(asked.sent_at_s)
        angles = (turned_rad(answer), answer.elevation_rad or 0.0)
        azimuth_deg, elevation_deg = (clamped(math.degrees(angle), -90, 90) for angle in angles)
        rssi_dbm, number = round(answer.power_dbm), self.next_number()
        channel = self.CHANNELS[int(self._rng.integers(len(self.CHANNELS)))]
        tail = f'{rssi_dbm - 1},{channel},"{self.ANCHOR}","",{clock_ms},{number}'
        name = self.name_on_wire(answer.emitter_id)
        return [uudf_line(name, azimuth_deg, elevation_deg, rssi_dbm, tail)]


def turned_rad(answer: Answer) -> float:
    """Return the azimuth about the upright; the third component follows from the two arcsines."""
    azimuth_rad, heard = answer.azimuth_rad or 0.0, answer.heard
    if heard is None or not heard.is_array_angle:
        return azimuth_rad
    right, up = math.sin(azimuth_rad), math.sin(answer.elevation_rad or 0.0)
    return math.atan2(right, math.sqrt(max(0.0, 1.0 - right * right - up * up)))


CENTRE_HZ = 434_000_000.0
ANGLES = 360
BEAM_DEG = 5.0
"""Width of the peak."""
BAND_BINS = 64
TYPE_BAND, TYPE_DIRECTIONS = 0, 3
TEXT, BINARY = 0x81, 0x82
Spectrum = npt.NDArray[np.float64]


def frame(opcode: int, payload: bytes) -> bytes:
    """Return a whole message from a server: unmasked."""
    length = len(payload)
    if length < 126:
        return bytes([opcode, length]) + payload
    if length < 65_536:
        return bytes([opcode, 126]) + length.to_bytes(2, "big") + payload
    return bytes([opcode, 127]) + length.to_bytes(8, "big") + payload


def spectrum_of(theta_deg: float, confidence: float, rng: np.random.Generator) -> Spectrum:
    """Return linear power by degree, counter-clockwise; its peak stands out by the confidence."""
    away_deg = (np.arange(ANGLES) - theta_deg + 180.0) % 360.0 - 180.0
    peak = np.exp(-0.5 * (away_deg / BEAM_DEG) ** 2)
    mean, ratio = float(peak.mean()), 1.0 + 3.0 * confidence
    floor = max(0.0, (1.0 - ratio * mean) / (ratio - 1.0)) if ratio > 1.0 else 1.0
    spectrum: Spectrum = (peak + floor) * (1.0 + 1e-6 * rng.standard_normal(ANGLES))
    return spectrum


class KrakenSocket(Kraken):
    """Frames of directions, each with the band, and the antenna geometry."""

    name = "kraken_ws"
    title = "KrakenSDR suite of 2026, web socket"
    rate_hz = 5.0
    document = None
    socket = "/ws"
    banner = frame(TEXT, b'{"sync_cmd":"TOPOLOGY:UCA"}') + frame(TEXT, b'{"sync_cmd":"DOA:1"}')

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._spectra: dict[int, Spectrum] = {}

    def encode(self, asked: Round) -> bytes:
        """Return all channels, new or not."""
        for answer in asked.heard:
            if answer.azimuth_rad is not None:
                theta_deg = -math.degrees(answer.azimuth_rad) % 360.0
                spectrum = spectrum_of(theta_deg, answer.quality, self._rng)
                self._spectra[frequency_hz(answer.emitter_id)] = spectrum
        channels = b"".join(map(self._channel, self._spectra.items()))
        count = len(self._spectra)
        directions = struct.pack("<2I", TYPE_DIRECTIONS, count) + channels
        head = struct.pack("<3I3f2I", TYPE_BAND, 5, 4, CENTRE_HZ / 1e6, 40.2, 0.3, 0x80, BAND_BINS)
        frequencies = np.linspace(-1.2, 1.2, BAND_BINS) + CENTRE_HZ / 1e6
        band = frame(BINARY, head + frequencies.astype("<f4").tobytes() + bytes(2 * BAND_BINS))
        return band + (frame(BINARY, directions) if count else b"")

    def _channel(self, item: tuple[int, Spectrum]) -> bytes:
        hz, spectrum = item
        offset_khz = (hz - CENTRE_HZ) / 1e3
        number = list(self._spectra).index(hz)
        head = struct.pack("<IfIIfIf", number, offset_khz, 3, ANGLES, 0.2, 17, 1.0)
        return head + spectrum.astype("<f4").tobytes() + struct.pack("<I", 0)
