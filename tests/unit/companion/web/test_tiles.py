"""Folders of map tiles as people have them."""

import io
from pathlib import Path

from PIL import Image

from companion.web.settings import tile, zooms_of


def put(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())


def test_the_zooms_are_those_that_have_a_tile(tmp_path: Path) -> None:
    put(tmp_path, "15/3/4.png", "17/12/16.png", "18/24/32.jpg", "licence.txt")
    (tmp_path / "19").mkdir()
    assert zooms_of(tmp_path) == (15, 17)


def test_other_pictures_are_no_tiles(tmp_path: Path) -> None:
    assert zooms_of(tmp_path) is None
    put(tmp_path, "photo.png", "holiday/1/2.png", "15/x/4.png", "15/3/cover.png", "15/3.png")
    assert zooms_of(tmp_path) is None


def test_where_there_is_no_tile_the_map_shows_nothing(tmp_path: Path) -> None:
    put(tmp_path, "15/3/4.png")
    assert tile(tmp_path, 15, 3, 4) == b"15/3/4.png"
    picture = Image.open(io.BytesIO(tile(tmp_path, 15, 3, 5)))
    assert (picture.size, picture.convert("RGBA").getpixel((0, 0))) == ((1, 1), (0, 0, 0, 0))
