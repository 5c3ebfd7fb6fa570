"""What each flight mode does: from mode, setpoint and motion to a velocity command.

A mode that stays in place stays where a braking vehicle comes to rest. POSITION, and every other
mode flown by sticks, sinks slowly: nobody holds the sticks, and PX4 without a remote control was
seen to do the same.
"""

from __future__ import annotations

import math

from companion.domain import FlightMode, PositionEnu
from companion.geometry.frames import wrap_pi
from sim_link.autopilot.setpoints import Setpoint
from sim_link.world.point_mass import (
    PointMass,
    VehicleParams,
    approach_speed_mps,
    approach_velocity,
    stopping_point,
)

SINK_WITHOUT_STICKS_MPS = 0.7
"""PX4 1.15 in POSCTL without a remote control: 0.6 to 0.9 m/s."""
SLOW_DESCENT_BELOW_M = 5.0
"""Height under which LAND uses the landing speed (PX4 MPC_LAND_ALT2)."""
REACHED_M = 0.2
HOME_REACHED_M = 0.5
CLIMBED_M = 1.0
"""How far below its cruise height RETURN may start, and dip on, the way home."""


class Pilot:
    """Flies the modes.

    Args:
        vehicle: Limits and response, for braking.
        home_enu_m: Where RETURN goes.
        return_altitude_m: Height above home for the way there.
    """

    def __init__(
        self, vehicle: VehicleParams, home_enu_m: PositionEnu, return_altitude_m: float
    ) -> None:
        self._vehicle = vehicle
        self._home_enu_m = home_enu_m
        self._return_up_m = home_enu_m[2] + return_altitude_m
        self._hold_enu_m = home_enu_m
        self._cruise_up_m: float | None = None
        self._is_staying = False
        self.takeoff_up_m = home_enu_m[2]
        """Height at which TAKEOFF ends; set with the command."""

    def enter(self, mode: FlightMode, body: PointMass) -> None:
        """The flown mode changes to `mode`."""
        self._stay(body)
        self._is_staying = False
        self._cruise_up_m = None
        if mode is FlightMode.RETURN and not body.is_on_ground and not self._is_over_home(body):
            self._cruise_up_m = max(body.position_enu_m[2], self._return_up_m)

    def has_taken_off(self, body: PointMass) -> bool:
        """Whether the takeoff height is reached."""
        return body.position_enu_m[2] >= self.takeoff_up_m - REACHED_M

    def command(self, mode: FlightMode, setpoint: Setpoint, body: PointMass) -> PositionEnu:
        """The velocity that the mode wants now, local east-north-up."""
        match mode:
            case FlightMode.OFFBOARD:
                return self._follow(setpoint, body)
            case FlightMode.TAKEOFF:
                east, north, _ = self._hold_enu_m
                up_m = max(self.takeoff_up_m, self._hold_enu_m[2])
                return self._towards((east, north, up_m), body)
            case FlightMode.LAND:
                return self._land(body)
            case FlightMode.RETURN:
                return self._return(body)
            case FlightMode.HOLD | FlightMode.MISSION:
                return self._towards(self._hold_enu_m, body)
        return (0.0, 0.0, -SINK_WITHOUT_STICKS_MPS)

    def yaw_ned_rad(
        self, mode: FlightMode, setpoint: Setpoint, body: PointMass, dt_s: float
    ) -> float | None:
        """The heading that the mode wants now, clockwise from north; None keeps the present."""
        if mode is not FlightMode.OFFBOARD:
            return None
        if setpoint.yaw_ned_rad is None and setpoint.yaw_rate_ned_radps is not None:
            return wrap_pi(body.yaw_ned_rad + setpoint.yaw_rate_ned_radps * dt_s)
        return setpoint.yaw_ned_rad

    def _stay(self, body: PointMass) -> None:
        east, north, up = stopping_point(body.position_enu_m, body.velocity_enu_mps, self._vehicle)
        self._hold_enu_m = (east, north, max(up, body.ground_up_m))

    def _towards(self, goal_enu_m: PositionEnu, body: PointMass) -> PositionEnu:
        return approach_velocity(body.position_enu_m, goal_enu_m, self._vehicle)

    def _land(self, body: PointMass) -> PositionEnu:
        east, north, _ = self._towards(self._hold_enu_m, body)
        if body.height_m > SLOW_DESCENT_BELOW_M:
            return (east, north, -self._vehicle.max_descent_mps)
        return (east, north, -self._vehicle.landing_speed_mps)

    def _return(self, body: PointMass) -> PositionEnu:
        if self._cruise_up_m is None:
            return self._land(body)
        if body.position_enu_m[2] < self._cruise_up_m - CLIMBED_M:
            east, north, _ = self._hold_enu_m
            return self._towards((east, north, self._cruise_up_m), body)
        if self._is_over_home(body):
            self._hold_enu_m = self._home_enu_m
            self._cruise_up_m = None
            return self._land(body)
        return self._towards((*self._home_enu_m[:2], self._cruise_up_m), body)

    def _is_over_home(self, body: PointMass) -> bool:
        """Whether the wind lets it come no nearer, or it is there."""
        distance_m = math.dist(body.position_enu_m[:2], self._home_enu_m[:2])
        slack_mps = body.drift_mps + self._vehicle.position_gain_per_s * HOME_REACHED_M
        return approach_speed_mps(distance_m, self._vehicle) <= slack_mps

    def _follow(self, setpoint: Setpoint, body: PointMass) -> PositionEnu:
        gives_nothing = (
            setpoint.position_en_m is None
            and setpoint.velocity_en_mps is None
            and setpoint.up_m is None
            and setpoint.climb_mps is None
        )
        if gives_nothing:
            if not self._is_staying:
                self._stay(body)
                self._is_staying = True
            return self._towards(self._hold_enu_m, body)
        self._is_staying = False
        own_east, own_north, own_up = body.position_enu_m
        east, north = setpoint.position_en_m or (own_east, own_north)
        up = own_up if setpoint.up_m is None else setpoint.up_m
        to_goal = self._towards((east, north, up), body)
        forward_east, forward_north = setpoint.velocity_en_mps or (0.0, 0.0)
        return (
            to_goal[0] + forward_east,
            to_goal[1] + forward_north,
            to_goal[2] + (setpoint.climb_mps or 0.0),
        )
