"""The simulated vehicle: an aircraft and the autopilot that flies it, without the wire."""

from __future__ import annotations

import numpy as np

from companion.domain import LandedState, PositionEnu
from companion.geometry.frames import LocalOrigin
from sim_link.autopilot.aircraft import Aircraft, Occurrence
from sim_link.autopilot.battery import Battery
from sim_link.autopilot.estimator import Estimator
from sim_link.autopilot.flavours.base import Flavour
from sim_link.autopilot.flavours.registry import make_flavour
from sim_link.autopilot.geodetic import GeodeticReports
from sim_link.autopilot.pilot import STEP_S, Pilot
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.setpoints import SetpointMonitor
from sim_link.autopilot.sticks import StickInput
from sim_link.world.point_mass import PointMass

__all__ = ["STEP_S", "Occurrence", "SimVehicle"]


class SimVehicle:
    """One multicopter with its autopilot.

    Args:
        scenario: Place, limits and configuration.
        noise_rng: Generator of the reported position's noise.
        body: What restarts where it is; None: a new one, at the scenario's start.

    Raises:
        ConfigError: The scenario sets a parameter that does not exist, or to what may not be.
    """

    def __init__(
        self, scenario: Scenario, noise_rng: np.random.Generator, body: PointMass | None = None
    ) -> None:
        self.scenario = scenario
        self.system_id = scenario.system_id
        self.flavour: Flavour = make_flavour(scenario, noise_rng, body)
        self.aircraft: Aircraft = self.flavour.aircraft
        self._reports = GeodeticReports(self.aircraft.estimator.world_origin)
        self._geodetic_at_s = -1.0
        self._geodetic = (0.0, 0.0, 0.0)
        self._home_seen = 0
        self._home_e7 = (0, 0, 0)

    def step(self, now_s: float) -> None:
        """Advance by one physics step, which ends at `now_s` seconds since boot."""
        self.flavour.step(now_s)

    @property
    def time_s(self) -> float:
        """Seconds since boot."""
        return self.aircraft.time_s

    @property
    def modes(self) -> Flavour:
        """Mode, arming and failsafe."""
        return self.flavour

    @property
    def is_armed(self) -> bool:
        """Whether the motors may turn."""
        return self.aircraft.is_armed

    @property
    def offboard(self) -> SetpointMonitor:
        """The streamed setpoints."""
        return self.flavour.setpoints

    @property
    def occurrences(self) -> list[Occurrence]:
        """Since the list was last emptied by its reader."""
        return self.flavour.occurrences

    @property
    def body(self) -> PointMass:
        """The true motion."""
        return self.aircraft.body

    @property
    def heading_ned_rad(self) -> float:
        """Where its nose points as it believes, clockwise from north."""
        return self.aircraft.heading_ned_rad

    @property
    def estimator(self) -> Estimator:
        """What the autopilot believes about its position."""
        return self.aircraft.estimator

    @property
    def battery(self) -> Battery:
        """The pack."""
        return self.aircraft.battery

    @property
    def sticks(self) -> StickInput:
        """Who holds them."""
        return self.aircraft.sticks

    @property
    def pilot(self) -> Pilot:
        """Flies the tasks."""
        return self.aircraft.pilot

    @property
    def origin(self) -> LocalOrigin:
        """The EKF origin: zero of the local frame."""
        return self.aircraft.estimator.origin

    @property
    def home_enu_m(self) -> PositionEnu:
        """Launch-and-return point, in the world's frame."""
        return self.aircraft.home_enu_m

    @property
    def home_altitude_m(self) -> float:
        """Home above mean sea level."""
        return self.aircraft.home_altitude_m

    @property
    def has_home(self) -> bool:
        """Whether origin and home are known yet."""
        return self.flavour.has_home(self.time_s)

    @property
    def has_position(self) -> bool:
        """Whether the position is told."""
        return self.flavour.has_position(self.time_s)

    @property
    def landed_state(self) -> LandedState:
        """EXTENDED_SYS_STATE.landed_state."""
        return self.flavour.landed_state

    @property
    def flight_time_s(self) -> float:
        """In the air so far."""
        return self.aircraft.flight_time_s

    @property
    def distance_m(self) -> float:
        """Flown so far."""
        return self.aircraft.distance_m

    @property
    def goal_enu_m(self) -> PositionEnu:
        """Where it goes."""
        return self.pilot.goal_enu_m or self.pilot.hold_enu_m

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Reported latitude and longitude in degrees and altitude in metres, once per step."""
        if self._geodetic_at_s != self.time_s:
            self._geodetic = self._reports.geodetic_from_enu(self.estimator.reported_enu_m)
            self._geodetic_at_s = self.time_s
        return self._geodetic

    @property
    def home_e7(self) -> tuple[int, int, int]:
        """Home in 1e-7 degrees and millimetres."""
        if self._home_seen != self.aircraft.home_changes:
            self._home_seen = self.aircraft.home_changes
            lat, lon, alt = self.estimator.world_origin.geodetic_from_enu(self.home_enu_m)
            self._home_e7 = (round(lat * 1e7), round(lon * 1e7), round(alt * 1e3))
        return self._home_e7
