"""Execution of an uploaded mission: the current item, its task, and its completion.

Commands that do nothing here (cameras, gimbals, servos) count as done at once.

Source: MAVLink common, MAV_CMD_NAV_* and MAV_CMD_DO_*; MISSION_STATE.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from companion.domain import PositionEnu
from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.plan_items import NO_VALUE, MissionState, PlanItem

ACCEPTANCE_M = 2.0
"""Radius in which a waypoint counts as reached, unless the item has one (PX4 NAV_ACC_RAD)."""
ACCEPTANCE_UP_M = 0.8
MAX_STEPS = 1000
"""Maximum number of items executed at once without flying: a loop of jumps must end."""


TIMED_WAYPOINTS = (
    mavlink.MAV_CMD_NAV_WAYPOINT,
    mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
    mavlink.MAV_CMD_NAV_LOITER_TIME,
)
"""Waypoints to loiter at for the seconds of their first parameter."""

Locate = Callable[[PlanItem], PositionEnu]
"""Position of an item, in the world's frame."""


class LegKind(Enum):
    """Kind of task of an item."""

    FLY = "fly"
    LAND = "land"
    RETURN = "return"


@dataclass(frozen=True, slots=True)
class MissionLeg:
    """Target of the current part of a mission."""

    kind: LegKind
    goal_enu_m: PositionEnu
    speed_mps: float | None = None
    yaw_ned_rad: float | None = None


