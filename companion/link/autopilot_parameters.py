"""Parameters of the autopilot that are read: fences, and PX4's reaction to lost setpoints.

The fences are a circle about home, and limits of altitude.

ArduPilot has FENCE_RADIUS, FENCE_ALT_MAX and FENCE_ALT_MIN, each with a bit of FENCE_TYPE, where
FENCE_ENABLE is 1, and stops FENCE_MARGIN inside. PX4 has GF_MAX_HOR_DIST and GF_MAX_VER_DIST where
they are above 0, unless GF_ACTION is 0. None of them is an item of the fence's plan. Each parameter
is requested by its name, a few times; both autopilots report changes on all links.

With COM_OBL_RC_ACT = 0, the default, PX4 falls back to Position mode when setpoints stop; without
an RC that sinks at 0.6 to 0.9 m/s and drifts (PX4 1.15, observed in SITL). A warning says so.

Source: ArduPilot `AC_Fence.cpp` (4.5), Copter Parameter List; PX4 Parameter Reference, Geofence and
COM_OBL_RC_ACT; MAVLink guide, "Parameter Protocol", for integers sent bytewise in a float.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from companion.domain import Autopilot
from companion.guidance.events import FenceLimits
from companion.mav.dialect import Message, mavlink
from companion.mav.param_encoding import ParamEncoding, ParamType, name_of, raw_of, value_from_raw

NAMES = {
    Autopilot.ARDUPILOT: (
        "FENCE_ENABLE",
        "FENCE_AUTOENABLE",
        "FENCE_TYPE",
        "FENCE_RADIUS",
        "FENCE_ALT_MAX",
        "FENCE_ALT_MIN",
        "FENCE_MARGIN",
    ),
    Autopilot.PX4: ("GF_ACTION", "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"),
}
ALTITUDE_MAX, CIRCLE, ALTITUDE_MIN = 1, 2, 8
"""Bits of FENCE_TYPE."""
KINDS = frozenset(int(kind) for kind in ParamType)
RESEND_S = 1.0
TRIES = 8
"""Requests of each; an autopilot without such a parameter does not answer."""


class FenceParameters:
    """Reader of the fence's parameters."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start again after a restart of the autopilot, maybe with other parameters."""
        self._values: dict[str, float] = {}
        self._asked: dict[str, tuple[int, float]] = {}
        """Number and time of the requests for each."""

    def due(self, now_s: float, autopilot: Autopilot, target: tuple[int, int]) -> Message | None:
        """Return the next request to send, if any."""
        for name in NAMES.get(autopilot, ()):
            tries, asked_s = self._asked.get(name, (0, -math.inf))
            if name in self._values or tries >= TRIES or now_s - asked_s < RESEND_S:
                continue
            self._asked[name] = (tries + 1, now_s)
            return mavlink.MAVLink_param_request_read_message(*target, name.encode(), -1)
        return None

    def receive(self, message: Message, autopilot: Autopilot) -> bool:
        """Process a message of the autopilot; return True if its limits changed."""
        if not isinstance(message, mavlink.MAVLink_param_value_message):
            return False
        name = name_of(message)
        if name not in NAMES.get(autopilot, ()) or message.param_type not in KINDS:
            return False
        is_px4 = autopilot is Autopilot.PX4
        encoding = ParamEncoding.BYTEWISE if is_px4 else ParamEncoding.C_CAST
        value = value_from_raw(raw_of(message), ParamType(message.param_type), encoding)
        if not math.isfinite(value):
            return False
        before = self.limits
        self._values[name] = value
        return self.limits != before

    @property
    def limits(self) -> FenceLimits:
        """Limits by the parameters reported so far."""
        values = self._values
        return _of_px4(values) if "GF_ACTION" in values else _of_ardupilot(values)


def _of_ardupilot(values: Mapping[str, float]) -> FenceLimits:
    if not (values.get("FENCE_ENABLE", 0) or values.get("FENCE_AUTOENABLE", 0)):
        return FenceLimits()
    parts = int(values.get("FENCE_TYPE", 0))
    return FenceLimits(
        radius_m=values.get("FENCE_RADIUS") if parts & CIRCLE else None,
        altitude_max_m=values.get("FENCE_ALT_MAX") if parts & ALTITUDE_MAX else None,
        altitude_min_m=values.get("FENCE_ALT_MIN") if parts & ALTITUDE_MIN else None,
        margin_m=max(0.0, values.get("FENCE_MARGIN", 0.0)),
    )


def _of_px4(values: Mapping[str, float]) -> FenceLimits:
    if values["GF_ACTION"] == 0:
        return FenceLimits()
    return FenceLimits(
        radius_m=values.get("GF_MAX_HOR_DIST", 0.0) or None,
        altitude_max_m=values.get("GF_MAX_VER_DIST", 0.0) or None,
    )


RC_BIT = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER


def hears_transmitter(status: mavlink.MAVLink_sys_status_message) -> bool:
    """Return True if the autopilot reports a healthy RC transmitter."""
    present = status.onboard_control_sensors_present & RC_BIT
    return bool(present and status.onboard_control_sensors_health & RC_BIT)


PARAMETER = "COM_OBL_RC_ACT"
ASK_PERIOD_S = 3.0
ASKS = 3
WARNING = (
    "COM_OBL_RC_ACT is 0 and there is no RC: if setpoints stop, PX4 sinks and drifts. "
    "Set it to 5 (hold) or 3 (return)"
)


class Px4FailsafeCheck:
    """Check of PX4's reaction to lost setpoints: reads the parameter, and warns once."""

    def __init__(self) -> None:
        self._asks = 0
        self._next_s = 0.0
        self._action: int | None = None
        self._has_rc: bool | None = None
        self._is_done = False

    def due(
        self, now_s: float, autopilot: Autopilot, system_id: int, component_id: int
    ) -> Message | None:
        """Return the request to send now, if any; after a few tries silence is accepted."""
        is_needed = autopilot is Autopilot.PX4 and self._action is None and self._asks < ASKS
        if not is_needed or now_s < self._next_s:
            return None
        self._asks += 1
        self._next_s = now_s + ASK_PERIOD_S
        name = PARAMETER.encode("ascii")
        return mavlink.MAVLink_param_request_read_message(system_id, component_id, name, -1)

    def receive(self, message: Message) -> str | None:
        """Process a message of the autopilot; return the warning, once, if it applies."""
        if isinstance(message, mavlink.MAVLink_param_value_message):
            self._take_parameter(message)
        elif isinstance(message, mavlink.MAVLink_sys_status_message):
            self._has_rc = hears_transmitter(message)
        if self._is_done or self._action is None or self._has_rc is None:
            return None
        self._is_done = True
        return WARNING if self._action == 0 and not self._has_rc else None

    def _take_parameter(self, message: mavlink.MAVLink_param_value_message) -> None:
        if name_of(message) == PARAMETER:
            self._action = struct.unpack("<i", struct.pack("<f", message.param_value))[0]
