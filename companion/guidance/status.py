"""A snapshot of the session for views and logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.domain import FlightMode, PositionEnu, TargetEstimate, Waypoint
from companion.guidance.states import Phase


@dataclass(frozen=True, slots=True)
class GuidanceStatus:
    """Everything an operator may want to see, as of `time_s`."""

    time_s: float
    phase: Phase
    detail: str
    """Why it holds or waits, in words."""
    mode: FlightMode
    is_armed: bool
    is_link_lost: bool
    vehicle_enu_m: PositionEnu | None
    height_m: float | None
    distance_m: float
    estimate: TargetEstimate | None
    waypoint: Waypoint | None
    setpoint_enu_m: PositionEnu | None
    guard: tuple[str, ...]
    """Why the setpoint is not where the planner wanted it."""
    nlos_share: float
    inflation: tuple[float, float]
    accepted: int
    refused: Mapping[str, int]
