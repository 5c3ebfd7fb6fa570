"""Incidents of a simulated vehicle: pilot, GNSS, weather, power, and another ground station.

A scenario lists incidents with their times, a fault schedule holds them among other faults, and
`SimEndpoint.apply_incident` applies one at once. In YAML `kind` names the record: `{kind: gps_loss,
start_s: 30, duration_s: 10}`. An event (a reboot, a mode switch) occurs at its start, and its
duration is ignored.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, Union

import msgspec

from companion.domain import FlightMode, NonNegative, Params, PositionEnu, Positive
from sim_link.world.environment import Coordinate
from sim_link.world.point_mass import Share, WindSpeed

Deflection = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
ClockPace = Annotated[float, msgspec.Meta(ge=0.5, le=2.0)]
ClockStep = Annotated[float, msgspec.Meta(ge=-3600.0, le=3600.0)]
StallLength = Annotated[float, msgspec.Meta(gt=0.0, le=600.0)]
ComponentName = Literal[
    "gimbal", "camera", "adsb", "router", "station", "mavros", "companion", "tracker", "autopilot"
]
VehicleTypeName = Literal[
    "quadrotor",
    "hexarotor",
    "octorotor",
    "tricopter",
    "dodecarotor",
    "decarotor",
    "coaxial",
    "helicopter",
    "plane",
    "quadplane",
    "tiltrotor",
    "tailsitter",
    "rover",
    "boat",
    "sub",
    "tracker",
    "generic",
]
EstimatorVote = Literal["all", "velocity", "position", "height", "compass"]
Angle = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]


class FaultRecord(Params, frozen=True, tag_field="kind"):
    """Fault with its start and duration; without a duration it lasts until the flight is over."""

    start_s: NonNegative = 0.0
    """Seconds since the simulator, or the schedule, began; a reboot does not restart them."""
    duration_s: Annotated[float, msgspec.Meta(gt=0.0)] = math.inf

    @property
    def end_s(self) -> float:
        """Time at which it ends, s."""
        return self.start_s + self.duration_s

    def is_active(self, time_s: float) -> bool:
        """Return True if it acts at a time since the schedule began."""
        return self.start_s <= time_s < self.end_s


def kinds_of(base: type[FaultRecord]) -> tuple[type[FaultRecord], ...]:
    """Return the faults with a name in a file that are a kind of `base`, as they are defined."""
    own = () if base.__struct_config__.tag == base.__name__ else (base,)
    return own + tuple(kind for each in base.__subclasses__() for kind in kinds_of(each))


class VehicleFault(FaultRecord, frozen=True):
    """Fault of the vehicle, its autopilot, its pilot or the weather."""


class IncidentRecord(VehicleFault, frozen=True):
    """Fault that the simulated vehicle causes itself."""


class PilotMode(IncidentRecord, frozen=True, tag="pilot_mode"):
    """The pilot moves the mode switch, and the autopilot may refuse the mode; event."""

    mode: FlightMode = FlightMode.HOLD


class Failsafe(PilotMode, frozen=True, tag="failsafe"):
    """The mode changes as by a failsafe that the autopilot does not report; event."""

    mode: FlightMode = FlightMode.RETURN


class PilotSticks(IncidentRecord, frozen=True, tag="pilot_sticks"):
    """The pilot moves the sticks; the transmitter is still received."""

    forward: Deflection = 0.5
    right: Deflection = 0.0
    up: Deflection = 0.0
    yaw: Deflection = 0.0
    """Deflection of yaw, clockwise positive."""


class RcLoss(IncidentRecord, frozen=True, tag="rc_loss"):
    """The transmitter is not received, and the autopilot reports that."""

    pulses: tuple[Deflection, Deflection, Deflection, Deflection] | None = None
    """Failsafe position that the receiver outputs: roll, pitch, throttle, yaw; None: no pulses."""


class GpsLoss(IncidentRecord, frozen=True, tag="gps_loss"):
    """No satellite is received; the estimate then drifts, and becomes invalid."""

    receiver: Literal["all", "first", "second"] = "all"
    """Affected receivers of those in `gps.receivers`."""


class EkfPoor(IncidentRecord, frozen=True, tag="ekf_poor"):
    """The estimator reports contradicting measurements, but the position as before."""

    ratio: Positive = 1.5
    """PX4's innovation test ratios, ArduPilot's variances; both doubt from 0.8 or 1 on."""
    of: EstimatorVote = "all"
    """Measurement that contradicts the estimate."""


class FalseLanding(IncidentRecord, frozen=True, tag="false_landing"):
    """The land detector reports the ground while the vehicle flies."""


class EkfJump(IncidentRecord, frozen=True, tag="ekf_jump"):
    """A reset of the estimator by this offset, which stays; event."""

    east_m: Coordinate = 7.0
    north_m: Coordinate = 0.0
    up_m: Coordinate = 0.0
    yaw_deg: Angle = 0.0
    """Step of the heading, clockwise positive."""


class OriginShift(IncidentRecord, frozen=True, tag="origin_shift"):
    """The zero of the local frame moves, the vehicle stays where it is; event."""

    east_m: Coordinate = 10.0
    north_m: Coordinate = 0.0
    up_m: Coordinate = 0.0


class BatteryCharge(IncidentRecord, frozen=True, tag="battery"):
    """The charge changes at once; event."""

    share: Share | None = 0.14
    """Charge, 0 to 1; None: unknown from now on, and reported so."""


class WindChange(IncidentRecord, frozen=True, tag="wind"):
    """Change of the wind, by the direction to which it blows; then the scenario's wind again."""

    east_mps: WindSpeed = 12.0
    north_mps: WindSpeed = 0.0


