"""Radios by name: built-in ones, plugins, and what is said of a broken one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.radios.decoder import BUILT_IN, known_radios, radio_kind

GOOD = """\
from companion.radios.decoder import LineDecoder, RadioKind, RadioReading

class Metres(LineDecoder):
    def read_line(self, line, received_s):
        return [RadioReading(range_m=float(line))]

KIND = RadioKind("metres", Metres, "Metres a line", "range", "anything", "serial:9600")
"""


def install(site: Path, *, package: str, entries: str, code: str | None = GOOD) -> None:
    """Write a package into a folder of the path, as pip does."""
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[companion.radios]\n{entries}\n")
    if code is not None:
        (site / f"{package}.py").write_text(code)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of packages that is on the path as long as the test runs."""
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_plugin_is_found_by_its_entry_point_and_imported_only_when_chosen(site: Path) -> None:
    install(site, package="plugin_found", entries="metres = plugin_found:KIND")
    assert known_radios()["metres"] == "plugin_found"
    assert "plugin_found" not in sys.modules
    assert radio_kind("metres").title == "Metres a line"


def test_a_built_in_radio_wins_over_a_plugin_of_its_name(site: Path) -> None:
    install(site, package="plugin_usurper", entries="ndjson = plugin_usurper:KIND")
    assert known_radios()["ndjson"] == "built in"
    assert radio_kind("ndjson").name == "ndjson"
    assert "plugin_usurper" not in sys.modules


@pytest.mark.parametrize(
    ("package", "entries", "code", "words"),
    [
        ("plugin_absent", "metres = plugin_absent:KIND", None, "cannot be imported: ModuleNot"),
        ("plugin_broken", "metres = plugin_broken:KIND", "1 / 0\n", "ZeroDivisionError"),
        ("plugin_lacking", "metres = plugin_lacking:OTHER", GOOD, "AttributeError"),
        ("plugin_class", "metres = plugin_class:Metres", GOOD, "must lead to a RadioKind"),
        ("plugin_named", "meters = plugin_named:KIND", GOOD, "calls itself metres"),
    ],
)
def test_a_broken_plugin_is_named_in_one_line(
    site: Path, package: str, entries: str, code: str | None, words: str
) -> None:
    install(site, package=package, entries=entries, code=code)
    name = entries.split()[0]
    with pytest.raises(ConfigError) as caught:
        radio_kind(name)
    said = str(caught.value)
    assert said.startswith(f"radio {name}: the plugin {package} ({package}:")
    assert words in said
    assert "\n" not in said


def test_two_plugins_of_one_name_are_both_named(site: Path) -> None:
    install(site, package="plugin_one", entries="metres = plugin_one:KIND")
    install(site, package="plugin_two", entries="metres = plugin_two:KIND")
    with pytest.raises(ConfigError, match="plugin_one and plugin_two have it; uninstall one"):
        radio_kind("metres")


def test_an_unknown_radio_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"radio nlnk: no such radio; did you mean nlink\?"):
        radio_kind("nlnk")


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_built_in_radio_can_be_loaded_and_has_its_own_name(name: str) -> None:
    kind = radio_kind(name)
    assert kind.name == name
