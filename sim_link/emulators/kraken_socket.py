"""KrakenSDR's suite of 2026 by its web socket, as frames of RFC 6455 from the server.

A channel for each emitter, by its offset from the centre of the band. What it has found it repeats,
spectrum and all, while nothing is heard.

Source: krakenrf/krakensdr_suite, `kraken_doa_v2/NATIVE_APP_API.md`, `src/message_builders.cpp`.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import numpy.typing as npt

from sim_link.emulators.bearings import Kraken, frequency_hz
from sim_link.emulators.emulator import Answer, Round

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


def band_message(centre_hz: float) -> bytes:
    """Return the picture of the band: centre in MHz, then frequencies and two envelopes."""
    head = struct.pack("<3I3f2I", TYPE_BAND, 5, 4, centre_hz / 1e6, 40.2, 0.3, 0x80, BAND_BINS)
    frequencies = np.linspace(-1.2, 1.2, BAND_BINS) + centre_hz / 1e6
    return head + frequencies.astype("<f4").tobytes() + bytes(2 * BAND_BINS)


def spectrum_of(theta_deg: float, confidence: float, rng: np.random.Generator) -> Spectrum:
    """Return linear power by degree, counter-clockwise; its peak stands out by the confidence."""
    away_deg = (np.arange(ANGLES) - theta_deg + 180.0) % 360.0 - 180.0
    peak = np.exp(-0.5 * (away_deg / BEAM_DEG) ** 2)
    mean, ratio = float(peak.mean()), 1.0 + 3.0 * confidence
    floor = max(0.0, (1.0 - ratio * mean) / (ratio - 1.0)) if ratio > 1.0 else 1.0
    spectrum: Spectrum = (peak + floor) * (1.0 + 1e-6 * rng.standard_normal(ANGLES))
    return spectrum


class KrakenSocket(Kraken):
    """Frames of directions, the band beside each, and how the antennas stand."""

    name = "kraken_ws"
    title = "KrakenSDR suite of 2026, web socket"
    rate_hz = 5.0
    document = None
    socket = "/ws"

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._spectra: dict[int, Spectrum] = {}
        """Spectra by frequency."""

    def boot(self) -> bytes:
        """Return the messages that every client receives first."""
        texts = ('{"sync_cmd":"TOPOLOGY:UCA"}', '{"sync_cmd":"DOA:1"}')
        return b"".join(frame(TEXT, text.encode()) for text in texts)

    def encode(self, asked: Round) -> bytes:
        """Return all channels, new or not."""
        for answer in asked.heard:
            if answer.azimuth_rad is not None:
                self._spectra[frequency_hz(answer.emitter_id)] = self._spectrum(answer)
        channels = b"".join(map(self._channel, self._spectra.items()))
        count = len(self._spectra)
        directions = struct.pack("<2I", TYPE_DIRECTIONS, count) + channels
        band = frame(BINARY, band_message(CENTRE_HZ))
        return band + (frame(BINARY, directions) if count else b"")

    def _spectrum(self, answer: Answer) -> Spectrum:
        theta_deg = -math.degrees(answer.azimuth_rad or 0.0) % 360.0
        return spectrum_of(theta_deg, answer.quality, self._rng)

    def _channel(self, item: tuple[int, Spectrum]) -> bytes:
        hz, spectrum = item
        offset_khz = (hz - CENTRE_HZ) / 1e3
        number = list(self._spectra).index(hz)
        head = struct.pack("<IfIIfIf", number, offset_khz, 3, ANGLES, 0.2, 17, 1.0)
        return head + spectrum.astype("<f4").tobytes() + struct.pack("<I", 0)
