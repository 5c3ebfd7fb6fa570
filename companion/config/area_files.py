"""Areas from files: a fence from a `.plan` or KML, and possible locations of the emitter.

Source: QGroundControl developer guide, "Plan File Format": `geoFence` version 2 with `polygons` and
`circles`, each of version 1, places as [latitude, longitude] in degrees, radii in metres. The
mission, the rally points and the breach return point of the plan are ignored.

Source: OGC KML 2.3, Polygon: `outerBoundaryIs` and `innerBoundaryIs` hold rings of
"longitude,latitude[,altitude]" tuples in degrees, closed by their first place. The one polygon that
is not a keep-out is the fence, and holes in it are keep-outs; so are polygons in a Placemark or
Folder whose name begins with one of `KEEP_OUT_NAMES`. Altitudes are ignored.

An XML document with a DOCTYPE could bring entities that grow without bound, and is refused.

Locations of the emitter are polygons or an ASCII grid, in degrees. The relative probability of a
polygon is in the property `weight` of GeoJSON (RFC 7946), or in the ExtendedData of a KML
Placemark; 1 without it. Source: Esri ASCII raster format: a header of ncols, nrows, xllcorner,
yllcorner, cellsize and perhaps NODATA_value, then rows from the north; here in degrees of WGS84.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from companion.config.loader import read_text
from companion.errors import ConfigError
from companion.geometry.geofence import GeoArea, GeoFence, LatLon, NamedArea, fence_of
from companion.geometry.polygons import is_simple
from companion.search.search_grid import MOST_CELLS
from companion.search.search_site import SearchSite, SiteArea, SiteRaster

FENCE_VERSION = 2
AREA_VERSION = 1


def areas_of_plan(text: str) -> list[NamedArea]:
    """Return the areas in a plan, in order; a `ValueError` begins with the path of the fault."""
    try:
        plan = json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise ValueError(f"line {error.lineno}, column {error.colno}: {error.msg}") from None
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(plan, dict) or plan.get("fileType") != "Plan":
        raise ValueError('fileType: is not "Plan"; save it as a plan in QGroundControl')
    fence = plan.get("geoFence")
    if not isinstance(fence, dict):
        raise ValueError("geoFence: is missing; draw a fence in QGroundControl and save the plan")
    _check_version(fence, "geoFence", FENCE_VERSION)
    return [*_areas_listed(fence, "polygons", _polygon), *_areas_listed(fence, "circles", _circle)]


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return an object, and refuse a repeated key: of two fences only one could apply."""
    found: dict[str, object] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key `{key[:40]}` is given twice")
        found[key] = value
    return found


def _areas_listed(
    fence: dict[str, object], key: str, read: Callable[[dict[str, object], str], GeoArea]
) -> Iterator[NamedArea]:
    listed = fence.get(key, [])
    if not isinstance(listed, list):
        raise ValueError(f"geoFence.{key}: is not a list")
    for index, area in enumerate(listed):
        path = f"geoFence.{key}[{index}]"
        if not isinstance(area, dict):
            raise ValueError(f"{path}: is not an object")
        _check_version(area, path, AREA_VERSION)
        found, is_inclusion = read(area, path), area.get("inclusion")
        if not isinstance(is_inclusion, bool):
            raise ValueError(f"{path}.inclusion: is not true or false")
        yield NamedArea(path, is_inclusion, found)


def _check_version(element: dict[str, object], path: str, version: int) -> None:
    found = element.get("version")
    if found != version or isinstance(found, bool):
        raise ValueError(
            f"{path}.version: is {json.dumps(found)}, not {version}; open the plan in a present "
            "QGroundControl and save it again"
        )


def _polygon(area: dict[str, object], path: str) -> GeoArea:
    corners = area.get("polygon")
    if not isinstance(corners, list):
        raise ValueError(f"{path}.polygon: is not a list of corners")
    places = tuple(_plan_place(c, f"{path}.polygon[{index}]") for index, c in enumerate(corners))
    return GeoArea(places)


def _circle(area: dict[str, object], path: str) -> GeoArea:
    circle = area.get("circle")
    if not isinstance(circle, dict):
        raise ValueError(f"{path}.circle: is missing")
    centre = _plan_place(circle.get("center"), f"{path}.circle.center")
    radius_m = _number(circle.get("radius"), f"{path}.circle.radius")
    return GeoArea((centre,), radius_m)


