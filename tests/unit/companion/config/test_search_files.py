from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from companion.config.schema import load_config, with_fence
from companion.config.search_files import read_search_site
from companion.errors import ConfigError
from companion.geometry.coordinates import LocalOrigin
from companion.search.search_grid import SiteRaster, grid_of_site

ORIGIN = LocalOrigin(47.0, 8.0, 400.0)
RING = [[8.0, 47.0], [8.002, 47.0], [8.002, 47.002], [8.0, 47.002], [8.0, 47.0]]
HOLE = [[8.0005, 47.0005], [8.001, 47.0005], [8.001, 47.001], [8.0005, 47.001], [8.0005, 47.0005]]
EAST = [[lon + 0.002, lat] for lon, lat in RING]


def geojson(*polygons: tuple[Any, object]) -> str:
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
    def boundary(name: str, corners_deg: list[list[float]]) -> str:
        text = " ".join(f"{lon},{lat},0" for lon, lat in corners_deg)
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


RASTER = np.array([[1.0, -1.0, 4.0], [2.0, 3.0, 0.0]])
ASCII = """xllcorner 8.0
yllcorner 47.0
cellsize 0.001
"""
ROWS = "1 -1 4\n2 3 0\n"


def written_tiff(path: Path, values: np.ndarray[Any, Any] = RASTER, **changed: object) -> Path:
    """The raster, as GDAL writes it."""
    about: dict[str, Any] = {"crs": "EPSG:4326", "dtype": "float32", "nodata": -1.0} | changed
    transform = rasterio.Affine(0.001, 0.0, 8.0, 0.0, -0.001, 47.002)
    rows, columns = values.shape
    size = {"height": rows, "width": columns, "count": 1}
    with rasterio.open(path, "w", "GTiff", transform=transform, **size, **about) as file:
        file.write(values.astype(about["dtype"]), 1)
    return path


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"compress": "deflate"},
        {"dtype": "int16"},
        {"tiled": True, "blockxsize": 16, "blockysize": 16},
        {"crs": "EPSG:4258"},
    ],
)
def test_geotiff_is_the_same_raster_as_ascii(changed: dict[str, Any], tmp_path: Path) -> None:
    header = f"ncols 3\nnrows 2\n{ASCII}NODATA_value -1\n"
    expected = read_search_site(written(tmp_path / "poa.asc", header + ROWS))
    found = read_search_site(written_tiff(tmp_path / "poa.tif", **changed))
    assert_same(found, expected)


def assert_same(found: object, expected: object) -> None:
    assert isinstance(found, SiteRaster)
    assert isinstance(expected, SiteRaster)
    for name in ("west_deg", "south_deg", "east_deg", "north_deg", "weights"):
        values = getattr(found, name), getattr(expected, name)
        assert np.allclose(*values, atol=1e-9, equal_nan=True), name


