"""The live map in a real browser, over a flight that really happens (in memory, at speed 4).

Needs Chromium (Debian: apt install chromium); without one these tests are skipped.
"""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from subprocess import PIPE

import msgspec
import pytest
from playwright.sync_api import Browser, Page, expect

from companion.estimation.antenna import AntennaParams
from companion.guidance.commands import Severity
from companion.web.live_map import MARKS
from tests.e2e.live_map_rig import (
    DESK,
    ENDLESS,
    FLYING,
    PATIENCE_MS,
    PHONE,
    SLOWLY,
    SPEED,
    STEP_S,
    LiveFlight,
    Watched,
    box_of,
    chromium,
    live_flight,
    needs_chromium,
    until,
    until_up,
    with_tile,
)
from tests.e2e.simulator_process import PATIENCE_S
from tests.loop.golden_flights import PLANS, fly
from tests.ports import free_port

pytestmark = [needs_chromium, pytest.mark.slow]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def test_the_ellipse_shrinks_to_the_emitter_on_a_desk_and_on_a_phone(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, begins=False) as live:
        pages = [Watched(browser, live.settings.url, size) for size in (DESK, PHONE)]
        for watched in pages:
            assert_no_panel_is_empty(watched.page)
        live.begun.set()
        until(lambda: live.has_estimate, "the companion has no idea where the emitter is")
        live.speed = SLOWLY
        for watched in pages:
            watched.page.get_by_role("button", name="Whole").click()
            for circle in ("ellipse", "r95", "absolute-r95"):
                drawn = watched.page.locator(f"path.{circle}")
                expect(drawn).to_have_count(1, timeout=PATIENCE_MS)
        first_px, first_m = pages[0].ellipse_px(), pages[0].r95_m()
        live.speed = SPEED
        for watched in pages:
            phase = watched.page.locator("#phase")
            expect(phase).to_contain_text(re.compile("localised|found"), timeout=PATIENCE_MS)
            state = watched.page.locator("#estimate-state")
            expect(state).to_have_text("localised", timeout=PATIENCE_MS)
        assert pages[0].r95_m() < 0.5 * first_m
        until(lambda: pages[0].ellipse_px() < 0.5 * first_px, "the ellipse does not shrink")
        until(lambda: miss_px(pages[0].page) < 25.0, "the estimate is not at the emitter")
        width = pages[1].page.evaluate("document.documentElement.scrollWidth")
        assert width <= PHONE["width"]
        for watched in pages:
            assert_no_panel_is_empty(watched.page)
        assert [watched.complaints for watched in pages] == [[], []]


def miss_px(page: Page) -> float:
    """Distance from the estimate to the truth on the screen."""
    boxes = (box_of(page, name) for name in ("path.estimate", "path.truth"))
    centres = [(left + width / 2, top + height / 2) for left, top, width, height in boxes]
    return math.dist(*centres)


def assert_no_panel_is_empty(page: Page) -> None:
    """Every panel that is seen says something; charts draw on a canvas."""
    texts = page.locator(".panel:visible:not(.chart)").all_inner_texts()
    assert texts
    assert all(text.strip() for text in texts)


def pixels_per_metre(page: Page) -> float:
    """The map's scale, as its scale bar has it."""
    scale = page.locator(".leaflet-control-scale-line")
    metres = float(scale.inner_text().removesuffix("m"))
    return box_of(page, ".leaflet-control-scale-line")[2] / metres


def settled_scale(page: Page) -> float:
    """The map's scale once it no longer changes."""
    seen = [0.0, pixels_per_metre(page)]
    while seen[-1] != seen[-2]:
        page.wait_for_timeout(500.0)
        seen.append(pixels_per_metre(page))
    return seen[-1]


def is_whole_fence_seen(page: Page) -> bool:
    """Return True if the fence is within the map from left to right."""
    fence, seen = box_of(page, "path.fence"), box_of(page, ".search-map")
    return seen[0] < fence[0] and fence[0] + fence[2] < seen[0] + seen[2]


def test_it_follows_until_the_whole_is_requested_and_rings_stay_few(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, PHONE)
        live.begun.set()
        page = watched.page
        expect(page.locator("#value-next")).to_contain_text("crossing", timeout=PATIENCE_MS)
        follow = page.get_by_role("button", name="Follow")
        expect(follow).to_have_class("is-on")
        page.get_by_role("button", name="Whole").click()
        expect(follow).not_to_have_class("is-on")
        until(lambda: is_whole_fence_seen(page), "the whole fence is not seen")
        scale = settled_scale(page)
        for _ in range(20):
            assert page.locator("path.range").count() <= MARKS
            page.wait_for_timeout(100.0)
        for button in page.get_by_role("button").all():
            box = button.bounding_box()
            assert box is None or box["height"] >= 40.0
        follow.click()
        until(lambda: pixels_per_metre(page) > 1.5 * scale, "the map does not follow")
        assert watched.complaints == []


def test_the_track_is_whole_where_no_snapshot_came_through(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, DESK)
        live.wishes.put(partial(unseen, live, 30.0))
        live.speed = SLOWLY
        live.begun.set()
        watched.page.get_by_role("button", name="Whole").click()
        until(lambda: live.flight.now_s > 29.9, "the flight does not go on")
        page, flown_m = watched.page, live.flight.companion.session.vehicle.distance_m
        assert flown_m > 30.0
        settled_scale(page)
        until(
            lambda: track_px(page) / pixels_per_metre(page) > 0.9 * flown_m,
            "the track is not whole",
        )
        assert watched.complaints == []


