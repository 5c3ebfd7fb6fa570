"""`companion radio record`: writes the output of radios and the vehicle's poses into one file.

The autopilot's streams are requested as in a flight (from component 191 of its system); no command
but SET_MESSAGE_INTERVAL and REQUEST_MESSAGE is sent. A pose is a position at its own time with the
interpolated attitude, so it waits for the next attitude.
"""

from __future__ import annotations

import os
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from companion.config.schema import CompanionConfig
from companion.domain import Attitude, VehicleState
from companion.errors import ConfigError, LinkError
from companion.flight_setup import radio_links
from companion.guidance.events import (
    Event,
    OriginSet,
    PositionAccuracyReported,
    VehicleMoved,
    YawMeasured,
)
from companion.guidance.vehicle_track import VehicleTrack, is_plausible
from companion.io.links.transports import FlightLink
from companion.io.radio_recording import (
    RadioBytes,
    RadioRecordingWriter,
    Record,
    RecordedOrigin,
    RecordedRadio,
    RecordingHeader,
    TimedPose,
)
from companion.io.shell import Clock, Shell
from companion.io.state_directory import VehicleLock, state_directory
from companion.link import outbound
from companion.link.autopilot_queries import StreamFreshness, StreamRequester
from companion.link.binding import AutopilotBinding
from companion.link.conversion.clock_sync import ClockSync
from companion.link.inbound import VehicleInbound
from companion.link.intake import Authenticity
from companion.link.outlet import COMPONENT_ID
from companion.link.quality import SequenceMonitor
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message
from companion.mav.endpoint import Chunk, OneShotEndpoint
from companion.run import link_name, open_signing

HEARTBEAT_PERIOD_S = 1.0
ATTITUDE_WAIT_S = 0.5
"""Time that a position waits for the next attitude."""


