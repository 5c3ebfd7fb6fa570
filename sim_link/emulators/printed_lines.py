"""Radios that print lines of text: sketches and kits, NDJSON, users' own, Doppler finders.

A direction finder gives degrees clockwise from the array's zero, whatever is on the air; of noise
the bearings are random and their quality low.

Sources: RADIO_RANGING as JSON (docs/wire.md names the fields); RadioLib and SX12XX-LoRa examples
(lines), Semtech's SX1280 data sheet (what a raw step is); Decawave, TREK1000 user manual; Nordic,
sample `channel_sounding_ras_initiator`; Silicon Labs, JSON of `bt_aoa_host_locator` as a subscriber
prints it with its topic; M5Stack, Unit UWB; pozyxLabs, Pozyx-Arduino-library `ready_to_range`;
Lora-net, SWSD003 `main_rttof.c`; charlieh0tel/rotaryclub, `kn5r-format.md`, `src/output/kn5r.rs`,
`src/output/json.rs`.
"""

from __future__ import annotations

import json
import math

import numpy as np

from sim_link.emulators.bearings import turned_rad
from sim_link.emulators.emulator import (
    SIMULATION_BEGAN_S,
    Answer,
    Emulator,
    LineEmulator,
    RangeLines,
    Round,
    clamped,
    lines,
)

BANDWIDTH_HZ = 812_500.0
RAW_STEP_M = 150.0 / (4.096 * BANDWIDTH_HZ / 1e3)
"""Step of the ranging engine at that bandwidth."""


def ranging_object(answer: Answer, time_usec: int) -> dict[str, object]:
    """Return RADIO_RANGING as JSON without unknown values."""
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
    measures = "both"
    epoch_s = SIMULATION_BEGAN_S
    reports_north = True
    document = "/"
    banner = b"# a program that prints what its radio measures\n"

    def encode(self, asked: Round) -> bytes:
        """Return a line for each that answered."""
        time_usec = round(1e6 * self.device_s(asked.sent_at_s))
        objects = [ranging_object(answer, time_usec) for answer in asked.heard]
        texts = [json.dumps(each, separators=(",", ":")) + "\n" for each in objects]
        return "".join(texts).encode()


class Lines(RangeLines):
    """A sketch of a user's: address, metres, nanoseconds, share of the frames in percent."""

    name = "lines"
    title = "lines of one's own, `MAC,12.34 m, 82 ns, 90`"
    names = "{mac_capitals}"
    line = "{name},{range_m:.2f} m, {rtt_ns} ns, {percent}"


def sx1280_valid(raw: int, rssi_dbm: int) -> str:
    """Return a register in hexadecimal, and its metres to one decimal."""
    rssi = f"RSSIReg,{clamped(-2.0 * rssi_dbm, 0, 255):X},RSSI,{rssi_dbm}dBm"
    return f"Valid,Register,{raw:X},Distance,{raw * RAW_STEP_M:.1f},{rssi}"


class Sx1280(RangeLines):
    """A ranging master at 812.5 kHz, whose output has no names."""

    name = "sx1280"
    title = "Semtech SX1280, lines of the SX12XX-LoRa ranging master"
    names = ""
    most = 1
    rate_hz = 5.0
    banner = lines(["54_Ranging_Master Starting", "", "LoRa Device found", "Calibration,11350"])
    silence = ("NotValid,Irq,8000",)

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:  # noqa: ARG002
        """Return the valid result of a range, whose register is never negative."""
        raw = clamped(range_m / RAW_STEP_M, 0, (1 << 23) - 1)
        return [sx1280_valid(raw, round(answer.power_dbm))]


TAGS = 8


class Trek1000(RangeLines):
    """Anchor 0 of a kit and its tags, whole millimetres; raw reports next to the corrected."""

    name = "trek1000"
    title = "Decawave TREK1000, mc reports"
    ids = range(TAGS)
    most = TAGS

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:
        """Return both reports of a tag."""
        range_mm = max(0, round(1e3 * range_m))
        sequence = self.next_number()
        rest = " ".join(["00000000"] * 3)  # anchors 1 to 3 are not there
        report = (
            f"mc 01 {range_mm:08x} {rest} {sequence & 0xFFFF:04x} {sequence & 0xFF:02x} "
            f"{clock_ms & 0xFFFFFFFF:08x} a{answer.emitter_id}:0"
        )
        return [report.replace("mc", "mr", 1), report]


