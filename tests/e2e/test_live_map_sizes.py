"""The live map on screens of every kind: what is seen without scrolling, and what can be copied."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.e2e.live_map_rig import (
    DESK,
    ENDLESS,
    PHONE,
    PHONE_ACROSS,
    SLOWLY,
    TABLET,
    Watched,
    box_of,
    chromium,
    live_flight,
    needs_chromium,
    until,
)

pytestmark = [needs_chromium, pytest.mark.slow]
SIZES = {"desk": DESK, "tablet": TABLET, "phone": PHONE, "phone across": PHONE_ACROSS}
MAX_COVERED = 0.25
"""Share of the map that the legend may cover before it is opened."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def bottom(page: Page, what: str) -> float:
    _, top, _, height = box_of(page, what)
    return top + height


def test_the_map_and_its_buttons_fit_the_screen_and_the_legend_leaves_it_free(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        pages = {name: Watched(browser, live.settings.url, size) for name, size in SIZES.items()}
        live.begun.set()
        until(lambda: live.has_estimate, "the companion has no idea where the emitter is")
        live.speed = SLOWLY
        for name, watched in pages.items():
            page, size = watched.page, SIZES[name]
            expect(page.locator("path.ellipse")).to_have_count(1)
            _, _, map_width, map_height = box_of(page, ".search-map")
            _, _, legend_width, legend_height = box_of(page, ".legend")
            assert legend_width * legend_height < MAX_COVERED * map_width * map_height, name
            assert page.evaluate("document.documentElement.scrollWidth") <= size["width"], name
            assert bottom(page, ".search-map") <= size["height"], name
            assert map_height >= 0.45 * size["height"], name
            page.screenshot(path=tmp_path / f"{name}.png")
        across = pages["phone across"].page
        assert bottom(across, "#button-hold") <= PHONE_ACROSS["height"]
        expect(across.locator("#r95")).to_be_in_viewport()
        is_open = {name: is_legend_open(watched.page) for name, watched in pages.items()}
        assert is_open == {"desk": True, "tablet": False, "phone": False, "phone across": False}
        assert [watched.complaints for watched in pages.values()] == [[]] * len(pages)


def is_legend_open(page: Page) -> bool:
    found: bool = page.locator(".legend").evaluate("box => box.open")
    return found


@pytest.mark.parametrize("has_clipboard", [True, False])
def test_the_position_is_copied_in_degrees_and_as_mgrs(
    browser: Browser, tmp_path: Path, has_clipboard: bool
) -> None:
    """Without TLS a browser has no clipboard beyond this computer."""
    with live_flight(tmp_path, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, PHONE)
        page = watched.page
        page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        if not has_clipboard:
            page.evaluate("Object.defineProperty(navigator, 'clipboard', {value: undefined})")
        page.evaluate(
            "document.addEventListener('copy', () => {"
            "  window.copied = document.activeElement.value; })"
        )
        expect(page.locator("#copy-value-position")).to_be_visible()
        live.speed = SLOWLY
        page.locator("#copy-value-position").click()
        expect(page.get_by_text("copied")).to_be_visible()
        read = "navigator.clipboard.readText()" if has_clipboard else "window.copied"
        degrees, grid = page.evaluate(read).split("  ")
        latitude_deg, longitude_deg = map(float, degrees.split(", "))
        origin = live.flight.companion.session.vehicle.origin
        estimate = live.flight.companion.session.estimate
        assert origin is not None
        assert estimate is not None
        truth = origin.geodetic_from_enu((*estimate.position_enu_m, 0.0))
        assert (latitude_deg, longitude_deg) == pytest.approx(truth[:2], abs=2e-3)
        assert grid.split()[0][-1].isalpha()
        left, top, width, height = box_of(page, "path.estimate")
        page.mouse.move(left + width / 2, top + height / 2)
        under_mouse = page.locator(".cursor").inner_text().split(", ")
        assert list(map(float, under_mouse)) == pytest.approx(truth[:2], abs=2e-4)
        assert watched.complaints == []
