"""Every preset of a radio is a whole configuration, and says what its radio needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config.radios import radio_setups
from companion.config.schema import load_config
from companion.flight_setup import radio_links
from companion.radios.decoder import BUILT_IN

ROOT = Path(__file__).resolve().parents[4]
PRESETS = sorted((ROOT / "configs" / "radios").glob("*.yaml"))
ALIKE = {
    "ftm_csv": "esp32_ftm",
    "kraken_xml": "kraken",
    "kraken_ws": "kraken",
    "pans_tlv": "pans",
    "trek1000": "pans",
    "ryuw122": "pans",
    "bu01": "pans",
    "bu03": "pans",
    "pozyx": "pans",
    "lr11xx": "sx1280",
    "doppler": "kraken",
    "channel_sounding": "lines",
    "silabs_aoa": "uudf",
    "lora_gateway": "rssi",
    "uavrt": "rssi",
}
"""Radios that are set up as another one is."""


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_a_preset_is_a_configuration_with_the_radio_of_its_name(path: Path) -> None:
    config = load_config(path)

    (radio,) = config.radios
    assert radio.name == path.stem
    assert len(radio_links(config.radios)) == 1


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_a_preset_tells_the_mount_in_one_place_and_bearings_a_sign(path: Path) -> None:
    config = load_config(path)
    ((raw,), (setup,)) = config.radios, radio_setups(config.radios)

    if path.stem not in ("ndjson", "lines") and "azimuth" in setup.kind.gives:
        assert "bearing_sign" in raw.settings
        assert raw.settings["bearing_sign"] == setup.kind.defaults.get("bearing_sign", 1)
    if config.estimation.filter.antenna.mount_deg != (0.0, 0.0, 0.0):
        assert setup.settings.bearing_mount_deg == 0.0


def test_every_radio_has_a_preset_or_one_like_it() -> None:
    names = {path.stem for path in PRESETS}

    assert {ALIKE.get(name, name) for name in BUILT_IN} == names
