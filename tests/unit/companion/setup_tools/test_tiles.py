"""Map tiles from archives that others write, and from a server, into the map's folder."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import write as write_pmtiles

from companion.cli import EXIT_BAD_INPUT, main
from companion.setup_tools.tile_commands import wanted_tiles
from companion.web.settings import tile, zooms_of

PNG = b"\x89PNG\r\n\x1a\n"
PLACES = [
    (z, x, y) for z in (0, 1, 2, 5) for x in range(2 ** min(z, 2)) for y in range(2 ** min(z, 2))
]


def picture(zoom: int, x: int, y: int) -> bytes:
    return PNG + f"{zoom}/{x}/{y}".encode()


def mbtiles(path: Path, format: str = "png") -> Path:
    with closing(sqlite3.connect(path)) as archive, archive:
        archive.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        archive.execute("INSERT INTO metadata VALUES ('format', ?)", (format,))
        archive.execute(
            "CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)"
        )
        for zoom, x, y in PLACES:
            row = 2**zoom - 1 - y
            values = (zoom, x, row, picture(zoom, x, y))
            archive.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", values)
    return path


def pmtiles(path: Path, kind: TileType = TileType.PNG, same: bool = False) -> Path:
    header: dict[str, object] = {"tile_type": kind, "tile_compression": Compression.NONE}
    header |= {"min_lon_e7": 0, "min_lat_e7": 0, "max_lon_e7": 1, "max_lat_e7": 1}
    with write_pmtiles(str(path)) as writer:
        for place in sorted(PLACES, key=lambda each: zxy_to_tileid(*each)):
            data = PNG if same else picture(*place)
            writer.write_tile(zxy_to_tileid(*place), data)
        writer.finalize(header, {})
    return path


@pytest.mark.parametrize("make", [mbtiles, pmtiles])
def test_every_tile_of_an_archive_is_where_the_map_looks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: object
) -> None:
    archive, folder = make(tmp_path / "site.tiles"), tmp_path / "tiles"  # type: ignore[operator]
    assert main(["tiles", "import", str(archive), str(folder)]) == 0
    assert zooms_of(folder) == (0, 5)
    for place in PLACES:
        assert tile(folder, *place) == picture(*place)
    assert f"{len(PLACES)} tiles in {folder}" in capsys.readouterr().out


def test_tiles_that_share_a_picture_are_all_there(tmp_path: Path) -> None:
    archive = pmtiles(tmp_path / "sea.pmtiles", same=True)
    assert main(["tiles", "import", str(archive), str(tmp_path / "tiles")]) == 0
    assert len(list((tmp_path / "tiles").rglob("*.png"))) == len(PLACES)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"GIF89a", "neither MBTiles nor PMTiles"),
        (b"SQLite format 3\x00" + bytes(200), "damaged"),
        (b"PMTiles\x03" + bytes(20), "damaged"),
        (b"PMTiles\x02" + bytes(200), "version 2"),
    ],
)
def test_what_is_no_archive_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, words: str
) -> None:
    archive = tmp_path / "site.tiles"
    archive.write_bytes(content)
    assert main(["tiles", "import", str(archive), str(tmp_path / "tiles")]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "tiles").exists()


def test_an_archive_cut_anywhere_never_ends_in_a_traceback(tmp_path: Path) -> None:
    whole = pmtiles(tmp_path / "whole.pmtiles").read_bytes()
    for size in range(0, len(whole) - 1, 97):
        archive = tmp_path / "cut.pmtiles"
        archive.write_bytes(whole[:size])
        assert main(["tiles", "import", str(archive), str(tmp_path / "t")]) == EXIT_BAD_INPUT


def test_vector_tiles_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archives = (mbtiles(tmp_path / "a", "pbf"), pmtiles(tmp_path / "b", TileType.MVT))
    for archive in archives:
        assert main(["tiles", "import", str(archive), str(tmp_path / "tiles")]) == EXIT_BAD_INPUT
        assert "has no pictures in it" in capsys.readouterr().err


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
    assert all(tile(tmp_path, *place) == picture(*place) for place in wanted)
    assert fetch(server, tmp_path) == 0
    assert len(TileServer.asked) == len(wanted)


def test_after_a_failure_it_goes_on_where_it_was(
    server: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    TileServer.fails_after = 3
    assert fetch(server, tmp_path) == EXIT_BAD_INPUT
    assert "run it again to go on" in capsys.readouterr().err
    TileServer.fails_after = 10_000
    assert fetch(server, tmp_path) == 0
    asked = len(wanted_tiles("47.398,8.546", 300.0, "15-16")) + 1
    assert len(TileServer.asked) == asked


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
