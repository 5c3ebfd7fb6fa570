"""Input events of the session, time included.

They include the state of an earlier session, as a value that outlives its process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

from companion.domain import (
    Autopilot,
    BatteryLevel,
    FlightMode,
    LandedState,
    PositionEnu,
    RangingMeasurement,
    VehicleClass,
    VehicleState,
)
from companion.estimation.belief import Belief
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import GeoFence
from companion.guidance.commands import ReportResult, Severity, Tuning
from companion.guidance.phases import Phase


@dataclass(frozen=True, slots=True)
class SessionMemory:
    """State of a session at one moment, as kept for a restart."""

    phase: Phase | None
    """Phase to continue in; None: another mission is flown now, and only the fences of the flight
    count."""
    origin: LocalOrigin | None
    """Origin of the frame in which the rest is given."""
    belief: Belief | None
    report: ReportResult | None
    """Latest report; None if no emitter was reported."""
    fence_anchor: LocalOrigin | None = None
    """Origin to which a fence in local metres refers; see `Fencing`."""
    others: tuple[Belief, ...] = ()
    """Beliefs of the emitters that were not searched for at that time."""
    earlier: tuple[ReportResult, ...] = ()
    """Reports of other emitters, the newest last."""
    flown_fences: tuple[GeoFence, ...] = ()
    """The autopilot's fences of the flight, the newest first."""
    fence_limits: FenceLimits | None = None
    """The strictest of its fence parameters in the flight."""

    @property
    def fences_alone(self) -> SessionMemory:
        """The fences alone, which stay valid for another mission in the same flight."""
        fences, limits = self.flown_fences, self.fence_limits
        return SessionMemory(None, None, None, None, flown_fences=fences, fence_limits=limits)

    @property
    def problem(self) -> str | None:
        """Reason why this state is invalid; None if it is valid."""
        problems = (_problem(self.origin), _problem(self.fence_anchor))
        return next((problem for problem in problems if problem is not None), None)