class PoseListener:
    """Decodes an autopilot's bytes into poses, and requests its streams."""

    def __init__(self, system_id: int | None, authenticity: Authenticity) -> None:
        self.binding = AutopilotBinding(system_id, is_keyed=authenticity.is_on)
        self._authenticity = authenticity
        self._codec = MavCodec(system_id or 1, COMPONENT_ID, authenticity.of_link(0))
        self._freshness = StreamFreshness()
        self._streams = StreamRequester(self._freshness)
        self._sequence = SequenceMonitor()
        self._clock = ClockSync()
        self._inbound = VehicleInbound(self._clock)
        self._track = VehicleTrack()
        self._waiting: deque[VehicleState] = deque()
        self._sigma_m: float | None = None
        self._next_heartbeat_s = 0.0

    def receive(self, chunk: Chunk, now_s: float) -> list[Record]:
        """Return poses and origins that some bytes complete."""
        self._authenticity.advance(now_s)
        found: list[Record] = []
        for message in self._codec.decode(chunk.data, is_datagram=chunk.is_datagram):
            is_proved = self._authenticity.is_proved(bytes(message.get_msgbuf()))
            if is_proved and self.binding.recognise(message, chunk.peer, now_s):
                self._codec.system_id = self.binding.system_id or 1
                self._freshness.receive(message, now_s)
                self._clock.receive(message, now_s)
                order = self._sequence.take(message.get_seq(), now_s)
                for event in self._inbound.events(message, now_s, order):
                    found += self._take(event)
        return found

    def due(self, now_s: float) -> list[Chunk]:
        """Return the bytes to send now."""
        self._authenticity.advance(now_s)
        self.binding.note_control(now_s, is_in_control=False, is_armed=False)
        messages: list[Message | None] = []
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + HEARTBEAT_PERIOD_S
            messages.append(outbound.heartbeat())
        system_id, component_id = self.binding.system_id, self.binding.component_id
        if system_id is not None:
            target = (system_id, component_id)
            messages.append(self._streams.due(now_s, target, self.binding.autopilot))
            messages.append(self._clock.due(now_s, *target))
        sent = [self._codec.encode(message) for message in messages if message is not None]
        return [Chunk(0, data, self.binding.peer) for data in sent]

    def _take(self, event: Event) -> list[Record]:
        match event:
            case OriginSet(origin=origin):
                values = (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
                names = ("latitude_deg", "longitude_deg", "altitude_m")
                fields = dict(zip(names, values, strict=True))
                return [RecordedOrigin(**fields, projection=origin.projection)]
            case PositionAccuracyReported():
                self._sigma_m = event.horizontal_m
            case VehicleMoved(state=state) if is_plausible(state):
                self._waiting.append(state)
                return self._poses(state.time_s - ATTITUDE_WAIT_S)
            case YawMeasured():
                self._track.add_attitude(
                    event.measured_at_s, Attitude(event.yaw_ned_rad, event.tilt_rad)
                )
                return self._poses(event.measured_at_s)
        return []

    def _poses(self, until_s: float) -> list[Record]:
        """Return the positions up to a time, each with its attitude, if there is one."""
        poses: list[Record] = []
        while self._waiting and self._waiting[0].time_s <= until_s:
            state = self._waiting.popleft()
            attitude = self._track.attitude_at(state.time_s)
            tilt_rad = None if attitude is None else attitude.tilt_rad
            poses.append(
                TimedPose(
                    state.time_s,
                    state.position_enu_m,
                    None if attitude is None else attitude.yaw_ned_rad,
                    None if tilt_rad is None else tilt_rad[0],
                    None if tilt_rad is None else tilt_rad[1],
                    self._sigma_m,
                )
            )
        return poses


class RecordingEndpoint(OneShotEndpoint):
    """Writes the input of all links; the vehicle's link, if any, is the first."""

    def __init__(
        self, writer: RadioRecordingWriter, listener: PoseListener | None, duration_s: float | None
    ) -> None:
        super().__init__(duration_s)
        self.counts = {"bytes": 0, "poses": 0}
        self._writer = writer
        self._listener = listener

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Record received bytes."""
        super().receive(chunk, now_s)
        number = chunk.link - (self._listener is not None)
        if number >= 0:
            self.counts["bytes"] += len(chunk.data)
            self._writer.write(RadioBytes(now_s, number, chunk.data))
        elif self._listener is not None:
            for record in self._listener.receive(chunk, now_s):
                self.counts["poses"] += isinstance(record, TimedPose)
                self._writer.write(record)

    def handle_timer(self, now_s: float) -> None:
        """Send the requests to the autopilot that are due."""
        super().handle_timer(now_s)
        if self._listener is not None:
            self._output += self._listener.due(now_s)


@dataclass(frozen=True, slots=True)
class Recorded:
    """Result of a recording."""

    bytes: int
    poses: int


def record_radios(
    path: Path,
    config: CompanionConfig,
    vehicle: FlightLink | None,
    duration_s: float | None,
) -> Recorded:
    """Record the radios of `config` until asked to stop; raises the errors of opening links.

    An existing file is a `ConfigError`: it may hold an hour of flight.
    """
    if path.exists():
        raise ConfigError(f"{path}: exists already; delete it, or choose another name")
    links = [*([] if vehicle is None else [vehicle]), *radio_links(config.radios)]
    radios = tuple(
        RecordedRadio(
            name=radio.name, url=radio.url or "", options=radio.options, settings=radio.settings
        )
        for radio in config.radios
    )
    clock = Clock()
    with ExitStack() as stack:
        listener = None
        if vehicle is not None:
            listener = PoseListener(
                config.vehicle.system_id, _authenticity(config, vehicle, clock, stack)
            )
        header = RecordingHeader(started_unix_s=time.time() - clock.now_s(), radios=radios)
        writer = stack.enter_context(RadioRecordingWriter(path, header))
        endpoint = RecordingEndpoint(writer, listener, duration_s)
        try:
            Shell(endpoint, [link.transport for link in links], clock).run_blocking()
        except LinkError:
            path.unlink(missing_ok=True)
            raise
    return Recorded(**endpoint.counts)


def _authenticity(
    config: CompanionConfig, vehicle: FlightLink, clock: Clock, stack: ExitStack
) -> Authenticity:
    """Return the authenticity of the vehicle's link, which no other companion may use as well."""
    name = link_name(vehicle.transport)
    state = state_directory(config.process.state_directory, os.environ)
    lock = VehicleLock(state, name, config.vehicle.system_id)
    stack.callback(lock.release)
    keeper = open_signing(config)
    if keeper is None:
        return Authenticity()
    stack.callback(keeper.close)
    return Authenticity(keeper.signing, time.time() - clock.now_s())
