"""The fence of a KML file, as Google Earth, QGIS and QGroundControl save it.

Source: OGC KML 2.3, Polygon: `outerBoundaryIs` and `innerBoundaryIs` hold rings of
"longitude,latitude[,altitude]" tuples in degrees, closed by their first place. The one polygon that
is not a keep-out is the fence, and holes in it are keep-outs; so are polygons in a Placemark or
Folder whose name begins with one of `KEEP_OUT_NAMES`. Altitudes are not looked at.

An XML document that brings its own entities can grow without bound, so one with a DOCTYPE is
refused, and nothing else can define any.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from companion.geometry.geofence import GeoArea, LatLon, NamedArea

KEEP_OUT_NAMES = ("keep-out", "keep out", "keepout", "exclusion", "no-fly", "no fly")
_NAMESPACE = re.compile(r"^\{[^}]*\}")


def areas_of_kml(text: str) -> list[NamedArea]:
    """The areas in the text of a KML file, in order, each with its path.

    Raises:
        ValueError: It is no KML, or a ring is none; the text begins with the path of the element.
    """
    if "<!DOCTYPE" in text.upper():
        raise ValueError("a DOCTYPE has no place in KML; save the file again")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line, column = error.position
        raise ValueError(f"line {line}, column {column + 1}: not XML ({error.msg})") from None
    except (ValueError, RecursionError):  # a declared encoding that is none
        raise ValueError("not XML in UTF-8") from None
    if _tag(root) != "kml":
        raise ValueError(f"<{_tag(root)}>: is not KML")
    areas: list[NamedArea] = []
    for number, (polygon, is_keep_out) in enumerate(_polygons(root, False), start=1):
        areas += _areas(polygon, f"Polygon {number}", is_keep_out)
    return areas


def _tag(element: Element) -> str:
    return _NAMESPACE.sub("", str(element.tag))


def _children(element: Element, *tags: str) -> list[Element]:
    """The children of the children ... of these names."""
    found = [element]
    for tag in tags:
        found = [child for parent in found for child in parent if _tag(child) == tag]
    return found


def _polygons(element: Element, is_keep_out: bool) -> Iterator[tuple[Element, bool]]:
    """Every polygon below, and whether a name on the way to it makes it a keep-out."""
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
        return  # a hole in a keep-out is no place to fly to
    inner = _children(polygon, "innerBoundaryIs", "LinearRing", "coordinates")
    for number, ring in enumerate(inner, start=1):
        hole = f"{path}, hole {number}"
        yield NamedArea(hole, False, _ring(ring, hole))


def _ring(coordinates: Element, path: str) -> GeoArea:
    tuples = (coordinates.text or "").split()
    places = tuple(_place(text, f"{path}: corner {n}") for n, text in enumerate(tuples, start=1))
    is_closed = len(places) > 1 and places[0] == places[-1]
    return GeoArea(places[:-1] if is_closed else places)


def _place(text: str, path: str) -> LatLon:
    parts = text.split(",")
    try:
        longitude_deg, latitude_deg = (float(part) for part in parts[:2])
    except ValueError:
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude") from None
    if len(parts) > 3 or not (math.isfinite(longitude_deg) and math.isfinite(latitude_deg)):
        raise ValueError(f"{path}: `{text[:40]}` is not longitude,latitude")
    return latitude_deg, longitude_deg
