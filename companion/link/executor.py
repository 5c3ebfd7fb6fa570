"""Executor: the autopilot's messages become events for the session, its commands messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from companion.domain import Autopilot
from companion.guidance import commands
from companion.guidance.events import (
    AutopilotFenceChanged,
    AutopilotFenceLimitsRead,
    AutopilotRestarted,
    Event,
    RequestAnswered,
    RequestKind,
)
from companion.guidance.session import GuidanceSession
from companion.link import outbound
from companion.link.autopilot_fence import FENCE_IDS, FenceMessage
from companion.link.autopilot_queries import AutopilotQueries
from companion.link.binding import AutopilotBinding
from companion.link.inbound import VehicleInbound
from companion.link.intake import RateLimit
from companion.link.interface import Journal, VehicleParams
from companion.link.outbound import Ids, RequestClient
from companion.link.outlet import Outlet
from companion.link.quality import LinkHealth
from companion.mav.codec import sender_of
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address
from companion.mav.payloads import is_for

OCCASIONAL = FENCE_IDS | {mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_STATUSTEXT}
"""Ids of messages that arrive as answers or occasionally."""
TEXTS_PER_S, TEXT_BURST = 10, 30
"""Rate and burst of the autopilot's texts in the log."""


class SessionExecutor:
    """Reports events to the session and executes its commands; restarts with the autopilot."""

    def __init__(
        self,
        session: GuidanceSession,
        params: VehicleParams,
        binding: AutopilotBinding,
        outlet: Outlet,
        queries: AutopilotQueries,
        health: LinkHealth,
        journal: Journal,
    ) -> None:
        self.session = session
        self.binding = binding
        self.outlet = outlet
        self.journal = journal
        self.inbound = VehicleInbound(queries.clock, queries.modes)
        self._params = params
        self._queries = queries
        self._health = health
        self.requests = RequestClient()
        self._text_limit = RateLimit(TEXTS_PER_S, TEXT_BURST)

    def handle(self, event: Event, now_s: float) -> None:
        """Pass an event to the session and execute the commands that follow."""
        if isinstance(event, AutopilotRestarted):
            self._queries.restart()
            self._health.sequence.restart()
            self.requests.cancel()
        for command in self.session.handle(event):
            self.execute(command, now_s)

    def send_request(self, now_s: float) -> None:
        """Send the request that is due, or abandon it."""
        due = self.requests.due(now_s)
        if isinstance(due, RequestAnswered):
            self.handle(due, now_s)
        elif due is not None:
            self.outlet.send(due, now_s)

    # What the autopilot says

    def bind(self, now_s: float) -> None:
        """Adopt the autopilot that was just bound, perhaps in place of another one."""
        bound = self.binding.bound
        assert bound is not None
        if self.binding.binds > 1:
            self.handle(self.inbound.begin_again(now_s), now_s)
        autopilot, system_id = bound.autopilot, bound.ids[0]
        self.outlet.adopt(system_id)
        kind = bound.vehicle_class.value
        fields = {"autopilot": autopilot.value, "class": kind, "system_id": system_id}
        self.journal.record("bound", fields, now_s)
        text = f"autopilot heard: {autopilot.value}, {kind}, system {system_id}"
        self.journal.text(commands.Severity.INFO, text, now_s)
        if autopilot is Autopilot.OTHER:
            text = "unknown autopilot: only PX4 and ArduPilot modes are supported"
            self.journal.text(commands.Severity.WARNING, text, now_s)

    def note_unread(
        self, sender: Ids, sequence: int, number: int, peer: Address | None, now_s: float
    ) -> None:
        """Note a frame that is not decoded: its sender, sequence and message id."""
        if self.binding.hear(sender, peer, now_s, sequence):
            if self._queries.stopper is not None:
                self._queries.stopper.hear(number, now_s)
            self._health.sequence.take(sequence, now_s)

    def note_unknown(self, frames: Sequence[bytes]) -> None:
        """Note frames of messages that the dialect lacks, whose checksum cannot be verified."""
        bound = self.binding.bound
        if bound is not None:
            self._health.sequence.exclude(sum(sender_of(frame) == bound.ids for frame in frames))

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of the autopilot."""
        header = message.get_header()
        order = self._health.sequence.take(header.seq, now_s)
        for text in self._queries.receive(message, now_s):
            self.outlet.announce(text, now_s)
        for event in self.inbound.events(message, now_s, order):
            self.handle(event, now_s)
        if header.msgId in OCCASIONAL:
            self._receive_occasional(message, order, now_s)

    def _receive_occasional(self, message: Message, order: int, now_s: float) -> None:
        """Process a message about the fence, an acknowledgement, or a text."""
        if isinstance(message, FenceMessage):
            queries, own_ids = self._queries, self.outlet.own_ids
            if queries.fence.notice(message, own_ids):
                self.handle(AutopilotFenceChanged(now_s), now_s)
            parameters = queries.fence_parameters
            if parameters.receive(message, self.binding.autopilot):
                self.handle(AutopilotFenceLimitsRead(now_s, parameters.limits), now_s)
            fence = queries.fence.receive(message, now_s, own_ids)
            if fence is not None:
                self.handle(fence, now_s)
        match message:
            case mavlink.MAVLink_command_ack_message() if is_for(message, self.outlet.own_ids):
                answer = self.requests.receive_ack(message, now_s)
                if answer is not None:
                    self.handle(replace(answer, order=order), now_s)
            case mavlink.MAVLink_statustext_message() if self._text_limit.acquire(now_s):
                raw = message.text
                words = raw.decode("utf-8", errors="replace") if isinstance(raw, bytes) else raw
                shown = "".join(c if c.isprintable() else "?" for c in words.rstrip())
                fields = {"text": shown, "dropped": self._text_limit.refused}
                self.journal.record("autopilot_text", fields, now_s)

    # What the session wants

    def execute(self, command: commands.Command, now_s: float) -> None:
        """Execute a command of the session."""
        match command:
            case commands.SendHeartbeat():
                self.outlet.broadcast(outbound.heartbeat(), now_s)
            case commands.SendSetpoint():
                self._send_setpoint(command, now_s)
            case commands.SetMode():
                autopilot = self.binding.autopilot
                order = outbound.set_mode(command.mode, autopilot, is_armed=command.is_armed)
                self.requests.submit(RequestKind.SET_MODE, order, self.outlet.target_ids)
            case commands.Arm():
                order = outbound.arm()
                self.requests.submit(RequestKind.ARM, order, self.outlet.target_ids)
            case commands.TakeOff():
                origin = self.session.vehicle.origin
                order = outbound.take_off(command, origin, self.binding.autopilot)
                self.requests.submit(RequestKind.TAKE_OFF, order, self.outlet.target_ids)
            case commands.WithdrawRequest():
                self.requests.cancel()
            case commands.Announce():
                self.outlet.announce(command, now_s)
            case commands.ReportResult():
                self.journal.result(command, now_s)
            case commands.Record():
                self.journal.record(command.kind, command.fields, now_s)

    def _send_setpoint(self, command: commands.SendSetpoint, now_s: float) -> None:
        origin, ids = self.session.vehicle.origin, self.outlet.target_ids
        if self._params.setpoint == "local_ned":
            message = outbound.local_setpoint(command.setpoint, now_s, ids)
        elif origin is not None:
            message = outbound.global_setpoint(command.setpoint, origin, now_s, ids)
        else:
            return  # without an origin there is no global position to send
        self.outlet.send_setpoint(message, now_s)
