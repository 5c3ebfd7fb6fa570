from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.config.area_files import MAX_BYTES, read_fence
from companion.errors import ConfigError
from companion.geometry.geofence import GeoArea, GeoFence

CORNERS = [[47.0, 8.0], [47.0, 8.01], [47.01, 8.0]]
FENCE = GeoFence(GeoArea(tuple((lat, lon) for lat, lon in CORNERS)))


def _plan(corners: list[list[float]]) -> str:
    polygon = {"inclusion": True, "polygon": corners, "version": 1}
    fence = {"circles": [], "polygons": [polygon], "version": 2}
    return json.dumps({"fileType": "Plan", "geoFence": fence, "version": 1})


def _kml(corners: list[list[float]]) -> str:
    ring = " ".join(f"{lon},{lat}" for lat, lon in corners)
    inside = f"<LinearRing><coordinates>{ring}</coordinates></LinearRing>"
    return f"<kml><Polygon><outerBoundaryIs>{inside}</outerBoundaryIs></Polygon></kml>"


@pytest.mark.parametrize("name", ["site.plan", "SITE.PLAN", "site.kml"])
def test_both_formats_give_the_same_fence(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    text = _kml(CORNERS) if path.suffix == ".kml" else _plan(CORNERS)
    path.write_text(text)
    assert read_fence(path) == FENCE
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_fence(path) == FENCE


@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("site.json", b"", "a fence is a .plan or .kml file"),
        ("site.kmz", b"", "there is a .kml in it"),
        ("site.plan", b"\xff\xfe", "not UTF-8 text (byte 0)"),
        ("site.plan", b" " * (MAX_BYTES + 1), "larger than 10000 kB"),
        ("site.plan", b"{", "line 1, column 2"),
        ("site.kml", b"<kml/>", "no inclusion area"),
        ("site.plan", _plan(CORNERS[:2]).encode(), "geoFence.polygons[0]: has 2 corners"),
        (
            "site.plan",
            _plan([[0, 0], *CORNERS]).encode(),
            "geoFence.polygons[0]: corner 1: 0/0 means",
        ),
    ],
)
def test_a_bad_file_is_refused_in_one_line(
    tmp_path: Path, name: str, data: bytes, problem: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ConfigError) as error:
        read_fence(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert problem in text
    assert "\n" not in text


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_fence(tmp_path / "none.plan")
    (tmp_path / "folder.plan").mkdir()
    with pytest.raises(ConfigError, match="cannot be read"):
        read_fence(tmp_path / "folder.plan")
