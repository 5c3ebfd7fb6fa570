"""Control laws of the tasks: from task, setpoint and motion to a velocity command.

A task that stays in place stays where a braking vehicle comes to rest. Modes flown by sticks sink
slowly without a stick input: PX4 without a remote control was seen to do the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from companion.domain import PositionEnu
from companion.geometry.coordinates import wrap_pi
from companion.geometry.polygons import Point
from sim_link.autopilot.control_inputs import DEAD_ZONE, Setpoint, Sticks, turned
from sim_link.autopilot.estimator import Kinematics
from sim_link.autopilot.mission_executor import LegKind, MissionLeg
from sim_link.world.point_mass import (
    MulticopterParams,
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
"""Distance below its cruise height at which RETURN may start, or that it may sink."""
STEP_S = 0.02


class Task(Enum):
    """Task of the flight controller, independent of the mode."""

    STAY = "stay"
    """Stays at the hold point, which a command may move."""
    TAKE_OFF = "take off"
    LAND = "land"
    RETURN = "return"
    FLY_MISSION = "fly mission"
    FOLLOW = "follow setpoints"
    FLY_BY_STICKS = "fly by sticks"
    CIRCLE = "circle"
    DESCEND = "descend"


@dataclass(frozen=True, slots=True)
class SpeedLimits:
    """Speed limits from parameters, within the vehicle's own limits."""

    horizontal_mps: float = math.inf
    climb_mps: float = math.inf
    descent_mps: float = math.inf


