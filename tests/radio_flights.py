"""Setup in which each emulated radio is flown: a scenario with its antenna, and a configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec

from companion.config.schema import CompanionConfig, load_config
from sim_link.autopilot.scenario import Scenario
from sim_link.emulators.wifi import ANDROID_HEADER
from sim_link.fleet import load_scenario
from tests.radio_formats import POWERS, Format

ROOT = Path(__file__).resolve().parents[1]
FIELD, FIELD_CONFIG = "configs/scenarios/field", "configs/companion/field"
SETUPS = {
    "canonical": ("", ""),
    "ranges": (f"{FIELD}/phone_ftm.yaml", f"{FIELD_CONFIG}/phone_ftm.yaml"),
    "line": (f"{FIELD}/uwb_tag_line.yaml", f"{FIELD_CONFIG}/uwb_tag_line.yaml"),
    "two_axis": (f"{FIELD}/uwb_two_axis.yaml", f"{FIELD_CONFIG}/uwb_two_axis.yaml"),
    "planar": (f"{FIELD}/beacon_planar.yaml", f"{FIELD_CONFIG}/beacon_planar.yaml"),
    "bearings": (f"{FIELD}/uwb_two_axis.yaml", f"{FIELD_CONFIG}/uwb_two_axis.yaml"),
    "power": (f"{FIELD}/rssi_only.yaml", f"{FIELD_CONFIG}/rssi_only.yaml"),
    "lte": (f"{FIELD}/phone_cellular.yaml", "configs/radios/srsran_4g.yaml"),
    "nr": (f"{FIELD}/phone_cellular.yaml", "configs/radios/srsran.yaml"),
    "oai": (f"{FIELD}/phone_cellular.yaml", "configs/radios/oai.yaml"),
}
"""Scenario and configuration; bearings: without the ranges."""
OWN = {"srsran_4g": "lte", "oai": "oai", "srsran": "nr", "ndjson": "canonical", "uudf": "bearings"}
"""Formats that are not flown by what their antenna is."""

IN_FLIGHT: dict[str, dict[str, object]] = {
    "uudf": {"as_arcsines": True},
    "android_rtt": {"header": ANDROID_HEADER},
}
"""A board that looks down; a file that is followed from its end."""


@dataclass(frozen=True, slots=True)
class Setup:
    """A scenario, and the companion's configuration for it."""

    scenario: Scenario
    config: CompanionConfig


@cache
def setup_of(name: str) -> Setup:
    """Return the setup of a name in `SETUPS`; it engages by itself, without range cut or lag."""
    scenario_path, config_path = SETUPS[name]
    scenario, config = Scenario(), CompanionConfig()
    if scenario_path:
        scenario, config = load_scenario(ROOT / scenario_path), load_config(ROOT / config_path)
        uncut = msgspec.structs.replace(scenario.channel, range_step_m=0.0)
        scenario = msgspec.structs.replace(scenario, channel=uncut)
        config = msgspec.structs.replace(config, radios=())  # the emulated one has no delay
    payload = msgspec.structs.replace(scenario.payload, lag_s=0.0)
    if name == "bearings":
        payload = msgspec.structs.replace(payload, measures="bearing")
    mission = msgspec.structs.replace(config.mission, engage="auto")
    return Setup(
        msgspec.structs.replace(scenario, payload=payload),
        msgspec.structs.replace(config, mission=mission, radios=()),
    )


def as_flown(format_: Format) -> Format:
    """Return the format with the decoder's configuration in flight."""
    options = IN_FLIGHT.get(format_.name)
    return format_ if options is None else replace(format_, options=options)


def setup_name(format_: Format) -> str:
    """Return the name of the setup for what the radio measures."""
    if format_.name in OWN:
        return OWN[format_.name]
    if format_ in POWERS:
        return "power"
    return format_.kind.antenna if format_.azimuth_deg is not None else "ranges"


def sigmas(format_: Format, scenario: Scenario) -> dict[str, object]:
    """Return settings that weigh it like RADIO_RANGING, which reports its sigmas."""
    antenna, channel = scenario.payload.antenna, scenario.channel
    settings: dict[str, object] = {}
    if format_.range_m is not None:
        settings["range_sigma_m"] = channel.range_sigma_m
    if format_.azimuth_deg is not None:
        settings["bearing_sigma_deg"] = antenna.sigma_deg or channel.bearing_sigma_deg
    if format_.elevation_deg is not None:
        settings["elevation_sigma_deg"] = antenna.sigma_deg or channel.bearing_sigma_deg
    return settings
