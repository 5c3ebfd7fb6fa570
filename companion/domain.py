"""Frozen values shared by all packages.

Units are in the names. Positions are local east-north-up metres from the autopilot's EKF origin;
`bearing_enu_rad` is counter-clockwise from east; time is float seconds on the companion's monotonic
axis. A quantity that was not measured is `None`, never NaN.

Parameter records are frozen too: every package declares its own as a subclass of `Params`;
`companion.config` composes them and reads them from YAML, so defaults and bounds are defined once,
next to the code that uses them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Annotated

import msgspec

from companion.geometry.coordinates import Projection
from companion.geometry.polygons import Point as Point

MAX_SETTING = 1e6
"""Largest configured length, time, speed or ratio in its unit; the product of any four still fits
the float32 of a parameter or an estimate on the wire."""
MAX_COORDINATE_M = 1e5
"""Limit of coordinates in the local frame, and of an estimate's standard deviation: 100 km."""
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=MAX_SETTING)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0, le=MAX_SETTING)]


Signed = Annotated[float, msgspec.Meta(ge=-MAX_SETTING, le=MAX_SETTING)]
Distance = Annotated[float, msgspec.Meta(ge=0.01, le=1e4)]
"""Distance in m, from the centimetre of a GNSS receiver with RTK to the largest fence of an
autopilot (PX4: GF_MAX_HOR_DIST up to 10,000 m)."""
Waiting = Annotated[float, msgspec.Meta(ge=0.05, le=3600.0)]
"""Time in s, from one control tick to an hour, which is longer than a multicopter flies."""


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A frozen parameter record that refuses unknown keys."""


PositionEnu = tuple[float, float, float]
"""Position in the local frame: east, north and up, metres."""


@dataclass(frozen=True, slots=True)
class ArrayDirection:
    """Direction to an emitter, measured by an antenna array in its own plane.

    A planar array measures the azimuth in its plane, clockwise from `first_axis` towards
    `second_axis` as seen from the antenna's top; any other array the direction cosines along its
    axes.
    """

    first_axis_enu: PositionEnu
    """Unit vector of the antenna in the local frame, by the attitude at the time."""
    second_axis_enu: PositionEnu
    first: float
    """Azimuth, radians, of a planar array; else the direction cosine along the first axis."""
    second: float | None = None
    """The direction cosine along the second axis; None: not measured."""


POWER_LIMITS_DBM = (-174.0, 20.0)
"""Received powers that a radio can measure: from the thermal noise of 1 Hz at 290 K to the upper
end of an RSSI of Bluetooth (Core Specification, HCI Read RSSI, where 127 is "not available")."""


@dataclass(frozen=True, slots=True)
class RangingMeasurement:
    """One answer of an emitter: slant range, bearing, received power, or several of them."""

    emitter_id: int
    measured_at_s: float
    """Time of the radio's measurement, on the companion's clock."""
    range_m: float | None = None
    range_sigma_m: float | None = None
    """Standard deviation that the radio reports; None: the configured one."""
    bearing_enu_rad: float | None = None
    """Direction to the emitter, counter-clockwise from east; None if given in the body frame."""
    bearing_body_rad: float | None = None
    """Direction to the emitter, clockwise from the vehicle's nose; needs the yaw to be used."""
    bearing_sigma_rad: float | None = None
    elevation_rad: float | None = None
    """Elevation of the direction, positive above the horizon of the sensor."""
    elevation_sigma_rad: float | None = None
    power_dbm: float | None = None
    """Received power, dBm; 0 is a measured milliwatt."""
    is_array_angle: bool = False
    """True if the angles are those of a line or two-axis array, in the frame of its antenna: the
    bearing is the arcsine of the direction's component to the right, the elevation of that
    upwards."""
    quality: float | None = None
    """Quality that the radio reports, 0 (worst) to 1 (best)."""
    line_of_sight: bool | None = None
    stamp_us: int | None = None
    """The sender's own stamp; a second message with the same values is a duplicate."""
    array: ArrayDirection | None = None
    """The bearing as the antenna measured it, once its attitude at the time is known."""
    least_sigmas: tuple[float | None, float | None, float | None] = (None, None, None)
    """Smallest standard deviations of range (m), bearing and elevation (rad) that are configured
    for its radio, and replace smaller reported ones; None: those of the estimation."""

    @property
    def has_direction(self) -> bool:
        """True if it has a direction that a filter can use."""
        return self.bearing_enu_rad is not None or self.array is not None

    @property
    def has_any(self) -> bool:
        """True if it has a range, a direction or a power that a filter can use."""
        return self.range_m is not None or self.has_direction or self.power_dbm is not None

    @property
    def is_power_alone(self) -> bool:
        """True if it has neither a range nor a bearing besides its power."""
        others = (self.range_m, self.bearing_enu_rad, self.bearing_body_rad)
        return self.power_dbm is not None and others == (None,) * 3

    def without_direction(self) -> RangingMeasurement:
        """Return the measurement without its direction."""
        return replace(self, bearing_enu_rad=None, bearing_body_rad=None, array=None)


