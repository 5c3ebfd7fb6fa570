"""The companion as a MAVLink endpoint: bytes and time in, bytes out.

The endpoint only joins its parts. On the way in there are two stages before guidance. The intake of
a link enforces a budget and verifies signatures before anything is decoded. Then the role of the
link decides: the autopilot's messages become events (`inbound`, by way of the `executor`, which
passes them to the session and executes its commands), a ranging source turns bytes into
measurements, and ground stations are answered (`gcs_services`). `autopilot_queries` request streams
and parameters, `outlet` is the only way out, `quality` monitors the line. Events go to a journal,
which a shell writes to disk.
"""

from __future__ import annotations

import math
from dataclasses import asdict

from companion.domain import RangingMeasurement
from companion.guidance import events
from companion.guidance.messages import health_fields
from companion.guidance.phases import HAS_VEHICLE, Phase
from companion.guidance.session import GuidanceSession
from companion.link.autopilot_queries import AutopilotQueries, request_message
from companion.link.binding import AutopilotBinding
from companion.link.executor import SessionExecutor
from companion.link.gcs_services import (
    AddressedCommand,
    CommandHandler,
    ParameterServer,
    ParamRequest,
    StationRequest,
    TunableBook,
)
from companion.link.inbound import TIMESYNC, UNREAD, is_time_request
from companion.link.intake import HEARTBEAT, Authenticity, FloodShield, Intake
from companion.link.interface import EndpointParams, InputRecorder, Journal, LinkRole, LinkSpec
from companion.link.outbound import Ids
from companion.link.outlet import COMPONENT_ID, NAMED_VALUE_FLOAT, ONBOARD_IDS, Outlet
from companion.link.presence import Presence
from companion.link.quality import LinkAlarms, LinkHealth, RadioWatch
from companion.link.radio_stage import RadioStage
from companion.link.ranging_sources import (
    RANGING_IDS,
    MavlinkRanging,
    RangingMessage,
    RangingSource,
)
from companion.mav.codec import MavCodec, header_of
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import is_signed

__all__ = ["COMPONENT_ID", "CompanionEndpoint", "Journal"]

_NAMES = ("DO_REPOSITION", "OVERRIDE_GOTO", "DO_CHANGE_ALTITUDE", "DO_ORBIT")
FLIGHT_COMMANDS = {getattr(mavlink, f"MAV_CMD_{name}"): name for name in _NAMES}
"""Commands by which a ground station sends a vehicle somewhere."""
SIGNS = (
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
)
"""Messages that are requested from an address that may be the autopilot's now."""
PAUSE_S = 0.001
"""Interval between two wake-ups for deferred work: the links are read in between."""
CHECK_PERIOD_S = 1.0
"""Interval at which counters and clocks of the links are checked for something to announce."""
RECORD_PERIOD_S = 10.0
"""Interval of the link health in the event log."""


