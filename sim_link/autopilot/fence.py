"""The geofence: what is inside, and how far to its border.

Source: MAVLink common, MAV_CMD_NAV_FENCE_* (5000 to 5004). Everything is in the world's frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from companion.domain import Point, PositionEnu
from companion.geometry.polygons import depth_m
from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.plan_items import PlanItem

POLYGON_IN = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
POLYGON_OUT = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
CIRCLE_IN = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
CIRCLE_OUT = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon, or a circle if it has a radius."""

    corners_enu_m: tuple[Point, ...]
    """Of the polygon, or only the centre of a circle."""
    is_inclusion: bool
    radius_m: float | None = None

    def depth_m(self, place: Point) -> float:
        """How far inside the area, negative outside."""
        if self.radius_m is None:
            return depth_m(self.corners_enu_m, place)
        return self.radius_m - math.dist(place, self.corners_enu_m[0])


class Fence:
    """Areas that must or must not be flown in.

    Several inclusions together are one: inside any of them is inside (PX4 and ArduPilot alike).

    Args:
        areas: Their shapes.
    """

    def __init__(self, areas: Sequence[Area] = ()) -> None:
        self._inclusions = [area for area in areas if area.is_inclusion]
        self._exclusions = [area for area in areas if not area.is_inclusion]

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to keep to."""
        return not (self._inclusions or self._exclusions)

    def margin_m(self, place: PositionEnu) -> float:
        """Distance to the nearest breach, negative in one; infinite without a fence."""
        point = place[:2]
        margin = math.inf
        if self._inclusions:
            margin = max(area.depth_m(point) for area in self._inclusions)
        return min([margin, *(-area.depth_m(point) for area in self._exclusions)])


def areas_from_items(
    items: Sequence[PlanItem], enu_from_e7: Callable[[int, int], Point]
) -> list[Area]:
    """The areas of an uploaded fence.

    Args:
        items: In order of upload; a return point (5000) is passed over.
        enu_from_e7: Converts latitude and longitude in 1e-7 degrees.

    Raises:
        ValueError: A polygon has fewer vertices than it says, or a circle no radius.
    """
    areas: list[Area] = []
    index = 0
    while index < len(items):
        item = items[index]
        if item.command in (CIRCLE_IN, CIRCLE_OUT):
            if not item.params[0] > 0.0:
                raise ValueError("a fence circle needs a radius above 0")
            centre = (enu_from_e7(item.x, item.y),)
            areas.append(Area(centre, item.command == CIRCLE_IN, float(item.params[0])))
            index += 1
        elif item.command in (POLYGON_IN, POLYGON_OUT):
            count = int(item.params[0]) if math.isfinite(item.params[0]) else 0
            vertices = items[index : index + count]
            is_whole = len(vertices) == count >= 3
            if not is_whole or any(v.command != item.command for v in vertices):
                raise ValueError("a fence polygon needs as many vertices as it says, 3 or more")
            corners = tuple(enu_from_e7(v.x, v.y) for v in vertices)
            areas.append(Area(corners, item.command == POLYGON_IN))
            index += count
        else:
            index += 1
    return areas
