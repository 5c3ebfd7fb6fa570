"""What the session is told; every input, time included, is one of these values.

Among them is what an earlier session knew, as a value that outlives its process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from companion.domain import (
    Autopilot,
    BatteryLevel,
    FlightMode,
    LandedState,
    PositionEnu,
    RangingMeasurement,
    VehicleState,
)
from companion.estimation.belief import Belief
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import GeoFence
from companion.guidance.authority.state_machine import Phase
from companion.guidance.commands import ReportResult
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
class HeartbeatReceived:
    """The bound autopilot's HEARTBEAT."""

    time_s: float
    autopilot: Autopilot
    mode: FlightMode
    is_armed: bool
    is_ready: bool
    """It says that it can be armed, or is."""
    is_failsafe: bool
    is_terminated: bool = False
    """The motors were stopped for good: kill switch, flight termination."""
    order: int | None = None
    """Of the frame among the sender's frames; None: unknown."""


@dataclass(frozen=True, slots=True)
class VehicleMoved:
    """A new own position; `state.time_s` is the time of its measurement."""

    time_s: float
    state: VehicleState
    order: int | None = None
    """As of HeartbeatReceived."""


@dataclass(frozen=True, slots=True)
class YawMeasured:
    """A new own heading, clockwise from north."""

    time_s: float
    measured_at_s: float
    yaw_ned_rad: float
    order: int | None = None
    """As of HeartbeatReceived."""


@dataclass(frozen=True, slots=True)
class OriginSet:
    """Where the local frame has its zero."""

    time_s: float
    origin: LocalOrigin


@dataclass(frozen=True, slots=True)
class HomeSet:
    """Launch-and-return point in the local frame."""

    time_s: float
    position_enu_m: PositionEnu


@dataclass(frozen=True, slots=True)
class LandedStateChanged:
    """Whether the vehicle is on the ground."""

    time_s: float
    landed: LandedState
    order: int | None = None
    """As of HeartbeatReceived."""


@dataclass(frozen=True, slots=True)
class SetpointEchoed:
    """The autopilot tells the target that it follows."""

    time_s: float
    position_enu_m: PositionEnu | None
    """None: it follows no position, but a velocity, for example."""


@dataclass(frozen=True, slots=True)
class EstimatorRated:
    """How well the autopilot's estimator agrees with its sensors."""

    time_s: float
    worst: float
    """The worst of its test ratios, in units of what its maker calls bad; 1 and more is poor."""


@dataclass(frozen=True, slots=True)
class FixReported:
    """Whether the satellites give a position."""

    time_s: float
    has_fix: bool


@dataclass(frozen=True, slots=True)
class BatteryReported:
    """The charge, as the autopilot knows it."""

    time_s: float
    charge_pct: float | None
    """0 to 100; None: unknown."""
    level: BatteryLevel
    """What the autopilot calls it."""


@dataclass(frozen=True, slots=True)
class SticksReported:
    """Where the pilot's sticks are."""

    time_s: float
    deflections: tuple[float, ...]
    """Of the first four channels, -1 to 1."""


@dataclass(frozen=True, slots=True)
class RangingReceived:
    """A measurement of the radio; its bearing may still be in the body frame."""

    time_s: float
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
class RequestAnswered:
    """The autopilot answered a request, or did not within the retries."""

    time_s: float
    kind: RequestKind
    outcome: Outcome
    detail: str = ""
    order: int | None = None
    """As of HeartbeatReceived."""
    is_repeated: bool = False
    """It was sent more than once, so that an earlier sending may have been obeyed."""


@dataclass(frozen=True, slots=True)
class AutopilotRestarted:
    """The autopilot's clock went back."""

    time_s: float


@dataclass(frozen=True, slots=True)
class AutopilotFenceRead:
    """The autopilot told its own fence, or did not."""

    time_s: float
    fence: GeoFence | None = None
    """None: it has none, if there was no problem."""
    problem: str | None = None
    """Why it is not known, in words."""
    is_unusable: bool = False
    """The problem is in what it told: there is a fence, but not one that can be kept."""


@dataclass(frozen=True, slots=True)
class ControlGranted:
    """The operator gives control back after a yield (MAV_CMD_NAV_GUIDED_ENABLE to us)."""

    time_s: float


class OperatorCommand(Enum):
    """What the operator may ask for beside the mode switch."""

    HOLD = "hold"
    RESUME = "resume"
    RETURN = "return"


@dataclass(frozen=True, slots=True)
class OperatorAsked:
    """A button of the live map was pressed and confirmed."""

    time_s: float
    wish: OperatorCommand


@dataclass(frozen=True, slots=True)
class Retuned:
    """Parameters of the mission were changed by a ground station."""

    time_s: float
    tuning: Tuning


@dataclass(frozen=True, slots=True)
class TimerFired:
    """The control tick, 20 times a second."""

    time_s: float
    heard_s: float | None
    """When the last valid frame of the autopilot arrived."""


@dataclass(frozen=True, slots=True)
class ControlStalled:
    """The control tick stood still (suspended, starved): mode and position are of the past."""

    time_s: float
    stalled_s: float


@dataclass(frozen=True, slots=True)
class StopRequested:
    """The process is asked to end."""

    time_s: float


@dataclass(frozen=True, slots=True)
class EarlierRunFound:
    """An earlier process of ours did not end in order; see `guidance.memory`."""

    time_s: float


@dataclass(frozen=True, slots=True)
class MemoryRecalled:
    """What the earlier process knew of this very vehicle, fence and mission."""

    time_s: float
    memory: SessionMemory
    age_s: float


@dataclass(frozen=True, slots=True)
class IdConflictHeard:
    """Somebody else, such as a second companion, sends under our own system and component id."""

    time_s: float


Event = (
    HeartbeatReceived
    | VehicleMoved
    | YawMeasured
    | OriginSet
    | HomeSet
    | LandedStateChanged
    | SetpointEchoed
    | EstimatorRated
    | FixReported
    | BatteryReported
    | SticksReported
    | RangingReceived
    | RequestAnswered
    | AutopilotRestarted
    | AutopilotFenceRead
    | ControlGranted
    | OperatorAsked
    | Retuned
    | TimerFired
    | ControlStalled
    | StopRequested
    | EarlierRunFound
    | MemoryRecalled
    | IdConflictHeard
)
