"""What the endpoint is built from and reports to: roles of links, parameters, journal, recorder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Literal, Protocol

import msgspec

from companion.domain import Params
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import Event
from companion.link.radio_stage import RadioSetup
from companion.mav.endpoint import Address


class LinkRole(Enum):
    """What a link is for."""

    VEHICLE = "vehicle"
    """Leads to the autopilot; there is exactly one."""
    RANGING = "ranging"
    """Brings ranging only, because a real autopilot does not forward our message."""
    GCS = "gcs"


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One link, as the endpoint sees it; its place among all of them is `Chunk.link`."""

    role: LinkRole
    radio: RadioSetup | None = None
    """What a RANGING link speaks instead of MAVLink."""


VEHICLE_ONLY = (LinkSpec(LinkRole.VEHICLE),)


class VehicleParams(Params, frozen=True):
    """Which autopilot, and how it is commanded."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one heard."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""


class LinkParams(Params, frozen=True):
    """How the companion uses its links."""

    component_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """MAVLink component id of the companion; null: 191, or the next free one up to 194 where
    another component has that."""

    rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 20.0
    """Control ticks, and so setpoints, per second."""
    lossy_rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 50.0
    """The same where frames get lost."""
    lossy_share: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.2
    """A line that loses more than this share of the autopilot's frames is lossy."""
    downlink_bytes_s: Annotated[float, msgspec.Meta(ge=100.0, le=1e9)] = 5760.0
    """Capacity of the slowest link to a ground station, bytes/s: 57,600 baud, the usual telemetry
    radio. Texts get one per cent of it."""
    signing_key_file: str | None = None
    """MAVLink 2 signing with the key in this file; null: no signing. `--signing-key` goes first."""
    unsigned_ranging: bool = False
    """With a key: `--ranging` links take unsigned ranging messages, of a radio that cannot sign;
    anything else that is unsigned is refused on every link."""

    stop_unread_streams: bool = False
    """Whether the autopilot is asked to stop, on this link, what it sends unasked and nothing here
    reads; only for a link that nobody else listens on. It lasts until the autopilot restarts."""
    gcs_icon: bool = False
    """Whether ground stations on `--gcs` links get the estimate as an ADSB_VEHICLE, an icon."""

    def __post_init__(self) -> None:
        if self.lossy_rate_hz < self.rate_hz:
            raise ValueError("lossy_rate_hz must not be below rate_hz")


@dataclass(frozen=True, slots=True)
class EndpointParams:
    """What an endpoint is built for."""

    vehicle: VehicleParams
    link: LinkParams
    links: tuple[LinkSpec, ...]


class Journal(Protocol):
    """Takes reports; never raises and never waits."""

    def frame(self, data: bytes, now_s: float) -> None:
        """A raw frame that came in or went out on the vehicle link, or came in on another."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """A line for the event log."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """A text for the operator."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """The target is localised."""


class InputRecorder(Protocol):
    """Takes the inputs in their order; never raises and never waits."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """A valid frame that was not our own."""

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Bytes of a radio that does not speak MAVLink."""

    def tick(self, now_s: float) -> None:
        """The timer fired."""

    def event(self, event: Event) -> None:
        """What the process or the operator says; all other events come of frames and ticks."""
