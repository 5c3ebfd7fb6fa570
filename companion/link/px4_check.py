"""A warning for PX4 as it comes: what it does when setpoints stop and there is no RC.

With COM_OBL_RC_ACT = 0, the default, PX4 falls back to Position mode; without an RC that sinks
at 0.6 to 0.9 m/s and drifts (PX4 1.15, observed in SITL). Source: PX4 parameter reference,
COM_OBL_RC_ACT; MAVLink guide, "Parameter Protocol", for integers sent bytewise in a float.
"""

from __future__ import annotations

import struct

from companion.domain import Autopilot
from companion.mav.dialect import Message, mavlink

PARAMETER = b"COM_OBL_RC_ACT"
ASK_PERIOD_S = 3.0
ASKS = 3
RC_BIT = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
WARNING = (
    "COM_OBL_RC_ACT is 0 and there is no RC: if setpoints stop, PX4 sinks and drifts. "
    "Set it to 5 (hold) or 3 (return)"
)


class Px4FailsafeCheck:
    """Asks for the parameter a few times and judges the answer once."""

    def __init__(self) -> None:
        self._asks = 0
        self._next_s = 0.0
        self._action: int | None = None
        self._has_rc: bool | None = None
        self._is_done = False

    def due(
        self, now_s: float, autopilot: Autopilot, system_id: int, component_id: int
    ) -> Message | None:
        """The request to send now, if any; silence is no error and is not asked about for ever."""
        is_needed = autopilot is Autopilot.PX4 and self._action is None and self._asks < ASKS
        if not is_needed or now_s < self._next_s:
            return None
        self._asks += 1
        self._next_s = now_s + ASK_PERIOD_S
        return mavlink.MAVLink_param_request_read_message(system_id, component_id, PARAMETER, -1)

    def heard(self, message: Message) -> str | None:
        """Take in a message of the autopilot; the warning, once, if it is deserved."""
        if isinstance(message, mavlink.MAVLink_param_value_message):
            self._take_parameter(message)
        elif isinstance(message, mavlink.MAVLink_sys_status_message):
            present = message.onboard_control_sensors_present & RC_BIT
            health = message.onboard_control_sensors_health & RC_BIT
            self._has_rc = bool(present and health)
        if self._is_done or self._action is None or self._has_rc is None:
            return None
        self._is_done = True
        return WARNING if self._action == 0 and not self._has_rc else None

    def _take_parameter(self, message: mavlink.MAVLink_param_value_message) -> None:
        name: bytes | str = message.param_id  # annotated as str, decoded as bytes
        raw = name.encode() if isinstance(name, str) else name
        if raw.rstrip(b"\x00") == PARAMETER:
            self._action = struct.unpack("<i", struct.pack("<f", message.param_value))[0]
