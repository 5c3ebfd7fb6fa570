"""The site: built without a warning, searched, and nothing of it fetched from elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.e2e.live_map_rig import DESK, Watched, chromium, needs_chromium

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    environment = dict(os.environ, NO_MKDOCS_2_WARNING="1")
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    handler = partial(QuietHandler, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_every_page_of_docs_is_on_the_site_and_in_its_menu(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        name = str(page.relative_to(ROOT / "docs").with_suffix(".html"))
        assert (site / name).exists()
        assert f'href="{name}"' in start, f"{name} is in no menu"
    assert ">flying.md</a>" not in (site / "safety.html").read_text(encoding="utf-8")
    assert "../configs" not in (site / "configuration.html").read_text(encoding="utf-8")


@needs_chromium
def test_a_reader_searches_and_nothing_comes_from_elsewhere(address: str) -> None:
    with chromium() as browser:
        watched = Watched(browser, f"{address}/index.html", DESK)
        page, strangers = watched.page, []
        page.on("request", lambda each: None if address in each.url else strangers.append(each.url))
        page.reload()
        page.keyboard.press("/")
        page.keyboard.type("fence")
        expect(page.locator(".md-search-result__meta")).to_contain_text("matching documents")
        assert [each for each in strangers if not each.startswith(("data:", "blob:"))] == []
        assert watched.complaints == []