@pytest.mark.parametrize(
    "header",
    [
        "NCOLS 3\nNROWS 2\nXLLCENTER 8.0005\nYLLCENTER 47.0005\nCELLSIZE 0.001\nnodata_value -1\n",
        "ncols 3\nnrows 2\nxllcorner 8\nyllcorner 47\ndx 0.001\ndy 0.001\nNODATA_value -1\n",
        "\ufeffncols 3\r\nnrows 2\r\nxllcorner 8\r\nyllcorner 47\r\ncellsize 1e-3\r\n"
        "NODATA_value nan\r\n",
    ],
)
def test_headers_of_other_programs_are_the_same_raster(header: str, tmp_path: Path) -> None:
    rows = ROWS.replace("-1", "nan") if "nan" in header else ROWS
    expected = read_search_site(written_tiff(tmp_path / "poa.tif"))
    assert_same(read_search_site(written(tmp_path / "poa.asc", header + rows)), expected)


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"crs": "EPSG:32632"}, "not in degrees of WGS84; save it as EPSG:4326"),
        ({"crs": None}, "not in degrees of WGS84; save it as EPSG:4326"),
        ({"nodata": None}, "weights must be 0 or above"),
        ({"values": np.zeros((2, 2))}, "one of them above 0"),
        ({"values": np.full((2, 2), np.inf)}, "finite"),
        ({"values": np.ones((2500, 4000)), "compress": "deflate"}, "10000000 cells; at most"),
    ],
)
def test_a_geotiff_that_is_no_search_area_is_one_clear_line(
    changed: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    path = written_tiff(tmp_path / "poa.tif", **changed)
    with pytest.raises(ConfigError, match=problem) as found:
        read_search_site(path)
    assert "\n" not in str(found.value)


def test_a_damaged_geotiff_is_one_clear_line(tmp_path: Path) -> None:
    path = written_tiff(tmp_path / "poa.tif", compress="deflate")
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    for length in range(0, len(whole), 7):
        damaged = bytearray(whole[:length] or b"\0")
        damaged[rng.integers(len(damaged))] ^= 0xFF
        path.write_bytes(damaged)
        with suppress(ConfigError):
            read_search_site(path)


def test_without_tifffile_the_line_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(ConfigError, match=r"GeoTIFF needs tifffile: .* install tifffile"):
        read_search_site(written_tiff(tmp_path / "poa.tif"))


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        (
            "poa.kmz",
            "",
            ".geojson, .kml, .asc or .tif file, in degrees; unpack it, there is a .kml",
        ),
        ("poa.geojson", "{", "not JSON"),
        ("poa.geojson", "[]", "not a GeoJSON object"),
        ("poa.geojson", geojson(), "there is no polygon in it"),
        ("poa.geojson", geojson(([RING], 0)), "no polygon has a weight above 0"),
        ("poa.geojson", geojson(([RING], -1)), "weight is not a number from 0 on"),
        ("poa.geojson", geojson(([RING], "70")), "weight is not a number"),
        ("poa.geojson", geojson(([[[2.6e6, 1.2e6]] * 4], 1)), "are not degrees; save it as WGS84"),
        ("poa.geojson", geojson(([RING[:2]], 1)), "fewer than 3 corners"),
        ("poa.geojson", "", "not JSON"),
        ("poa.geojson", "[" * 100_000, "nested too deeply"),
        ("poa.geojson", geojson(([RING], float("nan"))), "weight is not a number from 0 on"),
        ("poa.geojson", geojson(*[([RING], 1)] * 600), "2400 corners in all; at most 2000"),
        ("poa.kml", "", "not XML"),
        ("poa.asc", "", "the header has no ncols"),
        ("poa.tif", "", "not a TIFF file"),
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


def test_kml_of_other_programs_is_the_same_area(tmp_path: Path) -> None:
    """Prefixed and older namespaces, folders in folders, several polygons, a byte order mark."""
    plain = kml(placemark(RING, data("70")))
    expected = read_search_site(written(tmp_path / "plain.kml", plain))
    prefixed = plain.replace("<", "<k:").replace("<k:/", "</k:").replace("xmlns=", "xmlns:k=")
    several = plain.replace("<Polygon>", "<MultiGeometry><Polygon>").replace(
        "</Polygon>", "</Polygon><Point><coordinates>8,47</coordinates></Point></MultiGeometry>"
    )
    older = plain.replace("www.opengis.net/kml/2.2", "earth.google.com/kml/2.0")
    nested = plain.replace("<Folder>", "<Folder><Folder>").replace(
        "</Folder>", "</Folder></Folder>"
    )
    for text in (prefixed, several, older, nested, "\ufeff" + plain):
        assert read_search_site(written(tmp_path / "poa.kml", text)) == expected


def test_the_polygons_of_a_collection_share_its_weight(tmp_path: Path) -> None:
    parts = [{"type": "Polygon", "coordinates": [ring]} for ring in (RING, EAST)]
    geometry = {"type": "GeometryCollection", "geometries": [*parts, {"type": "Point"}]}
    feature = {"type": "Feature", "properties": {"weight": 3}, "geometry": geometry}
    site = read_search_site(written(tmp_path / "poa.geojson", json.dumps(feature)))
    assert isinstance(site, tuple)
    assert [area.weight for area in site] == [1.5, 1.5]


def test_a_polygon_smaller_than_a_cell_keeps_its_weight(tmp_path: Path) -> None:
    house = [[8.001, 47.001], [8.00105, 47.001], [8.00105, 47.00105], [8.001, 47.00105]]
    path = written(tmp_path / "poa.geojson", geojson(([house], 70), ([RING], 30)))
    grid = grid_of_site(read_search_site(path), ORIGIN, 20.0)
    likeliest = grid.centres_enu_m[grid.poa.argmax()]
    assert grid.poa.max() > 0.7
    assert abs(likeliest - (78.0, 114.0)).max() < 10.0


def test_a_polygon_that_is_all_hole_is_refused(tmp_path: Path) -> None:
    site = read_search_site(written(tmp_path / "poa.geojson", geojson(([RING, RING], 1))))
    with pytest.raises(ValueError, match="encloses nothing"):
        grid_of_site(site, ORIGIN, 20.0)


@pytest.mark.parametrize("name", ["poa.geojson", "poa.asc"])
def test_over_the_antimeridian_an_area_is_whole(name: str, tmp_path: Path) -> None:
    ring = [[179.999, -17.0], [-179.999, -17.0], [-179.999, -16.998], [179.999, -16.998]]
    header = "ncols 2\nnrows 2\nxllcorner 179.999\nyllcorner -17\ncellsize 0.001\n"
    text = geojson(([ring], 1)) if name == "poa.geojson" else header + "1 1\n1 1\n"
    site = read_search_site(written(tmp_path / name, text))
    grid = grid_of_site(site, LocalOrigin(-17.0, 179.9999, 0.0), 20.0)
    assert grid.inside.mean() > 0.9
    assert np.ptp(grid.centres_enu_m, axis=0) == pytest.approx((195.0, 203.0), abs=15.0)


def fenced(tmp_path: Path, *rings: list[list[float]]) -> Path:
    """A configuration whose fence is the ring, and search area the other ones."""
    written(tmp_path / "fence.kml", kml(placemark(RING)))
    written(tmp_path / "poa.geojson", geojson(*(([ring], 1) for ring in rings)))
    text = "limits: {fence_file: fence.kml}\nsearch: {area_file: poa.geojson}\n"
    return written(tmp_path / "search.yaml", text)


@pytest.mark.parametrize(
    ("ring", "problem"),
    [
        ([[lon + 0.01, lat] for lon, lat in RING], "lies entirely outside the fence"),
        ([[lat, lon] for lon, lat in RING], "from the fence; latitude and longitude are swapped"),
        ([[lon, lat + 1.0] for lon, lat in RING], "a corner is 111 km from the fence"),
        ([[lon + 130.0, lat] for lon, lat in RING], "a corner is .* km from the fence"),
    ],
)
def test_an_area_outside_a_fence_in_degrees_is_refused_before_the_flight(
    ring: list[list[float]], problem: str, tmp_path: Path
) -> None:
    config = fenced(tmp_path, ring)
    with pytest.raises(ConfigError, match=problem):
        load_config(config)
    config.write_text("search: {area_file: poa.geojson}\n")
    without = load_config(config)
    with pytest.raises(ConfigError, match=problem):
        with_fence(without, tmp_path / "fence.kml")


def test_an_area_partly_outside_the_fence_is_searched(tmp_path: Path) -> None:
    assert load_config(fenced(tmp_path, [[lon + 0.001, lat] for lon, lat in RING]))


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
