"""PX4's failsafes: what is wrong now, and which reaction to it wins.

Theory of operation. Every cause has a reaction while it is active, and the most severe reaction is
flown. Most reactions wait: PX4 holds for COM_FAIL_ACT_T first, so that the operator may take over,
by a mode but not by the sticks. What only falls back (no setpoints, no position) and a hold at the
fence do not wait. The time to hold shrinks while it is used and grows back four times as slowly, so
that a cause that comes and goes is acted on in the end.

Some causes end with their condition (setpoints, position, battery), the others stay until the
operator chooses a mode or the vehicle disarms (sticks, station, fence). A choice of the operator
takes over from all of them: a cause that was taken over acts again only after its condition has
gone and come back.

Source: PX4 1.15, `commander/failsafe/framework.cpp` and `failsafe.cpp`; user guide, "Safety
Configuration"; Parameter Reference, COM_*, NAV_*, BAT_*, GF_*.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore

REGROWTH = 0.25
"""Rate at which the delay recovers, in s per s."""


class Reaction(Enum):
    """Reactions in order of severity, each with the mode that carries it out."""

    WARN = (0, None)
    POSITION = (1, FlightMode.POSITION)
    ALTITUDE = (2, FlightMode.ALTITUDE)
    MANUAL = (3, FlightMode.STABILIZED)
    HOLD = (4, FlightMode.HOLD)
    RETURN = (5, FlightMode.RETURN)
    LAND = (6, FlightMode.LAND)
    DISARM = (7, None)

    def __init__(self, severity: int, mode: FlightMode | None) -> None:
        self.severity = severity
        self.mode = mode


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """Cause of a failsafe, and PX4's reaction to it."""

    text: str
    """Text of the report."""
    parameter: str | None
    """Says which reaction it is; None: the first."""
    reactions: tuple[Reaction | None, ...]
    """Reactions by the parameter's value; None: this is not watched."""
    waits: bool = True
    """True if it waits for COM_FAIL_ACT_T first."""
    ends: bool = False
    """True if it ends with its condition."""


WARN, HOLD, RETURN = Reaction.WARN, Reaction.HOLD, Reaction.RETURN
LAND, DISARM = Reaction.LAND, Reaction.DISARM
FALLBACKS = (Reaction.POSITION, Reaction.ALTITUDE, Reaction.MANUAL)
LINK_LOSS = (None, HOLD, RETURN, LAND, None, DISARM, DISARM)
CAUSES = (
    Cause(
        "no setpoints",
        "COM_OBL_RC_ACT",
        (*FALLBACKS, RETURN, LAND, HOLD, DISARM, DISARM),
        waits=False,
        ends=True,
    ),
    Cause("no sticks", "NAV_RCL_ACT", LINK_LOSS),
    Cause("no ground station", "NAV_DLL_ACT", LINK_LOSS),
    Cause("no position", None, (LAND,)),
    Cause("fence breached", "GF_ACTION", (None, WARN, HOLD, RETURN, DISARM, LAND)),
    Cause("battery critical", "COM_LOW_BAT_ACT", (WARN, WARN, LAND, RETURN), ends=True),
    Cause("battery emergency", "COM_LOW_BAT_ACT", (WARN, LAND, LAND, LAND), ends=True),
)
EXCEPTION_OF = {FlightMode.MISSION: 1, FlightMode.HOLD: 2, FlightMode.OFFBOARD: 4}


class Px4Failsafes:
    """Active failsafe causes of one aircraft, and the reaction that is flown."""

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self._aircraft = aircraft
        self._parameters = parameters
        self.delay_s = 0.0
        """Time for which it holds before the reaction; 0 once that time has passed."""
        self._active: dict[Cause, Reaction] = {}
        self._taken_over: set[Cause] = set()
        self._spent_s = 0.0
        """Time by which the next such hold is shorter than COM_FAIL_ACT_T."""
        self._had_sticks = False
        self._has_warned = False

    def watch(
        self, intention: FlightMode, fence_margin_m: float, now_s: float, *, is_stream_alive: bool
    ) -> list[Cause]:
        """Check an armed vehicle; return the causes that became active just now."""
        before, delay_s = self.flown, self._parameters["COM_FAIL_ACT_T"]
        is_reacting = before is not None and before.severity > HOLD.severity
        self.delay_s = max(0.0, self.delay_s - STEP_S)
        has_sticks = self._aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        excepted = int(self._parameters["COM_RCL_EXCEPT"])
        is_excepted = bool(excepted & EXCEPTION_OF.get(intention, 0))
        heard_s = max(self._aircraft.stations_s.values(), default=None)
        present = (
            intention is FlightMode.OFFBOARD and not is_stream_alive,
            (self._had_sticks and not has_sticks and not is_excepted),
            (heard_s is not None and now_s - heard_s > self._parameters["COM_DL_LOSS_T"]),
            not self._aircraft.estimator.is_position_valid,
            fence_margin_m < 0.0,
            self._aircraft.battery.share <= self._parameters["BAT_CRIT_THR"],
            self._aircraft.battery.share <= self._parameters["BAT_EMERGEN_THR"],
        )
        found = zip(CAUSES, present, strict=True)
        fresh = [cause for cause, is_present in found if self._note(cause, is_present)]
        if any(each.waits and self._active[each] is not WARN for each in fresh):
            self.delay_s = self.delay_s or max(0.0, delay_s - self._spent_s)
        can_hold = self._aircraft.estimator.is_position_valid
        if is_reacting or not can_hold or not self._active:
            self.delay_s = 0.0
        change_s = STEP_S if self.delay_s else -REGROWTH * STEP_S
        self._spent_s = min(delay_s, max(0.0, self._spent_s + change_s))
        return fresh

    def _note(self, cause: Cause, is_present: bool) -> bool:
        number = 0 if cause.parameter is None else int(self._parameters[cause.parameter])
        is_known = 0 <= number < len(cause.reactions)
        reaction = (cause.reactions[number] if is_known else WARN) if is_present else None
        if reaction is None:
            self._taken_over.discard(cause)
            if cause.ends:
                self._active.pop(cause, None)
            return False
        if cause in self._taken_over or cause in self._active:
            return False
        self._active[cause] = reaction
        return True

    def warn_of_battery(self) -> None:
        """Send a text when the charge falls below BAT_LOW_THR."""
        is_low = self._aircraft.battery.share <= self._parameters["BAT_LOW_THR"]
        if is_low and not self._has_warned:
            self._aircraft.say(mavlink.MAV_SEVERITY_WARNING, "Low battery level")
        self._has_warned = is_low

    def take_over(self) -> None:
        """Handle the operator's choice of a mode."""
        self._taken_over |= self._active.keys()
        self._active.clear()
        self.delay_s = 0.0

    def clear(self) -> None:
        """Clear failsafes when the vehicle disarms."""
        self._active.clear()
        self._taken_over.clear()
        self.delay_s = 0.0

    @property
    def worst(self) -> tuple[Cause, Reaction] | None:
        """The cause with the most severe reaction, or None."""
        return max(self._active.items(), key=lambda item: item[1].severity, default=None)

    @property
    def flown(self) -> Reaction | None:
        """The reaction that is flown now: a hold while the worst one waits."""
        if self.worst is None:
            return None
        _, reaction = self.worst
        waits = self.delay_s > 0.0 and reaction not in (WARN, DISARM)
        return HOLD if waits else reaction
