"""Access to the live map and its tiles: with and without the token, and from other sites."""

from __future__ import annotations

import asyncio
import resource
import uuid
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlencode

import pytest
from playwright.sync_api import Browser, expect
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from companion.web.settings import NO_TILE, web_settings
from tests.e2e.live_map_rig import (
    DESK,
    ENDLESS,
    FLYING,
    PATIENCE_MS,
    Watched,
    chromium,
    live_flight,
    needs_chromium,
    status,
    until_up,
    with_tile,
)
from tests.ports import free_port

MAX_MB = 10.0
"""Kept, eighty pages have 50 MB and three hundred refusals 13 MB."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.mark.slow
def test_beyond_loopback_there_is_nothing_without_the_token(tmp_path: Path) -> None:
    settings = web_settings(f"0.0.0.0:{free_port()}", is_control_on=True)
    with live_flight(tmp_path, settings):
        base = f"http://127.0.0.1:{settings.port}/"
        until_up(base)
        assert status(base) == 403
        assert status(f"{base}?token=wrong-token") == 403
        assert status(f"{base}?token={settings.token}") == 200


@pytest.mark.slow
def test_the_page_has_a_memory_limit_of_its_own_and_ends_before_the_flight(tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        until_up(live.settings.url)
        process = live.view.process.process_id
        most_bytes, _ = resource.prlimit(process, resource.RLIMIT_DATA)
        assert 0 < most_bytes <= 2**30 // 2  # MemoryMax of the service is twice that
        score = Path("/proc/{}/oom_score_adj")
        assert int(Path(str(score).format(process)).read_text()) > 0
        assert int(Path(str(score).format("self")).read_text()) <= 0


@pytest.mark.slow
def test_a_name_that_a_stranger_points_at_us_is_refused(tmp_path: Path) -> None:
    with live_flight(tmp_path) as live:
        until_up(live.settings.url)
        assert status(live.settings.url, Host="evil.example") == 421
        assert status(live.settings.url) == 200


def resident_mb(process_id: int) -> float:
    """Memory of a process that is in RAM."""
    pages = int(Path(f"/proc/{process_id}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@pytest.mark.slow
def test_requests_that_no_browser_follows_cost_no_memory(tmp_path: Path) -> None:
    settings = web_settings(f"0.0.0.0:{free_port()}", is_control_on=True)
    with live_flight(tmp_path, settings) as live:
        base = f"http://127.0.0.1:{settings.port}/"
        until_up(base)
        page = live.view.process.process_id
        kinds = {f"{base}?token={settings.token}": 80, base: 300, f"{base}nowhere": 300}
        for url, count in kinds.items():
            codes = {status(url) for _ in range(20)}
            before_mb = resident_mb(page)
            codes |= {status(url) for _ in range(count)}
            assert len(codes) == 1
            assert resident_mb(page) - before_mb < MAX_MB, url


async def received(address: str) -> str:
    """Return all that a client with an invented page number receives in two seconds."""
    query = {
        "EIO": 4,
        "transport": "websocket",
        "client_id": str(uuid.uuid4()),
        "tab_id": str(uuid.uuid4()),
        "document_id": str(uuid.uuid4()),
        "next_message_id": 0,
        "implicit_handshake": "true",
    }
    texts: list[str] = []
    try:
        async with asyncio.timeout(2.0), connect(f"{address}?{urlencode(query)}") as page:
            texts.append(str(await page.recv()))
            await page.send("40")
            while True:
                texts.append(str(await page.recv()))
    except (TimeoutError, WebSocketException):
        return "\n".join(texts)


@pytest.mark.slow
def test_a_socket_without_a_page_tells_nothing_of_the_flight(tmp_path: Path) -> None:
    settings = web_settings(f"0.0.0.0:{free_port()}", is_control_on=True)
    with live_flight(tmp_path, settings):
        until_up(f"http://127.0.0.1:{settings.port}/")
        address = f"ws://127.0.0.1:{settings.port}/_nicegui_ws/socket.io/"
        text = asyncio.run(received(address))
        assert "R95" not in text
        assert "vehicle" not in text
        assert len(text) < 1000


@pytest.mark.slow
def test_tiles_are_for_those_who_may_look_and_nothing_beside_them_is_served(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(NO_TILE)
    settings = web_settings(f"0.0.0.0:{free_port()}", tiles=with_tile(tmp_path))
    with live_flight(tmp_path, settings):
        base = f"http://127.0.0.1:{settings.port}/"
        until_up(base)
        assert status(f"{base}tiles/15/3/4.png") == 403
        assert status(f"{base}tiles/15/3/4.png?token={settings.token}") == 200
        assert status(f"{base}tiles/15/3/5.png?token={settings.token}") == 200
        outside = f"{base}tiles/15/..%2F..%2F..%2F/secret.png?token={settings.token}"
        assert status(outside) in (404, 422)


@pytest.mark.slow
@needs_chromium
def test_an_open_map_has_buttons_only_with_the_token_and_lays_it_on_tiles(
    browser: Browser, tmp_path: Path
) -> None:
    settings = web_settings(
        f"0.0.0.0:{free_port()}",
        is_control_on=True,
        is_view_open=True,
        tiles=with_tile(tmp_path),
    )
    with live_flight(tmp_path, settings, begins=False, config=ENDLESS) as live:
        base = f"http://127.0.0.1:{settings.port}/"
        until_up(base)
        looking = Watched(browser, base, DESK)
        pressing = Watched(browser, f"{base}?token={settings.token}", DESK)
        live.begun.set()
        for watched in (looking, pressing):
            expect(watched.page.locator("#phase")).to_contain_text(FLYING, timeout=PATIENCE_MS)
            expect(watched.page.locator(".leaflet-tile")).not_to_have_count(0)
        assert looking.page.locator("#button-hold").count() == 0
        pressing.page.locator("#button-hold").click()
        pressing.page.locator("#confirm-hold").click()
        phase = looking.page.locator("#phase")
        expect(phase).to_contain_text("operator requested hold", timeout=PATIENCE_MS)
        assert [looking.complaints, pressing.complaints] == [[], []]