def _plan_place(value: object, path: str) -> LatLon:
    if not (isinstance(value, list) and len(value) in (2, 3)):
        raise ValueError(f"{path}: is not [latitude, longitude]")
    return _number(value[0], f"{path}[0]"), _number(value[1], f"{path}[1]")


def _number(value: object, path: str) -> float:
    number = math.nan
    try:
        if isinstance(value, int | float) and not isinstance(value, bool):
            number = float(value)
    except OverflowError:  # JSON has integers of any length
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{path}: is not a finite number")
    return number


KEEP_OUT_NAMES = ("keep-out", "keep out", "keepout", "exclusion", "no-fly", "no fly")
_NAMESPACE = re.compile(r"^\{[^}]*\}")


def areas_of_kml(text: str) -> list[NamedArea]:
    """Return the areas in a KML file, in order; `ValueError` begins with the path of the fault."""
    root = _kml_root(text)
    areas: list[NamedArea] = []
    for number, (polygon, is_keep_out) in enumerate(_polygons(root, False), start=1):
        areas += _areas(polygon, f"Polygon {number}", is_keep_out)
    return areas


def _kml_root(text: str) -> Element:
    if "<!DOCTYPE" in text.upper():
        raise ValueError("a DOCTYPE has no place in KML; save the file again")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line, column = error.position
        raise ValueError(f"line {line}, column {column + 1}: not XML ({error.msg})") from None
    except (ValueError, RecursionError):  # a declared encoding that does not exist
        raise ValueError("not XML in UTF-8") from None
    if _tag(root) != "kml":
        raise ValueError(f"<{_tag(root)}>: is not KML")
    return root


def _tag(element: Element) -> str:
    return _NAMESPACE.sub("", str(element.tag))


def _children(element: Element, *tags: str) -> list[Element]:
    found = [element]
    for tag in tags:
        found = [child for parent in found for child in parent if _tag(child) == tag]
    return found


def _polygons(element: Element, is_keep_out: bool) -> Iterator[tuple[Element, bool]]:
    """Yield every polygon below, with True if a name above it makes it a keep-out."""
    pending = [(element, is_keep_out)]
    while pending:
        parent, is_out = pending.pop(0)
        if _tag(parent) == "Polygon":
            yield parent, is_out
            continue
        names = [(name.text or "").strip().lower() for name in _children(parent, "name")]
        is_out = is_out or any(name.startswith(KEEP_OUT_NAMES) for name in names)
        pending[:0] = [(child, is_out) for child in parent]


def _areas(polygon: Element, path: str, is_keep_out: bool) -> Iterator[NamedArea]:
    outer = _children(polygon, "outerBoundaryIs", "LinearRing", "coordinates")
    if len(outer) != 1:
        raise ValueError(f"{path}: has {len(outer)} outer rings")
    yield NamedArea(path, not is_keep_out, _ring(outer[0], path))
    if is_keep_out:
        return  # a hole in a keep-out is not part of the fence
    inner = _children(polygon, "innerBoundaryIs", "LinearRing", "coordinates")
    for number, ring in enumerate(inner, start=1):
        hole = f"{path}, hole {number}"
        yield NamedArea(hole, False, _ring(ring, hole))


def _ring(coordinates: Element, path: str) -> GeoArea:
    tuples = (coordinates.text or "").split()
    places = tuple(
        _kml_place(text, f"{path}: corner {n}") for n, text in enumerate(tuples, start=1)
    )
    is_closed = len(places) > 1 and places[0] == places[-1]
    return GeoArea(places[:-1] if is_closed else places)


def _kml_place(text: str, path: str) -> LatLon:
    parts = text.split(",")
    try:
        longitude_deg, latitude_deg = (float(part) for part in parts[:2])
    except ValueError:
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude") from None
    if len(parts) > 3 or not (math.isfinite(longitude_deg) and math.isfinite(latitude_deg)):
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude")
    return latitude_deg, longitude_deg


MAX_BYTES = 10_000_000
"""A plan with the mission of a whole day is smaller."""
READERS = {".plan": areas_of_plan, ".kml": areas_of_kml}


