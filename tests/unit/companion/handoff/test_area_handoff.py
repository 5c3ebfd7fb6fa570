from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gpxpy
import matplotlib.image
import msgspec
import numpy as np
import pytest
import rasterio
import shapely.geometry
from fastkml import KML
from fastkml.overlays import GroundOverlay
from fastkml.utils import find
from fastkml.validator import validate

from companion.area_handoff import area_files, result_fields
from companion.geometry.coordinates import LocalOrigin
from companion.search.detection_model import DetectionModel
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import SearchState
from companion.search.searched_flight import SearchedFlight

SQUARE = ((0.0, 0.0), (200.0, 0.0), (200.0, 200.0), (0.0, 200.0))
ORIGIN = LocalOrigin(-33.9, 18.4, 10.0)
FLIGHT = SearchedFlight(
    began_unix_s=1.8e9,
    ended_unix_s=1.8e9 + 60.0,
    listened_s=60.0,
    is_radio_heard=True,
    origin=ORIGIN,
    detection=DetectionModel(reach_m=60.0),
    track=[(0.0, 10.0, 10.0, 20.0), (30.0, 150.0, 10.0, 20.0)],
)


def state() -> SearchState:
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    return SearchState(grid, np.where(grid.centres_enu_m[:, 1] < 100.0, 0.97, 0.1))


def test_outlines_lie_where_it_was_searched() -> None:
    files = area_files(FLIGHT, state())
    features = json.loads(files["searched_area.geojson"])["features"]
    pods = [f for f in features if f["properties"]["kind"] == "pod"]
    assert [f["properties"]["share_of_area"] for f in pods] == [0.5, 0.5, 0.5]
    (gap,) = [f for f in features if f["properties"]["kind"] == "gap"]
    assert gap["properties"]["name"] == "N side"
    searched, missing = (shapely.geometry.shape(f["geometry"]) for f in (pods[1], gap))
    assert searched.is_valid
    assert searched.touches(missing)
    for position, shape in (((100.0, 50.0), searched), ((100.0, 150.0), missing)):
        latitude, longitude, _ = ORIGIN.geodetic_from_enu((*position, 0.0))
        assert shape.contains(shapely.Point(longitude, latitude))
    ring = pods[0]["geometry"]["coordinates"][0][0]
    assert ring[0] == ring[-1]
    assert shapely.LinearRing(ring).is_ccw


def test_the_image_is_north_up_and_clear_outside() -> None:
    pixels = matplotlib.image.imread(BytesIO(area_files(FLIGHT, state())["searched_area.png"]))
    assert pixels.shape == (400, 400, 4)
    north, south = pixels[10, 200], pixels[390, 200]
    assert north[0] > north[2]  # red where it was not searched
    assert south[2] > south[0]


def test_gpxpy_reads_the_track_with_its_times() -> None:
    (track,) = gpxpy.parse(area_files(FLIGHT, None)["searched_area.gpx"].decode()).tracks
    (segment,) = track.segments
    assert [round(point.latitude, 3) for point in segment.points] == [-33.9, -33.9]
    assert segment.points[1].time == datetime(2027, 1, 15, 8, 0, 30, tzinfo=UTC)


def test_the_kml_obeys_the_schema_and_lays_the_image_where_it_belongs(tmp_path: Path) -> None:
    path = tmp_path / "searched_area.kml"
    path.write_bytes(area_files(FLIGHT, state())["searched_area.kml"])
    assert validate(file_to_validate=path)
    overlay: Any = find(KML.parse(path), of_type=GroundOverlay)
    box = overlay.lat_lon_box
    for position, corner in (
        ((0.0, 0.0), (box.south, box.west)),
        ((200.0, 200.0), (box.north, box.east)),
    ):
        latitude, longitude, _ = ORIGIN.geodetic_from_enu((*position, 0.0))
        assert corner == pytest.approx((latitude, longitude), abs=1e-6)
    assert overlay.icon.href == "searched_area.png"


def test_gdal_reads_the_probability_at_every_position() -> None:
    with rasterio.MemoryFile(area_files(FLIGHT, state())["searched_area.tif"]) as file:
        image = file.open()
        assert image.crs.to_epsg() == 4326
        assert np.isnan(image.nodata)
        found = []
        for position in ((10.0, 30.0), (190.0, 90.0), (10.0, 110.0), (190.0, 190.0)):
            latitude, longitude, _ = ORIGIN.geodetic_from_enu((*position, 0.0))
            (value,) = image.sample([(longitude, latitude)])
            found.append(float(value[0]))
    assert found == pytest.approx([0.97, 0.97, 0.1, 0.1])


def test_over_the_antimeridian_shapes_stay_whole() -> None:
    fiji = LocalOrigin(-16.8, 179.9995, 10.0)
    files = area_files(msgspec.structs.replace(FLIGHT, origin=fiji), state())
    features = json.loads(files["searched_area.geojson"])["features"]
    west, _, east, _ = shapely.geometry.shape(features[0]["geometry"]).bounds
    assert 0.0 < east - west < 0.003
    with rasterio.MemoryFile(files["searched_area.tif"]) as file:
        assert file.open().bounds.right - file.open().bounds.left == pytest.approx(0.0019, abs=1e-4)
    root = ElementTree.fromstring(files["searched_area.kml"])
    sides = [float(e.text or "") for e in root.iter() if e.tag.endswith(("}east", "}west"))]
    assert sides == pytest.approx([-179.9986, 179.9995], abs=1e-4)  # KML: west exceeds east


def test_without_tifffile_there_is_no_geotiff(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tifffile", None)
    assert "searched_area.tif" not in area_files(FLIGHT, state())


def test_without_an_origin_there_is_nothing_on_the_earth() -> None:
    lost = msgspec.structs.replace(FLIGHT, origin=None)
    names = set(area_files(lost, state()))
    assert names == {"searched_area.json", "searched_area.txt", "searched_area.png"}
    assert result_fields(lost, state())["track"] == [[10.0, 10.0, 0.0], [150.0, 10.0, 30.0]]


def test_the_result_states_what_was_assumed() -> None:
    result = result_fields(FLIGHT, state())
    assert result["state"] == "not_found"
    assert result["pos"] == 0.535
    assert result["share_searched"] == 0.5
    assert isinstance(result["assumptions"], dict)
    assert result["assumptions"]["reach_m"] == 60.0
    unknown = result_fields(msgspec.structs.replace(FLIGHT, detection=None), None)
    assert unknown["pos"] is None
    assert unknown["assumptions"] is None
