"""The companion as a MAVLink participant: bytes and time in, bytes out.

Link 0 leads to the autopilot; the next ones carry only ranging, because a real autopilot does not
forward our message, and the last ones lead to ground stations. The endpoint only joins its parts:
`executor` sorts what the vehicle link brings, tells the session and does what it wants,
`autopilot_queries` ask for streams and parameters, `gcs_services` answer ground stations, `outlet`
is the one way out, `quality` keeps the books. What happened goes to a journal, which a shell writes
to disk.

On the way in, `intake` keeps to a budget, has proved what can be proved before anything is decoded,
and tells the operator what was refused.
"""

from __future__ import annotations

import math

from companion.guidance.events import (
    ControlStalled,
    EarlierRunFound,
    IdConflictHeard,
    MemoryRecalled,
    OperatorAsked,
    OperatorCommand,
    SessionMemory,
    StopRequested,
    TimerFired,
)
from companion.guidance.session import GuidanceSession
from companion.link.autopilot_queries import AutopilotQueries
from companion.link.binding import AutopilotBinding, LinkParams, VehicleParams
from companion.link.executor import SessionExecutor, VehicleReceiver
from companion.link.gcs_services import (
    AddressedCommand,
    CommandHandler,
    ParameterServer,
    ParamRequest,
    TunableBook,
)
from companion.link.inbound import RangingInbound, RangingMessage
from companion.link.intake import Authenticity, FloodShield, Intake, LinkAlarms
from companion.link.outlet import COMPONENT_ID, VEHICLE_LINK, Outlet
from companion.link.presence import Presence
from companion.link.quality import LinkCounters, LinkHealth
from companion.link.recorders import InputRecorder, Journal, NoRecorder
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message
from companion.mav.endpoint import Address, Chunk
from companion.mav.signing import Signing

__all__ = ["COMPONENT_ID", "VEHICLE_LINK", "CompanionEndpoint", "Journal", "VehicleParams"]


