"""Radios that print lines: TREK1000, BU01, Pozyx sketches, LR11xx, Bluetooth of two makers.

Sources: Decawave, TREK1000 user manual; Nordic, sample `channel_sounding_ras_initiator`; Silicon
Labs, JSON of `bt_aoa_host_locator` as a subscriber prints it with its topic; M5Stack, Unit UWB;
pozyxLabs, Pozyx-Arduino-library `ready_to_range`; Lora-net, SWSD003 `main_rttof.c`.
"""

from __future__ import annotations

import math

from sim_link.emulators.bearings import turned_rad
from sim_link.emulators.emulator import U32, Answer, Emulator, Round, lines

TAGS = 8


def mc_report(range_mm: int, tag: int, sequence: int, clock_ms: int) -> str:
    """Return a tag's range to anchor 0, which prints it; anchors 1 to 3 are not there."""
    rest = " ".join(["00000000"] * 3)
    return (
        f"mc 01 {range_mm:08x} {rest} {sequence & 0xFFFF:04x} {sequence & 0xFF:02x} "
        f"{clock_ms & 0xFFFFFFFF:08x} a{tag}:0"
    )


class Trek1000(Emulator):
    """Anchor 0 of a kit and its tags, whole millimetres; raw reports beside the corrected."""

    name = "trek1000"
    title = "Decawave TREK1000, mc reports"
    ids = range(TAGS)
    most = TAGS

    def encode(self, asked: Round) -> bytes:
        """Return both reports of each tag that answered."""
        texts = []
        for answer in asked.heard:
            if answer.range_m is not None:
                range_mm, clock_ms = round(1e3 * answer.range_m), self.device_ms(asked.sent_at_s)
                number = self.next_number()
                report = mc_report(max(0, range_mm), answer.emitter_id, number, clock_ms)
                texts += [report.replace("mc", "mr", 1), report]
        return lines(texts)


class ChannelSounding(Emulator):
    """Nordic's initiator, one reflector; two antenna paths."""

    name = "channel_sounding"
    title = "Nordic channel sounding, RAS initiator"
    names = ""
    rate_hz = 5.0
    most = 1

    def boot(self) -> bytes:
        """Return the console of Zephyr."""
        return lines(["*** Booting nRF Connect SDK v3.0.1 ***", "I: Starting initiator sample"])

    def encode(self, asked: Round) -> bytes:
        """Return a line for each antenna path."""
        return lines(
            [
                f"I: Distance estimates on antenna path {path}: ifft: {answer.range_m:.6f}, "
                f"phase_slope: {answer.range_m + 0.4:.6f}, rtt: {answer.range_m + 1.9:.6f}"
                for answer in asked.heard
                if answer.range_m is not None
                for path in range(2)
            ]
        )


class SilabsAoa(Emulator):
    """A locator upright: degrees about it, to the right and upwards, hundredths."""

    name = "silabs_aoa"
    title = "Silicon Labs AoA, JSON by MQTT"
    names = "02000000{0:04X}"
    gives = "azimuth, elevation"
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


class Bu01(Emulator):
    """An Ai-Thinker BU01 in the tag's role: a line an anchor, whole centimetres."""

    name = "bu01"
    title = "Ai-Thinker BU01, M5Stack Unit UWB"
    ids = range(10)
    most = 4

    def hear(self, data: bytes) -> bytes:
        """Return nothing: ranging goes on already."""
        return lines(["+switchdis=OK"]) if b"switchdis" in data else b""

    def encode(self, asked: Round) -> bytes:
        """Return a line for each that answered."""
        return lines(
            [
                f"an{answer.emitter_id}:{answer.range_m:.2f}m"
                for answer in asked.heard
                if answer.range_m is not None
            ]
        )


class PozyxSketch(Emulator):
    """An Arduino with a Pozyx shield and the sketch `ready_to_range`."""

    name = "pozyx_sketch"
    title = "Pozyx, Arduino sketch ready_to_range"
    names = ""
    most = 1

    def encode(self, asked: Round) -> bytes:
        """Return a line in any case."""
        clock_ms = self.device_ms(asked.sent_at_s) % U32
        return lines([self._line(answer, clock_ms) for answer in asked.answers])

    def _line(self, answer: Answer, clock_ms: int) -> str:
        if answer.range_m is None:
            return "ERROR: ranging"
        return f"{clock_ms}ms, {round(1e3 * answer.range_m)}mm, {round(answer.power_dbm)}dBm"


class Lr11xx(Emulator):
    """The manager of Semtech's ranging example: whole metres."""

    name = "lr11xx"
    title = "Semtech LR1110 and LR1120, RTToF example"
    names = ""
    rate_hz = 2.0
    most = 1

    def boot(self) -> bytes:
        """Return the banner with the example's role."""
        return lines(
            ["===== LR11xx RTToF example =====", "", "===== Running in manager mode ====="]
        )

    def encode(self, asked: Round) -> bytes:
        """Return a result, or that there was none."""
        return lines([self._line(answer) for answer in asked.answers])

    def _line(self, answer: Answer) -> str:
        if answer.range_m is None:
            return "RTTOF request timeout"
        return f"RTToF result: Distance: {round(answer.range_m)}m, RSSI: {round(answer.power_dbm)} "
