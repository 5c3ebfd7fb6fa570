"""The simulated vehicle: an aircraft and the autopilot that flies it, without the wire.

The module also creates the flavour that a scenario names, applies incidents, and records the true
track and the mode changes for the flight report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from companion.domain import FlightMode, PositionEnu
from companion.geometry.coordinates import LocalOrigin
from sim_link.autopilot.aircraft import Aircraft, Occurrence
from sim_link.autopilot.ardupilot import commands as ardupilot_commands
from sim_link.autopilot.ardupilot.firmware_profile import ardupilot_parameters
from sim_link.autopilot.ardupilot.flavour import ArduPilotFlavour
from sim_link.autopilot.control_inputs import StickInput, Sticks, sticks_at
from sim_link.autopilot.estimator import Estimator
from sim_link.autopilot.flavour import AutopilotFlavour, Handler
from sim_link.autopilot.flight_controller import STEP_S
from sim_link.autopilot.incidents import (
    BatteryCharge,
    ClockRate,
    ClockSlip,
    EkfJump,
    EkfPoor,
    FalseLanding,
    GpsLoss,
    Incident,
    IncidentRecord,
    OriginShift,
    PilotMode,
    PilotSticks,
    RcLoss,
    WindChange,
)
from sim_link.autopilot.protocols.command_protocol import StampClock
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.autopilot.px4 import commands as px4_commands
from sim_link.autopilot.px4.firmware_profile import px4_parameters
from sim_link.autopilot.px4.flavour import Px4Flavour
from sim_link.autopilot.scenario import FlavourName, Scenario
from sim_link.world.point_mass import PointMass


class FlavourParts(NamedTuple):
    """Parts that make an autopilot of one flavour."""

    kind: type[AutopilotFlavour]
    parameters: Callable[[Scenario], ParameterStore]
    handlers: Mapping[int, Handler]


FLAVOURS: dict[FlavourName, FlavourParts] = {
    "px4": FlavourParts(Px4Flavour, px4_parameters, px4_commands.HANDLERS),
    "ardupilot": FlavourParts(ArduPilotFlavour, ardupilot_parameters, ardupilot_commands.HANDLERS),
}


class SimVehicle:
    """One multicopter with its autopilot, as `Aircraft`; `ConfigError`: a parameter is wrong."""

    def __init__(
        self, scenario: Scenario, noise_rng: np.random.Generator, body: PointMass | None = None
    ) -> None:
        self.scenario = scenario
        self.system_id = scenario.system_id
        parts = FLAVOURS[scenario.autopilot.flavour]
        first = parts.kind.firmware.first_mission_item
        self.aircraft = Aircraft(scenario, noise_rng, first, body)
        self.flavour: AutopilotFlavour = parts.kind(self.aircraft, parts.parameters(scenario))
        self.flavour.handlers = parts.handlers
        self.body = self.aircraft.body
        self.estimator = self.aircraft.estimator
        self.battery = self.aircraft.battery
        self.sticks = self.aircraft.sticks
        self.setpoints = self.flavour.setpoints
        self.clock = StampClock()

    @property
    def time_s(self) -> float:
        """Seconds since boot."""
        return self.aircraft.time_s

    @property
    def stamp_s(self) -> float:
        """Seconds since boot by its own clock."""
        return self.clock.read_s(self.aircraft.time_s)

    @property
    def is_armed(self) -> bool:
        """True if the motors may turn."""
        return self.aircraft.is_armed

    @property
    def origin(self) -> LocalOrigin:
        """The EKF origin: zero of the local frame."""
        return self.aircraft.estimator.origin

    @property
    def home_enu_m(self) -> PositionEnu:
        """Launch-and-return point, in the world's frame."""
        return self.aircraft.home_enu_m

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Reported latitude and longitude in degrees and altitude in metres."""
        return self.estimator.world_origin.geodetic_from_enu(self.estimator.reported_enu_m)

    @property
    def home_e7(self) -> tuple[int, int, int]:
        """Home in 1e-7 degrees and millimetres."""
        lat, lon, alt = self.estimator.world_origin.geodetic_from_enu(self.home_enu_m)
        return (round(lat * 1e7), round(lon * 1e7), round(alt * 1e3))


class IncidentSchedule:
    """Schedule of the remaining incidents."""

    def __init__(self, incidents: Iterable[Incident]) -> None:
        self._coming = sorted(incidents, key=lambda incident: incident.start_s, reverse=True)

    def add(self, incident: Incident) -> None:
        """Add an incident."""
        self._coming.append(incident)
        self._coming.sort(key=lambda each: each.start_s, reverse=True)

    def take_due(self, now_s: float) -> list[Incident]:
        """Return the incidents that are due `now_s` seconds after the simulator began."""
        due = []
        while self._coming and self._coming[-1].start_s <= now_s + 0.5 * STEP_S:
            due.append(self._coming.pop())
        return due


def apply_to_vehicle(incident: IncidentRecord, vehicle: SimVehicle, now_s: float) -> None:
    """Apply an incident to a vehicle now; reboot and stall are its endpoint's business."""
    aircraft = vehicle.aircraft
    match incident:
        case PilotMode():
            vehicle.flavour.pilot_chooses(incident.mode, now_s)
        case PilotSticks() | RcLoss():
            _apply_to_sticks(incident, aircraft.sticks, now_s)
        case FalseLanding():
            aircraft.landed_until_s = now_s + incident.duration_s
        case GpsLoss() | EkfPoor() | EkfJump():
            _apply_to_estimator(incident, aircraft.estimator, now_s)
        case ClockRate():
            vehicle.clock.run(incident.rate, now_s, now_s + incident.duration_s)
        case ClockSlip():
            vehicle.clock.slip(incident.step_s, now_s)
        case OriginShift():
            aircraft.shift_origin((incident.east_m, incident.north_m, incident.up_m))
        case BatteryCharge():
            aircraft.battery.set_charge(incident.share)
        case WindChange():
            wind = msgspec.structs.replace(
                aircraft.body.wind, east_mps=incident.east_mps, north_mps=incident.north_mps
            )
            aircraft.body.set_wind(wind)
    vehicle.flavour.note(now_s, f"incident: {incident.__struct_config__.tag}")


