from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from companion.config.area_files import read_search_site
from companion.config.schema import load_config
from companion.errors import ConfigError
from companion.geometry.coordinates import LocalOrigin
from companion.search.search_site import SiteRaster, grid_of_site

ORIGIN = LocalOrigin(47.0, 8.0, 400.0)
RING = [[8.0, 47.0], [8.002, 47.0], [8.002, 47.002], [8.0, 47.002], [8.0, 47.0]]
HOLE = [[8.0005, 47.0005], [8.001, 47.0005], [8.001, 47.001], [8.0005, 47.001], [8.0005, 47.0005]]
EAST = [[lon + 0.002, lat] for lon, lat in RING]


def geojson(*polygons: tuple[list[object], object]) -> str:
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": rings},
            "properties": None if weight is None else {"weight": weight},
        }
        for rings, weight in polygons
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_polygons_have_their_weights_and_holes(tmp_path: Path) -> None:
    path = written(tmp_path / "poa.geojson", geojson(([RING, HOLE], 70), ([EAST], 30)))
    grid = grid_of_site(read_search_site(path), ORIGIN, 10.0)
    east = grid.centres_enu_m[:, 0] > 152.0  # 0.002 degrees at 47 degrees north
    assert grid.poa[~east].sum() == pytest.approx(0.7, abs=0.01)
    in_hole = (abs(grid.centres_enu_m - (57.0, 83.0)) < 15.0).all(axis=1)
    assert not in_hole.any()


def placemark(
    ring: list[list[float]], data: str = "", hole: list[list[float]] | None = None
) -> str:
    def boundary(name: str, places: list[list[float]]) -> str:
        text = " ".join(f"{lon},{lat},0" for lon, lat in places)
        ring = f"<LinearRing><coordinates>{text}</coordinates></LinearRing>"
        return f"<{name}>{ring}</{name}>"

    inner = "" if hole is None else boundary("innerBoundaryIs", hole)
    polygon = f"<Polygon>{boundary('outerBoundaryIs', ring)}{inner}</Polygon>"
    return f"<Placemark><ExtendedData>{data}</ExtendedData>{polygon}</Placemark>"


def kml(*placemarks: str) -> str:
    inner = "".join(placemarks)
    space = "http://www.opengis.net/kml/2.2"
    return f'<kml xmlns="{space}"><Document><Folder>{inner}</Folder></Document></kml>'


def data(value: str) -> str:
    return f'<Data name="weight"><value>{value}</value></Data>'


def test_kml_is_the_same_area_as_geojson(tmp_path: Path) -> None:
    simple = '<SchemaData><SimpleData name="weight">30</SimpleData></SchemaData>'
    text = kml(placemark(RING, data("70"), HOLE), placemark(EAST, simple))
    by_kml = read_search_site(written(tmp_path / "poa.kml", text))
    by_json = written(tmp_path / "poa.geojson", geojson(([RING, HOLE], 70), ([EAST], 30)))
    assert by_kml == read_search_site(by_json)


def test_without_weights_all_polygons_count_the_same(tmp_path: Path) -> None:
    path = written(tmp_path / "poa.json", geojson(([RING], None), ([EAST], None)))
    grid = grid_of_site(read_search_site(path), ORIGIN, 10.0)
    assert grid.poa.max() == pytest.approx(grid.poa.min(), rel=0.05)


