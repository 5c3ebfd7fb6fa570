"""The autopilot's fence: its plan, by the mission protocol, and its parameters, without I/O.

Source of the plan: MAVLink developer guide, "Mission Protocol", with the mission type FENCE:
MISSION_REQUEST_LIST, MISSION_COUNT, then MISSION_REQUEST_INT and MISSION_ITEM_INT alternately, and
our MISSION_ACK at the end, without which PX4 1.15 rejects the next transfer (also after a count of
0, observed in SITL). MAVLink common, MAV_CMD_NAV_FENCE_*: 5000 return point, 5001/5002 polygon
in/out with the number of its vertices in parameter 1, 5003/5004 circle in/out with its radius
there.

A request without an answer is repeated, one at a time; after some tries the download pauses, each
time for longer. In MAVLink 1 an answer has no mission type, and ArduPilot refuses every other plan
with a text to all stations, so one request per download is enough.

A fence that stations may change is read again. PX4 reports a change by another fence_id in
MISSION_CURRENT, ArduPilot by the PARAM_VALUE of a FENCE_ parameter on all links (its number of
items is one). A station on our line is answered by a MISSION_ACK that we receive. Where there is no
id, all of this may be missed, so the fence is also read again every few seconds.

Source: MAVLink common, MISSION_CURRENT.fence_id; ArduPilot `AC_PolyFence_loader`, FENCE_TOTAL.

The fences by parameters are a circle around home, and limits of altitude. ArduPilot has
FENCE_RADIUS, FENCE_ALT_MAX and FENCE_ALT_MIN, each with a bit of FENCE_TYPE, where FENCE_ENABLE is
1, and stops FENCE_MARGIN inside. PX4 has GF_MAX_HOR_DIST and GF_MAX_VER_DIST where they are above
0, unless GF_ACTION is 0. None of them is an item of the fence's plan. Each parameter is requested
by its name, a few times; both autopilots report changes on all links.

PX4's reaction to lost setpoints is read as well. With COM_OBL_RC_ACT = 0, the default, PX4 falls
back to Position mode when setpoints stop; without an RC that sinks at 0.6 to 0.9 m/s and drifts
(PX4 1.15, observed in SITL). A warning says so.

Source: ArduPilot `AC_Fence.cpp` (4.5), Copter Parameter List; PX4 Parameter Reference, Geofence and
COM_OBL_RC_ACT; MAVLink guide, "Parameter Protocol", for integers sent bytewise in a float.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import get_args

from companion.domain import Autopilot
from companion.geometry.geofence import GeoArea, GeoFence, LatLon, NamedArea, fence_of
from companion.guidance.events import AutopilotFenceRead, FenceLimits
from companion.mav.dialect import Message, mavlink, result_words
from companion.mav.payloads import (
    ParamEncoding,
    ParamType,
    fence_id_of,
    is_for,
    is_mavlink1,
    name_of,
    raw_of,
    value_from_raw,
)

RESEND_S = 0.4
TRIES = 8
"""Tries of one request: at 30 % loss each way 99.5 % are answered by then."""
REST_S, LAST_REST_S = 10.0, 60.0
"""First and longest pause after a failed download."""
NO_ANSWER = "no answer"
NEEDS_MAVLINK_2 = "its port speaks MAVLink 1, which has no fences: set it to MAVLink 2"
READ_AGAIN_S = 10.0
"""Interval of repeated readings: at 5 m/s, the usual speed limit, a vehicle flies 50 m in it; a
square takes about 5 frames."""
MAX_SHARE = 0.2
"""Largest share of time that readings of a long fence may take."""
PARAMETER_PREFIXES = ("FENCE_", "GF_")
"""Prefixes of the fence's parameters: ArduPilot's and PX4's."""
MAX_ITEMS = 255
DEGREE = 1e7
FENCE = mavlink.MAV_MISSION_TYPE_FENCE
RETURN_POINT = mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT
POLYGONS = {
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
CIRCLES = {
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION: False,
}
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)
Ids = tuple[int, int]
Item = mavlink.MAVLink_mission_item_int_message
Answer = mavlink.MAVLink_mission_count_message | Item | mavlink.MAVLink_mission_ack_message
FenceMessage = (
    Answer | mavlink.MAVLink_mission_current_message | mavlink.MAVLink_param_value_message
)
"""Messages that may be about the autopilot's fence, as items or as parameters."""
FENCE_IDS = frozenset(kind.id for kind in get_args(FenceMessage))


