"""The simulated vehicle on its MAVLink links: bytes and time in, bytes out.

Theory of operation. Physics advances in steps of 20 ms up to the time of the timer, and every
message is built at a step, so a run depends on its scenario, seed and inputs only. A timer that
comes more than half a second late (a suspended process) skips the steps it missed: no burst of
stale telemetry, and the vehicle has not moved meanwhile. On invented time this is lockstep: nothing
moves until the caller says what time it is.

Every link has its own streams and sequence numbers. What others send to each other is forwarded
(`routing`), on one link and between links, so that a ground station hears the companion and reaches
it. Vehicle and payload are two components with a sequence number each, as if each had its own
radio.
"""

from __future__ import annotations

import math

import numpy as np

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot import payload
from sim_link.autopilot.protocols.base import Channel, Outgoing
from sim_link.autopilot.protocols.routing import Router
from sim_link.autopilot.recorder import FlightRecorder
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.services import Services
from sim_link.autopilot.telemetry import Telemetry
from sim_link.autopilot.vehicle import STEP_S, Occurrence, SimVehicle
from sim_link.world.target import Emitter

AUTOPILOT_COMPONENT_ID = mavlink.MAV_COMP_ID_AUTOPILOT1
MAX_READERS = 64
"""Clients of stream links whose unfinished frames are kept."""
MAX_CATCH_UP_S = 0.5
STEP_TOLERANCE = 1e-6
"""Share of a step by which a timer may be early through rounding."""


class SimEndpoint:
    """A PX4-like or ArduPilot-like vehicle with a radio payload.

    Args:
        scenario: What is flown where.
        seed: Seed of all randomness.
        started_s: The shell's time at boot.
        links: How many links it has.

    Raises:
        ConfigError: The scenario sets a parameter that does not exist, or to what may not be.
    """

    def __init__(
        self, scenario: Scenario, seed: int, started_s: float = 0.0, links: int = 1
    ) -> None:
        self._scenario = scenario
        self._seeds = np.random.SeedSequence(seed)
        self._links = range(links)
        self._is_finished = False
        self._output: list[Chunk] = []
        self._codecs = [MavCodec(scenario.system_id, AUTOPILOT_COMPONENT_ID) for _ in self._links]
        self._readers: dict[tuple[int, Address], MavCodec] = {}
        self._payload_codecs = [
            MavCodec(scenario.system_id, payload.COMPONENT_ID) for _ in self._links
        ]
        own_components = (AUTOPILOT_COMPONENT_ID, payload.COMPONENT_ID)
        self._router = Router(scenario.system_id, own_components, links)
        self.recorder = FlightRecorder()
        self._boot(started_s, "")

    def _boot(self, started_s: float, parameters: str) -> None:
        """Power on: everything anew but the sequence numbers and the stored parameters."""
        noise_seed, payload_seed = self._seeds.spawn(2)
        scenario = self._scenario
        self._started_s = started_s
        self._next_step = 0
        self.vehicle = SimVehicle(scenario, np.random.default_rng(noise_seed))
        self.vehicle.flavour.parameters.load_text(parameters, "stored parameters")
        self._telemetry = Telemetry(self.vehicle)
        self._services = Services(self.vehicle, len(self._links))
        self._payload = payload.RadioPayload(
            scenario.payload,
            scenario.channel,
            [Emitter(params) for params in (scenario.emitter, *scenario.emitters)],
            np.random.default_rng(payload_seed),
            scenario.environment,
        )

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in bytes; whatever is no MAVLink, or not for us, is ignored."""
        reader = self._reader_of(chunk)
        for frame in reader.split(chunk.data, is_datagram=chunk.is_datagram):
            self._output += self._router.route(frame, Channel(chunk.link, chunk.peer))
            message = reader.decode_frame(frame)
            if message is not None:
                self._take(message, Channel(chunk.link), now_s)

    def _reader_of(self, chunk: Chunk) -> MavCodec:
        """Streams that share a link (clients of a TCP port) must not mix their unfinished frames."""
        if chunk.is_datagram or chunk.peer is None:
            return self._codecs[chunk.link]
        key = (chunk.link, chunk.peer)
        if key not in self._readers:
            if len(self._readers) >= MAX_READERS:
                del self._readers[next(iter(self._readers))]
            self._readers[key] = MavCodec(self._scenario.system_id, AUTOPILOT_COMPONENT_ID)
        return self._readers[key]

    def _take(self, message: Message, channel: Channel, now_s: float) -> None:
        if message.get_srcSystem() == 0 or message.get_srcComponent() == 0:
            return  # 0 is no source (MAVLink developer guide, "Serialization")
        self._send_all(self._services.handle(message, channel, now_s - self._started_s))
        if self._services.wants_reboot:
            self._boot(now_s, self.vehicle.flavour.parameters.to_text())

    def handle_timer(self, now_s: float) -> None:
        """Step the physics up to `now_s` and queue the telemetry that is due."""
        steps = (now_s - self._started_s) / STEP_S + STEP_TOLERANCE
        last = math.floor(steps)
        if last - self._next_step > MAX_CATCH_UP_S / STEP_S:
            self._next_step = last
        while self._next_step <= last:
            self._step(self._next_step * STEP_S)
            self._next_step += 1

    def next_timer_s(self) -> float:
        """The time of the next physics step."""
        return self._started_s + self._next_step * STEP_S

    def take_output(self) -> list[Chunk]:
        """The frames to send, in order; taken once."""
        output, self._output = self._output, []
        return output

    def take_occurrences(self) -> list[Occurrence]:
        """Mode changes and other events since the last call."""
        return self.recorder.take_occurrences()

    def request_stop(self, now_s: float) -> None:  # noqa: ARG002  the protocol gives the time
        """Finish at once: a simulator has nothing to bring home."""
        self._is_finished = True

    @property
    def is_finished(self) -> bool:
        """Whether a stop was requested."""
        return self._is_finished

    def _step(self, boot_s: float) -> None:
        self.vehicle.step(boot_s)
        self.recorder.take(self.vehicle)
        self._send_all(self._services.step(boot_s))
        built: dict[int, Message | None] = {}
        for channel, number in self._services.requests.take_due(boot_s):
            if number not in built:
                built[number] = self._telemetry.build(number)
            message = built[number]
            if message is not None:
                self._send(message, channel.link)
        for message in self._payload.messages(self.vehicle.body, boot_s):
            for link in self._links:
                self._output.append(Chunk(link, self._payload_codecs[link].encode(message)))

    def _send_all(self, outgoing: list[Outgoing]) -> None:
        for item in outgoing:
            links = self._links if item.to is None else (item.to.link,)
            for link in links:
                self._send(item.message, link)

    def _send(self, message: Message, link: int) -> None:
        self._output.append(Chunk(link, self._codecs[link].encode(message)))
