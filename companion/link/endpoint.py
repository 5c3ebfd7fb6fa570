"""The companion as a MAVLink participant: bytes and time in, bytes out.

Link 0 leads to the autopilot; the others carry only ranging, because a real autopilot does not
forward our message. The endpoint decodes, filters, feeds the session, and encodes what the session
wants; what happened goes to a journal, which a shell writes to disk.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Literal, Protocol

import msgspec

from companion.domain import Autopilot, FlightMode
from companion.guidance.commands import (
    Announce,
    Arm,
    Command,
    Record,
    ReportResult,
    SendHeartbeat,
    SendSetpoint,
    SetMode,
    Severity,
    TakeOff,
    WithdrawRequest,
)
from companion.guidance.events import (
    AutopilotRestarted,
    ControlGranted,
    Event,
    RequestAnswered,
    RequestKind,
    StopRequested,
    TimerFired,
)
from companion.guidance.session import TICK_S, GuidanceSession
from companion.link import outbound
from companion.link.binding import AutopilotBinding
from companion.link.inbound import RangingInbound, VehicleInbound
from companion.link.px4_check import Px4FailsafeCheck
from companion.link.requests import RequestClient
from companion.link.streams import StreamRequester
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.params import Params

VEHICLE_LINK = 0
COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""191: what ground stations expect an onboard computer to be."""
RATE_WINDOW_S = 2.0
RECORD_PERIOD_S = 10.0
"""How often the health of the links goes to the event log."""
AddressedCommand = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message


