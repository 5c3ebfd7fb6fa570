"""Plan transfer of the two autopilots: accepted items, and the refusals of the others.

PX4 1.15 and ArduCopter 4.5 let through more than is safe; here an infinite number, a position off
the globe, a terrain altitude without terrain and an altitude that is not a number are refused, each
by the result code of its field (MAVLink common, MAV_MISSION_RESULT).

Source: MAVLink developer guide, "Mission Protocol"; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.plan_items import (
    DEGREE,
    FRAME_MISSION,
    GLOBAL_FRAMES,
    NO_VALUE,
    PlanItem,
    PlanResult,
    PlanType,
)

MAX_LATITUDE = round(90 * DEGREE)
MAX_LONGITUDE = round(180 * DEGREE)
MAX_ALTITUDE_M = 83_000.0
"""ArduPilot's limit of a stored altitude, LOCATION_ALT_MAX_M."""
MIN_VERTICES = 3

WAYPOINT = mavlink.MAV_CMD_NAV_WAYPOINT
LAND = mavlink.MAV_CMD_NAV_LAND
DO_JUMP = mavlink.MAV_CMD_DO_JUMP


def commands_named(names: str) -> frozenset[int]:
    """Return MAV_CMDs by their names, separated by blanks."""
    return frozenset(getattr(mavlink, f"MAV_CMD_{name}") for name in names.split())


MAY_BE_HERE = commands_named(
    "NAV_LOITER_UNLIM NAV_LOITER_TURNS NAV_LOITER_TIME NAV_LAND NAV_TAKEOFF"
)
"""Commands for which 0/0, or no position, means the current position."""
POSITION_COMMANDS = MAY_BE_HERE | commands_named(
    "NAV_WAYPOINT DO_SET_ROI_LOCATION DO_SET_ROI DO_LAND_START"
)
OTHER_COMMANDS = commands_named(
    "NAV_RETURN_TO_LAUNCH NAV_DELAY CONDITION_DELAY CONDITION_YAW CONDITION_DISTANCE DO_JUMP "
    "DO_CHANGE_SPEED DO_SET_SERVO DO_SET_ROI_NONE DO_DIGICAM_CONTROL DO_MOUNT_CONTROL "
    "DO_SET_CAM_TRIGG_DIST DO_GIMBAL_MANAGER_PITCHYAW DO_GIMBAL_MANAGER_CONFIGURE SET_CAMERA_MODE "
    "IMAGE_START_CAPTURE IMAGE_STOP_CAPTURE VIDEO_START_CAPTURE VIDEO_STOP_CAPTURE"
)
POLYGON_COMMANDS = commands_named(
    "NAV_FENCE_POLYGON_VERTEX_INCLUSION NAV_FENCE_POLYGON_VERTEX_EXCLUSION"
)
CIRCLE_COMMANDS = commands_named("NAV_FENCE_CIRCLE_INCLUSION NAV_FENCE_CIRCLE_EXCLUSION")
FENCE_COMMANDS = POLYGON_COMMANDS | CIRCLE_COMMANDS | {mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT}
RALLY_COMMANDS = frozenset({mavlink.MAV_CMD_NAV_RALLY_POINT})

PARAM_RESULTS = (
    PlanResult.INVALID_PARAM1,
    PlanResult.INVALID_PARAM2,
    PlanResult.INVALID_PARAM3,
    PlanResult.INVALID_PARAM4,
)


@dataclass(frozen=True, slots=True)
class PlanChecks:
    """Plan items that one autopilot accepts."""

    zero_is_here: bool = False
    """True if a WAYPOINT at 0/0 is where the vehicle is (ArduPilot); otherwise it is refused."""
    nan_fourth: frozenset[int] | None = None
    """Mission commands whose fourth parameter alone may be NaN (ArduPilot); None: all."""
    more_positions: frozenset[int] = frozenset()
    """Commands with a position beyond those that both autopilots know."""
    more_others: frozenset[int] = frozenset()

    def problem_with(self, item: PlanItem, plan_type: PlanType) -> PlanResult | None:
        """Return the reason why an item is refused; None if it is accepted."""
        if self.nan_fourth is not None and plan_type is PlanType.MISSION:
            checked = item.params[: 3 if item.command in self.nan_fourth else 4]
            for param, result in zip(checked, PARAM_RESULTS, strict=False):
                if math.isnan(param):
                    return result
        has_position = self._has_position(item.command, plan_type)
        if has_position is None:
            return PlanResult.UNSUPPORTED
        frames = GLOBAL_FRAMES if has_position else (*GLOBAL_FRAMES, FRAME_MISSION)
        if item.frame not in frames:
            return PlanResult.UNSUPPORTED_FRAME
        for param, result in zip(item.params, PARAM_RESULTS, strict=True):
            if math.isinf(param):
                return result
        problem = self._position_problem(item) if has_position else None
        return problem or _meaning_problem(item)

    def _has_position(self, command: int, plan_type: PlanType) -> bool | None:
        """Return True if a command has a position; None if it does not belong into such a plan."""
        match plan_type:
            case PlanType.FENCE:
                return True if command in FENCE_COMMANDS else None
            case PlanType.RALLY:
                return True if command in RALLY_COMMANDS else None
        if command in POSITION_COMMANDS | self.more_positions:
            return True
        return False if command in OTHER_COMMANDS | self.more_others else None

    def _position_problem(self, item: PlanItem) -> PlanResult | None:
        may_be_here = item.command in MAY_BE_HERE
        is_nowhere = NO_VALUE in (item.x, item.y)
        if not (is_nowhere and may_be_here):
            if abs(item.x) > MAX_LATITUDE:
                return PlanResult.INVALID_PARAM5_X
            if abs(item.y) > MAX_LONGITUDE:
                return PlanResult.INVALID_PARAM6_Y
        if item.command == WAYPOINT and item.x == item.y == 0 and not self.zero_is_here:
            return PlanResult.INVALID_PARAM5_X
        if math.isnan(item.z) and item.command == LAND:
            return None  # the altitude of the ground, which may be unknown
        return None if abs(item.z) <= MAX_ALTITUDE_M else PlanResult.INVALID_PARAM7


