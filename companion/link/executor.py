"""Events to the session, and the session's commands to messages and requests."""

from __future__ import annotations

from dataclasses import replace

from companion.domain import FlightMode
from companion.guidance.commands import (
    Announce,
    Arm,
    Command,
    Record,
    ReportResult,
    SendHeartbeat,
    SendSetpoint,
    SetMode,
    TakeOff,
    WithdrawRequest,
)
from companion.guidance.events import AutopilotRestarted, Event, RequestAnswered, RequestKind
from companion.guidance.session import GuidanceSession
from companion.link import outbound
from companion.link.binding import AutopilotBinding
from companion.link.dialogues import Dialogues
from companion.link.health import LinkHealth
from companion.link.journal import Journal
from companion.link.outlet import Outlet
from companion.link.params import VehicleParams
from companion.link.requests import RequestClient
from companion.mav.dialect import mavlink


class SessionExecutor:
    """Tells the session what happened and does what it wants.

    Args:
        session: The guidance.
        params: How the autopilot is commanded.
        binding: The autopilot.
        outlet: The way out.
        dialogues: What is asked beside the session's requests; begins anew after a restart.
        health: Of the line; begins anew, too.
        journal: Where to report.
    """

    def __init__(
        self,
        session: GuidanceSession,
        params: VehicleParams,
        binding: AutopilotBinding,
        outlet: Outlet,
        dialogues: Dialogues,
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
            ack: The message.
            now_s: When it came.
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
