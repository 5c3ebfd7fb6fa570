"""Searched area for ground teams: GeoJSON, KML with an image, PNG, GPX, GeoTIFF and a sentence.

GeoJSON (RFC 7946) has the outlines of 50, 80 and 95 % probability of detection, gaps and the track;
CalTopo and ATAK read it. The KML 2.2 document lays `searched_area.png` on the ground
(GroundOverlay, OGC 07-147r2, 11.2), for Google Earth. GPX 1.1 has the track for handheld receivers.
GeoTIFF (OGC 19-008r4) has the values of POD for QGIS, where tifffile is installed.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Corners, Point
from companion.handoff import DECIMALS, NAMESPACE, add_text, feature, utc_text, xml_text
from companion.search.search_grid import SearchGrid
from companion.search.searched_area import SearchState
from companion.search.searched_flight import (
    GOOD_POD,
    SearchedFlight,
    gaps_of,
    outlines,
    reach_source,
    statement,
)

RECORD, GEOJSON, KML = "searched_area.json", "searched_area.geojson", "searched_area.kml"
PNG, GPX, TEXT = "searched_area.png", "searched_area.gpx", "searched_area.txt"
GEOTIFF = "searched_area.tif"
LEVELS = (0.5, 0.8, 0.95)


def area_files(flight: SearchedFlight, state: SearchState | None) -> dict[str, bytes]:
    """Return the files' contents by name; those on the Earth only where the origin is known."""
    files = {
        RECORD: msgspec.json.encode(flight) + b"\n",
        TEXT: (statement(flight, state) + "\n").encode(),
    }
    if state is not None:
        files[PNG] = png_of(state)
    if flight.origin is not None:
        files[GEOJSON] = geojson_of([flight], state, flight.origin).encode()
        files[GPX] = gpx_of(flight).encode()
        if state is not None:
            files[KML] = kml_of(flight, state, flight.origin).encode()
            geotiff = geotiff_of(state, flight.origin)
            if geotiff is not None:
                files[GEOTIFF] = geotiff
    return files


def result_fields(flight: SearchedFlight, state: SearchState | None) -> dict[str, object]:
    """Return the content of `result.json` without a report, or of its key `searched` with one."""
    gaps = [] if state is None else gaps_of(state)
    model = flight.detection
    return {
        "state": "not_found" if flight.contact_unix_s is None else "heard",
        "statement": statement(flight, state),
        "pos": None if state is None else round(state.pos, 4),
        "share_searched": None if state is None else round(state.share_at(GOOD_POD), 4),
        "area_m2": None if state is None else state.area_m2,
        "gaps": [
            {"name": g.name, "share_of_area": round(g.share_of_area, 4), "poa": round(g.poa, 4)}
            for g in gaps
        ],
        "began": utc_text(flight.began_unix_s),
        "ended": utc_text(flight.ended_unix_s),
        "contact": None if flight.contact_unix_s is None else utc_text(flight.contact_unix_s),
        "reported": flight.reported,
        "heard": flight.heard,
        "sought": flight.sought,
        "listened_s": flight.listened_s,
        "is_radio_heard": flight.is_radio_heard,
        "assumptions": model and {**msgspec.to_builtins(model), **model.propagation._asdict()},
        "reach_source": reach_source(flight),
        "reach_learnt": None if flight.learnt is None else msgspec.to_builtins(flight.learnt),
        "track": _track(flight),
        "unix_s": flight.ended_unix_s,
    }


def _track(flight: SearchedFlight) -> list[list[float]]:
    """Return longitude, latitude and seconds from the start; without an origin east and north."""
    origin = flight.origin
    if origin is None:
        return [[east, north, t_s] for t_s, east, north, _ in flight.track]
    geodetic = [origin.geodetic_from_enu(point[1:]) for point in flight.track]
    return [
        [round(lon, DECIMALS), round(lat, DECIMALS), point[0]]
        for (lat, lon, _), point in zip(geodetic, flight.track, strict=True)
    ]


