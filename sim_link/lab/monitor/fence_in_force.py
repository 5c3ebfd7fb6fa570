"""Fences of the autopilot that the companion was given, by the frames that reached it.

Written for the monitor alone. A fence counts from when its last item has arrived: all items since
the last MISSION_COUNT, in their order. In the air every one of the flight counts on, on the ground
only the newest.

Source: MAVLink developer guide, "Mission Protocol"; MAVLink common, MAV_CMD_NAV_FENCE_*.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from companion.mav.dialect import mavlink
from sim_link.lab.lockstep.observer import Frame
from sim_link.lab.monitor import independent_checks
from sim_link.lab.monitor.independent_checks import Corners, Point

FENCE = mavlink.MAV_MISSION_TYPE_FENCE
POLYGON_IN = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
POLYGON_OUT = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
CIRCLE_IN = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
CIRCLE_OUT = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION

Item = mavlink.MAVLink_mission_item_int_message
ToEnu = Callable[[float, float], Point]
"""Latitude and longitude in degrees to east and north in the world's frame."""


@dataclass(frozen=True, slots=True)
class FlownFence:
    """One fence: inside any of its inclusions, outside of all its exclusions."""

    inclusions: tuple[Corners, ...] = ()
    exclusions: tuple[Corners, ...] = ()
    circles_in: tuple[tuple[Point, float], ...] = ()
    circles_out: tuple[tuple[Point, float], ...] = ()

    def depth_m(self, place: Point) -> float:
        """Return the depth of a position inside the allowed area, m; negative: violated."""
        inside = [independent_checks.depth_m(each, (), place) for each in self.inclusions]
        inside += [radius_m - math.dist(at, place) for at, radius_m in self.circles_in]
        outside = [-independent_checks.depth_m(each, (), place) for each in self.exclusions]
        outside += [math.dist(at, place) - radius_m for at, radius_m in self.circles_out]
        return min([max(inside, default=math.inf), *outside])

    def is_way_clear(self, start: Point, end: Point) -> bool:
        """Return True if the straight line between two allowed points crosses no border."""
        polygons = (*self.inclusions, *self.exclusions)
        if polygons and not independent_checks.is_way_clear(polygons[0], polygons[1:], start, end):
            return False
        return all(
            independent_checks.to_segment_m(start, end, at) >= radius_m
            for at, radius_m in self.circles_out
        )


@dataclass(slots=True)
class FencesInForce:
    """The fences that hold beside that of the configuration, and the one that is being read."""

    fences: list[tuple[float, FlownFence]] = field(default_factory=list)
    """Each with the time when it was complete, in the order of that; equal ones once."""
    read_s: float = -math.inf
    """Time of the last complete download of a fence, or of its absence."""
    _count: int | None = None
    _items: list[Item] = field(default_factory=list)

    def clear(self) -> None:
        """Forget all fences: another process knows none yet."""
        self.fences.clear()
        self.read_s, self._count = -math.inf, None

    def land(self) -> None:
        """Keep only the newest fence, which alone counts on the ground."""
        del self.fences[:-1]

    def take(self, frame: Frame, to_enu: ToEnu) -> None:
        """Process a frame of the autopilot that reached the companion."""
        message = frame.message
        match message:
            case mavlink.MAVLink_mission_count_message() if message.mission_type == FENCE:
                self._count, self._items = message.count, []
            case mavlink.MAVLink_mission_item_int_message() if message.mission_type == FENCE:
                if self._count is not None and message.seq == len(self._items):
                    self._items.append(message)
            case _:
                return
        if self._count is not None and len(self._items) == self._count:
            self._count, self.read_s = None, frame.time_s
            fence = _fence_of(self._items, to_enu)
            if self._items and fence not in [each for _, each in self.fences]:
                self.fences.append((frame.time_s, fence))

    def known(self, before_s: float) -> list[FlownFence]:
        """Return the fences that were complete before a time."""
        return [fence for time_s, fence in self.fences if time_s < before_s]


def _fence_of(items: Sequence[Item], to_enu: ToEnu) -> FlownFence:
    """Return the fence that items make; those of a polygon follow each other."""
    polygons: dict[int, list[Corners]] = {POLYGON_IN: [], POLYGON_OUT: []}
    circles: dict[int, list[tuple[Point, float]]] = {CIRCLE_IN: [], CIRCLE_OUT: []}
    index = 0
    while index < len(items):
        item, count = items[index], 1
        if item.command in circles:
            at = to_enu(item.x / 1e7, item.y / 1e7)
            circles[item.command].append((at, item.param1))
        elif item.command in polygons:
            count = max(1, int(item.param1))
            corners = [to_enu(v.x / 1e7, v.y / 1e7) for v in items[index : index + count]]
            polygons[item.command].append(tuple(corners))
        index += count
    return FlownFence(
        tuple(polygons[POLYGON_IN]),
        tuple(polygons[POLYGON_OUT]),
        tuple(circles[CIRCLE_IN]),
        tuple(circles[CIRCLE_OUT]),
    )
