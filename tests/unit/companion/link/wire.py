"""An autopilot of bytes: feeds a CompanionEndpoint frames and decodes what it sends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import msgspec

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import AutopilotFenceRead
from companion.link.interface import VEHICLE_ONLY, LinkRole, LinkSpec
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.signing import Signing

M = TypeVar("M", bound=Message)
PEER: Address = ("127.0.0.1", 14580)
STRANGER: Address = ("10.0.0.9", 666)
PX4, ARDUPILOT, NOBODY = 12, 3, 8
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
E7 = 10_000_000


def link_specs(ranging: int = 0, gcs: int = 0) -> tuple[LinkSpec, ...]:
    """The vehicle's link, then those that bring ranging by MAVLink, then ground stations'."""
    stations = [LinkSpec(LinkRole.GCS)] * gcs
    return (*VEHICLE_ONLY, *[LinkSpec(LinkRole.RANGING)] * ranging, *stations)


class Journal:
    def __init__(self) -> None:
        self.frames = 0
        self.texts: list[str] = []
        self.records: list[tuple[str, Mapping[str, object]]] = []

    def frame(self, data: bytes, now_s: float) -> None:
        del data, now_s
        self.frames += 1

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        del now_s
        self.records.append((kind, fields))

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        del severity, now_s
        self.texts.append(text)

    def result(self, report: ReportResult, now_s: float) -> None:
        del report, now_s


def heartbeat(
    autopilot: int = PX4, custom_mode: int = HOLD, *, is_armed: bool = False, status: int = 3
) -> Message:
    base_mode = 1 | (128 if is_armed else 0)
    return mavlink.MAVLink_heartbeat_message(2, autopilot, base_mode, custom_mode, status, 3)


def local_position(boot_ms: int, *values: float) -> Message:
    return mavlink.MAVLink_local_position_ned_message(boot_ms, *(values or (0.0,) * 6))


def home_position(
    latitude: int = 47 * E7,
    longitude: int = 8 * E7,
    altitude: int = 488_000,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    time_usec: int = 0,
) -> Message:
    return mavlink.MAVLink_home_position_message(
        latitude, longitude, altitude, x, y, z, [1.0, 0, 0, 0], 0.0, 0.0, 0.0, time_usec
    )


def origin(latitude: int = 47 * E7, longitude: int = 8 * E7, altitude: int = 488_000) -> Message:
    return mavlink.MAVLink_gps_global_origin_message(latitude, longitude, altitude)


class Wire:
    """One endpoint and its autopilot, system 1 component 1.

    That system is configured, so that it is bound at once; None if it is listened for.
    """

    def __init__(
        self,
        config: CompanionConfig | None = None,
        links: int = 0,
        *,
        gcs_links: int = 0,
        signing: Signing | None = None,
        started_unix_s: float = 0.0,
        system_id: int | None = 1,
    ) -> None:
        self.journal = Journal()
        config = config or CompanionConfig()
        if config.vehicle.system_id is None and system_id is not None:
            vehicle = msgspec.structs.replace(config.vehicle, system_id=system_id)
            config = msgspec.structs.replace(config, vehicle=vehicle)
        self.endpoint = build_endpoint(
            config,
            self.journal,
            link_specs(links, gcs_links),
            signing=signing,
            started_unix_s=started_unix_s,
        )
        self.endpoint.session.handle(AutopilotFenceRead(0.0))  # it has none
        self.autopilot = MavCodec(1, 1)
        self.reader = MavCodec(9, 9)
        self.now_s = 0.0
        self.sent: list[Message] = []
        self.raw: list[Chunk] = []

    def say(
        self,
        message: Message,
        *,
        sender: MavCodec | None = None,
        peer: Address | None = PEER,
        link: int = 0,
    ) -> list[Message]:
        """A frame arrives; what the endpoint sends at once."""
        return self.bytes((sender or self.autopilot).encode(message), peer=peer, link=link)

    def bytes(self, data: bytes, *, peer: Address | None = PEER, link: int = 0) -> list[Message]:
        self.endpoint.receive(Chunk(link, data, peer), self.now_s)
        return self._collect()

    def wait(self, duration_s: float) -> list[Message]:
        """Let ticks pass in silence."""
        sent: list[Message] = []
        until_s = self.now_s + duration_s
        while self.endpoint.next_timer_s() <= until_s:
            self.now_s = max(self.now_s, self.endpoint.next_timer_s())
            self.endpoint.handle_timer(self.now_s)
            sent += self._collect()
        self.now_s = until_s
        return sent

    def bound(self) -> Wire:
        self.say(heartbeat())
        return self

    def ready(self, custom_mode: int = HOLD, *, is_armed: bool = True) -> Wire:
        """Bring the vehicle into the air with all inputs known, and return the wire."""
        self.say(heartbeat(custom_mode=HOLD, is_armed=is_armed, status=4))
        self.say(origin())
        self.say(home_position())
        self.say(self.position())
        self.wait(0.05)
        if custom_mode != HOLD:
            self.say(heartbeat(custom_mode=custom_mode, is_armed=is_armed, status=4))
        return self

    def position(self) -> Message:
        return local_position(round(1e3 * self.now_s), 0.0, 0.0, -20.0, 0.0, 0.0, 0.0)

    def of(self, kind: type[M]) -> list[M]:
        return [m for m in self.sent if isinstance(m, kind)]

    def _collect(self) -> list[Message]:
        sent: list[Message] = []
        for chunk in self.endpoint.take_output():
            self.raw.append(chunk)
            sent += self.reader.decode(chunk.data)
        self.sent += sent
        return sent
