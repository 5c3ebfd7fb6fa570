"""Map tiles from a server into the map's folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from companion.cli import main
from companion.errors import EXIT_BAD_INPUT
from companion.setup_tools import config_commands
from companion.setup_tools.config_commands import wanted_tiles
from companion.web.settings import tile

PNG = b"\x89PNG\r\n\x1a\n"


def picture(zoom: int, x: int, y: int) -> bytes:
    return PNG + f"{zoom}/{x}/{y}".encode()


class TileServer(BaseHTTPRequestHandler):
    asked: list[str] = []  # noqa: RUF012 - one server at a time
    fails_after = 10_000

    def do_GET(self) -> None:
        self.asked.append(self.path)
        is_there = len(self.asked) <= self.fails_after
        self.send_response(200 if is_there else 503)
        self.end_headers()
        if is_there:
            self.wfile.write(picture(*map(int, self.path.strip("/").split("/"))))

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    TileServer.asked, TileServer.fails_after = [], 10_000
    with ThreadingHTTPServer(("127.0.0.1", 0), TileServer) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}" + "/{z}/{x}/{y}"
        running.shutdown()


def fetch(url: str, folder: Path) -> int:
    options = ("--around", "47.398,8.546", "--radius", "300", "--zoom", "15-16")
    return main(["tiles", "fetch", url, str(folder), *options])


def test_what_a_server_has_about_a_place_is_fetched_once(server: str, tmp_path: Path) -> None:
    wanted = wanted_tiles("47.398,8.546", 300.0, "15-16")
    assert fetch(server, tmp_path) == 0
    assert TileServer.asked == [f"/{z}/{x}/{y}" for z, x, y in wanted]
    assert all(tile(tmp_path, *position) == picture(*position) for position in wanted)
    assert fetch(server, tmp_path) == 0
    assert len(TileServer.asked) == len(wanted)


def test_after_a_failure_it_goes_on_where_it_was(
    server: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    TileServer.fails_after = 3
    assert fetch(server, tmp_path) == EXIT_BAD_INPUT
    assert "run it again to continue" in capsys.readouterr().err
    TileServer.fails_after = 10_000
    assert fetch(server, tmp_path) == 0
    asked = len(wanted_tiles("47.398,8.546", 300.0, "15-16")) + 1
    assert len(TileServer.asked) == asked


def test_what_is_too_large_for_a_tile_is_not_cut_and_stored(
    server: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config_commands, "MAX_TILE_BYTES", 10)
    assert fetch(server, tmp_path) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "more than 10 bytes" in line
    assert list(tmp_path.rglob("*.png")) == []


def test_the_tiles_are_those_of_the_usual_web_map() -> None:
    # Zürich, by the formulas of the OpenStreetMap wiki, "Slippy map tilenames"
    assert wanted_tiles("47.3769,8.5417", 1.0, "12") == [(12, 2145, 1434)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("https://t/{z}/{x}", "--around", "47,8"), "{z}, {x} and {y}"),
        (("ftp://t/{z}/{x}/{y}", "--around", "47,8"), "http://"),
        (("https://t/{z}/{x}/{y}", "--around", "here"), "give LAT,LON"),
        (("https://t/{z}/{x}/{y}", "--around", "47,8", "--zoom", "3-99"), "--zoom 3-99"),
        (
            ("https://t/{z}/{x}/{y}", "--around", "47,8", "--radius", "90000", "--zoom", "20"),
            "more than 20000 tiles",
        ),
    ],
)
def test_a_wish_that_makes_no_sense_asks_no_server(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], words: str
) -> None:
    url, *more = options
    assert main(["tiles", "fetch", url, str(tmp_path), *more]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