@dataclass(slots=True)
class _Reading:
    begun_s: float
    fence_id: int
    """Reported fence id when the reading began."""
    is_wanted: bool
    """False: only a check for changes; then silence is not reported."""
    count: int | None = None
    items: list[Item] = field(default_factory=list)
    tries: int = 0
    next_s: float = -math.inf
    refusal: str | None = None
    """Text of the autopilot's refusal; None if it did not refuse."""

    def advance(self) -> None:
        """Note that the request was answered; the next one is due at once."""
        self.tries, self.next_s, self.refusal = 0, -math.inf, None

    def refuse(self, why: str, now_s: float) -> None:
        """Note that no repetition of the request will be answered."""
        self.refusal, self.tries, self.next_s = why, TRIES, now_s


class FenceDownload:
    """State machine that downloads the fence item by item."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start again after a restart of the autopilot, which ends the transfer."""
        self._reading: _Reading | None = None
        self._owes_ack = False
        self._rest_until_s = -math.inf
        self._rest_s = REST_S
        self._fence_id: int | None = None
        """Reported id of the current fence; 0: ids are not supported, or there is no fence."""
        self._read_id: int | None = None
        """Reported id of the fence that was read last."""
        self._again_s = math.inf
        """Time of the next reading where there are no ids."""
        self._parameters: dict[str, bytes] = {}

    def notice(self, message: Message, own: Ids) -> bool:
        """Return True if a message shows that the autopilot's fence has changed.

        An uncertain sign, a parameter that was not received before, only triggers another reading.
        """
        has_changed = False
        match message:
            case mavlink.MAVLink_mission_current_message():
                before, self._fence_id = self._fence_id, fence_id_of(bytes(message.get_msgbuf()))
                has_changed = before is not None and before != self._fence_id
            case mavlink.MAVLink_mission_ack_message() if not is_for(message, own):
                is_fence = message.mission_type in (FENCE, mavlink.MAV_MISSION_TYPE_ALL)
                has_changed = is_fence and message.type == mavlink.MAV_MISSION_ACCEPTED
            case mavlink.MAVLink_param_value_message():
                has_changed = self._note_parameter(message)
        if has_changed:
            self._reading, self._rest_until_s, self._rest_s = None, -math.inf, REST_S
        return has_changed

    def _note_parameter(self, message: mavlink.MAVLink_param_value_message) -> bool:
        name = name_of(message)
        if not name.startswith(PARAMETER_PREFIXES):
            return False
        before, self._parameters[name] = self._parameters.get(name), raw_of(message)
        if before is None and self._again_s < math.inf:
            self._again_s = -math.inf
        return before is not None and before != self._parameters[name]

    def skip_pause(self) -> None:
        """Cancel the pause before the next reading."""
        self._rest_until_s = -math.inf

    def _is_due_again(self, now_s: float) -> bool:
        """Return True if the fence may have changed since it was read."""
        if self._fence_id and self._again_s > -math.inf:
            return self._read_id is not None and self._read_id != self._fence_id
        return now_s >= self._again_s

    def due(
        self, now_s: float, autopilot: Ids, *, is_wanted: bool, is_followed: bool = False
    ) -> Message | None:
        """Return the message to send to the autopilot now, if any.

        A reading begins if it `is_wanted`, or, where changes are followed, if there may be one.
        """
        if self._owes_ack:
            self._owes_ack = False
            accepted = mavlink.MAV_MISSION_ACCEPTED
            return mavlink.MAVLink_mission_ack_message(*autopilot, accepted, FENCE)
        if self._reading is None:
            is_due = is_wanted or (is_followed and self._is_due_again(now_s))
            if not is_due or now_s < self._rest_until_s:
                return None
            self._reading = _Reading(now_s, self._fence_id or 0, is_wanted)
        reading = self._reading
        if now_s < reading.next_s or reading.tries >= TRIES:
            return None
        reading.tries += 1
        reading.next_s = now_s + RESEND_S
        if reading.count is None:
            return mavlink.MAVLink_mission_request_list_message(*autopilot, FENCE)
        return mavlink.MAVLink_mission_request_int_message(*autopilot, len(reading.items), FENCE)

    def check_silence(self, now_s: float) -> AutopilotFenceRead | None:
        """Return the failure of a reading without answer, once, or None."""
        reading = self._reading
        if reading is None or reading.tries < TRIES or now_s < reading.next_s:
            return None
        why = NO_ANSWER if reading.refusal is None else f"refused ({reading.refusal})"
        self._end(now_s)
        self._rest_s = min(2.0 * self._rest_s, LAST_REST_S)
        return AutopilotFenceRead(now_s, problem=why) if reading.is_wanted else None

    def receive(self, message: Message, now_s: float, own: Ids) -> AutopilotFenceRead | None:
        """Process a message of the autopilot for us; return its fence once complete, else None."""
        reading = self._reading
        if reading is None or not isinstance(message, Answer) or not is_for(message, own):
            return None
        if is_mavlink1(message):
            reading.refuse(NEEDS_MAVLINK_2, now_s)
        elif message.mission_type == FENCE:
            return self._take(reading, message, now_s)
        return None

    def _take(self, reading: _Reading, message: Answer, now_s: float) -> AutopilotFenceRead | None:
        match message:
            case mavlink.MAVLink_mission_ack_message():
                words = result_words("MAV_MISSION_RESULT", message.type, "MAV_MISSION_")
                reading.refusal = words
                return None
            case mavlink.MAVLink_mission_count_message() if reading.count is None:
                reading.count = message.count
                reading.advance()
            case mavlink.MAVLink_mission_item_int_message() if (
                reading.count is not None and message.seq == len(reading.items)
            ):
                reading.items.append(message)
                reading.advance()
        if reading.count is None:
            return None
        if len(reading.items) < reading.count <= MAX_ITEMS:
            return None
        self._owes_ack = True
        self._rest_s = REST_S
        self._read_id = reading.fence_id
        self._again_s = now_s + max(READ_AGAIN_S, (now_s - reading.begun_s) / MAX_SHARE)
        self._end(now_s)
        try:
            if reading.count > MAX_ITEMS:
                raise ValueError(f"it has {reading.count} items, more than {MAX_ITEMS}")
            return AutopilotFenceRead(now_s, fence_of_items(reading.items))
        except ValueError as error:
            return AutopilotFenceRead(now_s, problem=str(error), is_unusable=True)

    def _end(self, now_s: float) -> None:
        self._reading = None
        self._rest_until_s = now_s + self._rest_s


