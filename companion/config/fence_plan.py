"""The fence of a QGroundControl `.plan` file.

Source: QGroundControl developer guide, "Plan File Format": `geoFence` version 2 with `polygons` and
`circles`, each of version 1, places as [latitude, longitude] in degrees, radii in metres. The
mission and the rally points of the plan are not looked at; neither is the breach return point.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

from companion.geometry.geofence import GeoArea, LatLon, NamedArea

FENCE_VERSION = 2
AREA_VERSION = 1


def areas_of_plan(text: str) -> list[NamedArea]:
    """The areas in the text of a plan, in order, each with its path.

    Raises:
        ValueError: It is no plan of this version; the text begins with the path of the element.
    """
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
    polygons = [_polygon(area, path) for area, path in _listed(fence, "polygons")]
    return polygons + [_circle(area, path) for area, path in _listed(fence, "circles")]


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """An object whose keys are given once: of two fences nobody knows which one counts."""
    found: dict[str, object] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key `{key[:40]}` is given twice")
        found[key] = value
    return found


def _listed(fence: dict[str, object], key: str) -> Iterator[tuple[dict[str, object], str]]:
    listed = fence.get(key, [])
    if not isinstance(listed, list):
        raise ValueError(f"geoFence.{key}: is not a list")
    for index, area in enumerate(listed):
        path = f"geoFence.{key}[{index}]"
        if not isinstance(area, dict):
            raise ValueError(f"{path}: is not an object")
        _check_version(area, path, AREA_VERSION)
        yield area, path


def _check_version(element: dict[str, object], path: str, version: int) -> None:
    found = element.get("version")
    if found != version or isinstance(found, bool):
        raise ValueError(
            f"{path}.version: is {json.dumps(found)}, not {version}; open the plan in a present "
            "QGroundControl and save it again"
        )


def _is_inclusion(area: dict[str, object], path: str) -> bool:
    is_inclusion = area.get("inclusion")
    if not isinstance(is_inclusion, bool):
        raise ValueError(f"{path}.inclusion: is not true or false")
    return is_inclusion


def _polygon(area: dict[str, object], path: str) -> NamedArea:
    corners = area.get("polygon")
    if not isinstance(corners, list):
        raise ValueError(f"{path}.polygon: is not a list of corners")
    places = tuple(_place(c, f"{path}.polygon[{index}]") for index, c in enumerate(corners))
    return NamedArea(path, _is_inclusion(area, path), GeoArea(places))


def _circle(area: dict[str, object], path: str) -> NamedArea:
    circle = area.get("circle")
    if not isinstance(circle, dict):
        raise ValueError(f"{path}.circle: is missing")
    centre = _place(circle.get("center"), f"{path}.circle.center")
    radius_m = _number(circle.get("radius"), f"{path}.circle.radius")
    return NamedArea(path, _is_inclusion(area, path), GeoArea((centre,), radius_m))


def _place(value: object, path: str) -> LatLon:
    if not (isinstance(value, list) and len(value) in (2, 3)):
        raise ValueError(f"{path}: is not [latitude, longitude]")
    return _number(value[0], f"{path}[0]"), _number(value[1], f"{path}[1]")


def _number(value: object, path: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(number := _float(value)):
        raise ValueError(f"{path}: is not a finite number")
    return number


def _float(value: object) -> float:
    assert isinstance(value, int | float)
    try:
        return float(value)
    except OverflowError:  # JSON has integers of any length
        return math.inf