@dataclass(frozen=True, slots=True)
class Attitude:
    """Vehicle attitude."""

    yaw_ned_rad: float
    """Yaw, clockwise from north."""
    tilt_rad: tuple[float, float] | None = None
    """Roll, to the right positive, and pitch, nose up positive; None: not reported."""


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Position and velocity of the vehicle."""

    time_s: float
    position_enu_m: PositionEnu
    velocity_enu_mps: PositionEnu


R95_OF_SIGMA = math.sqrt(-2.0 * math.log(0.05))
"""R95 of a circular normal distribution with a sigma of 1."""
DEFAULT_GNSS_SIGMA_M = 3.0
"""Assumed position sigma when the autopilot reports none: one frequency, part of the sky hidden."""
GNSS_ACCURACY_FACTOR, CORRECTED_GNSS_M = 1.5, 0.5
"""Ratio of the error of a GNSS receiver without corrections to its reported accuracy, and the
reported accuracy below which it has corrections."""
GNSS_VERTICAL_RATIO = 2.0
"""GNSS vertical error is 1.5 to 2 times the horizontal."""


@dataclass(frozen=True, slots=True)
class PositionAccuracy:
    """Position accuracy of the vehicle on the Earth, one sigma.

    It is the same error for all measurements from that position, and independent of others' errors.
    """

    horizontal_m: float = DEFAULT_GNSS_SIGMA_M
    """Horizontal sigma as reported, per axis."""
    vertical_m: float = GNSS_VERTICAL_RATIO * DEFAULT_GNSS_SIGMA_M
    is_reported: bool = False
    """True if the autopilot reported it; False: it is the assumed default."""
    jumped_en_m: Point = (0.0, 0.0)
    """Sum of the jumps of the vehicle's navigation in this flight; either position may be right."""

    def or_worse(self, other: PositionAccuracy | None) -> PositionAccuracy:
        """Return the worse of both accuracies, with the jumps of this one, the newer."""
        if other is None:
            return self
        return PositionAccuracy(
            max(self.horizontal_m, other.horizontal_m),
            max(self.vertical_m, other.vertical_m),
            self.is_reported and other.is_reported,
            self.jumped_en_m,
        )

    @property
    def is_corrected(self) -> bool:
        """True if it is reported, and only a receiver with corrections is as accurate."""
        return self.is_reported and self.horizontal_m < CORRECTED_GNSS_M

    @property
    def effective_m(self) -> float:
        """Horizontal sigma in use, per axis.

        Receivers underestimate their errors, because they ignore reflections, except for those with
        corrections.
        """
        is_optimistic = self.is_reported and not self.is_corrected
        return self.horizontal_m * (GNSS_ACCURACY_FACTOR if is_optimistic else 1.0)

    @property
    def text(self) -> str:
        """The horizontal accuracy as text."""
        return f"GNSS {self.horizontal_m:.2f} m{'' if self.is_reported else ', assumed'}"


DEFAULT_ACCURACY = PositionAccuracy()


