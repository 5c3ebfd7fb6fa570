"""A flight that really happens, its live map, and a browser that looks at it."""

from __future__ import annotations

import math
import re
import shutil
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from companion.io.flight_recorder import FlightJournal
from companion.link.interface import Journal
from companion.run import ViewedJournal
from companion.web.live_map import WebView
from companion.web.settings import NO_TILE, WebSettings, web_settings
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight
from tests.ports import free_port

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt install chromium")

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
ENDLESS = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=3600.0))
"""Is never content with what it found: a browser may take its time to press a button."""
CANONICAL = Scenario()
SPEED = 4.0
SLOWLY = 0.2
"""Speed at which a view can be checked before the flight goes on."""
STEP_S = 0.05
FLYING = re.compile("searching|confirming")
"""The phase on the page while the companion flies the vehicle."""
PATIENCE_MS = 60_000
expect.set_options(timeout=PATIENCE_MS)
DESK, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}
TABLET, PHONE_ACROSS = {"width": 1024, "height": 768}, {"width": 844, "height": 390}


@dataclass
class LiveFlight:
    """A flight that goes on in its own thread, and its page."""

    settings: WebSettings
    flight: Flight
    view: WebView
    journal: Journal
    speed: float = SPEED
    begun: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    wishes: SimpleQueue[Callable[[], None]] = field(default_factory=SimpleQueue)
    """Calls that a test requests of the flight's thread, as its parts are for one thread only."""

    def fly(self) -> None:
        """Fly on at its speed until the test is over."""
        self.step()  # the page wants a first picture
        self.begun.wait()
        due_s = time.monotonic()
        while not self.ended.is_set():
            self.step()
            due_s = max(due_s + STEP_S / self.speed, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))

    def step(self) -> None:
        """Fly a little, and show it."""
        while not self.wishes.empty():
            self.wishes.get()()
        self.flight.run(STEP_S)
        companion = self.flight.companion
        if companion is not None:
            self.view.update(companion, self.flight.now_s)

    @property
    def has_estimate(self) -> bool:
        """True once the companion has an estimate."""
        companion = self.flight.companion
        return companion is not None and companion.session.estimate is not None

    @property
    def vehicle_enu_m(self) -> tuple[float, float, float]:
        """True position of the vehicle."""
        return self.flight.sim.vehicle.body.position_enu_m


@contextmanager
def live_flight(
    folder: Path,
    settings: WebSettings | None = None,
    *,
    begins: bool = True,
    config: CompanionConfig = AUTO,
    scenario: Scenario = CANONICAL,
) -> Iterator[LiveFlight]:
    settings = settings or web_settings(str(free_port()), is_control_on=True)
    truth = scenario.emitter.position_enu_m[:2]
    view = WebView(settings, config, (truth[0], truth[1]))
    log = FlightJournal(folder, time.time())
    journal = ViewedJournal(log, [view])
    live = LiveFlight(settings, Flight(config, scenario, 1, journal), view, journal)
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


@contextmanager
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox"], timeout=PATIENCE_MS
        )
        yield started
        started.close()


def box_of(page: Page, what: str) -> tuple[float, float, float, float]:
    """Return left, top, width and height on the screen, pixels; every picture redraws the map."""
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
        """Return R95 as the page shows it."""
        line = self.page.locator("#r95")
        expect(line).to_contain_text(re.compile(r"\d m"))
        found = re.search(r"[\d.]+(?= m)", line.inner_text())
        assert found is not None
        return float(found.group())


def status(url: str, **headers: str) -> int:
    """The HTTP status of a request."""
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_MS / 1000.0) as answer:
            code: int = answer.status
            return code
    except urllib.error.HTTPError as error:
        return error.code


def until(condition: Callable[[], bool], otherwise: str) -> None:
    """Wait for something on the page, which takes its time where the machine is busy."""
    give_up_s = time.monotonic() + PATIENCE_MS / 1000.0
    while not condition():
        assert time.monotonic() < give_up_s, otherwise
        time.sleep(0.05)


def until_up(url: str) -> None:
    """Wait until a server answers at an address."""
    until(lambda: is_up(url), f"no answer at {url}")


def is_up(url: str) -> bool:
    """Return True if a server answers."""
    try:
        status(url)
    except urllib.error.URLError:
        return False
    return True


def with_tile(folder: Path) -> Path:
    """A folder with one tile."""
    path = folder / "tiles" / "15" / "3" / "4.png"
    path.parent.mkdir(parents=True)
    path.write_bytes(NO_TILE)
    return folder / "tiles"