def _meaning_problem(item: PlanItem) -> PlanResult | None:
    first, second = item.params[:2]
    if item.command == WAYPOINT and first < 0.0:
        return PlanResult.INVALID_PARAM1
    if item.command == DO_JUMP:
        if not (first >= 0.0 and first.is_integer()):
            return PlanResult.INVALID_PARAM1
        if not (second >= -1.0 and second.is_integer()):
            return PlanResult.INVALID_PARAM2
    if item.command in POLYGON_COMMANDS and not (first >= MIN_VERTICES and first.is_integer()):
        return PlanResult.INVALID_PARAM1
    if item.command in CIRCLE_COMMANDS and not first > 0.0:
        return PlanResult.INVALID_PARAM1
    return None


def plan_problem(items: Sequence[PlanItem], plan_type: PlanType) -> PlanResult | None:
    """Return the reason why valid items form no plan, such as an incomplete polygon, or None."""
    if plan_type is PlanType.FENCE:
        return _fence_problem(items)
    for item in items:
        if item.command == DO_JUMP and item.params[0] >= len(items):
            return PlanResult.INVALID_PARAM1
    return None


def _fence_problem(items: Sequence[PlanItem]) -> PlanResult | None:
    index = 0
    while index < len(items):
        first = items[index]
        if first.command not in POLYGON_COMMANDS:
            index += 1
            continue
        count = int(first.params[0])
        polygon = items[index : index + count]
        if len(polygon) < count:
            return PlanResult.INVALID_PARAM1
        if any((v.command, v.params[0]) != (first.command, count) for v in polygon):
            return PlanResult.INVALID_PARAM1
        index += count
    return None


MAX_TRANSFERS = 16
"""Uploads, and as many downloads, at a time; all end by themselves within seconds."""


@dataclass(frozen=True, slots=True)
class PlanRules:
    """Behaviour of an autopilot in plan transfers."""

    capacity: Mapping[PlanType, int]
    checks: PlanChecks
    retry_s: float
    """Silence after which an item is requested again."""
    timeout_s: float
    """Silence after which a transfer is over."""
    is_atomic: bool = True
    """True if a mission changes as a whole, at the end of its upload; otherwise it is cut at
    MISSION_COUNT and overwritten item by item."""
    is_one_at_a_time: bool = False
    """True if a second partner may not upload the same plan at the same time."""
    can_be_cancelled: bool = True
    waits_for_ack: bool = True
    """True if a download lasts until MISSION_ACK, and items are given only during one."""
    reports_wrong_number: bool = False
    """True if an item out of order gets INVALID_SEQUENCE; otherwise it is dropped."""
    asks_in_old_form: bool = False
    """True if items are requested by MISSION_REQUEST instead of MISSION_REQUEST_INT."""
    stores_less: bool = False
    """True if a NaN is given back as 0, and a frame by its older name."""


@dataclass(slots=True)
class Upload:
    """A plan on its way in."""

    plan_type: PlanType
    count: int
    active_s: float
    """Arrival time of the last expected item."""
    asked_s: float
    items: list[PlanItem] = field(default_factory=list)
    current: int = 0
    """The item that was marked as the one to begin with."""

    @property
    def expected(self) -> int:
        """The number of the item that is wanted next."""
        return len(self.items)


@dataclass(slots=True)
class Download:
    """Download of a plan as it was when requested."""

    plan_type: PlanType
    items: tuple[PlanItem, ...]
    active_s: float