def read_fence(path: Path) -> GeoFence:
    """Return the fence in a `.plan` or `.kml` file; `ConfigError` names file and element."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        kinds = " or ".join(READERS)
        hint = "; unpack it, there is a .kml in it" if path.suffix.lower() == ".kmz" else ""
        raise ConfigError(f"{path}: a fence is a {kinds} file{hint}")
    try:
        return fence_of(reader(read_text(path, MAX_BYTES)))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


MOST_AREAS = 1000


def read_search_site(path: Path) -> SearchSite:
    """Return the weighted areas in a file; a `ConfigError` names the file and the fault."""
    readers = {
        ".geojson": _areas_of_geojson,
        ".json": _areas_of_geojson,
        ".kml": _areas_of_search_kml,
        ".asc": _raster_of_ascii,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: a search area is a .geojson, .kml or .asc file, in degrees")
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
    return _checked(tuple(_site_areas(root)))


def _areas_of_search_kml(text: str) -> SearchSite:
    """Return the polygons of all Placemarks; several of one share its weight."""
    areas: list[SiteArea] = []
    for number, placemark in enumerate(_below(_kml_root(text), "Placemark"), start=1):
        path, polygons = f"Placemark {number}", list(_below(placemark, "Polygon"))
        weight = _weight(_extended_data(placemark), path) / max(1, len(polygons))
        for polygon in polygons:
            outer = _children(polygon, "outerBoundaryIs", "LinearRing", "coordinates")
            inner = _children(polygon, "innerBoundaryIs", "LinearRing", "coordinates")
            if len(outer) != 1:
                raise ValueError(f"{path}: has {len(outer)} outer rings")
            rings = [_ring(each, path).corners_deg for each in (*outer, *inner)]
            places = [[[lon, lat] for lat, lon in ring] for ring in rings]
            outside, *holes = (_site_ring(ring, path) for ring in places)
            areas.append(SiteArea(outside, weight, tuple(holes)))
    return _checked(tuple(areas))


def _below(element: Element, tag: str) -> Iterator[Element]:
    return (each for each in element.iter() if _tag(each) == tag)


def _extended_data(placemark: Element) -> dict[str, object]:
    """Return the values of Data and SimpleData by name, numbers where they are."""
    values: dict[str, object] = {}
    for each in (*_below(placemark, "Data"), *_below(placemark, "SimpleData")):
        inner = _children(each, "value")
        text = (inner[0].text if inner else each.text) or ""
        try:
            values[each.get("name", "")] = float(text)
        except ValueError:
            values[each.get("name", "")] = text
    return values


def _checked(areas: tuple[SiteArea, ...]) -> SearchSite:
    if not areas:
        raise ValueError("there is no polygon in it")
    if len(areas) > MOST_AREAS:
        raise ValueError(f"{len(areas)} polygons; at most {MOST_AREAS}")
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
        outside, *holes = (_site_ring(ring, path) for ring in polygon)
        yield SiteArea(outside, share, tuple(holes))


def _site_ring(ring: object, path: str) -> tuple[LatLon, ...]:
    if not isinstance(ring, list):
        raise ValueError(f"{path}.geometry: a ring is not a list of places")
    places = [_site_place(each, path) for each in ring]
    if len(places) > 1 and places[0] == places[-1]:
        places.pop()
    if len(places) < 3:
        raise ValueError(f"{path}.geometry: a ring has fewer than 3 corners")
    if not is_simple([(100_000.0 * lon, 100_000.0 * lat) for lat, lon in places]):
        raise ValueError(f"{path}.geometry: a ring has two edges that touch or cross each other")
    return tuple(places)


def _site_place(value: object, path: str) -> LatLon:
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
        header[words[0].lower()] = _word_number(words[1])
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
    values = np.array([_word_number(word) for line in lines for word in line.split()])
    if values.size != columns * rows or not values.size:
        raise ValueError(f"{values.size} values for {columns} by {rows} cells")
    values[values == header.get("nodata_value", -9999.0)] = math.nan
    if np.any(values < 0.0) or not np.any(values > 0.0):
        raise ValueError("weights must be 0 or above, and one of them above 0")
    return SiteRaster(west, south, step, values.reshape(rows, columns)[::-1])


def _word_number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"`{word[:40]}` is not a number")
    return value