def test_a_raster_is_north_up_and_skips_what_has_no_data(tmp_path: Path) -> None:
    text = """ncols 2
nrows 2
xllcorner 8.0
yllcorner 47.0
cellsize 0.001
NODATA_value -1
1 -1
2 3
"""
    site = read_search_site(written(tmp_path / "poa.asc", text))
    assert isinstance(site, SiteRaster)
    grid = grid_of_site(site, ORIGIN, 10.0)
    east, north = grid.centres_enu_m.T
    north_east = (east > 76.0) & (north > 112.0)
    assert not north_east.any()
    south_east = (east > 76.0) & (north < 111.0)
    north_west = (east < 76.0) & (north > 112.0)
    assert np.median(grid.poa[south_east]) == pytest.approx(3.0 * np.median(grid.poa[north_west]))


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("poa.kmz", "", "a search area is a .geojson, .kml or .asc file, in degrees"),
        ("poa.geojson", "{", "not JSON"),
        ("poa.geojson", "[]", "not a GeoJSON object"),
        ("poa.geojson", geojson(), "there is no polygon in it"),
        ("poa.geojson", geojson(([RING], 0)), "no polygon has a weight above 0"),
        ("poa.geojson", geojson(([RING], -1)), "weight is not a number from 0 on"),
        ("poa.geojson", geojson(([RING], "70")), "weight is not a number"),
        ("poa.geojson", geojson(([[[2.6e6, 1.2e6]] * 4], 1)), "are not degrees; save it as WGS84"),
        ("poa.geojson", geojson(([RING[:2]], 1)), "fewer than 3 corners"),
        ("poa.geojson", geojson(([[RING[0], RING[2], RING[1], RING[3]]], 1)), "cross each other"),
        ("poa.kml", kml(), "there is no polygon in it"),
        ("poa.kml", kml(placemark(RING, data("0"))), "no polygon has a weight above 0"),
        ("poa.kml", kml(placemark(RING, data("much"))), "Placemark 1: its weight is not a number"),
        ("poa.kml", kml(placemark([[2.6e6, 1.2e6]] * 4)), "are not degrees; save it as WGS84"),
        ("poa.kml", kml(placemark(RING[:2])), "fewer than 3 corners"),
        ("poa.kml", "<gpx/>", "is not KML"),
        ("poa.kml", "<kml>", "not XML"),
        ("poa.asc", "ncols 2\nnrows 2\n1 2\n3 4", "the header has no xllcorner"),
        ("poa.asc", "ncols two\n", "`two` is not a number"),
        (
            "poa.asc",
            "ncols 2\nnrows 2\nxllcorner 2600000\nyllcorner 1200000\ncellsize 20\n1 2 3 4",
            "are not degrees; save it as WGS84",
        ),
        (
            "poa.asc",
            "ncols 2\nnrows 2\nxllcorner 8\nyllcorner 47\ncellsize 0.001\n1 2 3",
            "3 values for 2 by 2 cells",
        ),
        (
            "poa.asc",
            "ncols 1\nnrows 1\nxllcorner 8\nyllcorner 47\ncellsize 0.001\n-5",
            "weights must be 0 or above",
        ),
        (
            "poa.asc",
            "ncols 10000\nnrows 1000\nxllcorner 8\nyllcorner 47\ncellsize 0.00001\n1",
            "10000000 cells; at most 4000000",
        ),
    ],
)
def test_what_is_no_search_area_is_one_clear_line(
    name: str, text: str, problem: str, tmp_path: Path
) -> None:
    path = written(tmp_path / name, text)
    with pytest.raises(ConfigError) as found:
        read_search_site(path)
    line = str(found.value)
    assert line.startswith(str(path))
    assert problem in line
    assert "\n" not in line


def test_an_area_of_another_place_is_refused(tmp_path: Path) -> None:
    site = read_search_site(written(tmp_path / "poa.geojson", geojson(([RING], 1))))
    with pytest.raises(ValueError, match="km from the vehicle's origin"):
        grid_of_site(site, LocalOrigin(52.0, 8.0, 0.0), 20.0)


def test_a_configuration_names_its_file_and_what_is_wrong(tmp_path: Path) -> None:
    written(tmp_path / "poa.geojson", geojson(([RING], 0)))
    config = written(tmp_path / "search.yaml", "search: {area_file: poa.geojson}\n")
    with pytest.raises(ConfigError, match=r"\$\.search\.area_file: .*no polygon has a weight"):
        load_config(config)
    written(tmp_path / "poa.geojson", geojson(([RING], 1)))
    assert load_config(config).search.area_file == str(tmp_path / "poa.geojson")