class MissionRun:
    """Progress through one mission from its `first` item: 1 where item 0 is home (ArduPilot)."""

    def __init__(self, locate: Locate, first: int) -> None:
        self.items: tuple[PlanItem, ...] = ()
        self.current = 0
        self.state = MissionState.NO_MISSION
        self.reached: list[int] = []
        """Items reached since the list was last emptied: MISSION_ITEM_REACHED."""
        self._locate = locate
        self._first = first
        self._speed_mps: float | None = None
        self._arrived_s: float | None = None
        self._goal: PositionEnu | None = None
        self._jumps: dict[int, int] = {}

    @property
    def has_items(self) -> bool:
        """True if there is an item to fly."""
        return len(self.items) > self._first

    def load(self, items: Sequence[PlanItem]) -> None:
        """Replace the plan; it begins at its start."""
        self.items = tuple(items)
        self.rewind()

    def rewind(self) -> None:
        """Go back to the start."""
        self._go_to(0 if not self.has_items else self._first)
        self._jumps.clear()
        self._speed_mps = None
        self.state = MissionState.NOT_STARTED if self.has_items else MissionState.NO_MISSION

    def set_current(self, index: int) -> bool:
        """Continue at an item; return True if it exists."""
        if not 0 <= index < len(self.items):
            return False
        self._go_to(index)
        if self.state is MissionState.COMPLETE:
            self.state = MissionState.PAUSED
        return True

    def start(self) -> None:
        """Continue; a complete mission starts again."""
        if self.state is MissionState.COMPLETE:
            self.rewind()
        if self.has_items:
            self.state = MissionState.ACTIVE

    def finish_leg(self) -> None:
        """Finish the current item."""
        self._done()
        if self.current >= len(self.items):
            self._complete()

    def pause(self) -> None:
        """Pause the mission at the current item."""
        if self.state is MissionState.ACTIVE:
            self.state = MissionState.PAUSED
        self._goal = None

    def leg(self, position: PositionEnu, is_on_ground: bool, now_s: float) -> MissionLeg | None:
        """Return the target at `now_s`, or None at the end; completed items are passed."""
        if self.state is not MissionState.ACTIVE:
            return None
        for _ in range(MAX_STEPS):
            if self.current >= len(self.items):
                break
            leg = self._leg_of(self.items[self.current], position, is_on_ground, now_s)
            if leg is not None:
                return leg
        self._complete()
        return None

    def _complete(self) -> None:
        self.current = max(0, len(self.items) - 1)
        self.state = MissionState.COMPLETE

    def _go_to(self, index: int) -> None:
        self.current = index
        self._arrived_s = None
        self._goal = None

    def _done(self) -> None:
        self.reached.append(self.current)
        self._go_to(self.current + 1)

    def _leg_of(
        self, item: PlanItem, position: PositionEnu, is_on_ground: bool, now_s: float
    ) -> MissionLeg | None:
        """Return the leg of an item, or None if it is done (the run has moved on then)."""
        hold_s = item.params[0] if item.params[0] > 0.0 else 0.0
        match item.command:
            case mavlink.MAV_CMD_NAV_LAND:
                return self._land(item, position, is_on_ground)
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return MissionLeg(LegKind.RETURN, position)
            case number if number in TIMED_WAYPOINTS:
                return self._fly(item, self._goal_of(item, position), position, hold_s, now_s)
            case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
                return self._fly(item, self._goal_of(item, position), position, math.inf, now_s)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                if self._goal is None:
                    up_m = self._locate(item)[2]
                    self._goal = (position[0], position[1], max(up_m, position[2]))
                return self._fly(item, self._goal, position, 0.0, now_s)
            case mavlink.MAV_CMD_NAV_DELAY | mavlink.MAV_CMD_CONDITION_DELAY:
                goal = self._goal = self._goal or position
                return self._fly(item, goal, position, hold_s, now_s)
            case mavlink.MAV_CMD_DO_CHANGE_SPEED:
                self._speed_mps = item.params[1] if item.params[1] > 0.0 else None
            case mavlink.MAV_CMD_DO_JUMP if self._jump(item):
                return None
        self._done()
        return None

    def _jump(self, item: PlanItem) -> bool:
        is_number = math.isfinite(item.params[0]) and math.isfinite(item.params[1])
        if not is_number or not 0 <= int(item.params[0]) < len(self.items):
            return False
        flown = self._jumps.get(self.current, 0)
        if 0 <= int(item.params[1]) <= flown:
            return False
        self._jumps[self.current] = flown + 1
        self.reached.append(self.current)
        self._go_to(int(item.params[0]))
        return True

    def _goal_of(self, item: PlanItem, position: PositionEnu) -> PositionEnu:
        if self._goal is None:
            is_here = (item.x, item.y) == (0, 0) or NO_VALUE in (item.x, item.y)
            self._goal = position if is_here else self._locate(item)
        return self._goal

    def _land(self, item: PlanItem, position: PositionEnu, is_on_ground: bool) -> MissionLeg | None:
        east, north, _ = self._goal_of(item, position)
        if self._arrived_s is None and math.dist((east, north), position[:2]) > ACCEPTANCE_M:
            return MissionLeg(LegKind.FLY, (east, north, position[2]), self._speed_mps)
        self._arrived_s = 0.0
        if is_on_ground:
            self._done()
            return None
        return MissionLeg(LegKind.LAND, (east, north, position[2]))

    def _fly(
        self, item: PlanItem, goal: PositionEnu, position: PositionEnu, hold_s: float, now_s: float
    ) -> MissionLeg | None:
        is_waypoint = item.command == mavlink.MAV_CMD_NAV_WAYPOINT
        radius_m = item.params[1] if is_waypoint and item.params[1] > 0.0 else ACCEPTANCE_M
        is_level = abs(goal[2] - position[2]) <= ACCEPTANCE_UP_M
        is_there = is_level and math.dist(goal[:2], position[:2]) <= radius_m
        if is_there and self._arrived_s is None:
            self._arrived_s = now_s
        if self._arrived_s is not None and now_s - self._arrived_s >= hold_s:
            self._done()
            return None
        yaw = item.params[3]
        wanted = math.radians(yaw) if is_waypoint and math.isfinite(yaw) and yaw != 0.0 else None
        if wanted is None and math.dist(goal[:2], position[:2]) > ACCEPTANCE_M:
            wanted = math.atan2(goal[0] - position[0], goal[1] - position[1])
        return MissionLeg(LegKind.FLY, goal, self._speed_mps, wanted)
