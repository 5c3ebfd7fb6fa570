"""The live map in a real browser, over a flight that really happens (in memory, at speed 4).

Needs Chromium (Debian: apt install chromium); without one these tests are skipped.
"""

from __future__ import annotations

import math
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from companion.config.schema import CompanionConfig
from companion.guidance.commands import Severity
from companion.guidance.session import SessionParams
from companion.io.journal import FlightJournal
from companion.link.journal import Journal
from companion.view.collector import MARKS
from companion.web.settings import WebSettings, web_settings
from companion.web.view import WebView
from sim_link.autopilot.scenario import Scenario
from sim_link.lockstep.flight import Flight
from tests.loop.golden_flights import PLANS, fly

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt install chromium")

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
SPEED = 4.0
STEP_S = 0.05
PATIENCE_MS = 60_000
DESK, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@dataclass
class LiveFlight:
    """A flight that goes on in its own thread, and its page."""

    settings: WebSettings
    flight: Flight
    view: WebView
    journal: Journal
    begun: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)

    def fly(self) -> None:
        """Fly on at its speed until the test is over."""
        self.step()  # the page wants a first picture
        self.begun.wait()
        started_s = time.monotonic() - self.flight.now_s / SPEED
        while not self.ended.is_set():
            self.step()
            ahead_s = started_s + self.flight.now_s / SPEED - time.monotonic()
            if ahead_s > 0.0:
                time.sleep(ahead_s)
            else:
                started_s -= ahead_s

    def step(self) -> None:
        """Fly a little, and show it."""
        self.flight.run(STEP_S)
        companion = self.flight.companion
        if companion is not None:
            self.view.update(companion, self.flight.now_s)

    @property
    def vehicle_enu_m(self) -> tuple[float, float, float]:
        """Where the vehicle truly is."""
        return self.flight.sim.vehicle.body.position_enu_m


@contextmanager
def live_flight(
    folder: Path, settings: WebSettings | None = None, *, begins: bool = True
) -> Iterator[LiveFlight]:
    scenario = Scenario()
    settings = settings or web_settings(str(free_port()), is_control_on=True)
    truth = scenario.emitter.position_enu_m[:2]
    view = WebView(settings, AUTO, (truth[0], truth[1]))
    log = FlightJournal(folder, time.time())
    journal = view.listen(log)
    live = LiveFlight(settings, Flight(AUTO, scenario, 1, journal), view, journal)
    thread = threading.Thread(target=live.fly, daemon=True)
    thread.start()
    if begins:
        live.begun.set()
    try:
        yield live
    finally:
        live.ended.set()
        live.begun.set()
        thread.join(10.0)
        view.close()
        log.close(5.0)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox"], timeout=PATIENCE_MS
        )
        yield chromium
        chromium.close()


def box_of(page: Page, what: str) -> tuple[float, float, float, float]:
    """Left, top, width and height on the screen, pixels; the map draws anew with every picture."""
    give_up_s = time.monotonic() + PATIENCE_MS / 1000.0
    box = None
    while box is None:
        assert time.monotonic() < give_up_s, f"no {what} on the page"
        box = page.locator(what).first.bounding_box()
    return box["x"], box["y"], box["width"], box["height"]


class Watched:
    """A page, and everything its console complained of."""

    def __init__(self, browser: Browser, url: str, size: dict[str, int]) -> None:
        self.page: Page = browser.new_context(
            viewport={"width": size["width"], "height": size["height"]}
        ).new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.complaints: list[str] = []
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on(
            "console",
            lambda line: self.complaints.append(line.text) if line.type == "error" else None,
        )
        self.page.goto(url)

    def ellipse_px(self) -> float:
        """Size of the ellipse on the screen."""
        return math.hypot(*box_of(self.page, "path.ellipse")[2:])

    def r95_m(self) -> float:
        """As the page says it."""
        found = re.search(r"[\d.]+(?= m)", self.page.locator("#r95").inner_text())
        assert found is not None
        return float(found.group())


