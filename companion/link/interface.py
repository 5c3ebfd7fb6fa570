"""Interface of the endpoint: roles of links, parameters, journal, recorder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar, Literal, Protocol

import msgspec

from companion.domain import Params
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import Event
from companion.link.radio_settings import RadioSetup
from companion.mav.endpoint import Address


class LinkRole(Enum):
    """Purpose of a link."""

    VEHICLE = "vehicle"
    """Link to the autopilot; there is exactly one."""
    RANGING = "ranging"
    """Ranging only, because a real autopilot does not forward our message."""
    GCS = "gcs"


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One link; its index among all of them is `Chunk.link`."""

    role: LinkRole
    radio: RadioSetup | None = None
    """Radio format of a RANGING link; None: MAVLink."""


VEHICLE_ONLY = (LinkSpec(LinkRole.VEHICLE),)


class VehicleParams(Params, frozen=True):
    """Autopilot, and the kind of setpoint for it."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one received."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""


class LinkParams(Params, frozen=True):
    """Use of the companion's links."""

    component_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """MAVLink component id of the companion; null: 191, or the next free one up to 194 where
    another component has that."""

    rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 20.0
    """Control ticks, and so setpoints, per second."""
    lossy_rate_hz: ClassVar[float] = 50.0
    """The same rate on a lossy line, the greatest that is configurable."""
    lossy_share: ClassVar[float] = 0.2
    """Share of lost frames of the autopilot above which a line is lossy."""
    downlink_bytes_s: Annotated[float, msgspec.Meta(ge=100.0, le=1e9)] = 5760.0
    """Capacity of the slowest link to a ground station, bytes/s: 57,600 baud, the usual telemetry
    radio. Texts get one per cent of it."""
    signing_key_file: str | None = None
    """MAVLink 2 signing with the key in this file; null: no signing. `--signing-key` has
    precedence."""
    unsigned_ranging: bool = False
    """With a key, `--ranging` links accept unsigned ranging messages of a radio that cannot sign;
    anything else that is unsigned is refused on every link."""

    stop_unread_streams: bool = False
    """True: the autopilot is asked to stop streams on this link that the companion does not use;
    only for a link without other receivers. It lasts until the autopilot restarts."""
    gcs_icon: bool = False
    """True: ground stations on `--gcs` links get the estimate as an ADSB_VEHICLE, an icon."""


@dataclass(frozen=True, slots=True)
class EndpointParams:
    """Parameters of an endpoint."""

    vehicle: VehicleParams
    link: LinkParams
    links: tuple[LinkSpec, ...]


class Journal(Protocol):
    """Receiver of reports; never raises and never blocks."""

    def frame(self, data: bytes, now_s: float) -> None:
        """Record a raw frame, received or sent on the vehicle link, or received on another."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Record a line for the event log."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Record a text for the operator."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """Record that the target is localised."""


class InputRecorder(Protocol):
    """Receiver of all inputs in their order; never raises and never blocks."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record a valid frame that was not our own."""

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record bytes of a radio with its own format."""

    def tick(self, now_s: float) -> None:
        """Record that the timer fired."""

    def event(self, event: Event) -> None:
        """Record an event of the process or the operator; others follow from frames and ticks."""
