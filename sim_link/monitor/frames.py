"""I6 and I11: what may be on the wire at all, and how much of it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

from companion.mav.dialect import MAVLink_target_estimate_message, Message, mavlink
from sim_link.lockstep.observer import Frame
from sim_link.monitor.invariant import Invariant
from sim_link.monitor.scene import Scene

ALLOWED: frozenset[type[Message]] = frozenset(
    {
        mavlink.MAVLink_heartbeat_message,
        mavlink.MAVLink_set_position_target_local_ned_message,
        mavlink.MAVLink_set_position_target_global_int_message,
        mavlink.MAVLink_command_long_message,
        mavlink.MAVLink_command_ack_message,
        mavlink.MAVLink_statustext_message,
        mavlink.MAVLink_timesync_message,
        mavlink.MAVLink_param_request_read_message,
        mavlink.MAVLink_request_data_stream_message,
        mavlink.MAVLink_mission_request_list_message,
        mavlink.MAVLink_mission_request_int_message,
        mavlink.MAVLink_mission_ack_message,
        mavlink.MAVLink_named_value_float_message,
        mavlink.MAVLink_param_value_message,
        mavlink.MAVLink_param_error_message,
        mavlink.MAVLink_autopilot_version_message,
        MAVLink_target_estimate_message,
    }
)
"""Messages that a companion has any business sending to a vehicle, and through it to others."""
COMMANDS = frozenset(
    {
        mavlink.MAV_CMD_DO_SET_MODE,
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
        mavlink.MAV_CMD_REQUEST_MESSAGE,
    }
)
FORCE = 21196.0
"""Parameter 2 of an arming command that overrides every check."""
FRAME_OF: dict[type[Message], tuple[int, ...]] = {
    mavlink.MAVLink_set_position_target_local_ned_message: (mavlink.MAV_FRAME_LOCAL_NED,),
    mavlink.MAVLink_set_position_target_global_int_message: (mavlink.MAV_FRAME_GLOBAL_INT,),
}
FARTHEST_M = 1e6
WINDOW_S = 1.0
RECORD_WINDOW_S = 10.0


class KnownFrames(Invariant):
    """Only finite values, in allowed messages, frames and commands."""

    name = "I6"
    title = "only allowed messages, frames and commands, and only finite values"

    def sent(self, frame: Frame) -> None:
        """Judge a frame."""
        message = frame.message
        if message is None:
            self.report("a frame that cannot be read", number=float(frame.number))
            return
        if type(message) not in ALLOWED:
            self.report("a message that is none of its business", number=float(frame.number))
            return
        frames = FRAME_OF.get(type(message))
        if frames is not None:
            self._judge_setpoint(message, frames)
        if isinstance(message, mavlink.MAVLink_command_long_message):
            self._judge_command(message)

    def _judge_setpoint(self, message: Message, frames: tuple[int, ...]) -> None:
        used = getattr(message, "coordinate_frame", -1)
        if used not in frames:
            self.report("a setpoint in a frame that is not allowed", frame=float(used))
        for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
            value = getattr(message, name)
            if kind == "float" and not math.isfinite(value):
                self.report(f"a setpoint with a {name} that is no number")
            elif kind == "float" and abs(value) > FARTHEST_M:
                self.report(f"a setpoint with an absurd {name}", value=value)

    def _judge_command(self, message: mavlink.MAVLink_command_long_message) -> None:
        if message.command not in COMMANDS:
            self.report("a command that is none of its business", command=float(message.command))
        is_arming = message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM
        if is_arming and (message.param1 != 1.0 or message.param2 == FORCE):
            self.report("disarmed or forced to arm", param1=message.param1)
        params = [getattr(message, f"param{i}") for i in range(1, 8)]
        if any(math.isinf(value) for value in params):
            self.report("a command with an infinite parameter", command=float(message.command))


class Bounded(Invariant):
    """What is sent, written and kept stays within bounds.

    Args:
        scene: What all invariants share.
        sizes: Lengths of the companion's queues by name, each with its bound; None: not known.
    """

    name = "I11"
    title = "frames, log lines and queues stay within bounds"

    def __init__(
        self, scene: Scene, sizes: Callable[[], Mapping[str, tuple[int, int]]] | None = None
    ) -> None:
        super().__init__(scene)
        self._sizes = sizes
        self._sent: deque[tuple[float, int]] = deque()
        self._sent_bytes = 0
        self._records: deque[float] = deque()

    def sent(self, frame: Frame) -> None:
        """Count frames and bytes of the last second."""
        self._sent.append((frame.time_s, len(frame.data)))
        self._sent_bytes += len(frame.data)
        while self._sent[0][0] < frame.time_s - WINDOW_S:
            self._sent_bytes -= self._sent.popleft()[1]
        rules = self.scene.rules
        if len(self._sent) > rules.sent_frames_per_s * WINDOW_S:
            self.report("too many frames in a second", frames=float(len(self._sent)))
            self._sent.clear()
            self._sent_bytes = 0
        elif self._sent_bytes > rules.sent_bytes_per_s * WINDOW_S:
            self.report("too many bytes in a second", sent_bytes=float(self._sent_bytes))
            self._sent.clear()
            self._sent_bytes = 0

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:  # noqa: ARG002
        """Count lines of the journal."""
        now_s = self.scene.now_s
        self._records.append(now_s)
        while self._records[0] < now_s - RECORD_WINDOW_S:
            self._records.popleft()
        if len(self._records) > self.scene.rules.records_per_s * RECORD_WINDOW_S:
            self.report("too many lines in the journal", lines=float(len(self._records)))
            self._records.clear()

    def ticked(self) -> None:
        """Look at the queues."""
        if self._sizes is None:
            return
        for name, (size, bound) in self._sizes().items():
            if size > bound:
                self.report(f"the queue of {name} grows", size=float(size), bound=float(bound))
