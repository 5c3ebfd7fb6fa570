"""Missions, fences and rally points: their items, the store, and the progress of a mission.

Source: MAVLink developer guide, "Mission Protocol"; MAVLink common, MISSION_CURRENT.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Outgoing, Partner

DEGREE = 1e7
LOCAL_METRE = 1e4
INT32_MIN, INT32_MAX = -(2**31), 2**31 - 1
NO_VALUE = INT32_MAX
"""Unknown integer coordinate, as NaN is for floats."""
AMSL_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
RELATIVE_FRAMES = (mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
GLOBAL_FRAMES = AMSL_FRAMES + RELATIVE_FRAMES
FRAME_MISSION = mavlink.MAV_FRAME_MISSION


class PlanType(IntEnum):
    """MAV_MISSION_TYPE of the stored plan."""

    MISSION = mavlink.MAV_MISSION_TYPE_MISSION
    FENCE = mavlink.MAV_MISSION_TYPE_FENCE
    RALLY = mavlink.MAV_MISSION_TYPE_RALLY


ALL_TYPES = mavlink.MAV_MISSION_TYPE_ALL


class PlanResult(IntEnum):
    """Result of a plan transfer, MAV_MISSION_RESULT."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED_FRAME = 2
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID = 5
    INVALID_PARAM1 = 6
    INVALID_PARAM2 = 7
    INVALID_PARAM3 = 8
    INVALID_PARAM4 = 9
    INVALID_PARAM5_X = 10
    INVALID_PARAM6_Y = 11
    INVALID_PARAM7 = 12
    INVALID_SEQUENCE = 13
    DENIED = 14
    CANCELLED = 15


@dataclass(frozen=True, slots=True)
class PlanItem:
    """One item, in the units of MISSION_ITEM_INT."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    """The first four; a NaN is kept as one."""
    x: int
    """Latitude in 1e-7 degrees where the frame is global."""
    y: int
    z: float
    """Altitude in metres, of the frame."""
    continues: bool = True


ItemMessage = mavlink.MAVLink_mission_item_int_message | mavlink.MAVLink_mission_item_message


def item_from(message: ItemMessage) -> PlanItem | PlanResult:
    """Return the unchecked item of a message, or why its position cannot be integers."""
    params = (message.param1, message.param2, message.param3, message.param4)
    if isinstance(message, mavlink.MAVLink_mission_item_int_message):
        x, y = message.x, message.y
    else:
        scale = DEGREE if message.frame in GLOBAL_FRAMES else LOCAL_METRE
        scale = 1.0 if message.frame == FRAME_MISSION else scale
        converted = [_scaled(value, scale) for value in (message.x, message.y)]
        if converted[0] is None:
            return PlanResult.INVALID_PARAM5_X
        if converted[1] is None:
            return PlanResult.INVALID_PARAM6_Y
        x, y = converted[0], converted[1]
    return PlanItem(
        message.command, message.frame, params, x, y, message.z, bool(message.autocontinue)
    )


def _scaled(value: float, scale: float) -> int | None:
    if math.isnan(value):
        return NO_VALUE
    scaled = value * scale
    return round(scaled) if INT32_MIN <= scaled <= INT32_MAX else None


def item_message(
    item: PlanItem, seq: int, plan_type: PlanType, target: tuple[int, int], *, is_current: bool
) -> Message:
    """Return the MISSION_ITEM_INT of an item."""
    flags = (int(is_current), int(item.continues))
    what = (*target, seq, item.frame, item.command, *flags)
    return mavlink.MAVLink_mission_item_int_message(
        *what, *item.params, item.x, item.y, item.z, plan_type
    )


def plan_type_of(mission_type: int) -> PlanType | None:
    """Return the plan that a MAV_MISSION_TYPE names; None for "all" and unknown numbers."""
    return PlanType(mission_type) if mission_type in tuple(PlanType) else None


def ack(partner: Partner, result: PlanResult, mission_type: int) -> Outgoing:
    """Return a MISSION_ACK to a partner."""
    message = mavlink.MAVLink_mission_ack_message(*partner.ids, result, mission_type)
    return Outgoing(message, partner.channel)


@dataclass(frozen=True, slots=True)
class PlanChanged:
    """A plan was replaced, changed in part or cleared."""

    plan_type: PlanType


@dataclass(frozen=True, slots=True)
class CurrentChosen:
    """Request to continue the mission from another item."""

    seq: int


PlanEvent = PlanChanged | CurrentChosen


class PlanStore:
    """Plans stored in a vehicle; `home` is ArduPilot's item 0, whatever was uploaded; or None."""

    def __init__(self, home: Callable[[], PlanItem] | None = None) -> None:
        self._home = home
        self._plans: dict[PlanType, tuple[PlanItem, ...]] = dict.fromkeys(PlanType, ())
        self.current = 0
        """The mission item that is flown to, or would be first."""
        self._events: list[PlanEvent] = []

    def items(self, plan_type: PlanType) -> tuple[PlanItem, ...]:
        """Return the items of a plan, in order."""
        return self._plans[plan_type]

    @property
    def ids(self) -> tuple[int, int, int]:
        """A number for each plan that is another one where its items are; 0 of none (PX4: CRC)."""
        mission, fence, rally = (
            zlib.crc32(repr(items).encode("ascii")) if items else 0
            for items in (self._plans[plan_type] for plan_type in PlanType)
        )
        return mission, fence, rally

    def home_at(self, plan_type: PlanType, seq: int) -> PlanItem | None:
        """Return the vehicle's home if it replaces this mission item, else None."""
        is_home = plan_type is PlanType.MISSION and seq == 0
        return self._home() if self._home is not None and is_home else None

    def choose(self, seq: int) -> bool:
        """Continue from a requested item; False if there is no such item."""
        if not 0 <= seq < len(self._plans[PlanType.MISSION]):
            return False
        self.current = seq
        self._events.append(CurrentChosen(seq))
        return True

    def replace(self, plan_type: PlanType, items: Sequence[PlanItem], current: int = 0) -> None:
        """Replace a plan as a whole."""
        self._plans[plan_type] = tuple(items)
        if plan_type is PlanType.MISSION:
            self.current = current
        self._events.append(PlanChanged(plan_type))

    def patch(self, plan_type: PlanType, seq: int, item: PlanItem) -> None:
        """Put one item in its place, or at the end, as ArduPilot does during an upload."""
        items = self._plans[plan_type]
        self._plans[plan_type] = (*items[:seq], item, *items[seq + 1 :])

    def take_events(self) -> list[PlanEvent]:
        """Take the events since the last call."""
        events, self._events = self._events, []
        return events


NO_MISSION_TOTAL = 0xFFFF


class MissionState(IntEnum):
    """State of the mission, MISSION_STATE."""

    UNKNOWN = 0
    NO_MISSION = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """Progress of a mission."""

    seq: int
    """The item that is flown to, or would be first."""
    count: int
    """Items stored, ArduPilot's home among them."""
    state: MissionState
    is_in_mission_mode: bool
    has_home: bool = False
    """True if item 0 is home, which the total does not include."""
    plan_ids: tuple[int, int, int] = (0, 0, 0)
    """Ids of mission, fence and rally points; 0 also if the autopilot has none."""

    @property
    def fields(self) -> tuple[int, int, int, int, tuple[int, int, int]]:
        """Return the fields of MISSION_CURRENT: item, total, state, mode and ids."""
        total = max(0, self.count - self.has_home) if self.count else NO_MISSION_TOTAL
        mode = 1 if self.is_in_mission_mode else 2
        return (self.seq, total, self.state, mode, self.plan_ids)