class VehicleParams(Params, frozen=True):
    """Which autopilot, and how it is commanded."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one heard."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""


class Journal(Protocol):
    """Where the endpoint reports what happened; a shell writes it to disk."""

    def frame(self, data: bytes, now_s: float) -> None:
        """A raw frame that came in or went out on the vehicle link, or came in on another."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """A line for the event log."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """A text for the operator."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """The target is localised."""


class CompanionEndpoint:
    """The companion on the wire; implements `companion.mav.endpoint.Endpoint`.

    Args:
        session: The guidance.
        params: Which autopilot, and how it is commanded.
        journal: Where to report.
        links: Number of links, the vehicle's included.
    """

    def __init__(
        self, session: GuidanceSession, params: VehicleParams, journal: Journal, links: int = 1
    ) -> None:
        self.session = session
        self.binding = AutopilotBinding(params.system_id)
        self.setpoints_sent = 0
        self._params = params
        self._journal = journal
        self._codecs = [MavCodec(params.system_id or 1, COMPONENT_ID) for _ in range(links)]
        self._vehicle = VehicleInbound()
        self._ranging = RangingInbound()
        self._streams = StreamRequester()
        self._px4_check = Px4FailsafeCheck()
        self._requests = RequestClient()
        self._next_timer_s = -math.inf
        self._next_record_s = -math.inf
        self._text_id = 0
        self._setpoint_times_s: list[float] = []
        self._output: list[Chunk] = []

    # The Endpoint protocol

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived on a link."""
        messages = self._codecs[chunk.link].decode(chunk.data, is_datagram=chunk.is_datagram)
        for message in messages:
            if message.get_srcComponent() == COMPONENT_ID and self._is_own_system(message):
                continue  # our own frame, echoed by a router
            self._journal.frame(bytes(message.get_msgbuf()), now_s)
            if chunk.link == VEHICLE_LINK:
                self._receive_vehicle(message, chunk, now_s)
                if message.get_srcSystem() != self.binding.system_id:
                    continue  # what another vehicle's radio measures is not from our place
            vehicle_offset_s = self._vehicle.clock_offset_s
            for event in self._ranging.events(message, chunk.link, now_s, vehicle_offset_s):
                self._handle(event, now_s)

    def handle_timer(self, now_s: float) -> None:
        """The control tick; a late one is not made up for."""
        self._next_timer_s += TICK_S
        if self._next_timer_s <= now_s:
            self._next_timer_s = now_s + TICK_S
        answer = self._requests.due(now_s)
        if isinstance(answer, RequestAnswered):
            self._handle(answer, now_s)
        elif answer is not None:
            self._send(answer, now_s)
        if self.binding.is_bound:
            request = self._streams.due(now_s, *self._target_ids())
            request = request or self._px4_check.due(
                now_s, self.binding.autopilot, *self._target_ids()
            )
            if request is not None:
                self._send(request, now_s)
        self._handle(TimerFired(now_s, self.binding.heard_s), now_s)
        if now_s >= self._next_record_s:
            self._next_record_s = now_s + RECORD_PERIOD_S
            self._journal.record("link", self._link_record(now_s), now_s)
            self._journal.record("health", asdict(self.session.tracker.health), now_s)

    def next_timer_s(self) -> float:
        """When the next control tick is due."""
        return self._next_timer_s

    def take_output(self) -> list[Chunk]:
        """What is to be sent, in order; taken once."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        """Hand the vehicle back, then finish."""
        self._handle(StopRequested(now_s), now_s)

    @property
    def is_finished(self) -> bool:
        """Whether the vehicle was handed back."""
        return self.session.is_stopped

    # For views

    @property
    def bad_frames(self) -> int:
        """Frames that failed their CRC or could not be decoded, on all links."""
        return sum(codec.counters.bad_crc + codec.undecodable for codec in self._codecs)

    def setpoint_rate_hz(self, now_s: float) -> float:
        """Setpoints sent per second over the last two seconds."""
        recent = [t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S]
        return len(recent) / RATE_WINDOW_S

    def _link_record(self, now_s: float) -> dict[str, object]:
        """Counters of all links, and what became of the measurements."""
        tracker = self.session.tracker
        return {
            "links": [asdict(codec.counters) for codec in self._codecs],
            "undecodable": sum(codec.undecodable for codec in self._codecs),
            "strangers": self.binding.strangers,
            "setpoints": self.setpoints_sent,
            "setpoint_rate_hz": self.setpoint_rate_hz(now_s),
            "accepted": tracker.accepted,
            "refused": {reason.value: count for reason, count in tracker.refusals.items()},
            "restarts": tracker.restarts,
        }

    # Inbound

    def _is_own_system(self, message: Message) -> bool:
        return message.get_srcSystem() == self._codecs[VEHICLE_LINK].system_id

    def _receive_vehicle(self, message: Message, chunk: Chunk, now_s: float) -> None:
        was_bound = self.binding.is_bound
        is_autopilot = self.binding.admits(message, chunk.peer, now_s)
        if not was_bound and self.binding.is_bound:
            self._on_bound(now_s)
        if is_autopilot:
            self._streams.heard(message, now_s)
            warning = self._px4_check.heard(message)
            if warning is not None:
                self._announce(Announce(Severity.WARNING, warning), now_s)
            for event in self._vehicle.events(message, now_s):
                self._handle(event, now_s)
            self._receive_protocol(message, now_s)
        if isinstance(message, AddressedCommand):
            self._receive_command(message, chunk, now_s)

    def _on_bound(self, now_s: float) -> None:
        binding = self.binding
        for codec in self._codecs:
            codec.system_id = binding.system_id or 1
        self._journal.record(
            "bound",
            {"autopilot": binding.autopilot.value, "system_id": binding.system_id},
            now_s,
        )
        text = f"autopilot heard: {binding.autopilot.value}, system {binding.system_id}"
        self._journal.text(Severity.INFO, text, now_s)
        if binding.autopilot is Autopilot.OTHER:
            text = "unknown autopilot: only PX4 and ArduPilot modes are understood"
            self._journal.text(Severity.WARNING, text, now_s)

    def _receive_protocol(self, message: Message, now_s: float) -> None:
        match message:
            case mavlink.MAVLink_command_ack_message():
                if self._is_for_us(message.target_system, message.target_component):
                    answer = self._requests.answered(message, now_s)
                    if answer is not None:
                        self._handle(answer, now_s)
            case mavlink.MAVLink_statustext_message():
                text = _clean(message.text)
                self._journal.record("autopilot_text", {"text": text}, now_s)

    def _is_for_us(self, target_system: int, target_component: int) -> bool:
        own = self._codecs[VEHICLE_LINK]
        return target_system in (0, own.system_id) and target_component in (0, COMPONENT_ID)

    def _receive_command(self, message: AddressedCommand, chunk: Chunk, now_s: float) -> None:
        """A command to this very component: only the operator's grant is known."""
        own = (self._codecs[VEHICLE_LINK].system_id, COMPONENT_ID)
        if (message.target_system, message.target_component) != own:
            return
        if chunk.peer != self.binding.peer:
            return
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == mavlink.MAV_CMD_NAV_GUIDED_ENABLE:
            result = mavlink.MAV_RESULT_DENIED
            if message.param1 == 1.0:
                result = mavlink.MAV_RESULT_ACCEPTED
                self._handle(ControlGranted(now_s), now_s)
        self._send(outbound.command_ack(message.command, result, message), now_s)

    # Outbound

    def _handle(self, event: Event, now_s: float) -> None:
        if isinstance(event, AutopilotRestarted):
            self._streams.restart()
            self._requests.cancel()
        for command in self.session.handle(event):
            self._execute(command, now_s)

    def _execute(self, command: Command, now_s: float) -> None:
        match command:
            case SendHeartbeat():
                self._send(outbound.heartbeat(), now_s)
            case SendSetpoint():
                self._send_setpoint(command, now_s)
            case SetMode():
                self._ask_mode(command.mode, command.is_armed)
            case Arm():
                self._requests.submit(
                    RequestKind.ARM, lambda n: outbound.arm(*self._target_ids(), n)
                )
            case TakeOff():
                self._ask_take_off(command)
            case WithdrawRequest():
                self._requests.cancel()
            case Announce():
                self._announce(command, now_s)
            case ReportResult():
                self._journal.result(command, now_s)
            case Record():
                self._journal.record(command.kind, command.fields, now_s)

    def _target_ids(self) -> tuple[int, int]:
        return (self.binding.system_id or 1, self.binding.component_id)

    def _send(self, message: Message, now_s: float) -> None:
        data = self._codecs[VEHICLE_LINK].encode(message)
        self._journal.frame(data, now_s)
        self._output.append(Chunk(VEHICLE_LINK, data, self.binding.peer))

    def _send_setpoint(self, command: SendSetpoint, now_s: float) -> None:
        origin = self.session.vehicle.origin
        if self._params.setpoint == "local_ned":
            message = outbound.local_setpoint(command.setpoint, now_s, *self._target_ids())
        elif origin is not None:
            message = outbound.global_setpoint(command.setpoint, origin, now_s, *self._target_ids())
        else:
            return  # without an origin there is no global position to send
        self._send(message, now_s)
        self.setpoints_sent += 1
        self._setpoint_times_s.append(now_s)
        if self._setpoint_times_s[0] < now_s - 2.0 * RATE_WINDOW_S:
            self._setpoint_times_s = [
                t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S
            ]

    def _ask_mode(self, mode: FlightMode, is_armed: bool) -> None:
        autopilot = self.binding.autopilot
        self._requests.submit(
            RequestKind.SET_MODE,
            lambda n: outbound.set_mode(mode, autopilot, is_armed, *self._target_ids(), n),
        )

    def _ask_take_off(self, command: TakeOff) -> None:
        origin = self.session.vehicle.origin
        self._requests.submit(
            RequestKind.TAKE_OFF,
            lambda n: outbound.take_off(
                command.altitude_m,
                command.home_up_m,
                origin,
                self.binding.autopilot,
                *self._target_ids(),
                n,
            ),
        )

    def _announce(self, command: Announce, now_s: float) -> None:
        self._journal.text(command.severity, command.text, now_s)
        if not self.binding.is_bound:
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for message in outbound.status_text(command.severity.value, command.text, self._text_id):
            self._send(message, now_s)


def _clean(text: bytes | str) -> str:
    """A peer's text without control characters."""
    raw = text.decode("utf-8", errors="replace") if isinstance(text, bytes) else text
    return "".join(c if c.isprintable() else "?" for c in raw)
