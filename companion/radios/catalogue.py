"""Radios by name: the built-in ones, and those of installed packages.

A radio is imported only when it is chosen, so a broken plugin harms only its users.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points

from companion.errors import ConfigError
from companion.radios.decoder import RadioKind

GROUP = "companion.radios"
"""The entry-point group of plugins: the radio's name to `module:ATTRIBUTE` of its `RadioKind`."""

BUILT_IN: Mapping[str, str] = {
    "ndjson": "companion.radios.lora_gateways:NDJSON",
    "nlink": "companion.radios.nlink:NLINK",
    "fira_uci": "companion.radios.fira:FIRA_UCI",
    "sr150": "companion.radios.fira:SR150",
    "pans": "companion.radios.fira:PANS",
    "pans_tlv": "companion.radios.fira:PANS_TLV",
    "qorvo_cli": "companion.radios.qorvo:QORVO_CLI",
    "pdoa_js": "companion.radios.qorvo:PDOA_JS",
    "kraken": "companion.radios.kraken:KRAKEN",
    "kraken_xml": "companion.radios.kraken:KRAKEN_XML",
    "kraken_ws": "companion.radios.kraken_socket:KRAKEN_WS",
    "esp32_ftm": "companion.radios.wifi_ftm:ESP32_FTM",
    "ftm_csv": "companion.radios.wifi_csv:FTM_CSV",
    "iw_ftm": "companion.radios.wifi_ftm:IW_FTM",
    "android_rtt": "companion.radios.wifi_csv:ANDROID_RTT",
    **dict.fromkeys(
        (
            *("makerfabs_at", "trek1000", "ryuw122", "bu01", "bu03", "pozyx", "uudf", "silabs_aoa"),
            *("channel_sounding", "sx1280", "lr11xx", "doppler", "lines"),
        ),
        "companion.radios.line_forms:RADIOS",
    ),
    "rssi": "companion.radios.power_scans:RSSI",
    "uavrt": "companion.radios.power_scans:UAVRT",
    "lora_gateway": "companion.radios.lora_gateways:LORA_GATEWAY",
    "srsran_4g": "companion.radios.cellular:SRSRAN_4G",
    "srsran": "companion.radios.cellular:SRSRAN",
    "oai": "companion.radios.cellular:OAI",
}
"""Radio's name to `module:ATTRIBUTE` of its `RadioKind`, or of a table of kinds by name."""


def known_radios() -> dict[str, str]:
    """Return every name that can be chosen, and its origin: `built in`, or a package's name.

    A broken plugin is listed, too; `radio_kind` reports the error.
    """
    plugins = {point.name: _package(point) for point in entry_points(group=GROUP)}
    return {name: "built in" for name in BUILT_IN} | {
        name: package for name, package in sorted(plugins.items()) if name not in BUILT_IN
    }


def radio_kind(name: str) -> RadioKind:
    """Return the radio of a name; a built-in one takes precedence over a plugin's.

    Raises a `ConfigError` for an unknown name, and for a plugin that is broken.
    """
    if name in BUILT_IN:
        found = EntryPoint(name, BUILT_IN[name], GROUP).load()
        kind = found[name] if isinstance(found, Mapping) else found
        assert isinstance(kind, RadioKind)
        return kind
    points = list(entry_points(group=GROUP, name=name))
    if not points:
        near = get_close_matches(name, known_radios(), n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(f"radio {name}: no such radio; {hint}`companion radio list` has them all")
    if len(points) > 1:
        packages = " and ".join(sorted(_package(point) for point in points))
        raise ConfigError(f"radio {name}: both {packages} have it; uninstall one of them")
    return _of_plugin(points[0])


def _of_plugin(point: EntryPoint) -> RadioKind:
    """Load a plugin's entry point. Raises a `ConfigError` in one line that names it."""
    place = f"radio {point.name}: the plugin {_package(point)} ({point.value})"
    try:
        kind = point.load()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(
            f"{place} cannot be imported: {reason}; repair or uninstall it"
        ) from error
    if not isinstance(kind, RadioKind):
        raise ConfigError(
            f"{place} is a {type(kind).__name__}; its entry point must lead to a RadioKind"
        )
    if kind.name != point.name:
        raise ConfigError(
            f"{place} calls itself {kind.name}; its entry point must have the same name"
        )
    return kind


def _package(point: EntryPoint) -> str:
    return "of an unknown package" if point.dist is None else point.dist.name
