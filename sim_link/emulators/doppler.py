"""Doppler direction finders: KN5R-RDF sentences, and rotaryclub's JSON.

Degrees clockwise from the array's zero, whatever is on the air; of noise the bearings are random
and their quality low.

Source: charlieh0tel/rotaryclub, `kn5r-format.md`, `src/output/kn5r.rs`, `src/output/json.rs`.
"""

from __future__ import annotations

import json
import math

import numpy as np

from sim_link.emulators.bearings import turned_rad
from sim_link.emulators.emulator import Answer, Emulator, Round, lines
from sim_link.emulators.wifi import SIMULATION_BEGAN_S

HISS_MAGNITUDE = 80
"""The most of 999 that is printed of an open squelch here; 99 % are below 100."""


def c_sentence(azimuth_deg: float, magnitude: int, tone_peak: int, epoch_ms: int) -> str:
    """Return a sentence of 26 characters, fixed width."""
    tenths = round(10.0 * azimuth_deg) % 3600
    return f"C{tenths:04d}{magnitude:03d}{tone_peak:03d}{epoch_ms:015d}"


class Kn5r(Emulator):
    """A sentence twenty times a second."""

    name = "doppler_kn5r"
    title = "Doppler direction finder, KN5R-RDF sentences"
    names = ""
    gives = "azimuth"
    antenna = "planar"
    measures = "bearing"
    rate_hz = 20.0
    most = 1
    epoch_s = SIMULATION_BEGAN_S

    def encode(self, asked: Round) -> bytes:
        """Return a sentence in any case."""
        epoch_ms = self.device_ms(asked.sent_at_s)
        return lines([self._sentence(answer, epoch_ms) for answer in asked.answers])

    def _sentence(self, answer: Answer, epoch_ms: int) -> str:
        if answer.azimuth_rad is None:
            azimuth_deg, magnitude = (
                self._rng.uniform(0.0, 360.0),
                self._rng.integers(HISS_MAGNITUDE),
            )
            return c_sentence(float(azimuth_deg), int(magnitude), 150, epoch_ms)
        azimuth_deg = math.degrees(turned_rad(answer)) % 360.0
        return c_sentence(azimuth_deg, round(999.0 * answer.quality), 640, epoch_ms)


class Rotaryclub(Kn5r):
    """rotaryclub with `--format json`: a line a bearing, tenths of a degree."""

    name = "doppler_json"
    title = "Doppler direction finder, rotaryclub's JSON"

    def _sentence(self, answer: Answer, epoch_ms: int) -> str:
        is_heard = answer.azimuth_rad is not None
        azimuth_deg = math.degrees(turned_rad(answer)) % 360.0
        if not is_heard:
            azimuth_deg = float(self._rng.uniform(0.0, 360.0))
        fields = {
            "ts": f"{np.datetime64(epoch_ms, 'ms')}Z",
            "bearing": round(azimuth_deg, 1),
            "raw": round(azimuth_deg, 1),
            "confidence": round(answer.quality if is_heard else 0.03, 2),
            "snr_db": 12.5 if is_heard else -14.0,
            "bearing_uncertainty_deg": None,
            "signal_strength": 0.71,
            "signal_present": is_heard,
            "resultant_length": 0.97 if is_heard else 0.02,
            "tone_peak": 0.64 if is_heard else 0.15,
            "lock_quality": 0.99,
            "phase_error_variance": 0.0004,
        }
        return json.dumps(fields, separators=(",", ":"))