def _apply_to_sticks(incident: PilotSticks | RcLoss, input_: StickInput, now_s: float) -> None:
    until_s = now_s + incident.duration_s
    if isinstance(incident, RcLoss):
        input_.lose(until_s, None if incident.pulses is None else sticks_at(incident.pulses))
        return
    input_.move(Sticks(incident.forward, incident.right, incident.up, incident.yaw), until_s)


def _apply_to_estimator(
    incident: GpsLoss | EkfPoor | EkfJump, estimator: Estimator, now_s: float
) -> None:
    match incident:
        case GpsLoss():
            receiver = {"all": None, "first": 0, "second": 1}[incident.receiver]
            estimator.lose_fix(now_s + incident.duration_s, receiver)
        case EkfPoor():
            estimator.degrade(incident.ratio, now_s + incident.duration_s, incident.of)
        case EkfJump():
            offset = (incident.east_m, incident.north_m, incident.up_m)
            estimator.jump(offset, math.radians(incident.yaw_deg))


TRACK_PERIOD_S = 0.5
MAX_OCCURRENCES = 10_000
"""Maximum number of occurrences that are kept: a report of a flight that flaps for days stays
readable, and the memory bounded."""
MAX_TRACK_POINTS = 7_200
"""Maximum number of points of the track, an hour at first; beyond it every other point is dropped,
and half as many follow."""


class FlightRecorder:
    """Collects while the vehicle is stepped."""

    def __init__(self) -> None:
        self.track: list[tuple[float, float, float, float]] = []
        """Seconds since boot and true east, north and up, metres, of the whole flight."""
        self.mode_changes: list[Occurrence] = []
        self._mode = FlightMode.HOLD
        self._track_due_s = 0.0
        self._period_s = TRACK_PERIOD_S
        self._fresh: list[Occurrence] = []

    def take(self, vehicle: SimVehicle) -> None:
        """Add the events up to the vehicle's current step."""
        if vehicle.time_s + 0.5 * STEP_S >= self._track_due_s:
            self.track.append((vehicle.time_s, *vehicle.body.position_enu_m))
            if len(self.track) > MAX_TRACK_POINTS:
                self.track = self.track[::2]
                self._period_s *= 2.0
            self._track_due_s = max(self._track_due_s, vehicle.time_s) + self._period_s
        for occurrence in vehicle.flavour.occurrences:
            self._fresh = [*self._fresh[-MAX_OCCURRENCES:], occurrence]
            if occurrence.mode is not self._mode and len(self.mode_changes) < MAX_OCCURRENCES:
                self.mode_changes.append(occurrence)
            self._mode = occurrence.mode
        vehicle.flavour.occurrences.clear()

    def take_occurrences(self) -> list[Occurrence]:
        """Return the occurrences since the last call."""
        fresh, self._fresh = self._fresh, []
        return fresh