def geojson_of(
    flights: Sequence[SearchedFlight], state: SearchState | None, origin: LocalOrigin
) -> str:
    """Return a feature collection: outlines of POD, gaps, and the track of each flight."""
    features = [] if state is None else list(_areas(state, origin))
    for flight in flights:
        line = [position[:2] for position in _track(flight)]
        if flight.origin is not None and len(line) >= 2:
            about = {
                "kind": "track",
                "began": utc_text(flight.began_unix_s),
                "ended": utc_text(flight.ended_unix_s),
                "listened_s": flight.listened_s,
            }
            features.append(feature("LineString", line, about))
    collection: dict[str, object] = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, indent=1) + "\n"


def _areas(state: SearchState, origin: LocalOrigin) -> Iterator[dict[str, object]]:
    grid = state.grid
    for level in LEVELS:
        about: dict[str, object] = {"kind": "pod", "pod_at_least": level}
        about["share_of_area"] = round(state.share_at(level), 4)
        yield feature("MultiPolygon", grid_shapes(state, level, origin), about)
    for gap in gaps_of(state):
        shapes = [_shape(o.outside_enu_m, o.holes_enu_m, origin) for o in outlines(grid, gap.cells)]
        about = {"kind": "gap", "name": gap.name, "poa": round(gap.poa, 4)}
        about["share_of_area"] = round(gap.share_of_area, 4)
        yield feature("MultiPolygon", shapes, about)


def grid_shapes(state: SearchState, level: float, origin: LocalOrigin) -> list[Any]:
    """Return the polygons, in degrees, of the cells with at least this POD."""
    found = outlines(state.grid, state.pod >= level)
    return [_shape(each.outside_enu_m, each.holes_enu_m, origin) for each in found]


def _shape(outside: Corners, holes: Sequence[Corners], origin: LocalOrigin) -> list[Any]:
    rings = []
    for ring in (outside, *holes):
        corners = [_lon_lat(corner, origin) for corner in (*ring, ring[0])]
        rings.append([[round(lon, DECIMALS), round(lat, DECIMALS)] for lon, lat in corners])
    return rings


def _lon_lat(position_enu_m: Point, origin: LocalOrigin) -> Point:
    """Return degrees; longitudes continue beyond +-180 degrees, so that shapes stay whole."""
    latitude, longitude, _ = origin.geodetic_from_enu((*position_enu_m, 0.0))
    return origin.longitude_deg + _wrapped(longitude - origin.longitude_deg), latitude


def _wrapped(longitude_deg: float) -> float:
    return (longitude_deg + 180.0) % 360.0 - 180.0


MIN_PIXELS = 400
"""Minimum pixels of the longer side, so that cells stay sharp in viewers that smooth."""
POOR, GOOD = np.array((213.0, 94.0, 0.0)), np.array((0.0, 114.0, 178.0))
"""Vermilion and blue of M. Okabe and K. Ito, "Color Universal Design"."""
OPACITY = 150


def pod_colours() -> list[str]:
    """Return the colours of a POD of 0 and of 1 in CSS notation, `#rrggbbaa`."""
    return [f"#{bytes((*colour.astype(np.uint8), OPACITY)).hex()}" for colour in (POOR, GOOD)]


def png_of(state: SearchState) -> bytes:
    """Return the map of POD, north up: from vermilion, not searched, to blue, searched."""
    pod = state.grid.on_map(state.pod)
    colours = POOR + pod[..., None] * (GOOD - POOR)
    alpha = np.where(state.grid.inside, OPACITY, 0)[..., None]
    pixels = np.concatenate((colours, alpha), axis=2).astype(np.uint8)[::-1]
    scale = max(1, MIN_PIXELS // max(pod.shape))
    return encoded_png(pixels.repeat(scale, axis=0).repeat(scale, axis=1))


def encoded_png(pixels: np.typing.NDArray[np.uint8]) -> bytes:
    """Return (rows, columns, 4) RGBA pixels as PNG (ISO/IEC 15948), without filters."""
    rows, columns, _ = pixels.shape
    lines = np.zeros((rows, 1 + 4 * columns), dtype=np.uint8)
    lines[:, 1:] = pixels.reshape(rows, -1)

    def chunk(name: bytes, data: bytes) -> bytes:
        check = zlib.crc32(name + data)
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6))
    return b"\x89PNG\r\n\x1a\n" + body + chunk(b"IEND", b"")


