"""The live map in a browser: what its buttons answer, and that a dead page is seen to be dead."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from companion.domain import FlightMode
from tests.e2e.live_map_rig import (
    DESK,
    ENDLESS,
    FLYING,
    PHONE,
    PHONE_ACROSS,
    LiveFlight,
    Watched,
    chromium,
    live_flight,
    needs_chromium,
    until,
    until_up,
)
from tests.e2e.simulator_process import PATIENCE_S
from tests.ports import free_port

pytestmark = [needs_chromium, pytest.mark.slow]

SIZES = [DESK, PHONE, PHONE_ACROSS]
DEAD_S = 2.0
ANSWER_S = 1.0
LOAD_S = 1.0
"""Time that a busy machine may take in addition, which is not part of the promise."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


def shot(watched: Watched, name: str) -> None:
    """Keep a picture for people, where a folder for them is given."""
    folder = os.environ.get("LIVE_MAP_SHOTS")
    if folder:
        watched.page.screenshot(path=f"{folder}/{name}.png")


NOTE_DEATH = """() => new MutationObserver(() => {
  if (document.body.classList.contains("is-dead")) window.deadAt ??= Date.now();
}).observe(document.body, { attributeFilter: ["class"] })"""
"""The browser's own time of the red bar: asking for it takes long on a busy machine."""


def assert_dies_and_lives(live: LiveFlight, pages: list[Watched], how: int) -> None:
    """The pages are seen to be dead after a signal to their process, and live again later."""
    for watched in pages:
        expect(watched.page.locator("#phase")).to_contain_text(FLYING)
        expect(watched.page.locator("#dead")).not_to_be_visible()
        watched.page.evaluate(NOTE_DEATH)
    first = live.view.process.process_id
    os.kill(first, how)
    killed_s = time.time()
    for number, watched in enumerate(pages):
        watched.page.wait_for_selector("#dead", state="visible")
        assert watched.page.evaluate("deadAt") / 1000.0 - killed_s < DEAD_S + LOAD_S
        assert re.search(r"Not live since \d\d:\d\d:\d\d UTC", watched.page.inner_text("#dead"))
        grey = watched.page.locator(".nicegui-content").evaluate("e => getComputedStyle(e).filter")
        assert grey == "grayscale(1)"
        box = watched.page.locator("#dead").bounding_box()
        assert box is not None
        assert box["y"] >= 0.0
        shot(watched, f"dead-{how}-{number}")
    if how == signal.SIGSTOP:
        os.kill(first, signal.SIGCONT)
    for watched in pages:
        expect(watched.page.locator("#dead")).not_to_be_visible()
        expect(watched.page.locator("#phase")).to_contain_text(FLYING)
    assert (live.view.process.process_id == first) is (how == signal.SIGSTOP)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "cut off"])
def test_a_dead_page_says_so_and_comes_back(browser: Browser, tmp_path: Path, how: int) -> None:
    """A stopped process is as a lost network: connections stay open, and nothing arrives."""
    with live_flight(tmp_path, config=ENDLESS) as live:
        pages = [Watched(browser, live.settings.url, size) for size in SIZES]
        assert_dies_and_lives(live, pages, how)
        for watched in pages:
            expect(watched.page.locator("path.track")).to_have_count(1)


def test_a_companion_that_falls_silent_is_seen_too(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, PHONE)
        watched.page.wait_for_selector("#dead", state="visible")
        live.begun.set()
        expect(watched.page.locator("#dead")).not_to_be_visible()


def press(watched: Watched, name: str) -> None:
    watched.page.locator(f"#button-{name}").click()
    watched.page.locator(f"#confirm-{name}").click()


def assert_reasons(watched: Watched, reasons: dict[str, str]) -> None:
    """Buttons that would do nothing are grey and say why; the others can be pressed."""
    for name in ("hold", "resume", "return", "grant"):
        button = watched.page.locator(f"#button-{name}")
        reason = reasons.get(name, "")
        expect(watched.page.locator(f"#reason-{name}")).to_have_text(reason)
        (expect(button).to_be_disabled if reason else expect(button).to_be_enabled)()


