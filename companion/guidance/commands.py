"""Commands of the session, which the link converts to messages, and its parameters.

Tuning changes how the mission is flown, never where: fence, keep-outs and the altitude band are
read-only. A change arrives as whole records that were checked together, and takes effect with the
next control tick; the guard moves from one speed to the other within its acceleration, as from one
waypoint to the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from companion.domain import Distance, FlightMode, Params, PositionSetpoint, TargetEstimate, Waiting
from companion.geometry.coordinates import LocalOrigin
from companion.guard.gate import GuardLimits
from companion.planning.planner import Planner


class Severity(Enum):
    """Severity of a text, as MAV_SEVERITY."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Topic(Enum):
    """Subject whose texts are states: a newer text replaces the one before."""

    READINESS = "readiness"
    """Missing inputs, or readiness for control."""
    PLAN = "plan"
    """Following the plan, slower, or holding, with the reason."""
    CONTACT = "contact"
    """Searching by a pattern, or flying to the target."""


@dataclass(frozen=True, slots=True)
class SendHeartbeat:
    """Send our own HEARTBEAT; it comes from the control tick, so it stops when the tick stops."""


@dataclass(frozen=True, slots=True)
class SendSetpoint:
    """Send a guarded setpoint."""

    setpoint: PositionSetpoint


@dataclass(frozen=True, slots=True)
class SetMode:
    """Request a mode of the autopilot."""

    mode: FlightMode
    is_armed: bool


@dataclass(frozen=True, slots=True)
class Arm:
    """Request arming."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """Request a take-off."""

    altitude_m: float
    """Height to climb to, above home."""
    home_up_m: float
    """Height of home in the local frame."""


@dataclass(frozen=True, slots=True)
class WithdrawRequest:
    """Withdraw requests that are not answered yet: they must not be sent again."""


@dataclass(frozen=True, slots=True)
class Announce:
    """Show a text to the operator, by log and STATUSTEXT; the link limits its rate."""

    severity: Severity
    text: str
    topic: Topic | str | None = None
    """Subject of the state that the text describes, such as a radio's name; None: an event."""
    must_pass: bool = False
    """True if the rate limit does not apply: control begins or ends, a report, or a grant."""


@dataclass(frozen=True, slots=True)
class ReportResult:
    """Report the localised target."""

    estimate: TargetEstimate
    latitude_deg: float | None
    longitude_deg: float | None
    emitter_id: int | None = None
    origin: LocalOrigin | None = None
    """Origin of the estimate's frame; None: unknown."""
    budget_m: Mapping[str, float] = field(default_factory=dict)
    """R95, m, accumulated after each widening term, by the term's name."""


@dataclass(frozen=True, slots=True)
class Record:
    """Write a line to the event log."""

    kind: str
    fields: Mapping[str, object]


Command = (
    SendHeartbeat
    | SendSetpoint
    | SetMode
    | Arm
    | TakeOff
    | WithdrawRequest
    | Announce
    | ReportResult
    | Record
)


StickReaction = Literal["yield", "hold", "ignore"]
Percent = Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]


class SessionParams(Params, frozen=True):
    """Parameters of the mission."""

    engage: Literal["operator", "auto"] = "operator"
    """`operator`: the mode switch hands control over; `auto`: launch once (simulation)."""
    altitude_m: Distance = 20.0
    """Search altitude above home."""
    stop_radius_m: Distance = 1.0
    """R95 below which the target is reported, once it has stayed there for `stop_confirm_s`."""
    stop_confirm_s: Waiting = 10.0
    """Time for which R95 must stay below `stop_radius_m`."""
    settle_s: Waiting | None = 45.0
    """Time in which R95 must improve by 8 %, else the target is reported; null: never."""
    on_localised: Literal["hold", "return", "land"] = "hold"
    """Mode to request after the report, a value of `FlightMode`."""
    searches_on: bool = msgspec.field(default=False, name="continue")
    """True if the search continues for further emitters after a report."""
    ranging_timeout_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600.0)] = 5.0
    """Time without a usable measurement after which the vehicle holds."""
    degraded_after_s: Waiting = 2.0
    """Time without a usable measurement after which the vehicle flies more slowly."""
    coast_drift_mps: ClassVar[float] = 1.0
    """Assumed speed of the target, relative to its estimate, without measurements."""
    coast_sigma_max_m: ClassVar[float] = 30.0
    """Standard deviation of the estimate, without ranging, above which the vehicle holds."""
    on_sticks: StickReaction = "yield"
    """Reaction to a pilot who moves the sticks: `yield` holds, then leaves the vehicle to the
    pilot; `hold` only holds; `ignore` continues."""
    battery_low_pct: Percent = 20.0
    """Charge at which the leg is finished, estimates are reported, and the vehicle returns."""
    battery_critical_pct: Percent = 10.0
    """Charge at which the vehicle is handed back at once by requesting the return."""

    def __post_init__(self) -> None:
        if self.battery_low_pct < self.battery_critical_pct:
            raise ValueError("battery_low_pct must not be below battery_critical_pct")


class When(Enum):
    """State in which a parameter may be changed."""

    ANY_TIME = "at any time but during launch and hand-back"
    DISARMED = "only while the vehicle is disarmed"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Tuning:
    """Settings that the parts of a session use."""

    params: SessionParams
    limits: GuardLimits
    """Limits with the fence that the session began with."""
    planner: Planner[Any]
    """Planner of the same kind as before: it continues with the memory of the one before."""
