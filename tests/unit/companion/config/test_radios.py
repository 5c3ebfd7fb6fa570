"""Radios of a file and of the command line: what is understood, merged and refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config.loader import parse_yaml
from companion.config.radios import (
    RadioConfig,
    flown_radios,
    parse_radio_option,
    radio_setup,
    replayed_radios,
)
from companion.config.schema import CompanionConfig, with_radios
from companion.domain import Params
from companion.errors import ConfigError
from companion.link.interface import RadioSettings
from companion.radios.decoder import RadioDecoder, RadioKind, RadioReading

FILE = """
radios:
  - name: ndjson
    url: udp:127.0.0.1:9000
    settings: {range_offset_m: 27.3, emitters: {"aa:bb:cc:dd:ee:ff": 7}}
"""


def config_of(text: str) -> CompanionConfig:
    return parse_yaml(text, CompanionConfig, "site.yaml")


def test_the_page_of_radios_has_a_row_for_every_setting() -> None:
    page = (Path(__file__).parents[4] / "docs/radios.md").read_text()
    table = page.partition("## Settings that every radio has")[2].partition("\n## ")[0]
    assert [key for key in RadioSettings.__struct_fields__ if f"`{key}`" not in table] == []


def test_a_radio_of_a_file_is_set_as_it_says_and_else_by_its_kind() -> None:
    (radio,) = config_of(FILE).radios
    setup = radio_setup(radio, "radios[0]")
    assert setup.kind.name == "ndjson"
    assert setup.settings.range_offset_m == 27.3
    assert setup.settings.emitters == {"aa:bb:cc:dd:ee:ff": 7}


@pytest.mark.parametrize(
    ("setting", "problem"),
    [
        ("range_offset: 1.0", "$.radios[0].settings.range_offset: unknown key"),
        ("range_scale: 9.0", "$.radios[0].settings.range_scale: expected a number <= 2.0"),
        ("bearing_sign: 2", "$.radios[0].settings.bearing_sign: 2 is none of -1, 1"),
        ("emitters: {tag: 70000}", "$.radios[0].settings.emitters"),
        ("range_min_m: 5.0, range_max_m: 1.0", "$.radios[0].settings.range_max_m: must be above"),
    ],
)
def test_a_wrong_setting_is_named_by_its_path(setting: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config_of(f"radios: [{{name: ndjson, settings: {{{setting}}}}}]")
    assert str(caught.value).startswith(f"site.yaml: {problem}")


def test_a_wrong_option_of_the_format_is_named_by_its_path() -> None:
    radio = RadioConfig(name="ndjson", options={"volume": 3})
    with pytest.raises(ConfigError, match=r"^radios\[1\]: options.volume: unknown key"):
        radio_setup(radio, "radios[1]")


class Stubborn(RadioDecoder):
    """A plugin's, which fails where it should only be made."""

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        raise IndexError("no antenna")

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        del data, received_s
        return []


def test_a_decoder_that_cannot_be_made_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = RadioKind("stubborn", Stubborn, "", "range", "", "udp")
    monkeypatch.setattr("companion.config.radios.radio_kind", lambda _: kind)
    with pytest.raises(ConfigError, match=r"^radios\[0\]: .*IndexError: no antenna"):
        radio_setup(RadioConfig(name="stubborn"), "radios[0]")


def test_an_unknown_radio_is_refused_when_it_is_chosen() -> None:
    with pytest.raises(ConfigError, match="no such radio; did you mean ndjson"):
        radio_setup(RadioConfig(name="ndjsn"), "radios[0]")


def test_options_of_the_command_line_are_keys_and_values() -> None:
    text = "ndjson:range_offset_m=2.5,emitters.aa:bb:cc:dd:ee:ff=7,sigma_factors=[[0,3],[0.5,1]]@x"
    radio = parse_radio_option(text)
    assert radio.url == "x"
    assert radio.settings == {
        "range_offset_m": 2.5,
        "emitters": {"aa:bb:cc:dd:ee:ff": 7},
        "sigma_factors": [[0, 3], [0.5, 1]],
    }
    assert radio.options == {}


def test_what_is_no_setting_is_an_option_of_the_format() -> None:
    assert parse_radio_option("ndjson:array=ula@x").options == {"array": "ula"}


@pytest.mark.parametrize(
    "text",
    ["", "ndjson", "@udp:1.2.3.4:5", "ndjson@", "ndjson:lag_s@x", "ND@x", "ndjson:lag_s=a@x"],
)
def test_what_is_no_radio_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^--radio ") as caught:
        parse_radio_option(text)
    assert "\n" not in str(caught.value)


def test_the_command_line_says_where_and_the_file_how() -> None:
    configured = config_of(FILE).radios
    radios = flown_radios(configured, ["ndjson:lag_s=0.1,emitters.tag=8@stdin:"])
    assert [radio.url for radio in radios] == ["stdin:"]
    assert radios[0].settings == {
        "range_offset_m": 27.3,
        "lag_s": 0.1,
        "emitters": {"aa:bb:cc:dd:ee:ff": 7, "tag": 8},
    }
    assert configured[0].settings["emitters"] == {"aa:bb:cc:dd:ee:ff": 7}


def test_a_second_radio_of_a_name_is_another_one() -> None:
    radios = flown_radios(config_of(FILE).radios, ["ndjson@stdin:", "ndjson@udp:127.0.0.1:9001"])
    assert [radio.url for radio in radios] == ["stdin:", "udp:127.0.0.1:9001"]
    assert radios[1].settings == {}


def test_a_radio_that_is_nowhere_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"radios\[0\].url: is missing; .* --radio ndjson@URL"):
        flown_radios([RadioConfig(name="ndjson")], [])


@pytest.mark.parametrize(
    ("radio", "problem"),
    [
        (
            "{name: ndjsn, url: x}",
            r"^site.yaml: \$.radios\[0\] \(ndjsn\): radio ndjsn: no such radio",
        ),
        (
            "{name: ndjson, url: x, options: {volume: 3}}",
            r"^site.yaml: \$.radios\[0\] .*: options.vol",
        ),
        ("{name: ndjson}", r"^site.yaml: \$.radios\[0\].url: is missing"),
    ],
)
def test_a_radio_of_a_file_is_refused_with_its_file(radio: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        with_radios(config_of(f"radios: [{radio}]"), [], Path("site.yaml"))


def test_an_option_of_the_command_line_is_not_the_files_fault() -> None:
    with pytest.raises(ConfigError, match=r"^radios\[0\] \(ndjson\): options.volume"):
        with_radios(config_of(FILE), ["ndjson:volume=3@x"], Path("site.yaml"))


def test_a_replay_takes_other_settings_by_name_and_order() -> None:
    flown = [RadioConfig(name="ndjson", url="a"), RadioConfig(name="ndjson", url="b")]
    other = [RadioConfig(name="nlink"), RadioConfig(name="ndjson", settings={"lag_s": 0.5})]
    first, second = replayed_radios(flown, other)
    assert (first.url, first.settings) == ("a", {"lag_s": 0.5})
    assert second == flown[1]


def test_a_bearing_is_not_turned_twice() -> None:
    config = config_of("estimation: {filter: {antenna: {kind: planar, mount_deg: [0, 0, 30]}}}")
    assert with_radios(config, ["ndjson@stdin:"]).radios[0].name == "ndjson"
    with pytest.raises(ConfigError, match="both turn bearings; keep one"):
        with_radios(config, ["ndjson:bearing_mount_deg=30@stdin:"])
