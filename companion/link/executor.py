"""Between the vehicle link and the session: events in, commands out to messages and requests.

What the vehicle link receives, the autopilot's messages and its answers, is sorted here, too.
"""

from __future__ import annotations

from dataclasses import replace

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
from companion.guidance.events import AutopilotRestarted, Event, RequestAnswered, RequestKind
from companion.guidance.session import GuidanceSession
from companion.link import outbound
from companion.link.autopilot_queries import AutopilotQueries
from companion.link.binding import AutopilotBinding, VehicleParams
from companion.link.inbound import VehicleInbound
from companion.link.intake import RateLimit
from companion.link.outbound import RequestClient
from companion.link.outlet import Outlet
from companion.link.quality import LinkHealth
from companion.link.recorders import Journal
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address


class SessionExecutor:
    """Tells the session what happened and does what it wants.

    Args:
        dialogues: What is asked beside the session's requests; begins anew after a restart.
        health: Of the line; begins anew, too.
    """

    def __init__(
        self,
        session: GuidanceSession,
        params: VehicleParams,
        binding: AutopilotBinding,
        outlet: Outlet,
        dialogues: AutopilotQueries,
        health: LinkHealth,
        journal: Journal,
    ) -> None:
        self._session = session
        self._params = params
        self._binding = binding
        self._outlet = outlet
        self._dialogues = dialogues
        self._health = health
        self._journal = journal
        self._requests = RequestClient()

    @property
    def may_engage(self) -> bool:
        """Whether nothing that is known already forbids it: a fence that was refused does."""
        return self._session.fencing.refusal is None

    def handle(self, event: Event, now_s: float) -> None:
        """Give an event to the session and execute what follows from it."""
        if isinstance(event, AutopilotRestarted):
            self._dialogues.restart()
            self._health.restart()
            self._requests.cancel()
        for command in self._session.handle(event):
            self.execute(command, now_s)

    def answered(
        self,
        ack: mavlink.MAVLink_command_ack_message,
        now_s: float,
        order: int | None = None,
    ) -> None:
        """Take in an ACK of the autopilot that is for us.

        Args:
            order: Of its frame among the autopilot's, if that is known.
        """
        answer = self._requests.answered(ack, now_s)
        if answer is not None:
            self.handle(replace(answer, order=order), now_s)

    def tick(self, now_s: float) -> None:
        """Send the request that is due, or give it up."""
        due = self._requests.due(now_s)
        if isinstance(due, RequestAnswered):
            self.handle(due, now_s)
        elif due is not None:
            self._outlet.send(due, now_s)

    def execute(self, command: Command, now_s: float) -> None:
        """Do what the session wants."""
        match command:
            case SendHeartbeat():
                self._outlet.broadcast(outbound.heartbeat(), now_s)
            case SendSetpoint():
                self._send_setpoint(command, now_s)
            case SetMode():
                self._ask_mode(command.mode, command.is_armed)
            case Arm():
                ids = self._outlet.target_ids
                self._requests.submit(RequestKind.ARM, lambda n: outbound.arm(*ids, n))
            case TakeOff():
                self._ask_take_off(command)
            case WithdrawRequest():
                self._requests.cancel()
            case Announce():
                self._outlet.announce(command, now_s)
            case ReportResult():
                self._journal.result(command, now_s)
            case Record():
                self._journal.record(command.kind, command.fields, now_s)

    def _send_setpoint(self, command: SendSetpoint, now_s: float) -> None:
        origin, ids = self._session.vehicle.origin, self._outlet.target_ids
        if self._params.setpoint == "local_ned":
            message = outbound.local_setpoint(command.setpoint, now_s, *ids)
        elif origin is not None:
            message = outbound.global_setpoint(command.setpoint, origin, now_s, *ids)
        else:
            return  # without an origin there is no global position to send
        self._outlet.send_setpoint(message, now_s)

    def _ask_mode(self, mode: FlightMode, is_armed: bool) -> None:
        autopilot, ids = self._binding.autopilot, self._outlet.target_ids
        self._requests.submit(
            RequestKind.SET_MODE,
            lambda n: outbound.set_mode(mode, autopilot, is_armed, *ids, n),
        )

    def _ask_take_off(self, command: TakeOff) -> None:
        origin, autopilot = self._session.vehicle.origin, self._binding.autopilot
        ids = self._outlet.target_ids
        self._requests.submit(
            RequestKind.TAKE_OFF,
            lambda n: outbound.take_off(
                command.altitude_m, command.home_up_m, origin, autopilot, *ids, n
            ),
        )


