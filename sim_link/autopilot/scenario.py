"""Scenario: all parameters of one simulated flight.

The defaults are the canonical scenario. `sim_link.fleet` reads it from YAML.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.domain import Autopilot, NonNegative, Params, Positive
from companion.geometry.coordinates import Projection
from companion.geometry.polygons import check_polygon
from sim_link.autopilot.estimator import GpsParams, NavigationParams
from sim_link.autopilot.incidents import Incident, OtherVehicle, VehicleTypeName
from sim_link.autopilot.protocols.addressing import LinkMode
from sim_link.world.environment import (
    Coordinate,
    EmitterParams,
    Environment,
    FieldChannelParams,
    ObstacleParams,
    ShadowParams,
)
from sim_link.world.field_radio import Measures
from sim_link.world.point_mass import MulticopterParams, Share, WindParams
from sim_link.world.radio_channel import AntennaModelParams

Latitude = Annotated[float, msgspec.Meta(ge=-89.0, le=89.0)]
Longitude = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
SystemId = Annotated[int, msgspec.Meta(ge=1, le=255)]
PayloadRate = Annotated[float, msgspec.Meta(gt=0.0, le=50.0)]
SeaLevelAltitude = Annotated[float, msgspec.Meta(ge=-500.0, le=9000.0)]
FlightAltitude = Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)]
LossAction = Literal["hold", "position", "return", "land", "disarm"]
FlavourName = Literal["px4", "ardupilot"]
PROJECTION_OF: dict[FlavourName, Projection] = {
    "px4": Autopilot.PX4.projection,
    "ardupilot": Autopilot.ARDUPILOT.projection,
}

MIN_FENCE_M2 = 1.0
VehicleCount = Annotated[int, msgspec.Meta(ge=1, le=250)]


class OriginParams(Params, frozen=True):
    """The zero of the local frame: the autopilot's EKF origin, at the area's corner."""

    latitude_deg: Latitude = 47.397742
    longitude_deg: Longitude = 8.545594
    altitude_m: SeaLevelAltitude = 488.0
    """Altitude of the origin above mean sea level; the ground is flat there."""


class AutopilotParams(Params, frozen=True):
    """Simulated autopilot; clients may change values that are defaults of its parameters."""

    flavour: FlavourName = "px4"
    vehicle_type: VehicleTypeName = "quadrotor"
    """Reported vehicle class, with the modes of that class; it moves as a multicopter."""
    uid: Annotated[int, msgspec.Meta(ge=0, le=2**53)] | None = None
    """Hardware id that AUTOPILOT_VERSION reports; null: the system id; 0: none."""
    offers_offboard: bool = False
    """True if a script of an ArduCopter registered mode 30, OFFBOARD, which flies as GUIDED does,
    and the vehicle answers AVAILABLE_MODES, as ArduCopter 4.7 does."""
    ready_after_s: NonNegative = 2.0
    """Seconds after boot until it can be armed."""
    offboard_loss_timeout_s: Annotated[float, msgspec.Meta(gt=0.0, le=60.0)] = 1.0
    """Age of the last valid setpoint that ends OFFBOARD (PX4 COM_OF_LOSS_T)."""
    offboard_loss_action: LossAction = "position"
    """Reaction to lost setpoints (PX4 COM_OBL_RC_ACT)."""
    takeoff_altitude_m: FlightAltitude = 2.5
    """Takeoff altitude above home, when the command names none (PX4 MIS_TAKEOFF_ALT)."""
    return_altitude_m: FlightAltitude = 30.0
    """Altitude of RETURN above home (PX4 RTL_RETURN_ALT)."""
    disarm_after_landing_s: NonNegative = 2.0
    """Delay of disarming (COM_DISARM_LAND); ArduPilot does it 1 s after LAND and RTL."""
    streams: Literal["all", "asked"] = "all"
    """Streams that PX4 sends unasked: its onboard link's, or HEARTBEAT (mode Custom)."""
    parameters: dict[str, float] = msgspec.field(default_factory=dict)
    """Defaults of the autopilot's parameters that differ from its own, by name."""

    @property
    def link_mode(self) -> LinkMode:
        """Mode of links for which no other is configured."""
        return "asked" if self.streams == "asked" else "onboard"