class CompanionEndpoint:
    """Companion on the wire; implements `companion.mav.endpoint.Endpoint`.

    The `recorder` keeps all inputs of the endpoint, so that the flight can be replayed.
    """

    def __init__(
        self,
        session: GuidanceSession,
        params: EndpointParams,
        journal: Journal,
        *,
        tunables: TunableBook,
        authenticity: Authenticity | None = None,
        recorder: InputRecorder | None = None,
    ) -> None:
        self.session, self._params = session, params
        self._journal, self._recorder = journal, recorder
        self.authenticity = authenticity or Authenticity()
        self.binding = AutopilotBinding(params.vehicle.system_id, is_keyed=self.authenticity.is_on)
        links = list(enumerate(params.links))
        (self._vehicle_link,) = (n for n, link in links if link.role is LinkRole.VEHICLE)
        self._intakes = [self._make_intake(*each) for each in links]
        self._alarms = LinkAlarms(self.binding, self._intakes)
        self.shield = FloodShield(self._intakes[self._vehicle_link], self.binding)
        codecs = [(link.role, self._intakes[n].codec) for n, link in links]
        self.outlet = Outlet(codecs, self.binding, journal, params.link.downlink_bytes_s)
        self._queries = AutopilotQueries(
            self.binding, session.fencing, stops_unread=params.link.stop_unread_streams
        )
        self._health = LinkHealth(params.link)
        self.executor = SessionExecutor(
            session, params.vehicle, self.binding, self.outlet, self._queries, self._health, journal
        )
        self._parameters = ParameterServer(tunables, self.executor)
        self._commands = CommandHandler(self.executor, self._parameters)
        self._presence = Presence(session, self.outlet, has_icon=params.link.gcs_icon)
        self._vehicle_ranging = self._mavlink_ranging(self._vehicle_link)
        self._sources: dict[int, RangingSource] = {
            n: self._mavlink_ranging(n) if link.radio is None else RadioStage(link.radio)
            for n, link in links
            if link.role is LinkRole.RANGING
        }
        """Sources of the ranging links, of MAVLink or of a radio's own format."""
        sources = self._sources.values()
        self.radios = tuple(RadioWatch(each) for each in sources if isinstance(each, RadioStage))
        """Radios in the order of their links."""
        self._noted_binding: tuple[int, str | None] = (0, None)
        """Number of bindings and problem of the binding, as reported to the session."""
        self.ticks = 0
        self._texts = 0
        """Number of texts sent until the end of the last one."""
        self.next_tick_s = -math.inf
        self._woken_s = self._next_check_s = self._next_record_s = -math.inf

    def _make_intake(self, number: int, link: LinkSpec) -> Intake:
        """Return the intake of a link, with a codec that signs and verifies if there is a key."""
        params = self._params
        is_open = link.role is LinkRole.RANGING and params.link.unsigned_ranging
        signing = self.authenticity.of_link(number, RANGING_IDS if is_open else frozenset())
        component_id = params.link.component_id or COMPONENT_ID
        is_vehicle = link.role is LinkRole.VEHICLE
        own = (params.vehicle.system_id or 1, component_id)
        codec = MavCodec(*own, signing, keeps_unknown=is_vehicle)
        binding = self.binding if is_vehicle else None
        return Intake(codec, binding, is_raw=link.radio is not None)

    def _mavlink_ranging(self, number: int) -> MavlinkRanging:
        """Return the source of MAVLink ranging on a link."""
        return MavlinkRanging(self._intakes[number].codec, self.executor.inbound.clock)

    # The Endpoint protocol

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process bytes that arrived on a link."""
        if self.authenticity.is_on:
            self.authenticity.advance(now_s)
        intake = self._intakes[chunk.link]
        data = intake.take(chunk)
        if chunk.link == self._vehicle_link and (unknown := intake.codec.splitter.take_unknown()):
            self._note_unknown(unknown, chunk, now_s)
        for frame in () if intake.is_raw else data:
            if self._recorder is not None:
                self._recorder.frame(frame, chunk.link, chunk.peer, now_s)
            header, outlet = header_of(frame), self.outlet
            _, sender, number = header
            is_proved = not self.authenticity.is_on or is_signed(frame)
            is_ours = sender == outlet.own_ids
            may_be_rival = is_ours or sender[1] in ONBOARD_IDS or number == NAMED_VALUE_FLOAT
            if (may_be_rival and is_proved) and outlet.note_sender(
                frame, sender, number, now_s, self._may_move_aside
            ):
                self.executor.handle(events.IdConflictHeard(now_s), now_s)
            if is_ours:
                continue
            if chunk.link == self._vehicle_link:
                self._receive_on_vehicle_link(frame, header, chunk, now_s, is_proved=is_proved)
            else:
                self._receive_beside(frame, chunk.link, now_s)
        for bytes_of_radio in data if intake.is_raw else ():
            if self._recorder is not None:
                self._recorder.raw(bytes_of_radio, chunk.link, chunk.peer, now_s)
            self.session.searching.is_radio_heard = True
            source = self._sources[chunk.link]
            self._report_ranging(source.receive(bytes_of_radio, now_s), now_s)

    def _note_unknown(self, frames: list[bytes], chunk: Chunk, now_s: float) -> None:
        """Note frames of messages that the dialect lacks, for the loss of the link."""
        if chunk.peer != self.binding.peer:
            return  # a stranger's frames would only fill the log
        if self._recorder is not None:
            for frame in frames:
                self._recorder.frame(frame, chunk.link, chunk.peer, now_s)
        self.executor.note_unknown(frames)

    def handle_timer(self, now_s: float) -> None:
        """Run the control tick, without making up for a late one; before it is due, deferred work.

        So the setpoint of a tick is sent before anything is estimated.
        """
        if self._recorder is not None:
            self._recorder.tick(now_s)
        self._woken_s = now_s
        if now_s < self.next_tick_s and self.session.is_behind:
            self.executor.handle(events.TimeLeft(now_s), now_s)
            return
        self.ticks += 1
        if self.authenticity.is_on:
            self.authenticity.advance(now_s)
        self._note_control(now_s)
        self._note_binding(now_s)
        for intake in self._intakes:
            intake.budget.renew()
        if now_s >= self._next_check_s:
            self._next_check_s = now_s + CHECK_PERIOD_S
            self._announce_link_state(now_s)
        for radio in self.radios:
            for text in radio.tick(now_s):
                self.outlet.announce(text, now_s)
        stalled_s = self._health.tick(now_s)
        if stalled_s is not None:
            self._queries.ask_mode()
            self.executor.handle(events.ControlStalled(now_s, stalled_s), now_s)
        period_s = self._health.pacing.period_s
        self.next_tick_s += period_s
        if self.next_tick_s <= now_s:
            self.next_tick_s = now_s + period_s
        self._ask_autopilot(now_s)
        self.executor.handle(events.TimerFired(now_s, self.binding.heard_s), now_s)
        self._send_after_setpoint(now_s)

    def _send_after_setpoint(self, now_s: float) -> None:
        """Send parameters and reports that are due, and record the state."""
        if self._parameters.next_listed is not None:
            self._parameters.send_listed(now_s)
        phase = self.session.authority.phase
        if phase is not self._presence.phase or now_s >= self._presence.next_s:
            self._presence.report(now_s, has_text=self.outlet.texts_sent > self._texts)
        self._texts = self.outlet.texts_sent
        if now_s >= self._next_record_s:
            self._next_record_s = now_s + RECORD_PERIOD_S
            self._journal.record("link", self._link_record(now_s), now_s)
            self._journal.record("health", health_fields(self.session.tracker, now_s), now_s)
            for number, radio in enumerate(self.radios):
                self._journal.record("radio", {"number": number, **radio.record(now_s)}, now_s)

    def _announce_link_state(self, now_s: float) -> None:
        """Announce changes on the links, and withheld texts that still apply."""
        signing, links = self.authenticity.texts(now_s), self._alarms.texts(now_s)
        ranging = [
            text
            for source in (self._vehicle_ranging, *self._sources.values())
            if isinstance(source, MavlinkRanging)
            for text in source.texts(now_s)
        ]
        streams = () if self.binding.is_doubted else self._queries.new_texts(now_s)
        for text in (*signing, *links, *ranging, *streams):
            self.outlet.announce(text, now_s)
        self.outlet.announce_due(now_s)

    def next_timer_s(self) -> float:
        """Return the time of the next control tick, or of deferred work before it."""
        if self.session.is_behind:
            return min(self.next_tick_s, self._woken_s + PAUSE_S)
        return self.next_tick_s

    def take_output(self) -> list[Chunk]:
        """Return the chunks to be sent, in order; each is returned once."""
        return self.outlet.take()

    def request_stop(self, now_s: float) -> None:
        """Hand the vehicle back, then finish."""
        self.handle_event(events.StopRequested(now_s))

    def handle_event(self, event: events.Event) -> None:
        """Process an event from the process or the operator, besides the mode switch."""
        if self._recorder is not None:
            self._recorder.event(event)
        if isinstance(event, events.UncleanExitFound) and event.vehicle is not None:
            self.binding.expect(event.vehicle, event.time_s)
        self.executor.handle(event, event.time_s)

    @property
    def is_finished(self) -> bool:
        """True if the vehicle was handed back."""
        return self.session.is_stopped

    # For views

    @property
    def good_frames(self) -> int:
        """MAVLink frames with a right CRC, on all links."""
        return sum(intake.codec.counters.good for intake in self._intakes)

    @property
    def bad_frames(self) -> int:
        """Frames that failed their CRC or could not be decoded, on all links."""
        codecs = [intake.codec for intake in self._intakes]
        return sum(codec.counters.bad_crc + codec.undecodable for codec in codecs)

    @property
    def dropped_unread(self) -> int:
        """Datagrams, frames and messages over a budget, on all links."""
        return sum(intake.budget.dropped_unread for intake in self._intakes)

    # On the way in

    def _report_ranging(self, measurements: list[RangingMeasurement], now_s: float) -> None:
        for measurement in measurements:
            for command in self.session.handle(events.RangingReceived(now_s, measurement)):
                self.executor.execute(command, now_s)

    def _receive_beside(self, frame: bytes, link: int, now_s: float) -> None:
        """Process a frame on a link of ranging or of ground stations."""
        self._journal.frame(frame, now_s)
        source = self._sources.get(link)
        if source is not None:
            self._report_ranging(source.receive(frame, now_s), now_s)
        else:
            message = self._intakes[link].codec.decode_proved(frame)
            self._serve_station(message, now_s, may_grant=False)

    def _receive_on_vehicle_link(
        self,
        frame: bytes,
        header: tuple[int, Ids, int],
        chunk: Chunk,
        now_s: float,
        *,
        is_proved: bool,
    ) -> None:
        """Process a frame on the vehicle link; the log has no room for every unknown peer's.

        With a key, an unsigned frame is not evidence about the autopilot.
        """
        binding, peer, (sequence, sender, number) = self.binding, chunk.peer, header
        is_peer = peer == binding.peer
        if is_peer or binding.is_keyed or binding.bound is None:
            self._journal.frame(frame, now_s)
        if number in UNREAD or (number == TIMESYNC and is_time_request(frame)):
            if is_proved:
                self.executor.note_unread(sender, sequence, number, peer, now_s)
            return
        message, bound = self._intakes[chunk.link].codec.decode_proved(frame), binding.bound
        if message is None or not is_proved:
            return
        is_autopilot = bound is None or sender == bound.ids or number == HEARTBEAT
        is_ours = is_autopilot and binding.recognise(message, peer, now_s)
        if (binding.binds, binding.problem) != self._noted_binding:
            self._note_binding(now_s)
        if is_ours:
            phase = self.session.authority.phase
            self.executor.receive(message, now_s)
            if self.session.authority.phase is not phase:
                self._note_control(now_s)
        is_peer, bound = peer == binding.peer, binding.bound
        is_here = bound is not None and sender[0] == bound.ids[0] and (binding.is_keyed or is_peer)
        if number in RANGING_IDS and is_here and isinstance(message, RangingMessage):
            self._report_ranging(self._vehicle_ranging.measure(message, now_s), now_s)
        elif is_peer and isinstance(message, StationRequest):
            self._serve_station(message, now_s, may_grant=True)
            self._note_other_command(message, now_s)

    def _may_move_aside(self) -> bool:
        """True if the component id may change: not configured, and no vehicle in control."""
        is_before = self.session.phase in (Phase.WAITING, Phase.STANDBY)
        is_free = self._params.link.component_id is None and not self.binding.is_committed
        return is_free and is_before

    def _note_control(self, now_s: float) -> None:
        """Report to the binding whether the companion is in control."""
        phase, is_armed = self.session.authority.phase, self.session.vehicle.is_armed
        has_vehicle = phase in HAS_VEHICLE or phase is Phase.LAUNCHING
        self.binding.note_control(now_s, is_in_control=has_vehicle, is_armed=is_armed)

    def _note_binding(self, now_s: float) -> None:
        """Report to the session which autopilot is bound now, and any doubt about it."""
        binding, (binds, problem) = self.binding, self._noted_binding
        self._noted_binding = binding.binds, binding.problem
        if binding.binds != binds:
            self.executor.bind(now_s)
        if binding.problem != problem:
            self.executor.handle(events.IdentityDoubted(now_s, binding.problem), now_s)

    def _serve_station(self, message: Message | None, now_s: float, *, may_grant: bool) -> None:
        """Answer a request of a ground station, received directly or through the autopilot."""
        if not self.binding.is_bound:
            return
        if isinstance(message, ParamRequest):
            self._parameters.receive(message, now_s)
        elif isinstance(message, AddressedCommand):
            self._commands.receive(message, now_s, may_grant=may_grant)

    def _note_other_command(self, message: Message, now_s: float) -> None:
        """Report a station's flight command, if the autopilot forwards it."""
        is_here = self.binding.is_bound and message.get_srcSystem() != self.outlet.own_ids[0]
        if not (is_here and isinstance(message, AddressedCommand)):
            return
        if message.command in FLIGHT_COMMANDS and message.target_system == self.outlet.own_ids[0]:
            sender = message.get_srcSystem(), message.get_srcComponent()
            name = FLIGHT_COMMANDS[message.command]
            self.executor.handle(events.OtherCommandHeard(now_s, name, sender), now_s)

    # At the control tick

    def _ask_autopilot(self, now_s: float) -> None:
        """Send the requests of the session and of the queries that are due, if any can be."""
        if self.executor.requests.pending is not None:
            self.executor.send_request(now_s)
        vehicle = self.session.vehicle
        is_urgent = vehicle.mode_watch.is_in_doubt or self.session.fencing.is_urgent
        if not (is_urgent or now_s >= self._queries.next_s or self.binding.unproved):
            return
        given_up = self._queries.fence.check_silence(now_s)
        if given_up is not None:
            self.executor.handle(given_up, now_s)
        for peer in self.binding.take_unproved(now_s):
            for number in SIGNS:
                self.outlet.ask_elsewhere(request_message(number, self.outlet.target_ids), peer)
        is_mode_wanted = vehicle.mode_watch.is_in_doubt and not vehicle.is_link_lost(now_s)
        for query in self._queries.due(now_s, is_mode_wanted=is_mode_wanted):
            self.outlet.send(query, now_s, is_droppable=True)

    def _link_record(self, now_s: float) -> dict[str, object]:
        emitters = self.session.context.emitters
        return {
            "links": [
                asdict(intake.codec.counters) | {"over_budget": intake.budget.dropped}
                for intake in self._intakes
            ],
            **self._health.record(now_s),
            "overtaken": self.executor.inbound.overtaken,
            **self.authenticity.record(),
            "undecodable": sum(intake.codec.undecodable for intake in self._intakes),
            "strangers": self.binding.unknown_senders,
            "moves": self.binding.moves,
            "echoes": self.outlet.own_frames.echoes,
            "setpoints": self.outlet.setpoints_sent,
            "texts_withheld": self.outlet.gate.withheld,
            "texts_unsent": self.outlet.gate.unsent,
            "setpoint_rate_hz": self.outlet.setpoint_rate_hz(now_s),
            "accepted": emitters.accepted,
            "refused": {reason.value: count for reason, count in emitters.rejected.items()},
            "restarts": emitters.restarts,
        }
