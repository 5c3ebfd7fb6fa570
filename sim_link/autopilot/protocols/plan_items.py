"""The items of missions, fences and rally points, and the messages that carry them.

Source: MAVLink developer guide, "Mission Protocol".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.base import Outgoing, Partner

DEGREE = 1e7
LOCAL_METRE = 1e4
INT32_MIN, INT32_MAX = -(2**31), 2**31 - 1
NO_VALUE = INT32_MAX
"""Stands for NaN in an integer coordinate."""
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)
FRAME_MISSION = mavlink.MAV_FRAME_MISSION


class PlanType(IntEnum):
    """MAV_MISSION_TYPE of what is stored."""

    MISSION = mavlink.MAV_MISSION_TYPE_MISSION
    FENCE = mavlink.MAV_MISSION_TYPE_FENCE
    RALLY = mavlink.MAV_MISSION_TYPE_RALLY


ALL_TYPES = mavlink.MAV_MISSION_TYPE_ALL


class PlanResult(IntEnum):
    """MAV_MISSION_RESULT."""

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
    """MAV_CMD."""
    frame: int
    """MAV_FRAME."""
    params: tuple[float, float, float, float]
    """The first four; a NaN is kept as one."""
    x: int
    """Latitude in 1e-7 degrees where the frame is global."""
    y: int
    z: float
    """Altitude in metres, of the frame."""
    continues: bool = True
    """MISSION_ITEM_INT.autocontinue."""


ItemMessage = mavlink.MAVLink_mission_item_int_message | mavlink.MAVLink_mission_item_message


def item_from(message: ItemMessage) -> PlanItem | PlanResult:
    """The item that a message carries, not yet checked.

    Args:
        message: MISSION_ITEM_INT, or the older MISSION_ITEM, whose coordinates are floats.

    Returns:
        The item, or why its coordinates cannot be integers.
    """
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
    item: PlanItem,
    seq: int,
    plan_type: PlanType,
    target: tuple[int, int],
    *,
    is_current: bool = False,
) -> Message:
    """MISSION_ITEM_INT.

    Args:
        item: What to send.
        seq: Its place.
        plan_type: Of which plan.
        target: System and component.
        is_current: Whether the vehicle is at it, or would begin with it.
    """
    return mavlink.MAVLink_mission_item_int_message(
        *target,
        seq,
        item.frame,
        item.command,
        int(is_current),
        int(item.continues),
        *item.params,
        item.x,
        item.y,
        item.z,
        plan_type,
    )


def plan_type_of(mission_type: int) -> PlanType | None:
    """The plan that a MAV_MISSION_TYPE names; None for "all" and unknown numbers."""
    return PlanType(mission_type) if mission_type in tuple(PlanType) else None


def ack(partner: Partner, result: PlanResult, mission_type: int) -> Outgoing:
    """MISSION_ACK to a partner."""
    message = mavlink.MAVLink_mission_ack_message(
        partner.system_id, partner.component_id, result, mission_type
    )
    return Outgoing(message, partner.channel)