def fence_of_items(items: Sequence[Item]) -> GeoFence | None:
    """Return the fence that items form, if any; a `ValueError` begins with the item's number."""
    areas: list[NamedArea] = []
    index = 0
    while index < len(items):
        item, path = items[index], f"item {index + 1}"
        if item.frame not in GLOBAL_FRAMES:
            raise ValueError(f"{path}: frame {item.frame} is not a global one")
        if item.command in CIRCLES:
            area = GeoArea((_lat_lon(item),), item.param1)
            areas.append(NamedArea(path, CIRCLES[item.command], area))
            index += 1
        elif item.command in POLYGONS:
            vertices = _vertices(items, index, path)
            area = GeoArea(tuple(_lat_lon(vertex) for vertex in vertices))
            areas.append(NamedArea(path, POLYGONS[item.command], area))
            index += len(vertices)
        elif item.command == RETURN_POINT:
            index += 1
        else:
            raise ValueError(f"{path}: command {item.command} is no part of a fence")
    return fence_of(areas) if areas else None


def _vertices(items: Sequence[Item], index: int, path: str) -> Sequence[Item]:
    first = items[index]
    if not 3.0 <= first.param1 <= MAX_ITEMS:
        raise ValueError(f"{path}: a polygon of {first.param1:g} vertices")
    vertices = items[index : index + int(first.param1)]
    is_whole = len(vertices) == first.param1
    kind = (first.command, first.param1)
    if not is_whole or any((v.command, v.param1) != kind for v in vertices):
        raise ValueError(f"{path}: the polygon of {first.param1:g} vertices is incomplete")
    return vertices


