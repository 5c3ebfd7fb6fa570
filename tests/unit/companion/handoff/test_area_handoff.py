from __future__ import annotations

import json
from io import BytesIO
from xml.etree import ElementTree

import matplotlib.image
import msgspec
import numpy as np
import shapely.geometry

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
    for place, shape in (((100.0, 50.0), searched), ((100.0, 150.0), missing)):
        latitude, longitude, _ = ORIGIN.geodetic_from_enu((*place, 0.0))
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


def test_the_track_has_times() -> None:
    root = ElementTree.fromstring(area_files(FLIGHT, None)["searched_area.gpx"])
    points = [element for element in root.iter() if element.tag.endswith("trkpt")]
    assert [round(float(point.attrib["lat"]), 3) for point in points] == [-33.9, -33.9]
    assert points[1][0].text == "2027-01-15T08:00:30Z"


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
