"""Each emulated radio with the decoder that reads it, and the resolution of its format."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from companion.link.interface import RadioSettings, RadioSetup
from companion.radios.decoder import radio_kind
from sim_link.emulators.catalogue import EMULATORS
from sim_link.emulators.emulator import Emulator

LINES_PATTERN = (
    r"(?P<emitter>[0-9A-F:]{17}),(?P<range_m>[\d.]+) m, \d+ ns, (?P<quality_percent>\d+)"
)
LTE_STEP_M, NR_STEP_M = 78.0709, 39.0355
NAME = "NAME"
CELLS = ("srsran_4g", "srsran", "oai")
ONE_OF_EACH_LINE = ("ndjson", "fira_uci", "pdoa_js", "kraken", "lines", "iw_ftm", "android_rtt")
"""A radio of each kind of line that brings its bytes: serial, page, UDP, TCP, program, file."""


@dataclass(frozen=True, slots=True)
class Format:
    """Fields and resolution of a measurement in the bytes of a radio."""

    name: str
    """Name of the emulator."""
    radio: str
    """Name of the decoder."""
    range_m: float | None = None
    """Half a step of the range; None if it has no ranges."""
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    time_s: float | None = None
    """Half a step of the time; None if it has no clock."""
    sigma_m: float | None = None
    """Half a step of the sigma, where the radio reports one."""
    has_quality: bool = False
    power_db: float | None = None
    """Half a step of the received power."""
    options: Mapping[str, object] = field(default_factory=dict)
    """Options of the decoder."""

    @property
    def kind(self) -> type[Emulator]:
        return EMULATORS[self.name]

    @property
    def names_nobody(self) -> bool:
        return self.kind.name_on_wire(1) == ""

    def settings(self, emitter_id: int, **others: object) -> RadioSettings:
        """Return the settings of the radio's kind, with the emitter's name."""
        given: dict[str, Any] = dict(radio_kind(self.radio).defaults)
        if self.names_nobody:
            given["emitter"] = emitter_id
        else:
            given["emitters"] = {self.kind.name_on_wire(emitter_id): emitter_id}
        given |= others
        return msgspec.convert(given, RadioSettings)

    def options_for(self, emitter_id: int) -> dict[str, object]:
        """The options, with the emitter's name where `NAME` stands."""
        name = self.kind.name_on_wire(emitter_id)
        return {key: name if value == NAME else value for key, value in self.options.items()}

    def setup(self, emitter_id: int, **others: object) -> RadioSetup:
        kind = radio_kind(self.radio)
        options = msgspec.convert(self.options_for(emitter_id), kind.decoder.Options)
        return RadioSetup(kind, self.settings(emitter_id, **others), options)

    def azimuth_step_deg(self, range_m: float) -> float:
        """Return the azimuth's step; coordinates in centimetres make it depend on the range."""
        if self.name == "pdoa_js":
            return math.degrees(0.75 / (100.0 * range_m))
        assert self.azimuth_deg is not None
        return self.azimuth_deg


