"""Commands of the session; the link turns these values into messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from companion.domain import FlightMode, PositionSetpoint, TargetEstimate
from companion.geometry.coordinates import LocalOrigin


class Severity(Enum):
    """MAV_SEVERITY of a text."""

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
    """Above home."""
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
    """True if the rate limit does not apply: control begins or ends, or a find or a grant."""


@dataclass(frozen=True, slots=True)
class ReportResult:
    """Report the localised target."""

    estimate: TargetEstimate
    latitude_deg: float | None
    longitude_deg: float | None
    emitter_id: int | None = None
    origin: LocalOrigin | None = None
    """Zero of the estimate's frame."""
    budget_m: Mapping[str, float] = field(default_factory=dict)
    """R95 in metres after each term that widens it, by the term's name."""


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
