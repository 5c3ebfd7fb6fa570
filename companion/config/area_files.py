"""Fences from files: the plan of QGroundControl, and KML.

Source: QGroundControl developer guide, "Plan File Format": `geoFence` version 2 with `polygons` and
`circles`, each of version 1, positions as [latitude, longitude] in degrees, radii in metres. The
mission, the rally points and the breach return point of the plan are ignored.

Source: OGC KML 2.3, Polygon: `outerBoundaryIs` and `innerBoundaryIs` hold rings of
"longitude,latitude[,altitude]" tuples in degrees, closed by their first position. The one polygon
that is not a keep-out is the fence, and holes in it are keep-outs; so are polygons in a Placemark
or Folder whose name begins with one of `KEEP_OUT_NAMES`. Altitudes are ignored.

An XML document with a DOCTYPE could bring entities that grow without bound, and is refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from companion.config.loader import read_text
from companion.errors import ConfigError
from companion.geometry.geofence import GeoArea, GeoFence, LatLon, NamedArea, fence_of

FENCE_VERSION = 2
AREA_VERSION = 1


def areas_of_plan(text: str) -> list[NamedArea]:
    """Return the areas in a plan, in order; a `ValueError` begins with the path of the fault."""
    try:
        plan = json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise ValueError(
            f"line {error.lineno}, column {error.colno}: not JSON ({error.msg})"
        ) from None
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
    """Return an object; raise `ValueError` for a repeated key: only one of two could apply."""
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
    positions = tuple(
        _plan_position(c, f"{path}.polygon[{index}]") for index, c in enumerate(corners)
    )
    return GeoArea(positions)


def _circle(area: dict[str, object], path: str) -> GeoArea:
    circle = area.get("circle")
    if not isinstance(circle, dict):
        raise ValueError(f"{path}.circle: is missing")
    centre = _plan_position(circle.get("center"), f"{path}.circle.center")
    radius_m = _number(circle.get("radius"), f"{path}.circle.radius")
    return GeoArea((centre,), radius_m)


def _plan_position(value: object, path: str) -> LatLon:
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
    root = kml_root(text)
    areas: list[NamedArea] = []
    for number, (polygon, is_keep_out) in enumerate(_polygons(root, False), start=1):
        areas += _areas(polygon, f"Polygon {number}", is_keep_out)
    return areas


def kml_root(text: str) -> Element:
    """Return the root element of a KML document; raise `ValueError` if it is not KML."""
    if "<!DOCTYPE" in text.upper():
        raise ValueError("a DOCTYPE has no place in KML; save the file again")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line, column = error.position
        raise ValueError(f"line {line}, column {column + 1}: not XML ({error.msg})") from None
    except (ValueError, RecursionError):  # a declared encoding that does not exist
        raise ValueError("not XML in UTF-8") from None
    if tag_of(root) != "kml":
        raise ValueError(f"<{tag_of(root)}>: is not KML")
    return root


def tag_of(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return _NAMESPACE.sub("", str(element.tag))


def children_of(element: Element, *tags: str) -> list[Element]:
    """Return the elements at a path below an element."""
    found = [element]
    for tag in tags:
        found = [child for parent in found for child in parent if tag_of(child) == tag]
    return found


def _polygons(element: Element, is_keep_out: bool) -> Iterator[tuple[Element, bool]]:
    """Yield every polygon below, with True if a name above it makes it a keep-out."""
    pending = [(element, is_keep_out)]
    while pending:
        parent, is_out = pending.pop(0)
        if tag_of(parent) == "Polygon":
            yield parent, is_out
            continue
        names = [(name.text or "").strip().lower() for name in children_of(parent, "name")]
        is_out = is_out or any(name.startswith(KEEP_OUT_NAMES) for name in names)
        pending[:0] = [(child, is_out) for child in parent]


def _areas(polygon: Element, path: str, is_keep_out: bool) -> Iterator[NamedArea]:
    outer = children_of(polygon, "outerBoundaryIs", "LinearRing", "coordinates")
    if len(outer) != 1:
        raise ValueError(f"{path}: has {len(outer)} outer rings")
    yield NamedArea(path, not is_keep_out, ring_of(outer[0], path))
    if is_keep_out:
        return  # a hole in a keep-out is not part of the fence
    inner = children_of(polygon, "innerBoundaryIs", "LinearRing", "coordinates")
    for number, ring in enumerate(inner, start=1):
        hole = f"{path}, hole {number}"
        yield NamedArea(hole, False, ring_of(ring, hole))


def ring_of(coordinates: Element, path: str) -> GeoArea:
    """Return the ring in `coordinates`, open."""
    tuples = (coordinates.text or "").split()
    positions = tuple(
        _kml_position(text, f"{path}: corner {n}") for n, text in enumerate(tuples, start=1)
    )
    is_closed = len(positions) > 1 and positions[0] == positions[-1]
    return GeoArea(positions[:-1] if is_closed else positions)


def _kml_position(text: str, path: str) -> LatLon:
    parts = text.split(",")
    try:
        longitude_deg, latitude_deg = (float(part) for part in parts[:2])
    except ValueError:
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude") from None
    if len(parts) > 3 or not (math.isfinite(longitude_deg) and math.isfinite(latitude_deg)):
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude")
    return latitude_deg, longitude_deg


MAX_BYTES = 10_000_000
"""Largest size of a plan file; one with the mission of a whole day is smaller."""
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
