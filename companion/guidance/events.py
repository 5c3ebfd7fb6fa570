"""What the session is told; every input, time included, is one of these values.

Among them is what an earlier session knew, as a value that outlives its process.
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
from companion.guidance.authority.state_machine import Phase
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.session_params import Tuning


@dataclass(frozen=True, slots=True)
class SessionMemory:
    """What a session knew at a moment."""

    phase: Phase
    origin: LocalOrigin | None
    """Of the frame that the rest is in."""
    belief: Belief | None
    report: ReportResult | None
    """What was reported last, if anything was."""
    fence_anchor: LocalOrigin | None = None
    """The origin that a fence in local metres is about; see `Fencing`."""
    others: tuple[Belief, ...] = ()
    """Of the emitters whose turn it was not."""
    earlier: tuple[ReportResult, ...] = ()
    """What was reported of other emitters, the newest last."""
    flown_fences: tuple[GeoFence, ...] = ()
    """The autopilot's fences of the flight, the newest first."""
    fence_limits: FenceLimits | None = None
    """The strictest of its fence parameters in the flight."""

    @property
    def problem(self) -> str | None:
        """Why it cannot be what a session knew, in words, or None."""
        problems = (_problem(self.origin), _problem(self.fence_anchor))
        return next((problem for problem in problems if problem is not None), None)


