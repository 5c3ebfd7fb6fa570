"""The planner protocol: from what is known to the next waypoint, as a pure step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from companion.domain import Point, TargetEstimate, Waypoint
from companion.geometry.arrays import Matrix
from companion.geometry.polygons import Polygon

Memory = TypeVar("Memory")


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What a planner may know."""

    vehicle_enu_m: Point
    estimate: TargetEstimate | None = None
    """None before the first measurement."""
    fence_enu_m: Polygon | None = None
    """Waypoints and the straight legs to them stay inside this polygon, by `fence_margin_m`."""
    fence_margin_m: float = 0.0
    """Distance to keep from the fence and from every keep-out."""
    baseline_m: float = 0.0
    """How far to the side of the target a view must be to say much; 0 where bearings are measured.

    Straight above it a slant range hardly depends on where the target is.
    """
    keep_out_enu_m: tuple[Polygon, ...] = ()
    """Polygons that waypoints and the straight legs to them stay out of."""
    leg_from_enu_m: Point | None = None
    """Where the leg to the waypoint begins, if not at the vehicle: the setpoint moves ahead."""
    time_s: float = 0.0
    contact_s: float | None = None
    """When the last usable measurement came; None: unknown, and an estimate counts as fresh."""
    height_m: float = 0.0
    """Of the vehicle above the target, for slant ranges."""
    altitude_offset_m: float | None = None
    """Of the vehicle above the search altitude; None: heights are not waited for."""
    joint_covariance: Matrix | None = field(default=None, compare=False)
    """(4, 4) of [east, north, range offset, bearing offset]; metres and radians.

    None: that of the estimate, and offsets known as little as before the flight.
    """

    @property
    def begin_enu_m(self) -> Point:
        """Where the leg to the waypoint begins."""
        return self.vehicle_enu_m if self.leg_from_enu_m is None else self.leg_from_enu_m


@dataclass(frozen=True, slots=True)
class Plan(Generic[Memory]):
    """A waypoint, and what the planner wants to remember until the next request."""

    waypoint: Waypoint
    memory: Memory


class Planner(Protocol[Memory]):
    """Chooses where to fly; pure, the caller keeps the memory."""

    @property
    def search_after_s(self) -> float | None:
        """How long without contact until it searches; None: never, 0: it needs no contact."""

    def initial_memory(self) -> Memory:
        """The memory before the first request."""

    def plan(self, request: PlanRequest, memory: Memory) -> Plan[Memory]:
        """The next waypoint; the straight leg to it stays in the free space of the request."""
