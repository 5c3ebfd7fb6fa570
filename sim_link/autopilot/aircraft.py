"""The multicopter without its autopilot's rules: body, estimator, battery, sticks, plans, home.

A flavour, which owns the modes and their selection, operates on it. Positions are in the
world's frame, local east-north-up from the scenario's origin; time is seconds since boot.

The battery is a four-cell pack that only flying empties. The geofence gives the signed distance to
its border. Source: MAVLink common, MAV_CMD_NAV_FENCE_* (5000 to 5004).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import FlightMode, PositionEnu
from companion.geometry.coordinates import LocalOrigin, wrap_pi
from companion.geometry.polygons import Point, depth_m
from companion.mav.dialect import mavlink
from sim_link.autopilot.control_inputs import StickInput
from sim_link.autopilot.estimator import EstimatedMotion, Estimator, Kinematics
from sim_link.autopilot.flight_controller import STEP_S, FlightController
from sim_link.autopilot.mission_executor import MissionRun
from sim_link.autopilot.protocols.plan_items import (
    AMSL_FRAMES,
    GLOBAL_FRAMES,
    RELATIVE_FRAMES,
    PlanItem,
)
from sim_link.autopilot.scenario import PROJECTION_OF, BatteryParams, Scenario
from sim_link.world.point_mass import PointMass

FULL_CELL_MV, EMPTY_CELL_MV, CELLS = 4200, 3500, 4
HOVER_CURRENT_CA = 1800
IDLE_CURRENT_CA = 50


class Battery:
    """Charge, voltage and current."""

    def __init__(self, params: BatteryParams) -> None:
        self._params = params
        self.share = params.start_share
        """Remaining charge, 0 to 1."""
        self.is_known = True
        """True if the reports contain the charge."""
        self.current_ca = IDLE_CURRENT_CA
        """Current, hundredths of an ampere."""

    def step(self, is_flying: bool, dt_s: float) -> None:
        """Draw for `dt_s` seconds."""
        self.current_ca = HOVER_CURRENT_CA if is_flying else IDLE_CURRENT_CA
        if is_flying:
            self.share = max(0.0, self.share - dt_s / self._params.endurance_s)

    def set_charge(self, share: float | None) -> None:
        """Set the charge, 0 to 1; None: unknown from now on."""
        self.is_known = share is not None
        if share is not None:
            self.share = share

    @property
    def percent(self) -> int:
        """Remaining charge, 0 to 100."""
        return max(0, round(100.0 * self.share))

    @property
    def cell_mv(self) -> int:
        """Voltage of one cell, millivolts."""
        return round(EMPTY_CELL_MV + self.percent / 100.0 * (FULL_CELL_MV - EMPTY_CELL_MV))

    @property
    def consumed_mah(self) -> int:
        """Charge drawn since a full pack."""
        capacity_mah = HOVER_CURRENT_CA / 100.0 * self._params.endurance_s / 3.6
        return round((1.0 - self.share) * capacity_mah)

    @property
    def remaining_s(self) -> int:
        """Remaining hovering time."""
        return round(self.share * self._params.endurance_s)


POLYGON_IN = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
POLYGON_OUT = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
CIRCLE_IN = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
CIRCLE_OUT = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon, or a circle if it has a radius."""

    corners_enu_m: tuple[Point, ...]
    """Corners of the polygon, or only the centre of a circle."""
    is_inclusion: bool
    radius_m: float | None = None

    def depth_m(self, position: Point) -> float:
        """Return the distance to the boundary of the area; negative outside."""
        if self.radius_m is None:
            return depth_m(self.corners_enu_m, position)
        return self.radius_m - math.dist(position, self.corners_enu_m[0])


class Geofence:
    """Inclusions and exclusions; inside any inclusion is inside, as in PX4 and ArduPilot."""

    def __init__(self, areas: Sequence[Area] = ()) -> None:
        self._inclusions = [area for area in areas if area.is_inclusion]
        self._exclusions = [area for area in areas if not area.is_inclusion]

    @property
    def is_empty(self) -> bool:
        """True if there is neither an inclusion nor an exclusion."""
        return not (self._inclusions or self._exclusions)

    def margin_m(self, position: PositionEnu) -> float:
        """Return the distance to the nearest breach, negative in one; infinite without a fence."""
        point = position[:2]
        margin = math.inf
        if self._inclusions:
            margin = max(area.depth_m(point) for area in self._inclusions)
        return min([margin, *(-area.depth_m(point) for area in self._exclusions)])


