"""The simulated vehicle on a MAVLink link: bytes and time in, bytes out.

Theory of operation. Physics advances in steps of 20 ms up to the time of the timer, and every
message is built at a step, so a run depends on its scenario, seed and inputs only. A timer that
comes more than half a second late (a suspended process) skips the steps it missed: no burst of
stale telemetry, and the vehicle has not moved meanwhile.

What others on the link send to each other is forwarded (`router`), so that a ground station hears
the companion and reaches it.

Vehicle and payload are two components with a sequence number each, as if each had its own radio.
"""

from __future__ import annotations

import math

import numpy as np

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot import payload
from sim_link.autopilot.commands import (
    Command,
    CommandHandler,
    command_from_int,
    command_from_long,
    command_from_set_mode,
)
from sim_link.autopilot.recorder import FlightRecorder
from sim_link.autopilot.router import Router
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.setpoints import setpoint_from_global, setpoint_from_local
from sim_link.autopilot.streams import StreamTable
from sim_link.autopilot.telemetry import Telemetry
from sim_link.autopilot.vehicle import STEP_S, Occurrence, SimVehicle
from sim_link.world.target import Emitter

LINK = 0
AUTOPILOT_COMPONENT_ID = mavlink.MAV_COMP_ID_AUTOPILOT1
MAX_CATCH_UP_S = 0.5
STEP_TOLERANCE = 1e-6
"""Share of a step by which a timer may be early through rounding."""


class SimEndpoint:
    """A PX4-like vehicle with a radio payload, on link 0.

    Args:
        scenario: What is flown where.
        seed: Seed of all randomness.
        started_s: The shell's time at boot.
    """

    def __init__(self, scenario: Scenario, seed: int, started_s: float = 0.0) -> None:
        noise_seed, payload_seed = np.random.SeedSequence(seed).spawn(2)
        self._started_s = started_s
        self._next_step = 0
        self._is_finished = False
        self._has_told_origin = False
        self._output: list[Chunk] = []
        self._codec = MavCodec(scenario.system_id, AUTOPILOT_COMPONENT_ID)
        self._payload_codec = MavCodec(scenario.system_id, payload.COMPONENT_ID)
        self._router = Router(scenario.system_id, (AUTOPILOT_COMPONENT_ID, payload.COMPONENT_ID))
        self.vehicle = SimVehicle(scenario, np.random.default_rng(noise_seed))
        self.recorder = FlightRecorder()
        self._telemetry = Telemetry(self.vehicle)
        self._streams = StreamTable()
        self._commands = CommandHandler(self.vehicle, self._telemetry, self._streams)
        self._payload = payload.RadioPayload(
            scenario.payload,
            scenario.channel,
            Emitter(scenario.emitter),
            np.random.default_rng(payload_seed),
            scenario.environment,
        )

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in bytes; whatever is no MAVLink, or not for us, is ignored."""
        boot_s = now_s - self._started_s
        for message in self._codec.decode(chunk.data, is_datagram=chunk.is_datagram):
            self._output += self._router.forward(message, chunk.peer, LINK)
            self._dispatch(message, boot_s)

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
        if not self._has_told_origin:
            self._has_told_origin = True
            self._send(self._telemetry.gps_global_origin())
        for number in self._streams.take_due(boot_s):
            message = self._telemetry.build(number)
            if message is not None:
                self._send(message)
        for message in self._payload.messages(self.vehicle.body, boot_s):
            self._output.append(Chunk(LINK, self._payload_codec.encode(message)))

    def _send(self, message: Message) -> None:
        self._output.append(Chunk(LINK, self._codec.encode(message)))

    def _dispatch(self, message: Message, boot_s: float) -> None:
        match message:
            case mavlink.MAVLink_set_position_target_local_ned_message():
                if self._is_for_us(message.target_system, message.target_component):
                    self.vehicle.offboard.take(setpoint_from_local(message), boot_s)
            case mavlink.MAVLink_set_position_target_global_int_message():
                if self._is_for_us(message.target_system, message.target_component):
                    setpoint = setpoint_from_global(
                        message, self.vehicle.origin, self.vehicle.home_altitude_m
                    )
                    self.vehicle.offboard.take(setpoint, boot_s)
            case mavlink.MAVLink_command_long_message():
                if self._is_for_us(message.target_system, message.target_component):
                    self._obey(command_from_long(message), message, boot_s)
            case mavlink.MAVLink_command_int_message():
                if self._is_for_us(message.target_system, message.target_component):
                    self._obey(command_from_int(message), message, boot_s)
            case mavlink.MAVLink_set_mode_message():
                if self._is_for_us(message.target_system, 0):
                    self._obey(command_from_set_mode(message), message, boot_s)
            case mavlink.MAVLink_timesync_message():
                if message.tc1 == 0:
                    own_ns = max(1, round(1e9 * boot_s))
                    self._send(mavlink.MAVLink_timesync_message(own_ns, message.ts1))
            case mavlink.MAVLink_ping_message():
                if message.target_system == 0 and message.target_component == 0:
                    self._answer_ping(message)

    def _is_for_us(self, system_id: int, component_id: int) -> bool:
        """MAVLink developer guide, "Routing": 0 is a broadcast."""
        return system_id in (0, self._codec.system_id) and component_id in (
            0,
            AUTOPILOT_COMPONENT_ID,
        )

    def _obey(self, command: Command, message: Message, boot_s: float) -> None:
        result, replies = self._commands.handle(command, boot_s)
        for reply in replies:
            self._send(reply)
        self._send(
            mavlink.MAVLink_command_ack_message(
                command.number,
                result,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            )
        )

    def _answer_ping(self, message: mavlink.MAVLink_ping_message) -> None:
        self._send(
            mavlink.MAVLink_ping_message(
                message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
            )
        )
