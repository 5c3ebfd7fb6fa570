"""Possible locations of the emitter from files: weighted polygons, or a raster, in degrees.

The relative probability of a polygon is in the property `weight` of GeoJSON (RFC 7946), or in the
ExtendedData of a KML Placemark; 1 without it.

Source: Esri ASCII raster format: a header of ncols, nrows, the corner or the centre (`xllcenter`)
of the south-western cell, cellsize, or dx and dy as GDAL writes them, and perhaps NODATA_value,
then rows from the north; here in degrees of WGS84.

Source: OGC 19-008r4, GeoTIFF 1.1. The first band has the weights; tifffile reads it, if that is
installed.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from companion.config.area_files import MAX_BYTES, children_of, kml_root, ring_of, tag_of
from companion.config.loader import read_text
from companion.errors import ConfigError, how_to_install
from companion.geometry.geofence import GeoFence, LatLon
from companion.geometry.polygons import is_simple
from companion.io.files import open_file
from companion.search.search_grid import MAX_CELLS, SearchSite, SiteArea, SiteRaster, grid_of_site

MAX_CORNERS = 2000
"""Maximum number of corners of all polygons; with these the grid takes a quarter of a second."""
MAX_RASTER_CELLS = 100 * MAX_CELLS
"""Maximum number of raster cells, a hundred in each cell of the search; more have no effect."""


def read_search_site(path: Path) -> SearchSite:
    """Return the weighted areas in a file; a `ConfigError` names the file and the fault."""
    readers = {
        ".geojson": _areas_of_geojson,
        ".json": _areas_of_geojson,
        ".kml": _areas_of_search_kml,
        ".asc": _raster_of_ascii,
    }
    kind = path.suffix.lower()
    try:
        if kind in (".tif", ".tiff"):
            return _raster_of_geotiff(path)
        if kind in readers:
            return readers[kind](read_text(path, MAX_BYTES))
    except RecursionError:
        raise ConfigError(f"{path}: nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    hint = "; unpack it, there is a .kml in it" if kind == ".kmz" else ""
    kinds = ".geojson, .kml, .asc or .tif"
    raise ConfigError(f"{path}: a search area is a {kinds} file, in degrees{hint}")


def check_search_area(path: Path, fence: GeoFence | None, cell_m: float) -> None:
    """Raise `ConfigError` if the file has no search area, or none inside a fence in degrees."""
    site = read_search_site(path)
    if fence is None:
        return
    try:
        polygon = fence.local(fence.centre).polygon_enu_m
        grid_of_site(site, fence.centre, cell_m, polygon)
    except ValueError as error:
        problem = str(error).replace("the vehicle's origin", "the fence")
        raise ConfigError(f"{path}: {problem}") from None


def _areas_of_geojson(text: str) -> SearchSite:
    try:
        root = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON ({error})") from None
    if not isinstance(root, dict):
        raise ValueError("not a GeoJSON object")
    return _checked(tuple(_site_areas(root)))


def _areas_of_search_kml(text: str) -> SearchSite:
    """Return the polygons of all Placemarks; several of one share its weight."""
    areas: list[SiteArea] = []
    for number, placemark in enumerate(_below(kml_root(text), "Placemark"), start=1):
        path, polygons = f"Placemark {number}", list(_below(placemark, "Polygon"))
        weight = _weight(_extended_data(placemark), path) / max(1, len(polygons))
        for polygon in polygons:
            outer = children_of(polygon, "outerBoundaryIs", "LinearRing", "coordinates")
            inner = children_of(polygon, "innerBoundaryIs", "LinearRing", "coordinates")
            if len(outer) != 1:
                raise ValueError(f"{path}: has {len(outer)} outer rings")
            rings = [ring_of(each, path).corners_deg for each in (*outer, *inner)]
            corners = [[[lon, lat] for lat, lon in ring] for ring in rings]
            outside, *holes = (_site_ring(ring, path) for ring in corners)
            areas.append(SiteArea(outside, weight, tuple(holes)))
    return _checked(tuple(areas))


def _below(element: Element, tag: str) -> Iterator[Element]:
    return (each for each in element.iter() if tag_of(each) == tag)


def _extended_data(placemark: Element) -> dict[str, object]:
    """Return the values of Data and SimpleData by name, numbers where they are."""
    values: dict[str, object] = {}
    for each in (*_below(placemark, "Data"), *_below(placemark, "SimpleData")):
        inner = children_of(each, "value")
        text = (inner[0].text if inner else each.text) or ""
        try:
            values[each.get("name", "")] = float(text)
        except ValueError:
            values[each.get("name", "")] = text
    return values


def _checked(areas: tuple[SiteArea, ...]) -> SearchSite:
    if not areas:
        raise ValueError("there is no polygon in it")
    corners = sum(len(ring) for area in areas for ring in (area.corners_deg, *area.holes_deg))
    if corners > MAX_CORNERS:
        raise ValueError(f"{corners} corners in all; at most {MAX_CORNERS}: simplify the polygons")
    if not any(area.weight > 0.0 for area in areas):
        raise ValueError("no polygon has a weight above 0")
    return areas


def _site_areas(root: Mapping[str, object]) -> Iterator[SiteArea]:
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
        yield from _site_polygons(geometry, weight, path)


def _weight(properties: Mapping[str, object], path: str) -> float:
    weight = properties.get("weight", 1.0)
    if isinstance(weight, bool) or not isinstance(weight, int | float):
        raise ValueError(f"{path}: its weight is not a number")
    if not 0.0 <= weight < math.inf:
        raise ValueError(f"{path}: its weight is not a number from 0 on")
    return float(weight)


def _site_polygons(geometry: Mapping[str, object], weight: float, path: str) -> Iterator[SiteArea]:
    polygons = list(_polygons_in(geometry, path))
    share = weight / max(1, len(polygons))
    for polygon in polygons:
        if not isinstance(polygon, list) or not polygon:
            raise ValueError(f"{path}.geometry.coordinates: a polygon has no ring")
        outside, *holes = (_site_ring(ring, path) for ring in polygon)
        yield SiteArea(outside, share, tuple(holes))


def _polygons_in(geometry: Mapping[str, object], path: str) -> Iterator[object]:
    """Yield the rings of all polygons; points and lines have no area."""
    kind = geometry.get("type")
    if kind == "Polygon":
        yield geometry.get("coordinates")
    elif kind in ("MultiPolygon", "GeometryCollection"):
        parts = geometry.get("coordinates" if kind == "MultiPolygon" else "geometries")
        if not isinstance(parts, list):
            raise ValueError(f"{path}.geometry: its parts are not a list")
        for part in parts:
            if kind == "MultiPolygon":
                yield part
            elif isinstance(part, dict):
                yield from _polygons_in(part, path)


def _site_ring(ring: object, path: str) -> tuple[LatLon, ...]:
    if not isinstance(ring, list):
        raise ValueError(f"{path}.geometry: a ring is not a list of positions")
    positions = [_site_position(each, path) for each in ring]
    if len(positions) > 1 and positions[0] == positions[-1]:
        positions.pop()
    if len(positions) < 3:
        raise ValueError(f"{path}.geometry: a ring has fewer than 3 corners")
    if len(positions) > MAX_CORNERS:
        raise ValueError(
            f"{path}.geometry: a ring has more than {MAX_CORNERS} corners; simplify it"
        )
    if not is_simple([(100_000.0 * lon, 100_000.0 * lat) for lat, lon in positions]):
        raise ValueError(f"{path}.geometry: a ring has two edges that touch or cross each other")
    return tuple(positions)


def _site_position(value: object, path: str) -> LatLon:
    numbers = value[:2] if isinstance(value, list) else []
    found = [float(n) for n in numbers if isinstance(n, int | float) and not isinstance(n, bool)]
    if len(found) < 2:
        raise ValueError(f"{path}.geometry: a position is not [longitude, latitude]")
    longitude, latitude = found
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise ValueError(
            f"{path}.geometry: {longitude:g}, {latitude:g} are not degrees; save it as WGS84"
        )
    return latitude, longitude


def _raster_of_ascii(text: str) -> SearchSite:
    lines = text.splitlines()
    header: dict[str, float] = {}
    first = 0
    while first < len(lines) and (words := lines[first].split()) and words[0][:1].isalpha():
        if words[0].lower() == "nan":
            break  # a row of values
        if len(words) != 2:
            raise ValueError(f"the header line `{lines[first][:40]}` is not a name and a number")
        header[words[0].lower()] = _word_number(words[1], is_nan_known=words[0].lower() == NODATA)
        first += 1

    def value(*names: str) -> float:
        for name in names:
            if name in header:
                return header[name]
        raise ValueError(f"the header has no {names[0]}")

    columns, rows = value("ncols"), value("nrows")
    if not (columns.is_integer() and rows.is_integer() and columns > 0.0 and rows > 0.0):
        raise ValueError("ncols and nrows are not whole numbers above 0")
    _check_cells(int(columns * rows))
    west, south = value("xllcorner", "xllcenter"), value("yllcorner", "yllcenter")
    east_step, north_step = value("cellsize", "dx"), value("cellsize", "dy")
    west -= 0.0 if "xllcorner" in header else 0.5 * east_step
    south -= 0.0 if "yllcorner" in header else 0.5 * north_step
    words = " ".join(lines[first:]).split()
    try:
        values = np.array(words, dtype=float)
    except ValueError:
        values = np.array([_word_number(word, is_nan_known=True) for word in words])
    if values.size != columns * rows:
        raise ValueError(f"{values.size} values for {columns:.0f} by {rows:.0f} cells")
    values[values == header.get(NODATA, -9999.0)] = math.nan
    box = (west, south, west + columns * east_step, south + rows * north_step)
    return _raster(box, values.reshape(int(rows), int(columns))[::-1])


NODATA = "nodata_value"


def _word_number(word: str, *, is_nan_known: bool = False) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.inf
    if not math.isfinite(value) and not (is_nan_known and math.isnan(value)):
        raise ValueError(f"`{word[:40]}` is not a number")
    return value


def _check_cells(cells: int) -> None:
    if cells > MAX_RASTER_CELLS:
        raise ValueError(f"{cells} cells; at most {MAX_RASTER_CELLS}: make cells larger")


def _raster(box_deg: tuple[float, float, float, float], weights: NDArray[np.float64]) -> SiteRaster:
    """Return the raster of weights, rows from the south, after checks."""
    west, south, east, north = box_deg
    is_in_degrees = -90.0 <= south < north <= 90.0 and -180.0 <= west < east <= west + 360.0
    if not is_in_degrees or max(east - west, north - south) > MAX_DEGREES:
        corners = f"{west:g}, {south:g} to {east:g}, {north:g}"
        raise ValueError(f"{corners} are not degrees; save it as WGS84 (EPSG:4326)")
    if np.any(np.isinf(weights)) or np.any(weights < 0.0) or not np.any(weights > 0.0):
        raise ValueError("weights must be 0 or above, finite, and one of them above 0")
    return SiteRaster(west, south, east, north, weights)


MAX_DEGREES = 60.0
"""Largest extent of a raster in degrees; 20 km span 2 degrees of longitude far north."""
GEOGRAPHIC, PIXEL_IS_POINT = 2, 2
WGS84_CODES = (4326, 4258, 4269)
"""EPSG codes of WGS84, ETRS89 and NAD83, which differ by a metre."""


def _raster_of_geotiff(path: Path) -> SiteRaster:
    try:
        import tifffile
    except ImportError:
        raise ValueError(f"GeoTIFF needs tifffile: {how_to_install('tifffile')}") from None
    logging.getLogger("tifffile").disabled = True  # what it says of damage is in the error
    try:
        with open_file(path) as raw, tifffile.TiffFile(raw, name=str(path)) as file:
            page = file.pages.first
            if not isinstance(page, tifffile.TiffPage) or not page.size:
                raise ValueError("it has no image")
            _check_cells(page.size)
            rows, columns = page.imagelength, page.imagewidth
            box = _box_of_tags(page.geotiff_tags or {}, columns, rows)
            is_separate = page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
            bands = page.asarray().reshape(
                (-1, rows, columns) if is_separate else (rows, columns, -1)
            )
            weights = (bands[0] if is_separate else bands[..., 0]).astype(float)
            weights[weights == page.nodata] = math.nan
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror})") from None
    except ValueError:
        raise
    except Exception as error:  # of damaged files, the reader raises all kinds
        raise ValueError(f"cannot be read; save it uncompressed ({error})") from None
    return _raster(box, weights[::-1])


def _box_of_tags(
    tags: Mapping[str, Any], columns: int, rows: int
) -> tuple[float, float, float, float]:
    """Return west, south, east and north, degrees, of a north-up image."""
    system = int(tags.get("GeographicTypeGeoKey", WGS84_CODES[0]))
    if tags.get("GTModelTypeGeoKey") != GEOGRAPHIC or system not in WGS84_CODES:
        raise ValueError("it is not in degrees of WGS84; save it as EPSG:4326")
    scale: Sequence[float] = tags.get("ModelPixelScale", ())
    tie: Sequence[float] = tags.get("ModelTiepoint", ())
    if len(scale) < 2 or len(tie) != 6:
        raise ValueError("it is not north up with one scale; save it as EPSG:4326")
    half = 0.5 if tags.get("GTRasterTypeGeoKey") == PIXEL_IS_POINT else 0.0
    west = tie[3] - (tie[0] + half) * scale[0]
    north = tie[4] + (tie[1] + half) * scale[1]
    return west, north - rows * scale[1], west + columns * scale[0], north
