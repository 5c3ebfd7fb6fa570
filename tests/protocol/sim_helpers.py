"""A ground station in memory: speaks MAVLink bytes with a SimEndpoint, on invented time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from companion.domain import Autopilot, FlightMode
from companion.mav import dialect
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.flight_modes import mode_of, set_mode_params
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario

NAN = math.nan
STEP_S = 0.02
OWN_ADDRESS = ("127.0.0.1", 1)
M = TypeVar("M", bound=Message)

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF
LAND = mavlink.MAV_CMD_NAV_LAND
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
FAILED = mavlink.MAV_RESULT_FAILED


def local_setpoint(
    x: float = 10.0,
    y: float = 10.0,
    z: float = -10.0,
    *,
    vx: float = 0.0,
    vy: float = 0.0,
    vz: float = 0.0,
    yaw: float = 0.0,
    yaw_rate: float = 0.0,
    mask: int = dialect.POSITION_ONLY,
    frame: int = mavlink.MAV_FRAME_LOCAL_NED,
    system: int = 1,
    component: int = 1,
) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED; north, east, down."""
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, component, frame, mask, x, y, z, vx, vy, vz, 0.0, 0.0, 0.0, yaw, yaw_rate
    )


class GroundStation:
    """Drives a simulated vehicle and keeps what it sends, with the time of each message."""

    def __init__(self, scenario: Scenario | None = None, seed: int = 1) -> None:
        self.sim = SimEndpoint(scenario or Scenario(), seed)
        self.sender = MavCodec(255, 190)
        self.receiver = MavCodec(255, 190)
        self.now_s = 0.0
        self.inbox: list[tuple[float, Message]] = []
        self.stream: Callable[[], Message] | None = None
        """The setpoint that is sent while time passes; None sends none."""
        self.stream_period_s = 0.1
        self._stream_due_s = 0.0

    def run(self, duration_s: float) -> None:
        """Let simulated time pass."""
        for _ in range(round(duration_s / STEP_S)):
            self.now_s = round(self.now_s + STEP_S, 6)
            if self.stream is not None and self.now_s >= self._stream_due_s - 1e-9:
                self._stream_due_s = self.now_s + self.stream_period_s
                self.send(self.stream())
            self.sim.handle_timer(self.now_s)
            self._collect()

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> float:
        """Let time pass until `condition` holds; how long it took."""
        started_s = self.now_s
        while not condition():
            assert self.now_s - started_s < limit_s, "the condition never held"
            self.run(STEP_S)
        return self.now_s - started_s

    def send(self, message: Message) -> None:
        self.send_bytes(self.sender.encode(message))

    def send_bytes(self, data: bytes) -> None:
        self.sim.receive(Chunk(0, data, OWN_ADDRESS), self.now_s)
        self._collect()

    def command(self, number: int, *params: float, system: int = 1, component: int = 1) -> int:
        """Send COMMAND_LONG, unused parameters NaN as MAVSDK does; the ACK's result."""
        padded = [*params, *[NAN] * (7 - len(params))]
        return self.result_of(
            mavlink.MAVLink_command_long_message(system, component, number, 0, *padded)
        )

    def command_int(self, number: int, frame: int, p1: float = NAN, z: float = NAN) -> int:
        """Send COMMAND_INT with its first parameter and its height; the ACK's result."""
        return self.result_of(
            mavlink.MAVLink_command_int_message(
                1, 1, frame, number, 0, 0, p1, NAN, NAN, NAN, 0, 0, z
            )
        )

    def result_of(self, message: Message) -> int:
        """Send a command; the result of its only ACK."""
        seen = len(self.inbox)
        self.send(message)
        acks = [
            m for _, m in self.inbox[seen:] if isinstance(m, mavlink.MAVLink_command_ack_message)
        ]
        assert len(acks) == 1, f"{len(acks)} answers"
        assert (acks[0].target_system, acks[0].target_component) == (255, 190)
        return acks[0].result

    def set_mode(self, mode: FlightMode) -> int:
        params = set_mode_params(mode, Autopilot.PX4, is_armed=self.is_armed)
        return self.command(SET_MODE, *params)

    def take_off(self, height_m: float = 10.0) -> None:
        """Boot, arm, take off and wait for HOLD."""
        self.run(2.5)
        assert self.command(ARM, 1.0) == ACCEPTED
        assert self.command(TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, 488.0 + height_m) == ACCEPTED
        self.run_until(lambda: self.mode is FlightMode.HOLD, 60.0)
        self.run(2.0)

    def fly_offboard(self) -> None:
        """Take off and hand over to a streamed setpoint."""
        self.take_off()
        self.stream = local_setpoint
        self.run(0.5)
        assert self.set_mode(FlightMode.OFFBOARD) == ACCEPTED
        self.run(1.0)

    def all(self, kind: type[M], component: int = 1) -> list[M]:
        return [
            m for _, m in self.inbox if isinstance(m, kind) and m.get_srcComponent() == component
        ]

    def last(self, kind: type[M], component: int = 1) -> M:
        """Return the newest message of a kind, searched from the end for speed."""
        return next(
            m
            for _, m in reversed(self.inbox)
            if isinstance(m, kind) and m.get_srcComponent() == component
        )

    @property
    def heartbeat(self) -> mavlink.MAVLink_heartbeat_message:
        """The newest HEARTBEAT of the autopilot (at most a second old)."""
        return self.last(mavlink.MAVLink_heartbeat_message)

    @property
    def mode(self) -> FlightMode:
        """The mode now, asked for with REQUEST_MESSAGE, so without the second of delay."""
        self.refresh()
        return mode_of(self.heartbeat, Autopilot.PX4)

    @property
    def is_armed(self) -> bool:
        self.refresh()
        return bool(self.heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def status(self) -> int:
        self.refresh()
        return self.heartbeat.system_status

    def refresh(self) -> None:
        assert self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 0.0) == ACCEPTED

    @property
    def position(self) -> tuple[float, float, float]:
        """North, east and down from LOCAL_POSITION_NED."""
        report = self.last(mavlink.MAVLink_local_position_ned_message)
        return (report.x, report.y, report.z)

    def _collect(self) -> None:
        for chunk in self.sim.take_output():
            if OWN_ADDRESS in chunk.except_peers:
                continue  # a forwarded frame of our own, or what is only for others
            for message in self.receiver.decode(chunk.data):
                self.inbox.append((self.now_s, message))
