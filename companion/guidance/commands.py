"""What the session wants done; the link turns these values into messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
    """A subject whose texts are states: a newer one replaces the one before."""

    READINESS = "readiness"
    """Waiting for what, or ready to be given control."""
    PLAN = "plan"
    """Flying the plan, slower, or holding, and why."""
    CONTACT = "contact"
    """Searching by a pattern, or flying to the target."""


@dataclass(frozen=True, slots=True)
class SendHeartbeat:
    """Our own HEARTBEAT; it comes from the control tick, so it stops when the tick stops."""


@dataclass(frozen=True, slots=True)
class SendSetpoint:
    """A guarded setpoint."""

    setpoint: PositionSetpoint


@dataclass(frozen=True, slots=True)
class SetMode:
    """Ask the autopilot for a mode."""

    mode: FlightMode
    is_armed: bool


@dataclass(frozen=True, slots=True)
class Arm:
    """Ask the autopilot to arm."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """Ask the autopilot to take off."""

    altitude_m: float
    """Above home."""
    home_up_m: float
    """Height of home in the local frame."""


@dataclass(frozen=True, slots=True)
class WithdrawRequest:
    """Forget what was asked and not answered yet: it must not be sent again."""


@dataclass(frozen=True, slots=True)
class Announce:
    """A text for the operator: log and STATUSTEXT; how often one passes is up to the link."""

    severity: Severity
    text: str
    topic: Topic | None = None
    """None: an occurrence by itself."""
    must_pass: bool = False
    """Control begins or ends, or something was found or granted: never withheld."""


@dataclass(frozen=True, slots=True)
class ReportResult:
    """The target is localised."""

    estimate: TargetEstimate
    latitude_deg: float | None
    longitude_deg: float | None
    emitter_id: int | None = None
    origin: LocalOrigin | None = None
    """Zero of the estimate's frame."""


@dataclass(frozen=True, slots=True)
class Record:
    """A line for the event log."""

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
