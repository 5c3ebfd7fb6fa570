"""The simulated vehicle: motion, pilot, mode rules and setpoints, stepped together.

Time is seconds since boot. Every change of mode, arming and landing becomes an `Occurrence`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.domain import FlightMode, LandedState, PositionEnu
from companion.geometry.frames import LocalOrigin
from sim_link.autopilot.modes import ModeLogic, Situation
from sim_link.autopilot.pilot import Pilot
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.setpoints import OffboardMonitor
from sim_link.world.point_mass import PointMass

STEP_S = 0.02
"""Physics step; also the shortest interval of a stream."""


@dataclass(frozen=True, slots=True)
class Occurrence:
    """Something that an operator would want to read."""

    time_s: float
    """Since boot."""
    mode: FlightMode
    is_armed: bool
    text: str


class SimVehicle:
    """One multicopter with its autopilot, without the wire.

    Args:
        scenario: Place, limits and configuration.
        noise_rng: Generator of the reported position's noise.
    """

    def __init__(self, scenario: Scenario, noise_rng: np.random.Generator) -> None:
        self.scenario = scenario
        place = scenario.origin
        self.origin = LocalOrigin(place.latitude_deg, place.longitude_deg, place.altitude_m)
        self.home_enu_m: PositionEnu = (*scenario.start_enu_m, 0.0)
        self.home_altitude_m = place.altitude_m
        self.body = PointMass(scenario.vehicle, scenario.wind, self.home_enu_m)
        self.modes = ModeLogic(scenario.autopilot.offboard_loss_action)
        self.offboard = OffboardMonitor(scenario.autopilot.offboard_loss_timeout_s)
        self.pilot = Pilot(scenario.vehicle, self.home_enu_m, scenario.autopilot.return_altitude_m)
        self.time_s = 0.0
        self.reported_enu_m = self.home_enu_m
        """The position that telemetry shows: the true one and noise."""
        self.flight_time_s = 0.0
        self.distance_m = 0.0
        self.occurrences: list[Occurrence] = []
        """Since the list was last emptied by its reader."""
        self._noise_rng = noise_rng
        self._seen = (self.modes.mode, self.modes.is_armed)
        self._has_flown = False
        self._landed_s: float | None = None

    def situation(self, now_s: float) -> Situation:
        """What the mode rules need to know."""
        return Situation(
            is_booted=now_s >= self.scenario.autopilot.ready_after_s,
            is_stream_alive=self.offboard.is_alive(now_s),
            is_on_ground=self.body.is_on_ground,
        )

    @property
    def landed_state(self) -> LandedState:
        """EXTENDED_SYS_STATE.landed_state."""
        if self.body.is_on_ground:
            return LandedState.ON_GROUND
        match self.modes.mode:
            case FlightMode.TAKEOFF:
                return LandedState.TAKEOFF
            case FlightMode.LAND:
                return LandedState.LANDING
        return LandedState.IN_AIR

    def step(self, now_s: float) -> None:
        """Advance by one physics step, which ends at `now_s` seconds since boot."""
        self.time_s = now_s
        self.modes.watch_stream(self.situation(now_s))
        self.note_changes(now_s)
        self._move()
        is_taking_off = self.modes.is_armed and self.modes.mode is FlightMode.TAKEOFF
        if is_taking_off and self.pilot.has_taken_off(self.body):
            self.modes.finish_takeoff()
            self.note_changes(now_s, "takeoff complete")
        self._watch_landing(now_s)
        self._report_position()

    def note_changes(self, now_s: float, why: str = "") -> None:
        """Tell the pilot of a changed mode and record what changed; called after every change."""
        mode, is_armed = self.modes.mode, self.modes.is_armed
        old_mode, was_armed = self._seen
        if (mode, is_armed) == self._seen:
            return
        self._seen = (mode, is_armed)
        if is_armed != was_armed:
            self._has_flown = False
            self._landed_s = None
        self.pilot.enter(mode, self.body)
        texts = []
        if is_armed != was_armed:
            texts.append("armed" if is_armed else "disarmed")
        if mode is not old_mode:
            if self.modes.is_failsafe:
                why = "failsafe: no setpoints"
            reason = f" ({why})" if why else ""
            texts.append(f"mode {old_mode.value} -> {mode.value}{reason}")
        self.occurrences.append(Occurrence(now_s, mode, is_armed, ", ".join(texts)))

    def _move(self) -> None:
        before = self.body.position_enu_m
        mode, setpoint = self.modes.mode, self.offboard.setpoint
        command = yaw = None
        if self.modes.is_armed:
            command = self.pilot.command(mode, setpoint, self.body)
            yaw = self.pilot.yaw_ned_rad(mode, setpoint, self.body, STEP_S)
        self.body.step(command, yaw, STEP_S)
        if not self.body.is_on_ground:
            self.flight_time_s += STEP_S
        self.distance_m += math.dist(before, self.body.position_enu_m)

    def _watch_landing(self, now_s: float) -> None:
        """Note touchdowns, and disarm after one; OFFBOARD never ends by itself, as on PX4."""
        if not self.body.is_on_ground:
            if not self._has_flown and self.modes.is_armed:
                self._note(now_s, "in the air")
            self._has_flown = True
            self._landed_s = None
            return
        if not self.modes.is_armed:
            return
        is_landing = self.modes.mode in (FlightMode.LAND, FlightMode.RETURN)
        if self.modes.mode is FlightMode.OFFBOARD or not (self._has_flown or is_landing):
            self._landed_s = None
            return
        if self._landed_s is None:
            self._landed_s = now_s
            self._note(now_s, "on the ground")
        if now_s - self._landed_s >= self.scenario.autopilot.disarm_after_landing_s:
            self.modes.disarm(self.situation(now_s), is_forced=False)
            self.note_changes(now_s, "landed")

    def _note(self, now_s: float, text: str) -> None:
        self.occurrences.append(Occurrence(now_s, self.modes.mode, self.modes.is_armed, text))

    def _report_position(self) -> None:
        sigma_m = self.scenario.position_noise_m
        east, north, up = self.body.position_enu_m
        if sigma_m > 0.0:
            de, dn, du = (sigma_m * self._noise_rng.standard_normal(3)).tolist()
            east, north, up = east + de, north + dn, up + du
        self.reported_enu_m = (east, north, up)