def radii_text(
    absolute_r95_m: float, r95_m: float, own: PositionAccuracy | None = None, *, decimals: int = 1
) -> str:
    """Return the text of both radii, the absolute one first, with the accuracy `own` between."""
    absolute, relative = f"{absolute_r95_m:.{decimals}f}", f"{r95_m:.{decimals}f}"
    text = f"R95 {absolute} m absolute, {relative} m relative"
    return text if own is None else f"{text} ({own.text})"


class EstimateState(Enum):
    """Knowledge of the target's position."""

    SEARCHING = "searching"
    """Too little to name a position."""
    AMBIGUOUS = "ambiguous"
    """Two or more positions explain the measurements about equally well (mirror image)."""
    LOCALISED = "localised"
    """One position, with R95 under the configured radius."""
    DIVERGED = "diverged"
    """The filter contradicts its own measurements or lost its covariance."""


@dataclass(frozen=True, slots=True)
class TargetEstimate:
    """Estimated position of the target, with its uncertainty.

    There are two radii. The relative one, `r95_m`, is in the vehicle's own frame, for the return of
    this vehicle; the stop rule uses the part of it that measurements can improve. The absolute one
    is on the Earth, for ground teams and other vehicles: it also contains the error of this
    vehicle's GNSS receiver.
    """

    time_s: float
    state: EstimateState
    position_enu_m: Point
    covariance_m2: tuple[tuple[float, float], tuple[float, float]]
    r95_m: float
    """Relative: radius about `position_enu_m` that holds the target with 95 % probability, all
    hypotheses, if the vehicle position is right."""
    range_offset_m: float
    bearing_offset_rad: float
    measurements: int
    alternative_enu_m: Point | None = None
    """Second hypothesis while the state is ambiguous."""
    height_m: float = 0.0
    """Height of the target above the local origin, known or estimated."""
    height_sigma_m: float | None = None
    """Standard deviation of the height where it is estimated."""
    range_scale: float = 0.0
    """Scale error of the ranges where it is estimated."""
    own: PositionAccuracy = DEFAULT_ACCURACY
    """Worst accuracy of the vehicle position while the target was measured."""
    absolute_r95_m: float = -math.inf
    """The same radius with the vehicle position's error in it; never less than `r95_m`."""
    settled_r95_m: float = math.inf
    """`r95_m` without the position's drift since then, which measurements do not reduce."""

    def __post_init__(self) -> None:
        """Fill in derived radii, of independent errors and a constant vehicle position error."""
        if not self.settled_r95_m <= self.r95_m:
            object.__setattr__(self, "settled_r95_m", self.r95_m)
        if not self.absolute_r95_m >= self.r95_m:  # NaN is no better than either
            radius_m = math.hypot(self.r95_m, R95_OF_SIGMA * self.own.effective_m)
            object.__setattr__(self, "absolute_r95_m", radius_m)

    @property
    def absolute_covariance_m2(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """`covariance_m2` with the vehicle position's error; after jumps, of both positions."""
        (a, b), (c, d) = self.covariance_m2
        own_m2, (east_m, north_m) = self.own.effective_m**2, self.own.jumped_en_m
        across_m2 = 0.5 * east_m * north_m
        a, d = a + own_m2 + 0.5 * east_m * east_m, d + own_m2 + 0.5 * north_m * north_m
        return ((a, b + across_m2), (c + across_m2, d))

    @property
    def absolute_height_sigma_m(self) -> float | None:
        """`height_sigma_m` with the vehicle height's error in it."""
        sigma_m = self.height_sigma_m
        return None if sigma_m is None else math.hypot(sigma_m, self.own.vertical_m)


class WaypointReason(Enum):
    """Planner's reason for a waypoint."""

    APPROACH = "approach"
    """Fly towards the estimate, on the way to its far side."""
    CROSSING = "crossing"
    """Fly over the estimate to its far side for bilateral information."""
    INFORMATION = "information"
    """Fly to the point where one more measurement is expected to be most informative."""
    SEARCH = "search"
    """Fly a search pattern, before contact or after its loss."""
    DETOUR = "detour"
    """Fly to a corner of the way around a keep-out or along the fence, or out of a keep-out."""
    HOLD = "hold"
    """Stay: there is no estimate, it is close enough, or no path exists."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Planner's goal, before any limit."""

    position_enu_m: Point
    reason: WaypointReason
    detail: str = ""
    """Short text for the operator, for example the overshoot."""
    altitude_offset_m: float = 0.0
    """Altitude relative to the search altitude, positive above it."""
    descent_m: float = 0.0
    """Part of that offset that is due to a lower pass."""


@dataclass(frozen=True, slots=True)
class PositionSetpoint:
    """Commanded position, after limits."""

    position_enu_m: PositionEnu
    yaw_ned_rad: float | None = None
    """Heading to keep, clockwise from north; None leaves it to the autopilot."""


class Autopilot(Enum):
    """Kind of autopilot, by HEARTBEAT.autopilot."""

    PX4 = "PX4"
    ARDUPILOT = "ArduPilot"
    OTHER = "unknown autopilot"

    @property
    def projection(self) -> Projection:
        """Projection of its local frame on the Earth, seen on PX4 1.15.2 and ArduCopter 4.5.7."""
        return PROJECTIONS.get(self, Projection.ELLIPSOID)


PROJECTIONS = {Autopilot.PX4: Projection.SPHERE, Autopilot.ARDUPILOT: Projection.FLAT}


class VehicleClass(Enum):
    """Kind of vehicle, from HEARTBEAT.type; the value is the operator's word.

    Supported are those that hover and take position setpoints as a multicopter does. A VTOL is not:
    it flies on like a fixed wing after a transition, which the position setpoint does not show.
    """

    MULTICOPTER = "multicopter"
    COAXIAL = "coaxial helicopter"
    HELICOPTER = "helicopter"
    FIXED_WING = "fixed wing"
    VTOL = "VTOL"
    ROVER = "rover"
    BOAT = "boat"
    SUBMARINE = "submarine"
    AIRSHIP = "airship"
    TRACKER = "antenna tracker"
    UNSET = "vehicle without a frame class"
    OTHER = "vehicle of another class"

    @property
    def is_flown(self) -> bool:
        """True if vehicles of this class are supported."""
        return self in (VehicleClass.MULTICOPTER, VehicleClass.COAXIAL, VehicleClass.HELICOPTER)


class FlightMode(Enum):
    """Flight modes by their function, independent of the autopilot's names."""

    OFFBOARD = "offboard"
    """Mode that obeys external setpoints: PX4 OFFBOARD, ArduPilot GUIDED."""
    HOLD = "hold"
    """Mode that stays in place by itself: PX4 AUTO.LOITER, ArduPilot BRAKE."""
    TAKEOFF = "takeoff"
    LAND = "land"
    RETURN = "return"
    MISSION = "mission"
    READY = "ready"
    POSITION = "position"
    """Mode flown by the sticks with position hold: PX4 POSCTL, ArduPilot LOITER."""
    ALTITUDE = "altitude"
    STABILIZED = "stabilized"
    ACRO = "acro"
    MANUAL = "manual"
    UNKNOWN = "unknown"


ARDUPILOT_NAMES: dict[FlightMode, str] = {
    FlightMode.OFFBOARD: "GUIDED",
    FlightMode.HOLD: "BRAKE",
    FlightMode.LAND: "LAND",
    FlightMode.RETURN: "RTL",
    FlightMode.MISSION: "AUTO",
    FlightMode.POSITION: "LOITER",
    FlightMode.ALTITUDE: "ALT_HOLD",
    FlightMode.STABILIZED: "STABILIZE",
    FlightMode.ACRO: "ACRO",
}
"""ArduPilot's names of its modes; BRAKE is HOLD, as LOITER obeys a throttle that may be down."""


class LandedState(Enum):
    """EXTENDED_SYS_STATE.landed_state."""

    UNKNOWN = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class BatteryLevel(IntEnum):
    """Level of the battery; a greater number is worse."""

    UNKNOWN = 0
    """The level is not reported, which does not mean full."""
    GOOD = 1
    LOW = 2
    CRITICAL = 3