TEXTS_PER_S, TEXT_BURST = 10, 30
"""Texts of the autopilot that go to the log."""


class VehicleReceiver:
    """Sorts what arrives on the vehicle link."""

    def __init__(
        self,
        binding: AutopilotBinding,
        executor: SessionExecutor,
        dialogues: AutopilotQueries,
        health: LinkHealth,
        outlet: Outlet,
        journal: Journal,
    ) -> None:
        self._binding = binding
        self._executor = executor
        self._dialogues = dialogues
        self._health = health
        self._outlet = outlet
        self._journal = journal
        self._inbound = VehicleInbound(dialogues.clock)
        self._text_limit = RateLimit(TEXTS_PER_S, TEXT_BURST)

    @property
    def clock_offset_s(self) -> float | None:
        """Local time minus the autopilot's, seconds; None before its first stamp."""
        return self._inbound.clock_offset_s

    def receive(self, message: Message, peer: Address | None, now_s: float) -> None:
        """Take in a message of anyone but ourselves."""
        was_bound = self._binding.is_bound
        is_autopilot = self._binding.admits(message, peer, now_s)
        if not was_bound and self._binding.is_bound:
            self._on_bound(now_s)
        if is_autopilot:
            number = self._health.heard(message, now_s)
            for text in self._dialogues.heard(message, now_s):
                self._outlet.announce(text, now_s)
            events = self._inbound.events(message, now_s, number)
            self._health.overtaken = self._inbound.overtaken
            for event in events:
                self._executor.handle(event, now_s)
            fence = self._dialogues.fence_heard(message, now_s, self._outlet.own_ids)
            if fence is not None:
                self._executor.handle(fence, now_s)
            self._receive_answer(message, now_s, number)

    def _on_bound(self, now_s: float) -> None:
        binding, system_id = self._binding, self._binding.system_id or 1
        self._outlet.adopt(system_id)
        self._journal.record(
            "bound", {"autopilot": binding.autopilot.value, "system_id": system_id}, now_s
        )
        text = f"autopilot heard: {binding.autopilot.value}, system {system_id}"
        self._journal.text(Severity.INFO, text, now_s)
        if binding.autopilot is Autopilot.OTHER:
            text = "unknown autopilot: only PX4 and ArduPilot modes are understood"
            self._journal.text(Severity.WARNING, text, now_s)

    def _receive_answer(self, message: Message, now_s: float, order: int | None) -> None:
        match message:
            case mavlink.MAVLink_command_ack_message():
                if self._is_for_us(message.target_system, message.target_component):
                    self._executor.answered(message, now_s, order)
            case mavlink.MAVLink_statustext_message():
                if self._text_limit.allows(now_s):
                    text = {"text": _clean(message.text), "dropped": self._text_limit.refused}
                    self._journal.record("autopilot_text", text, now_s)

    def _is_for_us(self, target_system: int, target_component: int) -> bool:
        system_id, component_id = self._outlet.own_ids
        return target_system in (0, system_id) and target_component in (0, component_id)


def _clean(text: bytes | str) -> str:
    """A peer's text without control characters."""
    raw = text.decode("utf-8", errors="replace") if isinstance(text, bytes) else text
    return "".join(c if c.isprintable() else "?" for c in raw)