def _problem(origin: LocalOrigin | None) -> str | None:
    if origin is None:
        return None
    values = (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    if not all(math.isfinite(value) for value in values):
        return "an origin that is not finite"
    if abs(origin.latitude_deg) > 90.0 or abs(origin.longitude_deg) > 180.0:
        return "an origin beyond the poles"
    return None


@dataclass(frozen=True, slots=True)
class VehicleMark:
    """Identity of a vehicle at one time, by which a restarted companion recognises it."""

    system_id: int
    component_id: int
    uid: str | None
    """Hardware id; None if it reports none, or has not answered yet."""
    boot_s: float
    """Reading of its boot clock, s."""


@dataclass(frozen=True, slots=True)
class Event:
    """Base of all inputs of the session; `time_s` is the time of reception."""

    time_s: float


@dataclass(frozen=True, slots=True)
class OrderedEvent(Event):
    """Event that may arrive out of order."""

    order: int | None = field(default=None, kw_only=True)
    """Position of its frame in the sender's sequence; None: unknown."""


@dataclass(frozen=True, slots=True)
class HeartbeatReceived(OrderedEvent):
    """HEARTBEAT of the bound autopilot."""

    autopilot: Autopilot
    mode: FlightMode
    is_armed: bool
    is_ready: bool
    """True if the autopilot reports that it can be armed, or is."""
    is_failsafe: bool
    is_terminated: bool = False
    """True if the motors were stopped permanently: kill switch, flight termination."""
    other_mode: str = ""
    """Name of the mode in the autopilot's tools, for an unknown mode."""
    vehicle_class: VehicleClass = VehicleClass.MULTICOPTER


@dataclass(frozen=True, slots=True)
class VehicleMoved(OrderedEvent):
    """A new vehicle position; `state.time_s` is the time of its measurement."""

    state: VehicleState


@dataclass(frozen=True, slots=True)
class YawMeasured(OrderedEvent):
    """A new vehicle heading, clockwise from north, with roll and pitch where they are reported."""

    measured_at_s: float
    yaw_ned_rad: float
    tilt_rad: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class OriginSet(Event):
    """Zero of the local frame."""

    origin: LocalOrigin
    off_m: float = 0.0
    """Distance of the global position from the local one before the transform was fitted."""


@dataclass(frozen=True, slots=True)
class HomeSet(Event):
    """Launch-and-return point in the local frame."""

    position_enu_m: PositionEnu


@dataclass(frozen=True, slots=True)
class LandedStateChanged(OrderedEvent):
    """Landed state of the vehicle: on the ground, in the air, or between."""

    landed: LandedState


@dataclass(frozen=True, slots=True)
class SetpointEchoed(Event):
    """Target that the autopilot reports to follow."""

    position_enu_m: PositionEnu | None
    """Position of the target; None if it is a velocity, for example."""


@dataclass(frozen=True, slots=True)
class OtherCommandHeard(Event):
    """Flight command of another system to the autopilot, received because it was forwarded."""

    command: str
    sender: tuple[int, int]


@dataclass(frozen=True, slots=True)
class EstimatorStatusReported(Event):
    """The autopilot's assessment of its own estimate."""

    worst: float
    """Largest test ratio; at 1 and more the autopilot's own check would call the estimate poor."""
    has_position: bool | None = None
    """True if the status flags report a horizontal position; None if no flags are reported."""


@dataclass(frozen=True, slots=True)
class FixReported(Event):
    """One GNSS receiver has a 3-D fix, or none."""

    has_fix: bool
    receiver: int = 0
    """Number of the receiver, from 0."""


class AccuracySource(Enum):
    """Source of a reported position accuracy."""

    RECEIVER = "receiver"
    """GNSS receiver: relative to the Earth."""
    ESTIMATOR = "estimator"
    """Estimator of the autopilot: relative to the local origin."""


@dataclass(frozen=True, slots=True)
class PositionAccuracyReported(Event):
    """Position accuracy of the vehicle, one sigma."""

    source: AccuracySource
    horizontal_m: float | None
    """Horizontal sigma; None: unknown to its source."""
    vertical_m: float | None


@dataclass(frozen=True, slots=True)
class BatteryReported(Event):
    """State of charge, as the autopilot reports it."""

    charge_pct: float | None
    """Charge, 0 to 100; None: unknown."""
    level: BatteryLevel
    """The autopilot's own classification."""


@dataclass(frozen=True, slots=True)
class RcStatusReported(Event):
    """Health of the RC input by the autopilot; if lost, its pulses are not the pilot's."""

    is_healthy: bool


@dataclass(frozen=True, slots=True)
class ThrottleReported(Event):
    """The throttle that the autopilot commands, 0 to 1."""

    share: float


@dataclass(frozen=True, slots=True)
class SticksReported(Event):
    """Positions of the pilot's sticks."""

    deflections: tuple[float, ...]
    """Deflections of the first four channels, -1 to 1."""


@dataclass(frozen=True, slots=True)
class RangingReceived(Event):
    """A measurement of the radio; its bearing may still be in the body frame."""

    measurement: RangingMeasurement


class Outcome(Enum):
    """Outcome of a request to the autopilot."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    NO_ANSWER = "no answer"


class RequestKind(Enum):
    """Kind of a request to the autopilot."""

    ARM = "arm"
    TAKE_OFF = "take off"
    SET_MODE = "set mode"


@dataclass(frozen=True, slots=True)
class RequestAnswered(OrderedEvent):
    """Answer of the autopilot to a request, or its absence after all retries."""

    kind: RequestKind
    outcome: Outcome
    detail: str = ""
    is_repeated: bool = False
    """True if it was sent more than once, so that an earlier copy may have been obeyed."""


@dataclass(frozen=True, slots=True)
class AutopilotRestarted(Event):
    """The autopilot's clock restarted from zero, or another autopilot was bound."""

    is_other: bool = False


@dataclass(frozen=True, slots=True)
class AutopilotClockSlipped(Event):
    """The autopilot's clock went back or ahead, or stood still; the autopilot did not restart."""


@dataclass(frozen=True, slots=True)
class AutopilotFenceRead(Event):
    """Result of downloading the autopilot's fence."""

    fence: GeoFence | None = None
    """Fence as downloaded; None without a problem: the autopilot has no fence."""
    problem: str | None = None
    """Reason why the fence is unknown; None if it is known."""
    is_unusable: bool = False
    """True if a fence was downloaded that the guard cannot keep."""


@dataclass(frozen=True, slots=True)
class FenceLimits:
    """Fence that the autopilot's parameters define; None: no such limit."""

    radius_m: float | None = None
    """Horizontal limit around home."""
    altitude_max_m: float | None = None
    """Upper limit above home."""
    altitude_min_m: float | None = None
    margin_m: float = 0.0
    """Distance inside the fence at which the autopilot stops by itself."""

    def strictest(self, other: FenceLimits) -> FenceLimits:
        """Return the limits that two fences allow together."""
        return FenceLimits(
            _least(self.radius_m, other.radius_m),
            _least(self.altitude_max_m, other.altitude_max_m),
            max((self.altitude_min_m, other.altitude_min_m), key=_or_lowest),
            max(self.margin_m, other.margin_m),
        )


def _least(one: float | None, other: float | None) -> float | None:
    return min((each for each in (one, other) if each is not None), default=None)


def _or_lowest(limit: float | None) -> float:
    return -math.inf if limit is None else limit


@dataclass(frozen=True, slots=True)
class AutopilotFenceLimitsRead(Event):
    """The autopilot reported parameters that define a fence."""

    limits: FenceLimits


@dataclass(frozen=True, slots=True)
class AutopilotFenceChanged(Event):
    """The autopilot's fence was changed; the new one is not downloaded yet."""


class OperatorCommand(Enum):
    """Commands of the operator besides the mode switch."""

    HOLD = "hold"
    RESUME = "resume"
    RETURN = "return"
    GRANT = "grant"
    """Hand control over again after a yield; also MAV_CMD_NAV_GUIDED_ENABLE sent to us."""


@dataclass(frozen=True, slots=True)
class OperatorCommandReceived(Event):
    """A button of the live map was pressed and confirmed, or a station sent a grant."""

    command: OperatorCommand


@dataclass(frozen=True, slots=True)
class Retuned(Event):
    """A ground station changed parameters of the mission."""

    tuning: Tuning


@dataclass(frozen=True, slots=True)
class TimerFired(Event):
    """The control tick, 20 times a second."""

    heard_s: float | None
    """Arrival of the autopilot's last valid frame, in seconds."""


@dataclass(frozen=True, slots=True)
class TimeLeft(Event):
    """Spare time between two control ticks, for work that may not delay one."""


@dataclass(frozen=True, slots=True)
class ControlStalled(Event):
    """The control loop stalled (suspended, starved): mode and position are out of date."""

    stalled_s: float


@dataclass(frozen=True, slots=True)
class StopRequested(Event):
    """Request to end the process."""


@dataclass(frozen=True, slots=True)
class ProcessMessage(Event):
    """Text of the process for the operator, about its log, timing or restart."""

    severity: Severity
    text: str


@dataclass(frozen=True, slots=True)
class UncleanExitFound(Event):
    """An earlier companion process ended uncleanly; see `guidance.readiness`."""

    vehicle: VehicleMark | None = None
    """Expected current state of that run's vehicle; None: unknown."""


@dataclass(frozen=True, slots=True)
class MemoryRecalled(Event):
    """State kept by the earlier process about this very vehicle."""

    memory: SessionMemory
    age_s: float


@dataclass(frozen=True, slots=True)
class IdConflictHeard(Event):
    """Another system, such as a second companion, sends under our own system and component id."""


@dataclass(frozen=True, slots=True)
class IdentityDoubted(Event):
    """Doubt that frames with the autopilot's ids are the vehicle's, or its end."""

    problem: str | None
    """Description of the problem; None if the identity is no longer doubted."""
