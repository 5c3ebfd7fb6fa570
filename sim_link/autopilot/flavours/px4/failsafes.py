"""PX4's failsafes: what is wrong now, and which reaction to it wins.

Theory of operation. Every cause has a reaction while it is active. Causes of the first kind end
with their condition (setpoints, sticks, station, position); those of the second stay until the
operator chooses a mode or the vehicle disarms (battery, fence). A choice of the operator takes over
from all of them: a cause that was taken over acts again only after its condition has gone and come
back. The most severe reaction is flown. Source: PX4 1.15, `failsafe/framework.h` and user guide,
"Safety Configuration".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.domain import FlightMode


class Cause(Enum):
    """What is wrong, in the words of the report."""

    NO_SETPOINTS = "no setpoints"
    NO_STICKS = "no sticks"
    NO_STATION = "no ground station"
    NO_POSITION = "no position"
    FENCE = "fence breached"
    BATTERY_CRITICAL = "battery critical"
    BATTERY_EMERGENCY = "battery emergency"


ENDS_WITH_ITS_CONDITION = frozenset(
    {Cause.NO_SETPOINTS, Cause.NO_STICKS, Cause.NO_STATION, Cause.NO_POSITION}
)


class Reaction(Enum):
    """What is done about it, in order of severity."""

    WARN = 0
    POSITION = 1
    ALTITUDE = 2
    MANUAL = 3
    HOLD = 4
    RETURN = 5
    LAND = 6
    DISARM = 7


MODE_OF_REACTION: dict[Reaction, FlightMode] = {
    Reaction.POSITION: FlightMode.POSITION,
    Reaction.ALTITUDE: FlightMode.ALTITUDE,
    Reaction.MANUAL: FlightMode.STABILIZED,
    Reaction.HOLD: FlightMode.HOLD,
    Reaction.RETURN: FlightMode.RETURN,
    Reaction.LAND: FlightMode.LAND,
}
OFFBOARD_LOSS_REACTION = {
    0: Reaction.POSITION,
    1: Reaction.ALTITUDE,
    2: Reaction.MANUAL,
    3: Reaction.RETURN,
    4: Reaction.LAND,
    5: Reaction.HOLD,
    6: Reaction.DISARM,
    7: Reaction.DISARM,
}
"""COM_OBL_RC_ACT."""
LINK_LOSS_REACTION = {
    1: Reaction.HOLD,
    2: Reaction.RETURN,
    3: Reaction.LAND,
    5: Reaction.DISARM,
    6: Reaction.DISARM,
}
"""NAV_DLL_ACT and NAV_RCL_ACT; 0: nothing."""
FENCE_REACTION = {
    1: Reaction.WARN,
    2: Reaction.HOLD,
    3: Reaction.RETURN,
    4: Reaction.DISARM,
    5: Reaction.LAND,
}
"""GF_ACTION; 0: nothing."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause, whether its condition holds now, and the reaction to it."""

    cause: Cause
    is_present: bool
    reaction: Reaction | None
    """None: this is not watched."""


class Failsafes:
    """Which causes are active."""

    def __init__(self) -> None:
        self._active: dict[Cause, Reaction] = {}
        self._taken_over: set[Cause] = set()

    def watch(self, finding: Finding) -> bool:
        """Take in a finding; whether a cause became active just now."""
        cause = finding.cause
        if not finding.is_present or finding.reaction is None:
            self._taken_over.discard(cause)
            if cause in ENDS_WITH_ITS_CONDITION:
                self._active.pop(cause, None)
            return False
        if cause in self._taken_over or cause in self._active:
            return False
        self._active[cause] = finding.reaction
        return True

    def take_over(self) -> None:
        """The operator chose a mode."""
        self._taken_over |= self._active.keys()
        self._active.clear()

    def clear(self) -> None:
        """The vehicle disarmed."""
        self._active.clear()
        self._taken_over.clear()

    @property
    def worst(self) -> tuple[Cause, Reaction] | None:
        """The cause with the most severe reaction, or None."""
        if not self._active:
            return None
        return max(self._active.items(), key=lambda item: item[1].value)
