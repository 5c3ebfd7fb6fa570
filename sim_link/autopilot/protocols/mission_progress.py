"""MISSION_CURRENT and MISSION_ITEM_REACHED.

Source: MAVLink common, MISSION_CURRENT. Its opaque plan ids are extensions that the dialect does
not have; left out, they read as 0, "not supported".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from companion.mav.dialect import Message, mavlink

NO_MISSION_TOTAL = 0xFFFF


class MissionState(IntEnum):
    """MISSION_STATE."""

    UNKNOWN = 0
    NO_MISSION = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """How far a mission is."""

    seq: int
    """The item that is flown to, or would be first."""
    count: int
    """Items stored, ArduPilot's home among them."""
    state: MissionState
    is_in_mission_mode: bool
    has_home: bool = False
    """Whether item 0 is home, which the total leaves out."""


def mission_current(progress: MissionProgress) -> Message:
    """MISSION_CURRENT."""
    total = max(0, progress.count - progress.has_home) if progress.count else NO_MISSION_TOTAL
    mode = 1 if progress.is_in_mission_mode else 2
    return mavlink.MAVLink_mission_current_message(progress.seq, total, progress.state, mode)


def mission_item_reached(seq: int) -> Message:
    """MISSION_ITEM_REACHED, to be sent once for each item."""
    return mavlink.MAVLink_mission_item_reached_message(seq)


class MissionAnnouncer:
    """Tells everyone of a change at once; the steady 1 Hz belongs to the streams."""

    def __init__(self) -> None:
        self._told: MissionProgress | None = None

    def changed(self, progress: MissionProgress) -> Message | None:
        """MISSION_CURRENT if anything in it is new."""
        if progress == self._told:
            return None
        self._told = progress
        return mission_current(progress)