class FlightController:
    """Flies the tasks."""

    def __init__(self, vehicle: MulticopterParams, home_enu_m: PositionEnu) -> None:
        self._vehicle = vehicle
        self.task = Task.STAY
        self.home_enu_m = home_enu_m
        self.return_up_m = home_enu_m[2]
        self.takeoff_up_m = home_enu_m[2]
        """Height at which TAKE_OFF ends; set with the command."""
        self.final_up_m: float | None = None
        """Height above which RETURN stays instead of landing; None if it lands."""
        self.return_loiter_s = 0.0
        """Time for which RETURN waits over home before it descends."""
        self.circle_radius_m = 0.0
        self.circle_rate_radps = 0.0
        """Rate of CIRCLE, clockwise positive; 0 only turns the nose to the centre."""
        self._circle_centre: Point = home_enu_m[:2]
        self._circle_yaw_ned_rad: float | None = None
        self.limits = SpeedLimits()
        self.hold_yaw_ned_rad: float | None = None
        self.hold_speed_mps: float | None = None
        self.hold_enu_m = home_enu_m
        self._holds_the_ground = True
        """True if the vehicle stands on its support; its estimate may wander."""
        self._cruise_up_m: float | None = None
        self._loitered_s = 0.0
        self._velocity: PositionEnu = (0.0, 0.0, 0.0)
        self._is_staying = False
        self._leg: MissionLeg | None = None
        self.goal_enu_m: PositionEnu | None = None
        """Current goal of the task; None if it has no position, as with moved sticks."""
        self.wanted_enu_mps: PositionEnu = (0.0, 0.0, 0.0)
        """Latest velocity command of the task."""

    def enter(self, task: Task, body: Kinematics) -> None:
        """Begin a new task."""
        self.task = task
        self._stay(body)
        self._is_staying = False
        self._cruise_up_m = None
        self._loitered_s = 0.0
        self._velocity = body.velocity_enu_mps
        self.hold_yaw_ned_rad = self.hold_speed_mps = None
        if task is Task.RETURN and not (body.is_on_ground or self._is_over_home(body)):
            self._cruise_up_m = max(body.position_enu_m[2], self.return_up_m)
        if task is Task.CIRCLE:
            ahead = turned(self.circle_radius_m, 0.0, body.yaw_ned_rad)
            self._circle_centre = (self.hold_enu_m[0] + ahead[0], self.hold_enu_m[1] + ahead[1])

    def go_to(self, goal_enu_m: PositionEnu, speed_mps: float | None, yaw: float | None) -> None:
        """Stay at another position from now on; needs the task STAY."""
        self.hold_enu_m = goal_enu_m
        self._holds_the_ground = False
        self.hold_speed_mps, self.hold_yaw_ned_rad = speed_mps, yaw

    def has_taken_off(self, body: Kinematics) -> bool:
        """Return True if the takeoff height is reached."""
        return body.position_enu_m[2] >= self.takeoff_up_m - REACHED_M

    def command(
        self, setpoint: Setpoint, leg: MissionLeg | None, sticks: Sticks | None, body: Kinematics
    ) -> PositionEnu:
        """Return the wanted velocity, local east-north-up; None if a parameter is not a number."""
        self._leg, self.goal_enu_m = leg, None
        if self._holds_the_ground and body.is_on_ground:
            self._stay(body)
        wanted = self._command(setpoint, leg, sticks, body)
        self.wanted_enu_mps = wanted if all(map(math.isfinite, wanted)) else (0.0, 0.0, 0.0)
        return self.wanted_enu_mps

    def _command(
        self, setpoint: Setpoint, leg: MissionLeg | None, sticks: Sticks | None, body: Kinematics
    ) -> PositionEnu:
        match self.task:
            case Task.FOLLOW:
                return self._follow(setpoint, body)
            case Task.TAKE_OFF:
                east, north, _ = self.hold_enu_m
                up_m = max(self.takeoff_up_m, self.hold_enu_m[2])
                return self._towards((east, north, up_m), body)
            case Task.LAND:
                return self._land(body)
            case Task.RETURN:
                return self._return(body)
            case Task.FLY_MISSION if leg is not None:
                if leg.kind is LegKind.LAND:
                    self.hold_enu_m = (*leg.goal_enu_m[:2], body.ground_up_m)
                    return self._land(body)
                self.hold_enu_m = leg.goal_enu_m
                return self._towards(leg.goal_enu_m, body, leg.speed_mps)
            case Task.CIRCLE:
                return self._circle(body)
            case Task.STAY | Task.FLY_MISSION:
                return self._towards(self.hold_enu_m, body, self.hold_speed_mps)
            case Task.FLY_BY_STICKS if sticks is not None:
                return self._fly_by_sticks(sticks, body)
        return (0.0, 0.0, -SINK_WITHOUT_STICKS_MPS)

    def yaw_ned_rad(
        self, setpoint: Setpoint, sticks: Sticks | None, heading_rad: float
    ) -> float | None:
        """Return the wanted heading, clockwise from north; None keeps the current one."""
        match self.task:
            case Task.FOLLOW:
                if setpoint.yaw_ned_rad is None and setpoint.yaw_rate_ned_radps is not None:
                    return wrap_pi(heading_rad + setpoint.yaw_rate_ned_radps * STEP_S)
                return setpoint.yaw_ned_rad
            case Task.STAY:
                return self.hold_yaw_ned_rad
            case Task.CIRCLE:
                return self._circle_yaw_ned_rad
            case Task.FLY_MISSION if self._leg is not None:
                return self._leg.yaw_ned_rad
            case Task.FLY_BY_STICKS if sticks is not None and sticks.yaw:
                rate_radps = sticks.yaw * self._vehicle.max_yaw_rate_radps
                return wrap_pi(heading_rad + rate_radps * STEP_S)
        return None

    def _stay(self, body: Kinematics) -> None:
        east, north, up = stopping_point(body.position_enu_m, body.velocity_enu_mps, self._vehicle)
        self.hold_enu_m = (east, north, max(up, body.ground_up_m))
        self._holds_the_ground = body.is_on_ground

    def _come_to_rest(self, body: Kinematics) -> PositionEnu:
        """Come to rest and return the position."""
        if not self._is_staying:
            self._stay(body)
            self._is_staying = True
        return self._towards(self.hold_enu_m, body)

    def _towards(
        self, goal_enu_m: PositionEnu, body: Kinematics, speed_mps: float | None = None
    ) -> PositionEnu:
        self.goal_enu_m = goal_enu_m
        east, north, up = approach_velocity(body.position_enu_m, goal_enu_m, self._vehicle)
        limits = self.limits
        limit_mps = limits.horizontal_mps if speed_mps is None else speed_mps
        speed = math.hypot(east, north)
        scale = limit_mps / speed if speed > limit_mps >= 0.0 else 1.0
        return (east * scale, north * scale, max(-limits.descent_mps, min(limits.climb_mps, up)))

    def _land(self, body: Kinematics) -> PositionEnu:
        east, north, _ = self._towards(self.hold_enu_m, body)
        if body.height_m > SLOW_DESCENT_BELOW_M:
            return (east, north, -self._vehicle.max_descent_mps)
        return (east, north, -self._vehicle.landing_speed_mps)

    def _circle(self, body: Kinematics) -> PositionEnu:
        """Fly along the circle, pulled back to its radius; the centre is where the nose pointed."""
        (east, north, _), (centre_e, centre_n) = body.position_enu_m, self._circle_centre
        angle = math.atan2(east - centre_e, north - centre_n)
        radius_m, speed_mps = self.circle_radius_m, self.circle_radius_m * self.circle_rate_radps
        position = (centre_e + radius_m * math.sin(angle), centre_n + radius_m * math.cos(angle))
        back = self._towards((*position, self.hold_enu_m[2]), body)
        along = (speed_mps * math.cos(angle), -speed_mps * math.sin(angle))
        self._circle_yaw_ned_rad = wrap_pi(angle + math.pi)
        return (back[0] + along[0], back[1] + along[1], back[2])

    def _return(self, body: Kinematics) -> PositionEnu:
        if self._cruise_up_m is None:
            if self.final_up_m is not None:
                return self._towards((*self.home_enu_m[:2], self.final_up_m), body)
            return self._land(body)
        if body.position_enu_m[2] < self._cruise_up_m - CLIMBED_M:
            east, north, _ = self.hold_enu_m
            return self._towards((east, north, self._cruise_up_m), body)
        if self._is_over_home(body):
            self.hold_enu_m = self.home_enu_m
            self._loitered_s += STEP_S
            if self._loitered_s > self.return_loiter_s:
                self._cruise_up_m = None
                return self._return(body)
        return self._towards((*self.home_enu_m[:2], self._cruise_up_m), body)

    def _is_over_home(self, body: Kinematics) -> bool:
        """Return True if it is over home, or as near as the wind lets it come."""
        distance_m = math.dist(body.position_enu_m[:2], self.home_enu_m[:2])
        slack_mps = body.drift_mps + self._vehicle.position_gain_per_s * HOME_REACHED_M
        return approach_speed_mps(distance_m, self._vehicle) <= slack_mps

    def _fly_by_sticks(self, sticks: Sticks, body: Kinematics) -> PositionEnu:
        """Return velocities by deflection; let go, it stays where it comes to rest."""
        vehicle, speed_mps = self._vehicle, self._vehicle.max_speed_mps
        if sticks.deflection <= DEAD_ZONE:
            return self._come_to_rest(body)
        self._is_staying = False
        forward_mps, right_mps = sticks.forward * speed_mps, sticks.right * speed_mps
        east, north = turned(forward_mps, right_mps, body.yaw_ned_rad)
        limit_mps = vehicle.max_climb_mps if sticks.up > 0.0 else vehicle.max_descent_mps
        return (east, north, sticks.up * limit_mps)

    def _follow(self, setpoint: Setpoint, body: Kinematics) -> PositionEnu:
        position, velocity = setpoint.position_en_m, setpoint.velocity_en_mps
        gives_nothing = (position, setpoint.up_m, velocity, setpoint.climb_mps) == (None,) * 4
        if gives_nothing and setpoint.acceleration_enu_mps2 is not None:
            self._is_staying = False
            limit = self._vehicle.max_speed_mps
            ve, vn, vu = (
                v + a * STEP_S
                for v, a in zip(self._velocity, setpoint.acceleration_enu_mps2, strict=True)
            )
            ve, vn = min(limit, max(-limit, ve)), min(limit, max(-limit, vn))
            vu = min(self._vehicle.max_climb_mps, max(-self._vehicle.max_descent_mps, vu))
            self._velocity = (ve, vn, vu)
            return self._velocity
        self._velocity = body.velocity_enu_mps
        if gives_nothing:
            return self._come_to_rest(body)
        self._is_staying = False
        east, north = position or body.position_enu_m[:2]
        up = body.position_enu_m[2] if setpoint.up_m is None else setpoint.up_m
        to_goal = self._towards((east, north, up), body)
        forward_east, forward_north = velocity or (0.0, 0.0)
        climb_mps = to_goal[2] + (setpoint.climb_mps or 0.0)
        return (to_goal[0] + forward_east, to_goal[1] + forward_north, climb_mps)