class VehicleReboot(IncidentRecord, frozen=True, tag="vehicle_reboot"):
    """The autopilot restarts: motors off, nothing received or sent, its clock at zero."""

    down_s: NonNegative = 1.0


class ClockRate(IncidentRecord, frozen=True, tag="clock_rate"):
    """Rate of the vehicle's clock, as on a computer that does not keep up; then 1 again."""

    rate: ClockPace = 0.988
    """Seconds of its clock a second; PX4's own simulator was 1.2 % slow."""


class ClockSlip(IncidentRecord, frozen=True, tag="clock_slip"):
    """Jump of the vehicle's clock; event."""

    step_s: ClockStep = -0.7
    """Step of the clock, ahead positive."""


class AutopilotStall(IncidentRecord, frozen=True, tag="autopilot_stall"):
    """Stall of the autopilot's computer: its clock stops, and input is read afterwards."""

    duration_s: StallLength = 1.2


class StationRecord(IncidentRecord, frozen=True):
    """Action of another ground station on the autopilot; event."""

    shares_line: bool = False
    """True if the companion also receives the answers to the station, as on a shared radio."""


class StationFence(StationRecord, frozen=True, tag="station_fence"):
    """Upload of another fence, a square or a circle, or its removal; event."""

    half_side_m: Positive | None = 30.0
    """Half the side of the square, or the radius; None: the fence is cleared."""
    east_m: Coordinate = 0.0
    north_m: Coordinate = 0.0
    is_circle: bool = False
    is_inclusion: bool = True


class StationParameter(StationRecord, frozen=True, tag="station_parameter"):
    """Change of a parameter by the station; event."""

    name: str = "FENCE_RADIUS"
    value: float = 30.0


class StationRates(StationRecord, frozen=True, tag="station_rates"):
    """Change of the rate of a message on every link, the companion's too; event."""

    message: str = "LOCAL_POSITION_NED"
    rate_hz: NonNegative = 1.0
    """New rate; 0: off."""


class StationHome(StationRecord, frozen=True, tag="station_home"):
    """Move of home by the station, in the world's frame; event."""

    east_m: Coordinate = 20.0
    north_m: Coordinate = 0.0
    up_m: Coordinate = 0.0


class OtherComponent(IncidentRecord, frozen=True, tag="component"):
    """Another component is heard on the vehicle's links: a gimbal, a router, MAVROS, and so on."""

    component: ComponentName = "gimbal"


class OtherVehicle(FaultRecord, frozen=True, tag="other_vehicle"):
    """Another vehicle in the air is heard on the link, with its own clock and companion."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 2
    """System id of the other vehicle; the same as ours if both have their factory setting."""
    has_own_address: bool = True
    """True if it has an address of its own; otherwise a router brings both by ours."""
    vehicle_type: VehicleTypeName = "quadrotor"
    flavour: Literal["same", "px4", "ardupilot"] = "same"
    uptime_s: NonNegative = 500.0
    """Time since its boot when it is first heard."""
    east_m: Coordinate = 60.0
    north_m: Coordinate = -40.0
    up_m: Positive = 15.0
    is_offboard: bool = True
    """True in the mode that obeys setpoints."""

    @property
    def position_enu_m(self) -> PositionEnu:
        """Position in the world's frame."""
        return (self.east_m, self.north_m, self.up_m)


if TYPE_CHECKING:
    Incident: TypeAlias = IncidentRecord
else:
    Incident = Union[kinds_of(IncidentRecord)]  # noqa: UP007  not written out

KEYS_OF_0_1 = {"time_s": "start_s", "for_s": "duration_s"}
KINDS_OF_0_1 = {"reboot": "vehicle_reboot"}
NAVIGATION_KEYS_OF_RC1 = {"tells_accuracy": "reports_accuracy", "told_ratio": "reported_ratio"}


def renew_scenario(scenario: dict[str, Any]) -> None:
    """Rename incidents of version 0.1 and keys of 1.0.0rc1 to their current names, in place."""
    navigation = scenario.get("navigation")
    if isinstance(navigation, dict):
        for old, present in NAVIGATION_KEYS_OF_RC1.items():
            if old in navigation and present not in navigation:
                navigation[present] = navigation.pop(old)
    incidents = scenario.get("incidents")
    for incident in incidents if isinstance(incidents, list) else ():
        if not isinstance(incident, dict):
            continue
        for old, present in KEYS_OF_0_1.items():
            if old in incident and present not in incident:
                incident[present] = incident.pop(old)
        kind = incident.get("kind")
        if isinstance(kind, str):
            incident["kind"] = KINDS_OF_0_1.get(kind, kind)