def unseen(live: LiveFlight, duration_s: float) -> None:
    """Fly on without one snapshot."""
    for _ in range(round(duration_s / STEP_S)):
        live.flight.run(STEP_S)


def track_px(page: Page) -> float:
    """Length of the track on the screen, pixels."""
    length: float = page.evaluate(
        "() => document.querySelector('path.track')?.getTotalLength() ?? 0"
    )
    return length


def test_a_configured_antenna_shows_where_it_looks(browser: Browser, tmp_path: Path) -> None:
    antenna = AntennaParams(kind="two_axis", mount_deg=(0.0, -90.0, 0.0), field_of_view_deg=120.0)
    change = msgspec.structs.replace
    believed = change(ENDLESS.estimation.filter, antenna=antenna)
    config = change(ENDLESS, estimation=change(ENDLESS.estimation, filter=believed))
    with live_flight(tmp_path, config=config) as live:
        watched = Watched(browser, live.settings.url, DESK)
        for drawn in ("path.antenna-view", "path.boresight"):
            expect(watched.page.locator(drawn)).to_have_count(1, timeout=PATIENCE_MS)
        expect(watched.page.locator(".legend")).to_contain_text("what its antenna sees")
        assert watched.complaints == []


def test_without_ranging_its_bar_turns_red_and_hold_holds(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, DESK)
        page = watched.page
        phase = page.locator("#phase")
        live.begun.set()
        expect(phase).to_contain_text(FLYING, timeout=PATIENCE_MS)
        page.locator("#button-hold").click()
        page.locator("#confirm-hold").click()
        expect(phase).to_contain_text("operator requested hold", timeout=PATIENCE_MS)
        held_s, held_at = live.flight.now_s, live.vehicle_enu_m
        live.flight.is_ranging_up = False
        bar = page.locator("#age-ranging")
        expect(bar).to_have_class(re.compile("text-negative"), timeout=PATIENCE_MS)
        expect(page.locator("#age-position")).not_to_have_class(re.compile("text-negative"))
        assert live.flight.now_s > held_s + 3.0
        assert math.dist(held_at[:2], live.vehicle_enu_m[:2]) < 8.0
        assert watched.complaints == []


def test_hostile_texts_are_shown_as_texts(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, DESK)
        hostile = "<img src=x onerror=\"document.title='taken'\">"
        live.wishes.put(lambda: live.journal.text(Severity.WARNING, hostile, live.flight.now_s))
        expect(watched.page.locator("#texts")).to_contain_text(hostile, timeout=PATIENCE_MS)
        assert watched.page.locator("#texts img").count() == 0
        assert watched.page.title() == "Companion"


def test_a_replay_that_no_browser_opens_ends_by_ctrl_c(tmp_path: Path) -> None:
    fly(PLANS["two_emitters"], tmp_path)
    options = ["replay", str(tmp_path / "0"), "--web", str(free_port())]
    command = [sys.executable, "-m", "companion", *options]
    with subprocess.Popen(command, text=True, stdout=PIPE, stderr=PIPE) as replay:
        try:
            assert replay.stdout is not None
            lines = iter(replay.stdout.readline, "")
            assert any("waits for a browser" in line for line in lines)
            replay.send_signal(signal.SIGINT)
            said = replay.communicate(timeout=PATIENCE_S)[1].splitlines()
        finally:
            replay.kill()
    assert (replay.returncode, said) == (1, ["companion: interrupted"])


def test_a_recorded_flight_is_shown_with_all_emitters_and_stays_until_it_is_ended(
    browser: Browser, tmp_path: Path
) -> None:
    """At this speed the flight would be over before the page is up."""
    fly(PLANS["two_emitters"], tmp_path)
    port = free_port()
    options = ["replay", str(tmp_path / "0"), "--web", str(port), "--speed", "50"]
    options += ["--web-tiles", str(with_tile(tmp_path))]
    command = [sys.executable, "-m", "companion", *options]
    with subprocess.Popen(command, text=True, stdout=PIPE, stderr=PIPE) as replay:
        try:
            assert replay.stdout is not None
            url = f"http://127.0.0.1:{port}/"
            until_up(url)  # which is not a browser
            time.sleep(2.0)
            watched = Watched(browser, url, DESK)
            banner = watched.page.locator("#replay")
            expect(banner).to_have_text(re.compile(r"REPLAY at 50x of flight 0, begun .* UTC"))
            expect(watched.page.locator("#time")).to_contain_text("UTC")
            assert watched.page.title() == "Companion: replay"
            until(lambda: track_px(watched.page) > 0.0, "there is no track")
            expect(watched.page.locator(".leaflet-tile")).not_to_have_count(0)
            expect(watched.page.locator("path.ellipse")).to_have_count(1, timeout=PATIENCE_MS)
            expect(watched.page.locator("path.other-emitter")).to_have_count(1)
            expect(watched.page.locator("#emitters")).to_contain_text("waiting")
            assert watched.page.locator("#button-hold").count() == 0
            lines = iter(replay.stdout.readline, "")
            assert any("IDENTICAL" in line for line in lines)
            time.sleep(3.0)
            expect(watched.page.locator("#phase")).not_to_contain_text("SILENT")
            assert watched.complaints == []
            replay.send_signal(signal.SIGINT)
            assert replay.communicate(timeout=PATIENCE_S)[1] == ""
            assert replay.returncode == 0
        finally:
            replay.kill()