def areas_from_items(
    items: Sequence[PlanItem], enu_from_e7: Callable[[int, int], Point]
) -> list[Area]:
    """Return the areas of an uploaded, checked fence; a return point (5000) is skipped.

    `enu_from_e7` converts latitude and longitude in 1e-7 degrees.
    """
    areas: list[Area] = []
    index = 0
    while index < len(items):
        item, count = items[index], 1
        if item.command in (CIRCLE_IN, CIRCLE_OUT):
            centre = (enu_from_e7(item.x, item.y),)
            areas.append(Area(centre, item.command == CIRCLE_IN, float(item.params[0])))
        elif item.command in (POLYGON_IN, POLYGON_OUT):
            count = int(item.params[0])
            corners = tuple(enu_from_e7(v.x, v.y) for v in items[index : index + count])
            areas.append(Area(corners, item.command == POLYGON_IN))
        index += count
    return areas


MAX_TEXTS = 32
"""Maximum number of texts that wait to be sent; the oldest are dropped."""


@dataclass(frozen=True, slots=True)
class Occurrence:
    """Event for the operator."""

    time_s: float
    """Time since boot, s."""
    mode: FlightMode
    is_armed: bool
    text: str


class Aircraft:
    """One multicopter.

    `noise_rng` is for the reported position, drift and gusts; `body` is kept over a restart.
    """

    landed_until_s = -math.inf
    """Time until which the land detector reports the ground, wherever the vehicle is."""

    def __init__(
        self,
        scenario: Scenario,
        noise_rng: np.random.Generator,
        first_mission_item: int = 0,
        body: PointMass | None = None,
    ) -> None:
        self.scenario = scenario
        zero = scenario.origin
        projection = PROJECTION_OF[scenario.autopilot.flavour]
        origin = LocalOrigin(zero.latitude_deg, zero.longitude_deg, zero.altitude_m, projection)
        start: PositionEnu = (*scenario.start_enu_m, 0.0)
        self.body = PointMass(scenario.vehicle, scenario.wind, start) if body is None else body
        """The true motion."""
        noise_m, navigation = scenario.position_noise_m, scenario.navigation
        self.estimator = Estimator(origin, scenario.gps, noise_m, noise_rng, navigation)
        self.estimator.step(0.0, self.body.position_enu_m, 0.0)
        error = self.estimator.error
        self.motion: Kinematics = self.body if error is None else EstimatedMotion(self.body, error)
        """Motion used for control: the estimated one if there is a navigation error."""
        east, north, _ = self.motion.position_enu_m
        self.home_enu_m: PositionEnu = (east, north, self.motion.ground_up_m)
        """Launch-and-return point, as estimated."""
        self.is_home_given = False
        """True if a station set home: then arming does not move it."""
        self.home_set_s = STEP_S
        """Time of the last change of home, in s since boot."""
        self.home_changes = 1
        self.origin_changes = 1
        self.battery = Battery(scenario.battery)
        self.sticks = StickInput(scenario.rc)
        self.controller = FlightController(scenario.vehicle, self.home_enu_m)
        self.mission = MissionRun(self._locate, first_mission_item)
        corners = scenario.fence.corners_enu_m
        self.plan_ids = (0, 0, 0)
        """Ids of mission, fence and rally points, as the autopilot reports them."""
        self.fence = Geofence([Area(corners, scenario.fence.is_inclusion)] if corners else [])
        self.is_armed = False
        self.time_s = 0.0
        self.flight_time_s = 0.0
        self.distance_m = 0.0
        self.has_flown = False
        self.stations_s: dict[int, float] = {}
        """Time of the latest HEARTBEAT of each ground station, by system id."""
        self.texts: list[tuple[int, str]] = []
        """MAV_SEVERITY and text, to be sent as STATUSTEXT."""
        self._gust_rng = noise_rng if scenario.wind.gust_sigma_mps > 0.0 else None

    @property
    def heading_ned_rad(self) -> float:
        """Estimated heading, clockwise from north."""
        return wrap_pi(self.body.yaw_ned_rad + self.estimator.yaw_bias_rad)

    @property
    def home_altitude_m(self) -> float:
        """Home above mean sea level, on the flat ground's scale."""
        return self.estimator.world_origin.altitude_m + self.home_enu_m[2]

    def notify(self, severity: int, text: str) -> None:
        """Queue a text for the operators."""
        self.texts = [*self.texts[-MAX_TEXTS:], (severity, text)]

    def move(self, command_enu_mps: PositionEnu | None, yaw_ned_rad: float | None) -> None:
        """Move for a step; without a command motors stand, without a yaw the heading stays."""
        before = self.body.position_enu_m
        if self._gust_rng is not None:
            east, north = self._gust_rng.standard_normal(2).tolist()
            self.body.blow((east, north), STEP_S)
        if yaw_ned_rad is not None:
            yaw_ned_rad -= self.estimator.yaw_bias_rad
        self.body.step(command_enu_mps, yaw_ned_rad, STEP_S)
        is_flying = not self.body.is_on_ground
        if is_flying:
            self.flight_time_s += STEP_S
            self.distance_m += math.dist(before, self.body.position_enu_m)
        self.battery.step(is_flying, STEP_S)
        self.estimator.step(self.time_s, self.body.position_enu_m, STEP_S)

    def set_home(self, position_enu_m: PositionEnu, *, is_given: bool) -> None:
        """Move home; `is_given` if requested by a station."""
        self.home_enu_m = self.controller.home_enu_m = position_enu_m
        self.is_home_given = is_given
        self.home_set_s = self.time_s
        self.home_changes += 1

    def set_origin(self, latitude_e7: int, longitude_e7: int, altitude_mm: int) -> None:
        """Move the zero of the local frame."""
        position = (latitude_e7 / 1e7, longitude_e7 / 1e7, altitude_mm / 1e3)
        self.estimator.set_origin(LocalOrigin(*position, self.estimator.world_origin.projection))
        self.origin_changes += 1

    def shift_origin(self, offset_enu_m: PositionEnu) -> None:
        """Move the zero of the local frame."""
        self.estimator.shift_origin(offset_enu_m)
        self.origin_changes += 1

    def up_from(self, altitude_m: float, frame: int) -> float | None:
        """Return the world height of an altitude in a MAV_FRAME; None if the frame is not ours."""
        if frame in AMSL_FRAMES:
            return altitude_m - self.estimator.world_origin.altitude_m
        if frame in RELATIVE_FRAMES:
            return altitude_m + self.home_enu_m[2]
        return None

    def position_from(
        self, latitude_e7: int, longitude_e7: int, altitude_m: float, frame: int
    ) -> PositionEnu | None:
        """Convert a geodetic target to local ENU; None if its frame is not supported."""
        up_m = self.up_from(altitude_m, frame)
        if up_m is None:
            return None
        amsl_m = self.estimator.world_origin.altitude_m + up_m
        position = (latitude_e7 / 1e7, longitude_e7 / 1e7, amsl_m)
        return (*self.estimator.world_from_geodetic(*position)[:2], up_m)

    def load_fence(self, items: Sequence[PlanItem]) -> None:
        """Take over an uploaded fence, which was checked before it was stored."""
        origin = self.estimator.world_origin

        def enu_from_e7(lat_e7: int, lon_e7: int) -> Point:
            """Return the local east and north, m, of a position in 1e-7 degrees."""
            return origin.enu_from_geodetic(lat_e7 / 1e7, lon_e7 / 1e7, origin.altitude_m)[:2]

        self.fence = Geofence(areas_from_items(items, enu_from_e7))

    def _locate(self, item: PlanItem) -> PositionEnu:
        frame = item.frame if item.frame in GLOBAL_FRAMES else 3
        position = self.position_from(item.x, item.y, item.z, frame)
        assert position is not None
        return position
