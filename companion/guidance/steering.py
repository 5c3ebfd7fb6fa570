"""From a waypoint to the next guarded setpoint."""

from __future__ import annotations

from companion.domain import PositionEnu, PositionSetpoint, Waypoint
from companion.guard.gate import Guard, Guarded, GuardReason

CLIMB_FIRST_M = 1.0
"""Below the altitude band by more than this the vehicle climbs before it goes anywhere."""


class Steering:
    """Walks the setpoint towards waypoints, always through the guard.

    Args:
        guard: What may be sent.
        altitude_m: Search altitude above home.
    """

    def __init__(self, guard: Guard, altitude_m: float) -> None:
        self.setpoint_enu_m: PositionEnu | None = None
        self.reasons: tuple[GuardReason, ...] = ()
        self._guard = guard
        self._altitude_m = altitude_m

    def forget_setpoint(self) -> None:
        """The next setpoint starts where the vehicle is."""
        self.setpoint_enu_m = None

    def stay_with(self, vehicle_enu_m: PositionEnu, home_up_m: float) -> PositionSetpoint:
        """Hold at the vehicle's present place, following it while someone else flies it."""
        return self._sent(self._guard.here(vehicle_enu_m, home_up_m))

    def stay(self, vehicle_enu_m: PositionEnu, home_up_m: float, dt_s: float) -> PositionSetpoint:
        """Hold at the place where holding began."""
        if self.setpoint_enu_m is None:
            return self._sent(self._guard.here(vehicle_enu_m, home_up_m))
        at = self.setpoint_enu_m
        return self._sent(self._guard.towards(at, at, vehicle_enu_m, home_up_m, dt_s))

    def follow(
        self,
        waypoint: Waypoint | None,
        vehicle_enu_m: PositionEnu,
        home_up_m: float,
        dt_s: float,
    ) -> PositionSetpoint:
        """One tick towards the waypoint at its altitude; without a waypoint, stay."""
        previous = self.setpoint_enu_m
        if previous is None or waypoint is None:
            return self.stay(vehicle_enu_m, home_up_m, dt_s)
        east, north = waypoint.position_enu_m
        floor_m = home_up_m + self._guard.limits.altitude_min_m
        if vehicle_enu_m[2] < floor_m - CLIMB_FIRST_M:
            east, north = previous[:2]
        up = home_up_m + self._altitude_m + waypoint.altitude_offset_m
        goal = (east, north, up)
        return self._sent(self._guard.towards(goal, previous, vehicle_enu_m, home_up_m, dt_s))

    def _sent(self, guarded: Guarded) -> PositionSetpoint:
        self.setpoint_enu_m = guarded.position_enu_m
        self.reasons = guarded.reasons
        return PositionSetpoint(guarded.position_enu_m)