def kml_of(flight: SearchedFlight, state: SearchState, origin: LocalOrigin) -> str:
    """Return a document with the map laid on the ground and the track."""
    root = ET.Element("kml", xmlns=NAMESPACE)
    document = ET.SubElement(root, "Document")
    add_text(document, "name", "Searched area")
    add_text(document, "description", statement(flight, state))
    overlay = ET.SubElement(document, "GroundOverlay")
    add_text(overlay, "name", "Probability of detection")
    add_text(ET.SubElement(overlay, "Icon"), "href", PNG)
    west, south, east, north = _box_deg(state.grid, origin)
    box = ET.SubElement(overlay, "LatLonBox")
    for name, value in (
        ("north", north),
        ("south", south),
        ("east", _wrapped(east)),
        ("west", _wrapped(west)),
    ):
        add_text(box, name, f"{value:.7f}")
    placemark = ET.SubElement(document, "Placemark")
    add_text(placemark, "name", "Track")
    line = ET.SubElement(placemark, "LineString")
    positions = " ".join(f"{lon:.7f},{lat:.7f}" for lon, lat, _ in _track(flight))
    add_text(line, "coordinates", positions)
    return xml_text(root)


def _box_deg(grid: SearchGrid, origin: LocalOrigin) -> tuple[float, float, float, float]:
    """Return the map's west, south, east and north, degrees.

    They are the middles of its sides: over 2 km local axes turn against the meridian by less than
    a cell.
    """
    rows, columns = grid.inside.shape
    east_m = grid.west_m + columns * grid.cell_m
    north_m = grid.south_m + rows * grid.cell_m
    middle_m = 0.5 * (grid.west_m + east_m), 0.5 * (grid.south_m + north_m)
    west, east = (_lon_lat((x, middle_m[1]), origin)[0] for x in (grid.west_m, east_m))
    south, north = (_lon_lat((middle_m[0], y), origin)[1] for y in (grid.south_m, north_m))
    return west, south, east, north


def geotiff_of(state: SearchState, origin: LocalOrigin) -> bytes | None:
    """Return POD as 32-bit floats in degrees of WGS84, NaN outside; None if tifffile is missing."""
    try:
        import tifffile
    except ImportError:
        return None
    west, south, east, north = _box_deg(state.grid, origin)
    rows, columns = state.grid.inside.shape
    scale = ((east - west) / columns, (north - south) / rows, 0.0)
    keys = (1, 1, 0, 3, *GEOGRAPHIC, *PIXEL_IS_AREA, *EPSG_4326)
    tags = [
        (33550, "d", 3, scale, True),  # ModelPixelScale
        (33922, "d", 6, (0.0, 0.0, 0.0, west, north, 0.0), True),  # ModelTiepoint
        (34735, "H", len(keys), keys, True),  # GeoKeyDirectory
        (42113, "s", 4, "nan", True),  # GDAL_NODATA
    ]
    image = state.grid.on_map(state.pod, math.nan)[::-1].astype(np.float32)
    file = BytesIO()
    tifffile.imwrite(
        file, image, photometric="minisblack", compression="zlib", metadata=None, extratags=tags
    )
    return file.getvalue()


GEOGRAPHIC, PIXEL_IS_AREA, EPSG_4326 = (1024, 0, 1, 2), (1025, 0, 1, 1), (2048, 0, 1, 4326)
"""GTModelType, GTRasterType and GeodeticCRS: key, location, count and value."""


def gpx_of(flight: SearchedFlight) -> str:
    """Return the track as GPX 1.1, with times."""
    root = ET.Element(
        "gpx", xmlns="http://www.topografix.com/GPX/1/1", version="1.1", creator="companion"
    )
    track = ET.SubElement(root, "trk")
    add_text(track, "name", f"Search {utc_text(flight.began_unix_s)}")
    segment = ET.SubElement(track, "trkseg")
    for longitude, latitude, t_s in _track(flight):
        point = ET.SubElement(segment, "trkpt", lat=f"{latitude:.7f}", lon=f"{longitude:.7f}")
        add_text(point, "time", utc_text(flight.began_unix_s + t_s))
    return xml_text(root)
