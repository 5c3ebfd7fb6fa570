"""Possible locations of the emitter, from a file: GeoJSON polygons or an ASCII grid, in degrees.

Source: RFC 7946 for GeoJSON; a polygon's property `weight` is its relative probability, 1 without
it. Source: Esri ASCII raster format: a header of ncols, nrows, xllcorner, yllcorner, cellsize and
perhaps NODATA_value, then rows from the north; here in degrees of WGS84.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from companion.config.loader import read_text
from companion.errors import ConfigError
from companion.geometry.polygons import is_simple
from companion.search.search_grid import MOST_CELLS
from companion.search.search_site import LatLon, SearchSite, SiteArea, SiteRaster

MAX_BYTES = 10_000_000
MOST_AREAS = 1000


def read_search_site(path: Path) -> SearchSite:
    """Return the weighted areas in a file; a `ConfigError` names the file and the fault."""
    readers = {".geojson": _areas_of_geojson, ".json": _areas_of_geojson, ".asc": _raster_of_ascii}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: a search area is a .geojson or .asc file, in degrees")
    try:
        return reader(read_text(path, MAX_BYTES))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


def _areas_of_geojson(text: str) -> SearchSite:
    try:
        root = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from None
    if not isinstance(root, dict):
        raise ValueError("not a GeoJSON object")
    areas = tuple(_areas(root))
    if not areas:
        raise ValueError("there is no polygon in it")
    if len(areas) > MOST_AREAS:
        raise ValueError(f"{len(areas)} polygons; at most {MOST_AREAS}")
    if not any(area.weight > 0.0 for area in areas):
        raise ValueError("no polygon has a weight above 0")
    return areas


def _areas(root: Mapping[str, object]) -> Iterator[SiteArea]:
    features = root.get("features") if root.get("type") == "FeatureCollection" else [root]
    if not isinstance(features, list):
        raise ValueError("features: is not a list")
    for number, feature in enumerate(features):
        path = f"features[{number}]"
        if not isinstance(feature, dict):
            raise ValueError(f"{path}: is not an object")
        is_feature = feature.get("type") == "Feature"
        geometry = feature.get("geometry") if is_feature else feature
        properties = feature.get("properties") if is_feature else {}
        if not isinstance(geometry, dict):
            continue
        weight = _weight(properties if isinstance(properties, dict) else {}, path)
        yield from _polygons(geometry, weight, path)


def _weight(properties: Mapping[str, object], path: str) -> float:
    weight = properties.get("weight", 1.0)
    if isinstance(weight, bool) or not isinstance(weight, int | float):
        raise ValueError(f"{path}.properties.weight: is not a number")
    if not 0.0 <= weight < math.inf:
        raise ValueError(f"{path}.properties.weight: is not a number from 0 on")
    return float(weight)


def _polygons(geometry: Mapping[str, object], weight: float, path: str) -> Iterator[SiteArea]:
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    if kind not in ("Polygon", "MultiPolygon"):
        return  # points and lines have no area
    polygons = [coordinates] if kind == "Polygon" else coordinates
    if not isinstance(polygons, list):
        raise ValueError(f"{path}.geometry.coordinates: is not a list")
    share = weight / max(1, len(polygons))
    for polygon in polygons:
        if not isinstance(polygon, list) or not polygon:
            raise ValueError(f"{path}.geometry.coordinates: a polygon has no ring")
        outside, *holes = (_ring(ring, path) for ring in polygon)
        yield SiteArea(outside, share, tuple(holes))


def _ring(ring: object, path: str) -> tuple[LatLon, ...]:
    if not isinstance(ring, list):
        raise ValueError(f"{path}.geometry: a ring is not a list of places")
    places = [_place(each, path) for each in ring]
    if len(places) > 1 and places[0] == places[-1]:
        places.pop()
    if len(places) < 3:
        raise ValueError(f"{path}.geometry: a ring has fewer than 3 corners")
    if not is_simple([(100_000.0 * lon, 100_000.0 * lat) for lat, lon in places]):
        raise ValueError(f"{path}.geometry: a ring has two edges that touch or cross each other")
    return tuple(places)


def _place(value: object, path: str) -> LatLon:
    numbers = value[:2] if isinstance(value, list) else []
    found = [float(n) for n in numbers if isinstance(n, int | float) and not isinstance(n, bool)]
    if len(found) < 2:
        raise ValueError(f"{path}.geometry: a place is not [longitude, latitude]")
    longitude, latitude = found
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise ValueError(
            f"{path}.geometry: {longitude:g}, {latitude:g} are not degrees; save it as WGS84"
        )
    return latitude, longitude


def _raster_of_ascii(text: str) -> SearchSite:
    lines = text.splitlines()
    header: dict[str, float] = {}
    while lines and (words := lines[0].split()) and words[0][:1].isalpha():
        if len(words) != 2:
            raise ValueError(f"the header line `{lines[0][:40]}` is not a name and a number")
        header[words[0].lower()] = _number(words[1])
        del lines[0]
    missing = [
        name
        for name in ("ncols", "nrows", "xllcorner", "yllcorner", "cellsize")
        if name not in header
    ]
    if missing:
        raise ValueError(f"the header has no {missing[0]}")
    columns, rows, step = int(header["ncols"]), int(header["nrows"]), header["cellsize"]
    if columns * rows > 100 * MOST_CELLS:
        raise ValueError(f"{columns * rows} cells; at most {100 * MOST_CELLS}")
    west, south = header["xllcorner"], header["yllcorner"]
    is_in_degrees = abs(south) <= 90.0 and abs(west) <= 180.0 and south + rows * step <= 90.0
    if not is_in_degrees or not 0.0 < step < 1.0:
        raise ValueError("xllcorner, yllcorner and cellsize are not degrees; save it as WGS84")
    values = np.array([_number(word) for line in lines for word in line.split()])
    if values.size != columns * rows or not values.size:
        raise ValueError(f"{values.size} values for {columns} by {rows} cells")
    values[values == header.get("nodata_value", -9999.0)] = math.nan
    if np.any(values < 0.0) or not np.any(values > 0.0):
        raise ValueError("weights must be 0 or above, and one of them above 0")
    return SiteRaster(west, south, step, values.reshape(rows, columns)[::-1])


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"`{word[:40]}` is not a number")
    return value
