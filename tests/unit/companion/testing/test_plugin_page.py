"""The plugin of docs/radios/any-radio.md is whole: it is read off the page, and tried."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from companion.radios.decoder import RadioKind

PAGE = Path(__file__).resolve().parents[4] / "docs" / "radios" / "any-radio.md"


def blocks(language: str) -> list[str]:
    """What the page has in that language."""
    found = re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return list(found)


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module of the page, imported under its name."""
    module = ModuleType("acme_radio")
    exec(compile(blocks("python")[0], str(PAGE), "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, "acme_radio", module)
    return module


def test_the_page_s_entry_point_leads_to_its_radio(plugin: ModuleType) -> None:
    points = tomllib.loads(blocks("toml")[0])["project"]["entry-points"]["companion.radios"]
    ((name, target),) = points.items()
    module, _, attribute = target.partition(":")

    assert module == plugin.__name__
    kind = getattr(plugin, attribute)
    assert isinstance(kind, RadioKind)
    assert kind.name == name


@pytest.mark.usefixtures("plugin")
def test_the_page_s_test_passes() -> None:
    test = ModuleType("test_acme")
    exec(compile(blocks("python")[1], str(PAGE), "exec"), test.__dict__)

    test.test_acme_holds_the_contract()


def test_the_example_is_no_longer_than_one_can_read() -> None:
    assert len(blocks("python")[0].splitlines()) <= 50
