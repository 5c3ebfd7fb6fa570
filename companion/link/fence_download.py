"""Download of the autopilot's fence by the mission protocol, without I/O.

Source: MAVLink developer guide, "Mission Protocol", with the mission type FENCE:
MISSION_REQUEST_LIST, MISSION_COUNT, then MISSION_REQUEST_INT and MISSION_ITEM_INT alternately, and
our MISSION_ACK at the end, without which PX4 1.15 rejects the next transfer (also after a count of
0, observed in SITL). MAVLink common, MAV_CMD_NAV_FENCE_*: 5000 return point, 5001/5002 polygon
in/out with the number of its vertices in parameter 1, 5003/5004 circle in/out with its radius
there.

A request without an answer is repeated, one at a time; after some tries the download pauses, each
time for longer.

A fence that stations may change is read again. PX4 reports a change by another fence_id in
MISSION_CURRENT, ArduPilot by the PARAM_VALUE of a FENCE_ parameter on all links (its number of
items is one). A station on our line is answered by a MISSION_ACK that we receive. Where there is no
id, all of this may be missed, so the fence is also read again every few seconds.

Source: MAVLink common, MISSION_CURRENT.fence_id; ArduPilot `AC_PolyFence_loader`, FENCE_TOTAL.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import get_args

from companion.geometry.geofence import GeoArea, GeoFence, LatLon, NamedArea, fence_of
from companion.guidance.events import AutopilotFenceRead
from companion.mav.addressing import fence_id_of, is_for
from companion.mav.dialect import Message, mavlink, result_words
from companion.mav.param_encoding import name_of, raw_of

RESEND_S = 0.4
TRIES = 8
"""Tries of one request: at 30 % loss each way 99.5 % are answered by then."""
REST_S, LAST_REST_S = 10.0, 60.0
"""First and longest pause after a failed download."""
READ_AGAIN_S = 10.0
"""Interval of repeated readings: at 5 m/s, the usual speed limit, a vehicle flies 50 m in it; a
square takes some 5 frames."""
MOST_SHARE = 0.2
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
    refusal: int | None = None
    """MAV_MISSION_RESULT of an autopilot that refused; None: it did not."""

    def advance(self) -> None:
        """Note that the request was answered; the next one is due at once."""
        self.tries, self.next_s, self.refusal = 0, -math.inf, None


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
        """Reported id of the present fence; 0: ids are not supported, or there is no fence."""
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

    def hurry(self) -> None:
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
        """Return the failure of a reading without answer, once."""
        reading = self._reading
        if reading is None or reading.tries < TRIES or now_s < reading.next_s:
            return None
        why = "no answer"
        if reading.refusal is not None:
            words = result_words("MAV_MISSION_RESULT", reading.refusal, "MAV_MISSION_")
            why = f"refused ({words})"
        self._end(now_s)
        self._rest_s = min(2.0 * self._rest_s, LAST_REST_S)
        return AutopilotFenceRead(now_s, problem=why) if reading.is_wanted else None

    def receive(self, message: Message, now_s: float, own: Ids) -> AutopilotFenceRead | None:
        """Process a message of the autopilot for us; return its fence, once complete."""
        reading = self._reading
        if reading is None or not isinstance(message, Answer) or message.mission_type != FENCE:
            return None
        if not is_for(message, own):
            return None
        match message:
            case mavlink.MAVLink_mission_ack_message():
                reading.refusal = message.type
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
        self._again_s = now_s + max(READ_AGAIN_S, (now_s - reading.begun_s) / MOST_SHARE)
        self._end(now_s)
        return _fence_event(reading.items, reading.count, now_s)

    def _end(self, now_s: float) -> None:
        self._reading = None
        self._rest_until_s = now_s + self._rest_s


def _fence_event(items: Sequence[Item], count: int, now_s: float) -> AutopilotFenceRead:
    try:
        if count > MAX_ITEMS:
            raise ValueError(f"it has {count} items, more than {MAX_ITEMS}")
        return AutopilotFenceRead(now_s, fence_of_items(items))
    except ValueError as error:
        return AutopilotFenceRead(now_s, problem=str(error), is_unusable=True)


def fence_of_items(items: Sequence[Item]) -> GeoFence | None:
    """Return the fence that items form, if any; a `ValueError` begins with the item's number."""
    areas: list[NamedArea] = []
    index = 0
    while index < len(items):
        item, path = items[index], f"item {index + 1}"
        if item.frame not in GLOBAL_FRAMES:
            raise ValueError(f"{path}: frame {item.frame} is not a global one")
        if item.command in CIRCLES:
            area = GeoArea((_place(item),), item.param1)
            areas.append(NamedArea(path, CIRCLES[item.command], area))
            index += 1
        elif item.command in POLYGONS:
            vertices = _vertices(items, index, path)
            area = GeoArea(tuple(_place(vertex) for vertex in vertices))
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
        raise ValueError(f"{path}: the polygon of {first.param1:g} vertices is torn")
    return vertices


def _place(item: Item) -> LatLon:
    return item.x / DEGREE, item.y / DEGREE