@pytest.mark.parametrize("size", SIZES, ids=["desk", "phone", "phone across"])
def test_buttons_are_grey_with_the_reason_and_every_press_is_answered(
    browser: Browser, tmp_path: Path, size: dict[str, int]
) -> None:
    with live_flight(tmp_path, begins=False, config=ENDLESS) as live:
        live.speed = 1.0
        watched = Watched(browser, live.settings.url, size)
        page = watched.page
        not_yet = dict.fromkeys(("hold", "resume", "return"), "not ready yet")
        assert_reasons(watched, {**not_yet, "grant": "not needed: not ready yet"})
        live.begun.set()
        expect(page.locator("#phase")).to_contain_text(FLYING)
        assert_reasons(watched, {"resume": "no HOLD is active", "grant": "already in control"})
        shot(watched, f"flying-{size['width']}")
        press(watched, "hold")
        pressed_s = time.monotonic()
        page.wait_for_selector("text=HOLD accepted")
        assert time.monotonic() - pressed_s < ANSWER_S + LOAD_S
        assert_reasons(watched, {"hold": "already done", "grant": "already in control"})
        page.locator("#button-resume").click()  # ... and meanwhile the pilot takes over
        live.wishes.put(lambda: choose(live, FlightMode.HOLD))
        expect(page.locator("#phase")).to_contain_text("pilot or another system has control")
        page.locator("#confirm-resume").click()
        page.wait_for_selector("text=RESUME refused: ")
        shot(watched, f"refused-{size['width']}")
        ready = dict.fromkeys(("hold", "resume", "return"), "not in control yet")
        assert_reasons(watched, {**ready, "grant": "not needed: switch to offboard mode"})
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= size["width"]
        assert watched.complaints == []


def choose(live: LiveFlight, mode: FlightMode) -> None:
    """A pilot chooses a mode."""
    live.flight.sim.vehicle.flavour.pilot_chooses(mode, live.flight.now_s)


def test_a_press_without_an_answer_is_reported(browser: Browser, tmp_path: Path) -> None:
    with live_flight(tmp_path, config=ENDLESS) as live:
        watched = Watched(browser, live.settings.url, DESK)
        expect(watched.page.locator("#phase")).to_contain_text(FLYING)
        watched.page.locator("#button-hold").click()
        live.begun.clear()
        live.wishes.put(lambda: until(live.begun.is_set, "the test does not go on"))
        watched.page.locator("#confirm-hold").click()
        watched.page.wait_for_selector("text=HOLD: no answer from the companion yet")
        live.begun.set()
        watched.page.wait_for_selector("text=HOLD accepted")


@pytest.mark.parametrize("end", ["browser", "ctrl-c"])
def test_the_page_of_a_demo_outlives_it(browser: Browser, tmp_path: Path, end: str) -> None:
    """HAND OVER is on it, and the demo is over before anyone has pressed it."""
    port = free_port()
    options = ["demo", "--web", str(port), "--no-browser", "--no-plot", "--speed", "4"]
    command = [sys.executable, "-m", "companion", *options]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as demo:
        try:
            url = f"http://127.0.0.1:{port}/"
            until_up(url)
            watched = Watched(browser, url, PHONE)
            assert demo.stdout is not None
            assert any("LOCALISED" in line for line in iter(demo.stdout.readline, ""))
            page = watched.page
            expect(page.locator("#phase")).to_contain_text("FLIGHT OVER")
            time.sleep(3.0)
            expect(page.locator("#dead")).not_to_be_visible()
            page.locator("#button-handoff").click()
            expect(page.locator(".handoff .qr").first).to_be_visible()
            shot(watched, "demo-over")
            assert demo.poll() is None
            if end == "browser":
                page.close()
            else:
                demo.send_signal(signal.SIGINT)
            assert demo.wait(timeout=PATIENCE_S) == 0
        finally:
            demo.kill()