MS, UNIX_MS = 0.5e-3, 0.51e-3
Q97 = 0.5 / 128.0
FORMATS = (
    Format("ndjson", "ndjson", 1e-9, 1e-9, 1e-9, 1e-6, 1e-9, power_db=1e-9),
    Format("nlink_aoa", "nlink", 0.5e-3, 0.005, None, MS, power_db=0.25),
    Format("nlink_iot", "nlink", 0.5e-3, 0.005, 0.005, MS, power_db=0.25),
    Format("nlink_node2", "nlink", 0.5e-3, time_s=MS, power_db=0.25),
    Format("nlink_node3", "nlink", 0.5e-3, time_s=MS, power_db=0.25),
    Format("nlink_node5", "nlink", 0.5e-3, time_s=MS, power_db=0.25),
    Format("nlink_tag0", "nlink", 0.5e-3, time_s=MS),
    Format("fira_uci", "fira_uci", 0.5e-2, Q97, Q97),
    Format("sr150", "sr150", 0.5e-2, Q97, Q97),
    Format("pans", "pans", 0.5e-2),
    Format("pans_tlv", "pans_tlv", 0.5e-3),
    Format("qorvo_cli", "qorvo_cli", 0.5e-2, 0.005, 0.005),
    Format("pdoa_js", "pdoa_js", 0.5e-2, 0.005),
    Format("makerfabs_at", "makerfabs_at", 0.5e-2),
    Format("kraken", "kraken", None, 0.5, time_s=UNIX_MS),
    Format("kraken_suite", "kraken", None, 0.5),
    Format("kraken_xml", "kraken_xml", None, 0.5, time_s=UNIX_MS),
    Format("kraken_ws", "kraken_ws", None, 0.01, has_quality=True),
    Format("uudf", "uudf", None, 0.5, 0.5, time_s=MS, power_db=0.5),
    Format("esp32_ftm", "esp32_ftm", 0.5e-2, time_s=MS, has_quality=True, power_db=0.5),
    Format("esp32_arduino", "esp32_ftm", 0.5e-2),
    Format("ftm_csv", "ftm_csv", 0.5e-2, power_db=0.5),
    Format("iw_ftm", "iw_ftm", 0.8e-4, time_s=1e-6, sigma_m=1e-3),
    Format(
        "android_rtt",
        "android_rtt",
        0.5e-3,
        time_s=UNIX_MS,
        sigma_m=0.5e-3,
        has_quality=True,
        power_db=0.5,
    ),
    Format("trek1000", "trek1000", 0.5e-3, options={"hidden": "tag"}),
    Format("channel_sounding", "channel_sounding", 0.5e-6),
    Format("silabs_aoa", "silabs_aoa", None, 0.005, 0.005),
    Format("bu01", "bu01", 0.5e-2),
    Format("bu03", "bu03", 0.5e-6),
    Format("ryuw122", "ryuw122", 0.5e-2, options={"tag": NAME}),
    Format("pozyx", "pozyx", 0.5e-3, time_s=MS, power_db=0.5, options={"tag": NAME}),
    Format("pozyx_sketch", "pozyx", 0.5e-3, time_s=MS, power_db=0.5),
    Format("lr11xx", "lr11xx", 0.5, power_db=0.5),
    Format("doppler_kn5r", "doppler", None, 0.05, time_s=UNIX_MS, has_quality=True),
    Format("doppler_json", "doppler", None, 0.05, has_quality=True),
    Format("sx1280", "sx1280", 0.0226, power_db=0.5, options={"bandwidth_khz": 812.5}),
    Format("srsran_4g", "srsran_4g", 0.5 * LTE_STEP_M, options={"offset_steps": 0}),
    Format(
        "srsran",
        "srsran",
        0.8e-2,
        time_s=UNIX_MS,
        options={"loop_is_off": True, "numerology": 1, "offset_steps": 0},
    ),
    Format("oai", "oai", 0.5 * NR_STEP_M, options={"offset_steps": 0}),
    Format("lines", "lines", 0.5e-2, has_quality=True, options={"pattern": LINES_PATTERN}),
)
POWERS = (
    Format("wifi_scan", "rssi", power_db=0.5),
    Format("ble_scan", "rssi", power_db=0.5),
    Format("esp32_sniffer", "rssi", power_db=0.5),
    Format("lora_forwarder", "lora_gateway", time_s=1e-6, power_db=0.7),
    Format("chirpstack", "lora_gateway", power_db=0.7),
    Format("things_stack", "lora_gateway", power_db=0.7),
    Format("uavrt", "uavrt", time_s=1e-6, power_db=1e-9),
)
"""Radios that measure nothing but the received power."""
ALL = FORMATS + POWERS
FORMAT_OF = {each.name: each for each in ALL}