class ChannelSounding(RangeLines):
    """Nordic's initiator, one reflector; two antenna paths."""

    name = "channel_sounding"
    title = "Nordic channel sounding, RAS initiator"
    names = ""
    rate_hz = 5.0
    most = 1
    banner = lines(["*** Booting nRF Connect SDK v3.0.1 ***", "I: Starting initiator sample"])

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:  # noqa: ARG002
        """Return a line for each antenna path."""
        return [
            f"I: Distance estimates on antenna path {path}: ifft: {range_m:.6f}, "
            f"phase_slope: {range_m + 0.4:.6f}, rtt: {range_m + 1.9:.6f}"
            for path in range(2)
        ]


class SilabsAoa(Emulator):
    """A locator upright: degrees about it, to the right and upwards, hundredths."""

    name = "silabs_aoa"
    title = "Silicon Labs AoA, JSON by MQTT"
    names = "02000000{0:04X}"
    antenna = "planar"
    measures = "bearing"

    def encode(self, asked: Round) -> bytes:
        """Return an object for each tag, over its lines."""
        heard = [answer for answer in asked.heard if answer.azimuth_rad is not None]
        return b"".join(self._object(answer) for answer in heard)

    def _object(self, answer: Answer) -> bytes:
        azimuth_deg = math.degrees(turned_rad(answer))
        elevation_deg = math.degrees(answer.elevation_rad or 0.0)
        topic = (
            f"silabs/aoa/angle/ble-pd-0C4314F46B2D/ble-pd-{self.name_on_wire(answer.emitter_id)}"
        )
        return lines(
            [
                f"{topic} {{",
                f'\t"azimuth":\t{azimuth_deg:.2f},',
                '\t"azimuth_stdev":\t5.00,',
                f'\t"elevation":\t{elevation_deg:.2f},',
                '\t"elevation_stdev":\t5.00,',
                '\t"distance":\t0.04,',
                f'\t"sequence":\t{self.next_number(65536)}',
                "}",
            ]
        )


class Bu01(RangeLines):
    """An Ai-Thinker BU01 in the tag's role: a line an anchor, whole centimetres."""

    name = "bu01"
    title = "Ai-Thinker BU01, M5Stack Unit UWB"
    ids = range(10)
    most = 4
    line = "an{id}:{range_m:.2f}m"

    def hear(self, data: bytes) -> bytes:
        """Return nothing: ranging is running already."""
        return lines(["+switchdis=OK"]) if b"switchdis" in data else b""


class PozyxSketch(RangeLines):
    """An Arduino with a Pozyx shield and the sketch `ready_to_range`."""

    name = "pozyx_sketch"
    title = "Pozyx, Arduino sketch ready_to_range"
    names = ""
    most = 1
    silence = ("ERROR: ranging",)
    line = "{ms}ms, {mm}mm, {dbm}dBm"


class Lr11xx(RangeLines):
    """The manager of Semtech's ranging example: whole metres."""

    name = "lr11xx"
    title = "Semtech LR1110 and LR1120, RTToF example"
    names = ""
    rate_hz = 2.0
    most = 1
    banner = lines(["===== LR11xx RTToF example =====", "", "===== Running in manager mode ====="])
    silence = ("RTTOF request timeout",)
    line = "RTToF result: Distance: {m}m, RSSI: {dbm} "


HISS_MAGNITUDE = 80
"""The most of 999 that is printed of an open squelch here; 99 % are below 100."""


def c_sentence(azimuth_deg: float, magnitude: int, tone_peak: int, epoch_ms: int) -> str:
    """Return a sentence of 26 characters, fixed width."""
    tenths = round(10.0 * azimuth_deg) % 3600
    return f"C{tenths:04d}{magnitude:03d}{tone_peak:03d}{epoch_ms:015d}"


class Kn5r(LineEmulator):
    """A Doppler finder that prints a sentence twenty times a second."""

    name = "doppler_kn5r"
    title = "Doppler direction finder, KN5R-RDF sentences"
    names = ""
    antenna = "planar"
    measures = "bearing"
    rate_hz = 20.0
    most = 1
    epoch_s = SIMULATION_BEGAN_S
    prints_silence = True

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return a sentence in any case."""
        return [self._sentence(answer, self.device_ms(asked.sent_at_s))]

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
