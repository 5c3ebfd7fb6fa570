"""The planner protocol: from an estimate to the next waypoint, as a pure step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from companion.domain import Point, TargetEstimate, Waypoint
from companion.geometry.polygons import Polygon

Memory = TypeVar("Memory")


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What a planner may know."""

    vehicle_enu_m: Point
    estimate: TargetEstimate
    fence_enu_m: Polygon | None = None
    """Waypoints stay inside this polygon, by `fence_margin_m`."""
    fence_margin_m: float = 0.0
    baseline_m: float = 0.0
    """How far to the side of the target a view must be to say much; 0 where bearings are measured.

    Straight above it a slant range hardly depends on where the target is.
    """


@dataclass(frozen=True, slots=True)
class Plan(Generic[Memory]):
    """A waypoint, and what the planner wants to remember until the next request."""

    waypoint: Waypoint
    memory: Memory


class Planner(Protocol[Memory]):
    """Chooses where to fly; pure, the caller keeps the memory."""

    def initial_memory(self) -> Memory:
        """The memory before the first request."""

    def plan(self, request: PlanRequest, memory: Memory) -> Plan[Memory]:
        """The next waypoint, inside the fence of the request."""
