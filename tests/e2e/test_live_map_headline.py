"""The large number of the live map is the radius that holds for everybody who goes there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from sim_link.autopilot.estimator import NavigationParams
from sim_link.autopilot.scenario import Scenario
from tests.e2e.live_map_rig import (
    DESK,
    PATIENCE_MS,
    PHONE,
    SLOWLY,
    Watched,
    box_of,
    chromium,
    live_flight,
    needs_chromium,
    until,
)

pytestmark = [needs_chromium, pytest.mark.slow]

SINGLE_FREQUENCY = Scenario(navigation=NavigationParams(fix="3d", sigma_m=1.5, height_sigma_m=2.5))
SIDEWAYS = {"width": PHONE["height"], "height": PHONE["width"]}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.mark.parametrize("size", [DESK, PHONE, SIDEWAYS], ids=["desk", "phone", "sideways"])
def test_the_headline_is_the_absolute_radius_with_the_relative_one_beside_it(
    browser: Browser, tmp_path: Path, size: dict[str, int]
) -> None:
    with live_flight(tmp_path, scenario=SINGLE_FREQUENCY) as live:
        watched = Watched(browser, live.settings.url, size)
        page = watched.page
        state = page.locator("#estimate-state")
        expect(state).to_have_text("localised", timeout=PATIENCE_MS)
        live.speed = SLOWLY

        def shown_m() -> tuple[float, float]:
            relative = page.locator("#value-relative").inner_text()
            found = re.fullmatch(r"([\d.]+) m to vehicle \(GNSS 1\.50 m\)", relative)
            assert found is not None, relative
            return watched.r95_m(), float(found.group(1))

        def is_of_the_estimate() -> bool:
            estimate = live.flight.companion.session.estimate
            assert estimate is not None
            radii = (estimate.absolute_r95_m, estimate.r95_m)
            return all(abs(a - b) < 0.01 for a, b in zip(shown_m(), radii, strict=True))

        until(is_of_the_estimate, "the page shows other radii than the estimate has")
        absolute_m, relative_m = shown_m()
        assert absolute_m > 2.0 * relative_m
        expect(page.locator("#estimate-panel")).to_contain_text(f"R95 {absolute_m:.2f} m")
        expect(page.locator("#r95-kind")).to_have_text("absolute")
        left, _, width, _ = box_of(page, "#r95")
        assert left >= 0.0
        assert left + width <= size["width"]
        page.screenshot(path=str(tmp_path / "headline.png"))
        assert watched.complaints == []
