"""Texts of the live map for a newcomer: the next step and the hand-off, readable in the sun."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect

from tests.e2e.live_map_rig import (
    DESK,
    PHONE,
    Watched,
    chromium,
    live_flight,
    needs_chromium,
)

pytestmark = [needs_chromium, pytest.mark.slow]

RULES = {"runOnly": ["wcag2a", "wcag2aa"]}
"""Rules of axe-core: WCAG 2, levels A and AA; contrast of text is AA's."""

DIALOG_MS = 1000.0
"""A dialog has faded in by then."""
MIN_CONTRAST = 4.5
"""WCAG 2.2, success criterion 1.4.3."""
CONTRASTS = """charts => charts.flatMap(chart => {
  const luminance = (colour) => {
    const parts = colour.match(/[\\d.]+/g).slice(0, 3).map(text => text / 255)
      .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
  };
  const page = luminance(getComputedStyle(chart).backgroundColor);
  return [...chart.querySelectorAll("svg text")].map(text => {
    const ink = luminance(getComputedStyle(text).fill);
    return (Math.max(page, ink) + 0.05) / (Math.min(page, ink) + 0.05);
  });
})"""
"""Contrasts of every text in a drawing, which axe-core does not look at; formulas of WCAG 2.2."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def file_of(page: Page, label: str) -> bytes:
    """Return the file that a button of the dialog saves."""
    with page.expect_download() as waiting:
        page.locator(f"#file-{label}").click()
    return waiting.value.path().read_bytes()


def broken_rules(page: Page, within: str = "body") -> list[str]:
    """Return the rules of axe-core that the page breaks now, with an example of each."""
    found = Axe().run(page, context=within, options=RULES).response["violations"]
    return [f"{rule['id']}: {rule['nodes'][0]['html'][:160]}" for rule in found]


def least_contrast_of_charts(page: Page) -> float:
    """The text of the curves that is hardest to read."""
    expect(page.locator(".chart svg text").first).to_be_visible()
    found: list[float] = page.locator(".chart").evaluate_all(CONTRASTS)
    return min(found)


def test_what_to_do_next_leads_to_a_hand_off_that_every_map_reads(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, PHONE)
        page = watched.page
        expect(page.locator("#next-step")).to_contain_text("HAND OVER")
        page.locator("#button-handoff").click()
        grid = page.locator(".grid-text")
        expect(grid).to_be_visible()
        page.wait_for_timeout(DIALOG_MS)
        assert broken_rules(page, ".handoff") == []
        features = json.loads(file_of(page, "geojson"))["features"]
        longitude, latitude = features[0]["geometry"]["coordinates"]
        kml = file_of(page, "kml").decode()
        assert f"<coordinates>{longitude:.7f},{latitude:.7f}</coordinates>" in kml
        point = ET.fromstring(file_of(page, "cot")).find("point")
        assert point is not None
        assert float(point.attrib["lat"]) == pytest.approx(latitude, abs=1e-6)
        code = page.locator(".qr")
        expect(code).to_be_visible()
        assert code.get_attribute("alt") == f"QR code of geo:{latitude:.6f},{longitude:.6f}"
        assert code.evaluate("picture => picture.naturalWidth") > 0
        page.get_by_role("button", name="Close").click()
        expect(grid).to_be_hidden()
        assert broken_rules(page) == []
        assert watched.complaints == []


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_has_the_contrast_that_sunlight_wants(
    browser: Browser, tmp_path: Path, size: dict[str, int], scheme: str
) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, size)
        watched.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        expect(watched.page.locator("path.ellipse")).to_have_count(1)
        assert broken_rules(watched.page) == []
        assert least_contrast_of_charts(watched.page) >= MIN_CONTRAST


def test_a_page_without_a_web_socket_is_as_readable(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        page = browser.new_page()
        page.add_init_script("delete window.WebSocket")  # as behind a proxy that refuses it
        page.goto(live.settings.url)
        expect(page.locator("path.ellipse")).to_have_count(1)
        assert broken_rules(page) == []