def _problem(origin: LocalOrigin | None) -> str | None:
    if origin is None:
        return None
    values = (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    if not all(math.isfinite(value) for value in values):
        return "an origin that is no place"
    if abs(origin.latitude_deg) > 90.0 or abs(origin.longitude_deg) > 180.0:
        return "an origin beyond the poles"
    return None


@dataclass(frozen=True, slots=True)
class Event:
    """Anything that the session is told."""

    time_s: float


@dataclass(frozen=True, slots=True)
class OrderedEvent(Event):
    """Something that may be overtaken on its way."""

    order: int | None = field(default=None, kw_only=True)
    """Of the frame among the sender's frames; None: unknown."""


@dataclass(frozen=True, slots=True)
class HeartbeatReceived(OrderedEvent):
    """The bound autopilot's HEARTBEAT."""

    autopilot: Autopilot
    mode: FlightMode
    is_armed: bool
    is_ready: bool
    """It says that it can be armed, or is."""
    is_failsafe: bool
    is_terminated: bool = False
    """The motors were stopped for good: kill switch, flight termination."""
    other_mode: str = ""
    """What its operator calls the mode, where it is unknown."""
    vehicle_class: VehicleClass = VehicleClass.MULTICOPTER


@dataclass(frozen=True, slots=True)
class VehicleMoved(OrderedEvent):
    """A new own position; `state.time_s` is the time of its measurement."""

    state: VehicleState


@dataclass(frozen=True, slots=True)
class YawMeasured(OrderedEvent):
    """A new own heading, clockwise from north, with roll and pitch where they are told."""

    measured_at_s: float
    yaw_ned_rad: float
    tilt_rad: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class OriginSet(Event):
    """Where the local frame has its zero."""

    origin: LocalOrigin
    off_m: float = 0.0
    """How far the autopilot's global position is from the local one without what was fitted."""


@dataclass(frozen=True, slots=True)
class HomeSet(Event):
    """Launch-and-return point in the local frame."""

    position_enu_m: PositionEnu


@dataclass(frozen=True, slots=True)
class LandedStateChanged(OrderedEvent):
    """Whether the vehicle is on the ground."""

    landed: LandedState


@dataclass(frozen=True, slots=True)
class SetpointEchoed(Event):
    """The autopilot tells the target that it follows."""

    position_enu_m: PositionEnu | None
    """None: it follows no position, but a velocity, for example."""


@dataclass(frozen=True, slots=True)
class OtherCommandHeard(Event):
    """Somebody else commands the autopilot to fly somewhere, by a command that it passed on."""

    command: str
    sender: tuple[int, int]


@dataclass(frozen=True, slots=True)
class EstimatorRated(Event):
    """The autopilot's verdict on its own estimate."""

    worst: float
    """1 and more: its own check would call the estimate poor."""
    has_position: bool | None = None
    """It estimates a horizontal position by its status flags; None: it reports no flags."""


@dataclass(frozen=True, slots=True)
class FixReported(Event):
    """One GNSS receiver has a 3-D fix, or none."""

    has_fix: bool
    receiver: int = 0
    """Counted from 0."""


class PlaceTeller(Enum):
    """Who tells how well the vehicle knows its own place."""

    RECEIVER = "receiver"
    """Of satellites: about the Earth."""
    ESTIMATOR = "estimator"
    """Of the autopilot: about the local origin."""


@dataclass(frozen=True, slots=True)
class OwnPlaceRated(Event):
    """How well the vehicle knows its own place, one sigma."""

    teller: PlaceTeller
    horizontal_m: float | None
    """None: it does not know."""
    vertical_m: float | None


@dataclass(frozen=True, slots=True)
class BatteryReported(Event):
    """The charge, as the autopilot knows it."""

    charge_pct: float | None
    """0 to 100; None: unknown."""
    level: BatteryLevel
    """What the autopilot calls it."""


@dataclass(frozen=True, slots=True)
class TransmitterRated(Event):
    """The autopilot calls its RC input healthy, or lost; then pulses are not the pilot's."""

    is_healthy: bool


@dataclass(frozen=True, slots=True)
class ThrottleReported(Event):
    """The throttle that the autopilot commands, 0 to 1."""

    share: float


@dataclass(frozen=True, slots=True)
class SticksReported(Event):
    """Where the pilot's sticks are."""

    deflections: tuple[float, ...]
    """Of the first four channels, -1 to 1."""


@dataclass(frozen=True, slots=True)
class RangingReceived(Event):
    """A measurement of the radio; its bearing may still be in the body frame."""

    measurement: RangingMeasurement


class Outcome(Enum):
    """How a request to the autopilot ended."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    NO_ANSWER = "no answer"


class RequestKind(Enum):
    """What the autopilot was asked for."""

    ARM = "arm"
    TAKE_OFF = "take off"
    SET_MODE = "set mode"


@dataclass(frozen=True, slots=True)
class RequestAnswered(OrderedEvent):
    """The autopilot answered a request, or did not within the retries."""

    kind: RequestKind
    outcome: Outcome
    detail: str = ""
    is_repeated: bool = False
    """It was sent more than once, so that an earlier sending may have been obeyed."""


@dataclass(frozen=True, slots=True)
class AutopilotRestarted(Event):
    """The autopilot's clock began again, or another autopilot was bound in its place."""

    is_other: bool = False


@dataclass(frozen=True, slots=True)
class AutopilotClockSlipped(Event):
    """The autopilot's clock went back or ahead, or stood still; the autopilot did not restart."""


@dataclass(frozen=True, slots=True)
class AutopilotFenceRead(Event):
    """The autopilot told its own fence, or did not."""

    fence: GeoFence | None = None
    """None: it has none, if there was no problem."""
    problem: str | None = None
    """Why it is not known, in words."""
    is_unusable: bool = False
    """The problem is in what it told: there is a fence, but not one that can be kept."""


@dataclass(frozen=True, slots=True)
class FenceLimits:
    """The autopilot's fence as far as parameters make it; None: no such limit."""

    radius_m: float | None = None
    """Horizontally, about home."""
    altitude_max_m: float | None = None
    """Above home."""
    altitude_min_m: float | None = None
    margin_m: float = 0.0
    """How far inside the autopilot stops by itself."""

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
    """The autopilot reported parameters that are a fence."""

    limits: FenceLimits


@dataclass(frozen=True, slots=True)
class AutopilotFenceChanged(Event):
    """The autopilot shows that its fence is another one now; which one is not read yet."""


class OperatorCommand(Enum):
    """What the operator may ask for beside the mode switch."""

    HOLD = "hold"
    RESUME = "resume"
    RETURN = "return"
    GRANT = "grant"
    """Give control again after a yield: MAV_CMD_NAV_GUIDED_ENABLE to us, too."""


@dataclass(frozen=True, slots=True)
class OperatorAsked(Event):
    """A button of the live map was pressed and confirmed, or a station sent a grant."""

    command: OperatorCommand


@dataclass(frozen=True, slots=True)
class Retuned(Event):
    """Parameters of the mission were changed by a ground station."""

    tuning: Tuning


@dataclass(frozen=True, slots=True)
class TimerFired(Event):
    """The control tick, 20 times a second."""

    heard_s: float | None
    """When the last valid frame of the autopilot arrived."""


@dataclass(frozen=True, slots=True)
class TimeLeft(Event):
    """There is time between two control ticks, for what may not delay one."""


@dataclass(frozen=True, slots=True)
class ControlStalled(Event):
    """The control loop stalled (suspended, starved): mode and position are of the past."""

    stalled_s: float


@dataclass(frozen=True, slots=True)
class StopRequested(Event):
    """The process is asked to end."""


@dataclass(frozen=True, slots=True)
class ProcessNoted(Event):
    """The process has something to say to the operator: about its log, its timing, its restart."""

    severity: Severity
    text: str


@dataclass(frozen=True, slots=True)
class EarlierRunFound(Event):
    """An earlier process of ours did not end in order; see `guidance.recovery`."""


@dataclass(frozen=True, slots=True)
class MemoryRecalled(Event):
    """What the earlier process knew of this very vehicle, fence and mission."""

    memory: SessionMemory
    age_s: float


@dataclass(frozen=True, slots=True)
class IdConflictHeard(Event):
    """Somebody else, such as a second companion, sends under our own system and component id."""


@dataclass(frozen=True, slots=True)
class IdentityDoubted(Event):
    """Frames of the autopilot's ids may be another vehicle's, or that doubt is over."""

    problem: str | None
    """In words; None: there is no doubt any more."""