class CompanionEndpoint:
    """The companion on the wire; implements `companion.mav.endpoint.Endpoint`.

    Args:
        params: Which autopilot, and how it is commanded.
        links: Number of links, the vehicle's included.
        tunables: The parameters that ground stations may change.
        gcs_links: How many of the links, the last ones, lead to ground stations.
        signing: Proves what arrives and signs what leaves; None: neither.
        started_unix_s: Unix time at `now_s` = 0, for the timestamps of signatures.
        recorder: Keeps what the endpoint is told, so that the flight can be run again.
    """

    def __init__(
        self,
        session: GuidanceSession,
        params: VehicleParams,
        journal: Journal,
        links: int = 1,
        link_params: LinkParams | None = None,
        *,
        tunables: TunableBook,
        gcs_links: int = 0,
        signing: Signing | None = None,
        started_unix_s: float = 0.0,
        recorder: InputRecorder | None = None,
    ) -> None:
        link_params = link_params or LinkParams()
        self.session = session
        self.binding = AutopilotBinding(params.system_id, is_keyed=signing is not None)
        self._journal = journal
        self._recorder = recorder or NoRecorder()
        self.authenticity = Authenticity(signing, started_unix_s)
        self._intakes = [self._make_intake(number, params, link_params) for number in range(links)]
        self._alarms = LinkAlarms(self.binding, self._intakes)
        self._shield = FloodShield(self._intakes[VEHICLE_LINK], self.binding)
        codecs = [intake.codec for intake in self._intakes]
        self._gcs_links = range(links - gcs_links, links)
        self._outlet = Outlet(codecs, self.binding, journal, self._gcs_links)
        self._dialogues = AutopilotQueries(self.binding, session.fencing)
        self._health = LinkHealth(link_params)
        self.executor = SessionExecutor(
            session, params, self.binding, self._outlet, self._dialogues, self._health, journal
        )
        self._parameters = ParameterServer(
            tunables, session, self.binding, self.executor, self._outlet, journal
        )
        self._presence = Presence(session, self._outlet, has_icon=link_params.gcs_icon)
        self._commands = CommandHandler(self.executor, self._parameters, self._outlet)
        self._receiver = VehicleReceiver(
            self.binding,
            self.executor,
            self._dialogues,
            self._health,
            self._outlet,
            journal,
        )
        self._ranging = RangingInbound()
        self._counters = LinkCounters(
            session,
            self._intakes,
            self.binding,
            self._health,
            self.authenticity,
            self._outlet,
            journal,
        )
        self._next_timer_s = -math.inf

    def _make_intake(self, number: int, params: VehicleParams, link_params: LinkParams) -> Intake:
        """The way in of a link, with a codec that proves and signs where there is a key."""
        is_vehicle = number == VEHICLE_LINK
        is_trusted = not is_vehicle and link_params.unsigned_ranging
        signing = self.authenticity.of_link(number, is_trusted=is_trusted)
        codec = MavCodec(params.system_id or 1, COMPONENT_ID, signing)
        return Intake(codec, self.binding if is_vehicle else None)

    # The Endpoint protocol

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived on a link."""
        self.authenticity.advance(now_s)
        for message in self._intakes[chunk.link].take(chunk):
            self._receive_message(message, chunk, now_s)

    def handle_timer(self, now_s: float) -> None:
        """The control tick; a late one is not made up for."""
        self._recorder.tick(now_s)
        self._shield.tick(now_s)
        for intake in self._intakes:
            intake.budget.renew()
        news = (
            *self.authenticity.tick(now_s),
            *self._alarms.tick(now_s),
            *self._dialogues.news(now_s),
        )
        for text in news:
            self._outlet.announce(text, now_s)
        stalled_s = self._health.tick(now_s)
        if stalled_s is not None:
            self._dialogues.ask_mode()
            self.executor.handle(ControlStalled(now_s, stalled_s), now_s)
        period_s = self._health.pacing.period_s
        self._next_timer_s += period_s
        if self._next_timer_s <= now_s:
            self._next_timer_s = now_s + period_s
        self.executor.tick(now_s)
        given_up = self._dialogues.fence_given_up(now_s)
        if given_up is not None:
            self.executor.handle(given_up, now_s)
        is_mode_wanted = self.session.vehicle.wants_mode(now_s)
        for question in self._dialogues.due(now_s, is_mode_wanted=is_mode_wanted):
            self._outlet.send(question, now_s, can_be_spared=True)
        self.executor.handle(TimerFired(now_s, self.binding.heard_s), now_s)
        self._parameters.tick(now_s)
        self._presence.tick(now_s)
        self._counters.report(now_s)

    def next_timer_s(self) -> float:
        """When the next control tick is due."""
        return self._next_timer_s

    def take_output(self) -> list[Chunk]:
        """What is to be sent, in order; taken once."""
        return self._outlet.take()

    def sole_peer(self, now_s: float) -> Address | None:
        """Whom alone to hear on the vehicle link, in a flood; None: everybody."""
        return self._shield.sole_peer(now_s)

    def request_stop(self, now_s: float) -> None:
        """Hand the vehicle back, then finish."""
        self._recorder.stop(now_s)
        self.executor.handle(StopRequested(now_s), now_s)

    def ask(self, command: OperatorCommand, now_s: float) -> None:
        """Take in what the operator asks for beside the mode switch."""
        self._recorder.operator_command(command, now_s)
        self.executor.handle(OperatorAsked(now_s, command), now_s)

    def found_earlier_run(self, now_s: float) -> None:
        """An earlier process of ours did not end in order."""
        self._recorder.earlier_run(now_s)
        self.executor.handle(EarlierRunFound(now_s), now_s)

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """Take up what that process knew `age_s` ago."""
        self._recorder.recall(memory, age_s, now_s)
        self.executor.handle(MemoryRecalled(now_s, memory, age_s), now_s)

    @property
    def is_finished(self) -> bool:
        """Whether the vehicle was handed back."""
        return self.session.is_stopped

    # For views

    @property
    def bad_frames(self) -> int:
        """Frames that failed their CRC or could not be decoded, on all links."""
        return self._counters.bad_frames

    @property
    def dropped_unread(self) -> int:
        """Datagrams, frames and messages that were over a budget, on all links."""
        return self._counters.dropped_unread

    @property
    def setpoints_sent(self) -> int:
        """Setpoints sent so far."""
        return self._outlet.setpoints_sent

    def setpoint_rate_hz(self, now_s: float) -> float:
        """Setpoints sent per second over the last two seconds."""
        return self._outlet.setpoint_rate_hz(now_s)

    # Inbound

    def _receive_message(self, message: Message, chunk: Chunk, now_s: float) -> None:
        frame = bytes(message.get_msgbuf())
        self._recorder.frame(frame, chunk.link, chunk.peer, now_s)
        if (message.get_srcSystem(), message.get_srcComponent()) == self._outlet.own_ids:
            is_twin = self.authenticity.is_proved(frame) and self._outlet.came_back(frame, now_s)
            if is_twin:
                self.executor.handle(IdConflictHeard(now_s), now_s)
            return
        if chunk.link == VEHICLE_LINK:
            self._receive_on_vehicle_link(message, frame, chunk, now_s)
        elif chunk.link in self._gcs_links:
            self._journal.frame(frame, now_s)
            self._receive_of_station(message, now_s, may_grant=False)
        else:
            self._journal.frame(frame, now_s)
            self._receive_ranging(message, chunk.link, now_s)

    def _receive_on_vehicle_link(
        self, message: Message, frame: bytes, chunk: Chunk, now_s: float
    ) -> None:
        """The log has room for the vehicle and whoever has the key, not for every stranger."""
        binding = self.binding
        if binding.is_keyed or not binding.is_bound or chunk.peer == binding.peer:
            self._journal.frame(frame, now_s)
        if not self.authenticity.is_proved(frame):
            return
        self._receiver.receive(message, chunk.peer, now_s)
        if chunk.peer == binding.peer:
            self._receive_of_station(message, now_s, may_grant=True)
        is_here = message.get_srcSystem() == binding.system_id
        if is_here and (binding.is_keyed or chunk.peer == binding.peer):
            self._receive_ranging(message, chunk.link, now_s)

    def _receive_of_station(self, message: Message, now_s: float, *, may_grant: bool) -> None:
        """What ground stations may ask of us, directly or by way of the autopilot."""
        if not self.binding.is_bound:
            return
        if isinstance(message, ParamRequest):
            self._parameters.receive(message, now_s)
        elif isinstance(message, AddressedCommand):
            self._commands.receive(message, now_s, may_grant=may_grant)

    def _receive_ranging(self, message: Message, link: int, now_s: float) -> None:
        if not isinstance(message, RangingMessage):
            return
        offset_s = self._receiver.clock_offset_s
        for event in self._ranging.events(message, link, now_s, offset_s):
            self.executor.handle(event, now_s)