def test_the_ellipse_shrinks_to_the_emitter_on_a_desk_and_on_a_phone(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path, begins=False) as live:
        pages = [Watched(browser, live.settings.url, size) for size in (DESK, PHONE)]
        for watched in pages:
            assert_no_panel_is_empty(watched.page)
        live.begun.set()
        for watched in pages:
            watched.page.get_by_role("button", name="Whole").click()
            expect(watched.page.locator("path.ellipse")).to_have_count(1, timeout=PATIENCE_MS)
        first_px, first_m = pages[0].ellipse_px(), pages[0].r95_m()
        for watched in pages:
            phase = watched.page.locator("#phase")
            expect(phase).to_contain_text(re.compile("localised|found"), timeout=PATIENCE_MS)
            state = watched.page.locator("#estimate-state")
            expect(state).to_have_text("localised", timeout=PATIENCE_MS)
        assert pages[0].r95_m() < 0.5 * first_m
        assert pages[0].ellipse_px() < 0.5 * first_px
        centres = [
            (left + width / 2, top + height / 2)
            for left, top, width, height in (
                box_of(pages[0].page, name) for name in ("path.estimate", "path.truth")
            )
        ]
        apart = math.dist(*centres)
        assert apart < 25.0
        width = pages[1].page.evaluate("document.documentElement.scrollWidth")
        assert width <= PHONE["width"]
        for watched in pages:
            assert_no_panel_is_empty(watched.page)
        assert [watched.complaints for watched in pages] == [[], []]


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


def test_it_follows_until_somebody_wants_the_whole_and_rings_stay_few(
    browser: Browser, tmp_path: Path
) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, PHONE)
        page = watched.page
        expect(page.locator("#value-next")).to_contain_text("crossing 1", timeout=PATIENCE_MS)
        follow = page.get_by_role("button", name="Follow")
        expect(follow).to_have_class("is-on")
        page.get_by_role("button", name="Whole").click()
        expect(follow).not_to_have_class("is-on")
        page.wait_for_timeout(1500.0)
        scale = pixels_per_metre(page)
        fence, whole = box_of(page, "path.fence"), box_of(page, ".search-map")
        assert whole[0] < fence[0]
        assert fence[0] + fence[2] < whole[0] + whole[2]
        for _ in range(20):
            assert page.locator("path.range").count() <= MARKS
            page.wait_for_timeout(100.0)
        for button in page.get_by_role("button").all():
            box = button.bounding_box()
            assert box is None or box["height"] >= 40.0
        follow.click()
        give_up_s = time.monotonic() + PATIENCE_MS / 1000.0
        while pixels_per_metre(page) < 1.5 * scale:
            assert time.monotonic() < give_up_s, "the map does not follow"
            page.wait_for_timeout(200.0)
        assert watched.complaints == []


def test_without_ranging_its_bar_turns_red_and_hold_holds(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        watched = Watched(browser, live.settings.url, DESK)
        page = watched.page
        phase = page.locator("#phase")
        expect(phase).to_contain_text("searching", timeout=PATIENCE_MS)
        page.locator("#button-hold").click()
        page.locator("#confirm-hold").click()
        expect(phase).to_contain_text("the operator asked to hold", timeout=PATIENCE_MS)
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
        live.journal.text(Severity.WARNING, hostile, live.flight.now_s)
        expect(watched.page.locator("#texts")).to_contain_text(hostile, timeout=PATIENCE_MS)
        assert watched.page.locator("#texts img").count() == 0
        assert watched.page.title() == "Companion"


def status(url: str, **headers: str) -> int:
    """The HTTP status of a request."""
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20.0) as answer:
            code: int = answer.status
            return code
    except urllib.error.HTTPError as error:
        return error.code


def until_up(url: str) -> None:
    for _ in range(200):
        try:
            status(url)
        except urllib.error.URLError:
            time.sleep(0.1)
        else:
            return


def test_beyond_loopback_there_is_nothing_without_the_token(tmp_path: Path) -> None:
    settings = web_settings(f"0.0.0.0:{free_port()}", is_control_on=True)
    with live_flight(tmp_path, settings):
        base = f"http://127.0.0.1:{settings.port}/"
        until_up(base)
        assert status(base) == 403
        assert status(f"{base}?token=wrong-token") == 403
        assert status(f"{base}?token={settings.token}") == 200


def test_a_name_that_a_stranger_points_at_us_is_refused(tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        until_up(live.settings.url)
        assert status(live.settings.url, Host="evil.example") == 421
        assert status(live.settings.url) == 200


def test_a_recorded_flight_is_shown_with_all_emitters_and_stays_until_it_is_ended(
    browser: Browser, tmp_path: Path
) -> None:
    fly(PLANS["two_emitters"], tmp_path)
    port = free_port()
    options = ["replay", str(tmp_path / "0"), "--web", str(port), "--speed", "4"]
    command = [sys.executable, "-m", "companion", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as replay:
        try:
            assert replay.stdout is not None
            url = f"http://127.0.0.1:{port}/"
            until_up(url)
            watched = Watched(browser, url, DESK)
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
            assert replay.wait(timeout=15.0) == 0
        finally:
            replay.kill()