def _lat_lon(item: Item) -> LatLon:
    return item.x / DEGREE, item.y / DEGREE


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
PARAMETER_RESEND_S = 1.0
PARAMETER_TRIES = 8
"""Requests of each; an autopilot without such a parameter does not answer."""


class ParameterRequests:
    """Requests for parameters by name, each repeated a few times until its value is known."""

    def __init__(self, period_s: float, tries: int) -> None:
        self._period_s = period_s
        self._tries = tries
        self._asked: dict[str, tuple[int, float]] = {}
        """Number of requests for each, and time of its next one."""
        self.values: dict[str, float] = {}

    def is_open(self, name: str) -> bool:
        """Return True while a parameter is unanswered and may be requested again."""
        return name not in self.values and self._asked.get(name, (0, 0.0))[0] < self._tries

    def due(self, names: Sequence[str], now_s: float, target: Ids) -> Message | None:
        """Return the next request to send, if any."""
        for name in names:
            tries, next_s = self._asked.get(name, (0, -math.inf))
            if self.is_open(name) and now_s >= next_s:
                self._asked[name] = (tries + 1, now_s + self._period_s)
                return mavlink.MAVLink_param_request_read_message(*target, name.encode(), -1)
        return None


def value_of(message: mavlink.MAVLink_param_value_message, autopilot: Autopilot) -> float | None:
    """Return the value in an autopilot's PARAM_VALUE; None if its type is unknown."""
    is_px4 = autopilot is Autopilot.PX4
    encoding = ParamEncoding.BYTEWISE if is_px4 else ParamEncoding.C_CAST
    try:
        return value_from_raw(raw_of(message), ParamType(message.param_type), encoding)
    except ValueError:
        return None


class FenceParameters:
    """Reader of the fence's parameters."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start again after a restart of the autopilot, maybe with other parameters."""
        self._requests = ParameterRequests(PARAMETER_RESEND_S, PARAMETER_TRIES)

    def due(self, now_s: float, autopilot: Autopilot, target: Ids) -> Message | None:
        """Return the next request to send, if any."""
        return self._requests.due(NAMES.get(autopilot, ()), now_s, target)

    def receive(self, message: Message, autopilot: Autopilot) -> bool:
        """Process a message of the autopilot; return True if its limits changed."""
        if not isinstance(message, mavlink.MAVLink_param_value_message):
            return False
        name, value = name_of(message), value_of(message, autopilot)
        if name not in NAMES.get(autopilot, ()) or value is None or not math.isfinite(value):
            return False
        before = self.limits
        self._requests.values[name] = value
        return self.limits != before

    @property
    def limits(self) -> FenceLimits:
        """Limits by the parameters reported so far."""
        values = self._requests.values
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
        self._requests = ParameterRequests(ASK_PERIOD_S, ASKS)
        self._has_rc: bool | None = None
        self._is_done = False

    def due(self, now_s: float, autopilot: Autopilot, target: Ids) -> Message | None:
        """Return the request to send now, if any; after a few tries silence is accepted."""
        names = (PARAMETER,) if autopilot is Autopilot.PX4 else ()
        return self._requests.due(names, now_s, target)

    def receive(self, message: Message) -> str | None:
        """Process a message of the autopilot; return the warning, once, or None."""
        if isinstance(message, mavlink.MAVLink_param_value_message):
            if name_of(message) == PARAMETER:
                raw, kind = raw_of(message), ParamType.INT32
                self._requests.values[PARAMETER] = value_from_raw(raw, kind, ParamEncoding.BYTEWISE)
        elif isinstance(message, mavlink.MAVLink_sys_status_message):
            self._has_rc = hears_transmitter(message)
        action = self._requests.values.get(PARAMETER)
        if self._is_done or action is None or self._has_rc is None:
            return None
        self._is_done = True
        return WARNING if action == 0 and not self._has_rc else None
