"""From a waypoint to the next guarded setpoint."""

from __future__ import annotations

import math

from companion.domain import PositionEnu, PositionSetpoint, Waypoint
from companion.guard.gate import Guard, Guarded, GuardReason, Motion

CLIMB_FIRST_M = 1.0
"""Below the altitude band by more than this the vehicle climbs before it goes anywhere."""


class Steering:
    """Walks the setpoint towards waypoints, always through the guard.

    Args:
        guard: What may be sent.
        altitude_m: Search altitude above home.
    """

    def __init__(self, guard: Guard, altitude_m: float) -> None:
        self._guard = guard
        self._altitude_m = altitude_m
        self._last: Guarded | None = None

    @property
    def setpoint_enu_m(self) -> PositionEnu | None:
        """The setpoint sent last, where the next one begins."""
        return None if self._last is None else self._last.position_enu_m

    @property
    def reasons(self) -> tuple[GuardReason, ...]:
        """Why it is not where the planner wanted it."""
        return () if self._last is None else self._last.reasons

    def forget_setpoint(self) -> None:
        """The next setpoint starts where the vehicle is."""
        self._last = None

    def use_altitude(self, altitude_m: float) -> None:
        """Another search altitude above home from now on."""
        self._altitude_m = altitude_m

    def stay_with(self, motion: Motion) -> PositionSetpoint:
        """Hold at the vehicle's present place, following it while someone else flies it."""
        return self._sent(self._guard.here(motion))

    def stand(self, motion: Motion) -> PositionSetpoint:
        """Move nothing, not even back inside: where the vehicle is may be wrong."""
        last = self._last
        place = motion.position_enu_m if last is None else last.position_enu_m
        return self._sent(self._guard.stand(place))

    def stay(self, motion: Motion, dt_s: float) -> PositionSetpoint:
        """Hold at the place where holding began."""
        if self._last is None:
            return self.stay_with(motion)
        return self._sent(self._guard.hold(self._last, motion, dt_s))

    def follow(
        self,
        waypoint: Waypoint | None,
        motion: Motion,
        dt_s: float,
        speed_cap_mps: float = math.inf,
    ) -> PositionSetpoint:
        """One tick towards the waypoint at its altitude; without a waypoint, stay."""
        last = self._last
        if last is None or waypoint is None:
            return self.stay(motion, dt_s)
        east, north = waypoint.position_enu_m
        home_up_m = motion.home_enu_m[2]
        floor_m = home_up_m + self._guard.limits.envelope.altitude_min_m
        if motion.position_enu_m[2] < floor_m - CLIMB_FIRST_M:
            east, north = last.position_enu_m[:2]
        goal = (east, north, home_up_m + self._altitude_m + waypoint.altitude_offset_m)
        return self._sent(self._guard.towards(goal, last, motion, dt_s, speed_cap_mps))

    def _sent(self, guarded: Guarded) -> PositionSetpoint:
        self._last = guarded
        return PositionSetpoint(guarded.position_enu_m)