class BatteryParams(Params, frozen=True):
    """The pack: only flying empties it."""

    endurance_s: Positive = 1200.0
    """Hovering time from full to empty."""
    start_share: Share = 1.0


class RcParams(Params, frozen=True):
    """The remote control."""

    is_present: bool = False
    """True if a transmitter is switched on; its sticks rest in the middle."""


class FenceParams(Params, frozen=True):
    """A geofence that is loaded at boot, local metres from the origin; a client may replace it."""

    corners_enu_m: tuple[tuple[Coordinate, Coordinate], ...] = ()
    """A simple polygon, not closed; empty: no fence."""
    is_inclusion: bool = True
    """True if the vehicle must stay inside, otherwise outside."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for a polygon that encloses nothing or crosses itself."""
        if self.corners_enu_m:
            check_polygon("fence", self.corners_enu_m, MIN_FENCE_M2)


class PayloadParams(Params, frozen=True):
    """The radio payload that measures the emitter."""

    rate_hz: PayloadRate = 10.0
    max_range_m: Positive = 500.0
    """True distance beyond which it hears nothing."""
    min_altitude_m: NonNegative = 3.0
    """Height above ground below which it hears nothing."""
    measures: Measures = "both"
    """Range and bearing, or one of them."""
    lag_s: Annotated[float, msgspec.Meta(ge=0.0, le=5.0)] = 0.0
    """Delay between a measurement and its stamp, in whole steps."""
    antenna: AntennaModelParams = AntennaModelParams()
    """Antenna that measures directions."""


class Scenario(Params, frozen=True):
    """One flight: location, vehicle, emitter, channel, obstacles and limits."""

    name: str = "canonical"
    system_id: SystemId = 1
    time_limit_s: Positive = 240.0
    """Time limit for the judgement of the flight; the simulator itself flies on."""
    origin: OriginParams = OriginParams()
    area_m: tuple[Positive, Positive] = (100.0, 100.0)
    """East and north extent of the search area from the origin; information only."""
    start_enu_m: tuple[Coordinate, Coordinate] = (10.0, 10.0)
    """Position of the vehicle at the start: its home."""
    emitter: EmitterParams = EmitterParams()
    channel: FieldChannelParams = FieldChannelParams()
    obstacles: tuple[ObstacleParams, ...] = ()
    """Obstacles to the line of sight; the vehicle does not collide with them."""
    shadow: ShadowParams = ShadowParams()
    """Effects on a path that an obstacle blocks."""
    payload: PayloadParams = PayloadParams()
    autopilot: AutopilotParams = AutopilotParams()
    vehicle: MulticopterParams = MulticopterParams()
    wind: WindParams = WindParams()
    battery: BatteryParams = BatteryParams()
    rc: RcParams = RcParams()
    gps: GpsParams = GpsParams()
    navigation: NavigationParams = NavigationParams()
    """Errors of the estimated position and heading, and their reported accuracy."""
    fence: FenceParams = FenceParams()
    emitters: tuple[EmitterParams, ...] = ()
    incidents: tuple[Incident, ...] = ()
    """Incidents with their times, in any order."""
    other_vehicles: tuple[OtherVehicle, ...] = ()
    """Other vehicles in the air with their own companions, heard besides this one."""
    vehicles: VehicleCount = 1
    """Number of these vehicles in one process."""
    position_noise_m: NonNegative = 0.0
    """Standard deviation per axis of the position that the autopilot reports."""

    @property
    def environment(self) -> Environment | None:
        """The obstacles as the channel takes them; None if there are none."""
        return Environment(self.obstacles, self.shadow) if self.obstacles else None
