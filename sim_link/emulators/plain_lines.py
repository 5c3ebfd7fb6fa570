"""Radios that print lines of their program's: NDJSON, users' own, SX1280 sketches.

Sources: RADIO_RANGING as JSON (docs/messages.md has the fields); RadioLib and SX12XX-LoRa examples
(lines), Semtech's SX1280 data sheet (what a raw step is).
"""

from __future__ import annotations

import json
import math

from sim_link.emulators.emulator import Answer, Emulator, Round, clamped, lines
from sim_link.emulators.wifi import SIMULATION_BEGAN_S, round_trip_s

BANDWIDTH_HZ = 812_500.0
RAW_STEP_M = 150.0 / (4.096 * BANDWIDTH_HZ / 1e3)
"""Step of the ranging engine at that bandwidth."""


def ranging_object(answer: Answer, time_usec: int) -> dict[str, object]:
    """Return RADIO_RANGING as JSON: what is unknown is left out."""
    heard = answer.heard
    assert heard is not None
    bearing_rad = heard.bearing_body_rad
    if bearing_rad is None and heard.bearing_enu_rad is not None:
        bearing_rad = math.remainder(0.5 * math.pi - heard.bearing_enu_rad, 2.0 * math.pi)
    fields: dict[str, object] = {
        "emitter_id": answer.emitter_id,
        "time_usec": time_usec,
        "range": heard.range_m,
        "range_std": heard.range_sigma_m,
        "bearing": bearing_rad,
        "bearing_std": None if bearing_rad is None else heard.bearing_sigma_rad,
        "elevation": heard.elevation_rad,
        "elevation_std": None if heard.elevation_rad is None else heard.elevation_sigma_rad,
        "power_dbm": heard.power_dbm,
        "quality": None if heard.quality is None else round(100.0 * heard.quality),
        "body_frame": True if heard.bearing_body_rad is not None else None,
        "array_angle": heard.is_array_angle or None,
        "line_of_sight": heard.line_of_sight,
    }
    return {key: value for key, value in fields.items() if value is not None}


class Ndjson(Emulator):
    """Any program that prints an object a line, with all the digits that it has."""

    name = "ndjson"
    title = "generic NDJSON lines"
    gives = "range, azimuth, elevation"
    measures = "both"
    epoch_s = SIMULATION_BEGAN_S
    reports_north = True
    document = "/"

    def boot(self) -> bytes:
        """Return a comment line."""
        return b"# a program that prints what its radio measures\n"

    def encode(self, asked: Round) -> bytes:
        """Return a line for each that answered."""
        time_usec = round(1e6 * self.device_s(asked.sent_at_s))
        objects = [ranging_object(answer, time_usec) for answer in asked.heard]
        texts = [json.dumps(each, separators=(",", ":")) + "\n" for each in objects]
        return "".join(texts).encode()


class Lines(Emulator):
    """A sketch of a user's: address, metres, nanoseconds, share of the frames in percent."""

    name = "lines"
    title = "lines of one's own, `MAC,12.34 m, 82 ns, 90`"
    names = "{mac_capitals}"

    def encode(self, asked: Round) -> bytes:
        """Return a line for each that answered."""
        return lines([self._line(answer) for answer in asked.heard if answer.range_m is not None])

    def _line(self, answer: Answer) -> str:
        range_m = answer.range_m or 0.0
        rtt_ns, percent = round(1e9 * round_trip_s(range_m)), round(100.0 * answer.quality)
        name = self.name_on_wire(answer.emitter_id)
        return f"{name},{range_m:.2f} m, {rtt_ns} ns, {percent}"


def sx1280_valid(raw: int, rssi_dbm: int) -> str:
    """Return a register in hexadecimal, and its metres to one place."""
    rssi = f"RSSIReg,{clamped(-2.0 * rssi_dbm, 0, 255):X},RSSI,{rssi_dbm}dBm"
    return f"Valid,Register,{raw:X},Distance,{raw * RAW_STEP_M:.1f},{rssi}"


class Sx1280(Emulator):
    """A ranging master at 812.5 kHz, whose output has no names."""

    name = "sx1280"
    title = "Semtech SX1280, lines of the SX12XX-LoRa ranging master"
    names = ""
    most = 1
    rate_hz = 5.0

    def boot(self) -> bytes:
        """Return the banner, with the calibration in use."""
        return lines(["54_Ranging_Master Starting", "", "LoRa Device found", "Calibration,11350"])

    def encode(self, asked: Round) -> bytes:
        """Return a line in any case."""
        return lines([self._line(answer) for answer in asked.answers])

    def _line(self, answer: Answer) -> str:
        if answer.range_m is None:
            return "NotValid,Irq,8000"
        raw = clamped(answer.range_m / RAW_STEP_M, 0, (1 << 23) - 1)
        return sx1280_valid(raw, round(answer.power_dbm))
