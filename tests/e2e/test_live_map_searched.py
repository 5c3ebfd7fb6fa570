"""The searched area on the live map: shown while nothing is heard, and switched off and on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Response, expect

from companion.config.schema import CompanionConfig, LimitsConfig, PatternConfig, PlannerConfig
from companion.guidance.commands import SessionParams
from companion.guidance.searching import STATE_EVERY_S
from companion.search.detection_model import DetectionModel
from companion.search.searched_flight import SearchAreaParams
from sim_link.autopilot.scenario import PayloadParams, Scenario
from tests.e2e.live_map_rig import (
    DESK,
    PHONE,
    PHONE_ACROSS,
    Watched,
    chromium,
    live_flight,
    needs_chromium,
    until,
)

pytestmark = [needs_chromium, pytest.mark.slow]
FENCE = ((-5.0, -5.0), (115.0, -5.0), (115.0, 85.0), (-5.0, 85.0))
SEARCH = CompanionConfig(
    mission=SessionParams(engage="auto"),
    limits=LimitsConfig(fence_enu_m=FENCE),
    planner=PlannerConfig(search="lawnmower", pattern=PatternConfig(spacing_m=20.0)),
    search=SearchAreaParams(detection=DetectionModel(reach_m=25.0, reach_sigma_db=3.0)),
)
MAP = "/searched.json"
ZOOM_MS = 600.0
"""Leaflet has zoomed by then."""
DEAF = Scenario(payload=PayloadParams(max_range_m=1.0))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def test_the_searched_area_is_shown_with_its_gaps_and_can_be_switched_off(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, config=SEARCH, scenario=DEAF) as live:
        sizes = {"desk": DESK, "phone": PHONE, "across": PHONE_ACROSS}
        pages = {name: Watched(browser, live.settings.url, size) for name, size in sizes.items()}
        until(lambda: live.flight.now_s > 45.0, "the flight does not go on")
        for name, watched in pages.items():
            page = watched.page
            expect(page.locator("#value-searched")).to_contain_text("POS")
            expect(page.locator(".search-map img.pod")).to_have_count(1)
            assert page.locator("img.pod").evaluate("image => image.naturalWidth") > 0
            expect(page.locator("path.gap").first).to_be_attached()
            page.get_by_role("button", name="Whole").click()
            expect(page.locator(".gap-label").first).to_be_in_viewport()
            assert page.evaluate("document.documentElement.scrollWidth") <= sizes[name]["width"]
            page.wait_for_timeout(ZOOM_MS)
            page.screenshot(path=tmp_path / f"{name}.png")
        page = pages["phone"].page
        switch = page.get_by_role("button", name="Searched")
        for is_on in (False, True):
            switch.click()
            expect(page.locator("img.pod")).to_have_count(int(is_on))
            expect(switch).to_have_attribute("aria-pressed", "true" if is_on else "false")
        assert [watched.complaints for watched in pages.values()] == [[]] * len(pages)


def test_the_map_is_asked_for_only_when_it_has_changed(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path, config=SEARCH, scenario=DEAF) as live:
        page = Watched(browser, live.settings.url, DESK).page
        answers: list[Response] = []
        page.on("response", lambda each: answers.append(each) if MAP in each.url else None)
        expect(page.locator("img.pod")).to_have_count(1)
        begun_s, before = live.flight.now_s, len(answers)
        while live.flight.now_s < begun_s + 30.0:
            page.wait_for_timeout(100.0)  # only here does the page report its answers
        versions = [answer.json()["version"] for answer in answers]
        assert versions == sorted(set(versions))
        renewals = (live.flight.now_s - begun_s) / STATE_EVERY_S
        assert 2 <= len(versions) - before <= renewals + 1.0


def test_without_a_reach_there_is_no_searched_area(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, DESK)
        expect(watched.page.locator("path.ellipse")).to_have_count(1)
        assert watched.page.locator("#value-searched, #button-searched, img.pod").count() == 0
        assert watched.page.locator(".legend").inner_text().find("POD") == -1
        assert watched.complaints == []


def test_at_contact_the_searched_area_leaves_the_map_to_the_estimate(
    browser: Browser, tmp_path: Path
) -> None:
    heard = Scenario(payload=PayloadParams(max_range_m=40.0))
    with live_flight(tmp_path, config=SEARCH, scenario=heard) as live:
        page = Watched(browser, live.settings.url, DESK).page
        switch = page.get_by_role("button", name="Searched")
        expect(page.locator("img.pod")).to_have_count(1)
        expect(page.locator("path.ellipse")).to_have_count(1)
        expect(page.locator("img.pod")).to_have_count(0)
        switch.click()  # it can still be looked at
        expect(page.locator("img.pod")).to_have_count(1)
