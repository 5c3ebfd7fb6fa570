"""The simulated vehicle on its MAVLink links: bytes and time in, bytes out.

Theory of operation. Physics advances in steps of 20 ms up to the time of the timer, and every
message is built at a step, so a run depends on its scenario, seed and inputs only. A timer more
than half a second late (a suspended process) skips the steps it missed: no burst of stale
telemetry, and the vehicle has not moved in between. On invented time this is lockstep: nothing
moves until the caller advances the time.

Every link has its own streams and sequence numbers, and so has every peer of a shared link that
asks for rates of its own or speaks MAVLink 1 (`protocols.link_layer`). A link with one peer, as a
port of PX4 is, answers only the first sender; others are heard. What others send to each
other is forwarded, on one link and between links, so that a ground station hears the companion and
reaches it. Vehicle and payload are two components with a sequence number each, as if each had its
own radio.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from companion.mav.codec import MAGIC_V1
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.aircraft import Occurrence
from sim_link.autopilot.flight_controller import STEP_S
from sim_link.autopilot.incidents import (
    AutopilotStall,
    IncidentRecord,
    OtherComponent,
    StationRates,
    StationRecord,
    VehicleReboot,
    WindChange,
)
from sim_link.autopilot.other_senders import (
    PAYLOAD_ID,
    STATION_CHANNEL,
    OtherComponentSender,
    RadioPayload,
    reject_command,
    station_orders,
)
from sim_link.autopilot.protocols.addressing import Channel, LinkSetup, Outgoing
from sim_link.autopilot.protocols.link_layer import NO_SECURITY, LinkLayer, LinkSecurity
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.services import Services
from sim_link.autopilot.telemetry import build_message
from sim_link.autopilot.vehicle import (
    FLAVOURS,
    FlightRecorder,
    IncidentSchedule,
    SimVehicle,
    apply_to_vehicle,
)
from sim_link.world.environment import Emitter
from sim_link.world.point_mass import PointMass

MAX_CATCH_UP_S = 0.5
MAX_UNREAD = 2000
"""Chunks that the socket of a stalled autopilot keeps, about; the oldest are lost."""
STEP_TOLERANCE = 1e-6
"""Share of a step by which a timer may be early through rounding."""


class SimEndpoint:
    """A PX4-like or ArduPilot-like vehicle with a radio payload.

    `ConfigError`: scenario or stored parameters have an unknown parameter or a forbidden value;
    `parameters_name` is the stored ones' name in it.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        started_s: float = 0.0,
        links: int | Sequence[LinkSetup] = 1,
        *,
        parameters: str = "",
        parameters_name: str = "stored parameters",
        security: LinkSecurity = NO_SECURITY,
    ) -> None:
        self._scenario = scenario
        self._seeds = np.random.SeedSequence(seed)
        if isinstance(links, int):
            links = [LinkSetup(scenario.autopilot.link_mode)] * links
        self._links = tuple(links)
        self._sole_peers: dict[int, Address] = {}
        self._unix_minus_local_s = security.started_unix_s - started_s
        self.is_finished = False
        self._output: list[Chunk] = []
        components = (mavlink.MAV_COMP_ID_AUTOPILOT1, PAYLOAD_ID)
        dialect = FLAVOURS[scenario.autopilot.flavour].kind.firmware.dialect
        self.links = LinkLayer(scenario.system_id, components, len(links), security, dialect)
        self.recorder = FlightRecorder()
        self._began_s = started_s
        self._schedule = IncidentSchedule(scenario.incidents)
        self._stalled_until_s = -math.inf
        self._unread: deque[Chunk] = deque(maxlen=MAX_UNREAD)
        self._others: list[tuple[float, OtherComponentSender]] = []
        """Other components on the links, and until when."""
        self._boot(started_s, parameters, parameters_name)

    def _boot(
        self, started_s: float, parameters: str, name: str, body: PointMass | None = None
    ) -> None:
        """Power on: reset all but position, wind, sequence numbers and the stored parameters."""
        noise_seed, payload_seed = self._seeds.spawn(2)
        scenario = self._scenario
        self._started_s = started_s
        self._next_step = 0
        self.vehicle = SimVehicle(scenario, np.random.default_rng(noise_seed), body)
        self.vehicle.flavour.parameters.load_text(parameters, name)
        self._services = Services(self.vehicle, self._links, self.links.router.knows)
        self.links.separate(self._services.requests.channels)
        self._payload = RadioPayload(
            scenario.payload,
            scenario.channel,
            [Emitter(params) for params in (scenario.emitter, *scenario.emitters)],
            np.random.default_rng(payload_seed),
            scenario.environment,
        )

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process bytes; anything that is not MAVLink, or not for us, is ignored."""
        if now_s < self._started_s:
            return
        if now_s < self._stalled_until_s:
            self._unread.append(chunk)
            return
        if self._links[chunk.link].has_one_peer and chunk.peer is not None:
            self._sole_peers.setdefault(chunk.link, chunk.peer)
            chunk = chunk._replace(peer=None)
        if not chunk.data and not chunk.is_datagram:
            self._forget(Channel(chunk.link, chunk.peer))
            return
        arrivals, forwarded = self.links.receive(chunk)
        self._output += forwarded
        for message, origin in arrivals:
            services, boot_s = self._services, now_s - self._started_s
            frame = bytes(message.get_msgbuf()[:1])
            if frame[0] == MAGIC_V1 and services.addressing.is_for_us(message):
                services.requests.open(origin, boot_s)  # in MAVLink 1, unlike the rest of its link
                self.links.separate(services.requests.channels)
                self.links.speaks_as(origin, frame)
            answers = services.handle(message, origin, boot_s)
            self.links.separate(services.requests.channels)
            self._send_all(answers)
            refused = reject_command(message, self._scenario.system_id)
            if refused is not None:
                self._send_all([Outgoing(refused, origin)], PAYLOAD_ID)
            if self._services.wants_reboot:
                self._reboot(now_s, 0.0)

    def apply_incident(self, incident: IncidentRecord, now_s: float) -> None:
        """Apply an incident to the vehicle now, regardless of its `start_s`."""
        if isinstance(incident, VehicleReboot):
            self._reboot(now_s, incident.down_s)
        elif isinstance(incident, AutopilotStall):
            self._stalled_until_s = now_s + incident.duration_s
            self._started_s += incident.duration_s
        elif isinstance(incident, StationRecord):
            if now_s >= self._started_s:
                self._obey_station(incident, now_s - self._started_s)
        elif isinstance(incident, OtherComponent):
            sender = OtherComponentSender(incident.component, self._scenario.system_id, now_s)
            self._others.append((now_s + incident.duration_s, sender))
        elif now_s >= self._started_s:
            apply_to_vehicle(incident, self.vehicle, now_s - self._started_s)
            if isinstance(incident, WindChange) and incident.duration_s < math.inf:
                end_s, wind = now_s + incident.duration_s - self._began_s, self._scenario.wind
                east_mps, north_mps = wind.east_mps, wind.north_mps
                self._schedule.add(
                    WindChange(start_s=end_s, east_mps=east_mps, north_mps=north_mps)
                )

    def _obey_station(self, incident: StationRecord, boot_s: float) -> None:
        """Execute an order of another ground station, on its own link or that of all others."""
        is_about_lines = isinstance(incident, StationRates)
        channels = list(self._services.requests.channels) if is_about_lines else [STATION_CHANNEL]
        for message in station_orders(incident, self.vehicle):
            for channel in channels:
                answers = self._services.handle(message, channel, boot_s)
                public = [item for item in answers if item.to is None]
                shared = [Outgoing(item.message) for item in answers if item.to is not None]
                self._send_all([*public, *(shared if incident.shares_line else ())])

    def _reboot(self, now_s: float, down_s: float) -> None:
        """Restart in place, motors off, neither receiving nor sending for `down_s` seconds."""
        body = self.vehicle.body
        self._boot(now_s + down_s, self.parameters_text, "stored parameters", body)

    def _forget(self, channel: Channel) -> None:
        if channel.peer is not None:
            self.links.forget(channel)
            self._services.requests.forget(channel)
            self.links.separate(self._services.requests.channels)

    def handle_timer(self, now_s: float) -> None:
        """Step the physics up to `now_s` and queue the telemetry that is due."""
        if now_s < self._stalled_until_s:
            return
        unread = list(self._unread)
        self._unread.clear()
        for chunk in unread:
            self.receive(chunk, now_s)
        self._send_all(self._services.clocks.due(now_s - self._started_s))
        last_step = self._last_step(now_s)
        self._others = [(end_s, each) for end_s, each in self._others if now_s < end_s]
        for _, sender in self._others:
            for frame in sender.frames(now_s):
                self._output += [Chunk(link, frame) for link in range(len(self._links))]
        if last_step - self._next_step > MAX_CATCH_UP_S / STEP_S:
            self._next_step = last_step
        if self.links.signing is not None:
            self.links.signing.advance(now_s + self._unix_minus_local_s)
        while self._next_step <= self._last_step(now_s):
            step_s = self._started_s + self._next_step * STEP_S
            for incident in self._schedule.take_due(step_s - self._began_s):
                self.apply_incident(incident, step_s)
            if self._next_step <= self._last_step(now_s):  # no reboot
                self._step(self._next_step * STEP_S)
                self._next_step += 1

    def _last_step(self, now_s: float) -> int:
        return math.floor((now_s - self._started_s) / STEP_S + STEP_TOLERANCE)

    def next_timer_s(self) -> float:
        """Return the time of the next physics step or answer; never before the end of a stall."""
        next_s = min(self._next_step * STEP_S, self._services.clocks.next_s())
        return max(self._started_s + next_s, self._stalled_until_s)

    def take_output(self) -> list[Chunk]:
        """Return the frames to send, in order; taken once."""
        output, self._output = self._output, []
        if not self._sole_peers:
            return output
        peers = self._sole_peers
        return [c.readdressed(c.link, peers.get(c.link, c.peer)) for c in output]

    def take_occurrences(self) -> list[Occurrence]:
        """Return mode changes and other events since the last call."""
        return self.recorder.take_occurrences()

    def request_stop(self, now_s: float) -> None:  # noqa: ARG002  the protocol gives the time
        """Finish at once: a simulator needs no orderly end."""
        self.is_finished = True

    @property
    def parameters_text(self) -> str:
        """The parameters that differ from their defaults, to be stored."""
        return self.vehicle.flavour.parameters.to_text()

    def _step(self, boot_s: float) -> None:
        self.vehicle.flavour.step(boot_s)
        self.recorder.take(self.vehicle)
        self._send_all(self._services.step(boot_s))
        built: dict[int, Message | None] = {}
        for channel, number in self._services.requests.take_due(boot_s):
            if number not in built:
                built[number] = build_message(self.vehicle, number)
            message = built[number]
            if message is not None:
                self._send_all([Outgoing(message, channel)])
        heard = self._payload.messages(self.vehicle.body, boot_s, self.vehicle.stamp_s)
        self._send_all([Outgoing(each) for each in heard], PAYLOAD_ID)

    def _send_all(self, outgoing: list[Outgoing], component_id: int | None = None) -> None:
        for item in outgoing:
            self._output += self.links.send(item, component_id)
