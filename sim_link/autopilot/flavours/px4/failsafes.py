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

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.protocols.parameter_store import ParameterStore


class Cause(Enum):
    """What is wrong, in the words of the report."""

    NO_SETPOINTS = "no setpoints"
    NO_STICKS = "no sticks"
    NO_STATION = "no ground station"
    NO_POSITION = "no position"
    FENCE = "fence breached"
    BATTERY_CRITICAL = "battery critical"
    BATTERY_EMERGENCY = "battery emergency"


REGROWTH = 0.25
"""How fast the delay grows back."""


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
class FailsafeCondition:
    """One cause, whether its condition holds now, and the reaction to it."""

    cause: Cause
    is_present: bool
    reaction: Reaction | None
    """None: this is not watched."""
    waits: bool = True
    """Whether COM_FAIL_ACT_T comes first."""
    ends: bool = False
    """Whether it ends with its condition."""


class Px4Failsafes:
    """Which causes are active, and what is flown for them."""

    def __init__(self) -> None:
        self._active: dict[Cause, Reaction] = {}
        self._taken_over: set[Cause] = set()
        self._delay_s = 0.0
        """What is left of the hold before the reaction."""
        self._spent_s = 0.0
        """By how much the next such hold is shorter than COM_FAIL_ACT_T."""

    def watch(
        self, findings: Iterable[FailsafeCondition], dt_s: float, delay_s: float, *, can_hold: bool
    ) -> list[Cause]:
        """Take in what is wrong; the causes that became active just now.

        Args:
            can_hold: Whether the vehicle could hold a place.
        """
        before = self.flown
        is_reacting = before is not None and before.value > Reaction.HOLD.value
        self._delay_s = max(0.0, self._delay_s - dt_s)
        fresh = [each for each in findings if self._watch(each)]
        if any(each.waits and each.reaction is not Reaction.WARN for each in fresh):
            self._delay_s = self._delay_s or max(0.0, delay_s - self._spent_s)
        if is_reacting or not can_hold or not self._active:
            self._delay_s = 0.0
        change_s = dt_s if self._delay_s else -REGROWTH * dt_s
        self._spent_s = min(delay_s, max(0.0, self._spent_s + change_s))
        return [each.cause for each in fresh]

    def _watch(self, finding: FailsafeCondition) -> bool:
        cause = finding.cause
        if not finding.is_present or finding.reaction is None:
            if self._taken_over:
                self._taken_over.discard(cause)
            if finding.ends:
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
        self._delay_s = 0.0

    def clear(self) -> None:
        """The vehicle disarmed."""
        self._active.clear()
        self._taken_over.clear()
        self._delay_s = 0.0

    @property
    def delay_s(self) -> float:
        """How long it will hold before the reaction; 0 once that is flown."""
        return self._delay_s

    @property
    def worst(self) -> tuple[Cause, Reaction] | None:
        """The cause with the most severe reaction, or None."""
        if not self._active:
            return None
        return max(self._active.items(), key=lambda item: item[1].value)

    @property
    def flown(self) -> Reaction | None:
        """The reaction that is flown now: a hold while the worst one waits."""
        worst = self.worst
        if worst is None:
            return None
        waits = self._delay_s > 0.0 and worst[1] not in (Reaction.WARN, Reaction.DISARM)
        return Reaction.HOLD if waits else worst[1]


EXCEPT_MISSION, EXCEPT_HOLD, EXCEPT_OFFBOARD = 1, 2, 4
"""Bits of COM_RCL_EXCEPT."""
EXCEPTION_OF = {
    FlightMode.MISSION: EXCEPT_MISSION,
    FlightMode.HOLD: EXCEPT_HOLD,
    FlightMode.OFFBOARD: EXCEPT_OFFBOARD,
}


@dataclass(frozen=True, slots=True)
class _FailsafeRules:
    """What the parameters say of failsafes."""

    findings: tuple[FailsafeCondition, ...]
    """Every cause that is watched, as if it were not there."""
    excepted: int
    station_loss_s: float
    critical_share: float
    emergency_share: float


def _failsafe_rules(value: ParameterStore) -> _FailsafeRules:
    action = int(value["COM_LOW_BAT_ACT"])
    critical = {2: Reaction.LAND, 3: Reaction.RETURN}.get(action, Reaction.WARN)
    emergency = Reaction.WARN if action == 0 else Reaction.LAND
    setpoints = OFFBOARD_LOSS_REACTION.get(int(value["COM_OBL_RC_ACT"]), Reaction.POSITION)
    findings = (
        FailsafeCondition(Cause.NO_SETPOINTS, False, setpoints, waits=False, ends=True),
        FailsafeCondition(
            Cause.NO_STICKS, False, LINK_LOSS_REACTION.get(int(value["NAV_RCL_ACT"]))
        ),
        FailsafeCondition(
            Cause.NO_STATION, False, LINK_LOSS_REACTION.get(int(value["NAV_DLL_ACT"]))
        ),
        FailsafeCondition(Cause.NO_POSITION, False, Reaction.LAND),
        FailsafeCondition(Cause.FENCE, False, FENCE_REACTION.get(int(value["GF_ACTION"]))),
        FailsafeCondition(Cause.BATTERY_CRITICAL, False, critical, ends=True),
        FailsafeCondition(Cause.BATTERY_EMERGENCY, False, emergency, ends=True),
    )
    return _FailsafeRules(
        findings,
        int(value["COM_RCL_EXCEPT"]),
        value["COM_DL_LOSS_T"],
        value["BAT_CRIT_THR"],
        value["BAT_EMERGEN_THR"],
    )


class FailsafeMonitor:
    """Looks at one aircraft.

    Args:
        parameters: What is done about a finding.
    """

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self._aircraft = aircraft
        self._parameters = parameters
        self._revision = parameters.revision
        self._rules = _failsafe_rules(parameters)
        self._present: tuple[bool, ...] | None = None
        """Which causes were there at the last look, in the order of the rules' findings."""
        self._found: list[FailsafeCondition] = []
        self._had_sticks = False
        self._has_warned = False

    def findings(
        self, intention: FlightMode, fence_margin_m: float, now_s: float, *, is_stream_alive: bool
    ) -> list[FailsafeCondition]:
        """Every cause that is watched, whether it is there or not; the vehicle is armed.

        Args:
            intention: The mode that the operator chose.
            fence_margin_m: Distance from a breach, negative in one.
            now_s: Seconds since boot.
        """
        rules, aircraft = self._current_rules(), self._aircraft
        has_sticks = aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        is_excepted = bool(rules.excepted & EXCEPTION_OF.get(intention, 0))
        heard_s, share = aircraft.station_heard_s, aircraft.battery.share
        present = (
            intention is FlightMode.OFFBOARD and not is_stream_alive,
            self._had_sticks and not has_sticks and not is_excepted,
            heard_s is not None and now_s - heard_s > rules.station_loss_s,
            not aircraft.estimator.is_position_valid,
            fence_margin_m < 0.0,
            share <= rules.critical_share,
            share <= rules.emergency_share,
        )
        if present != self._present:
            self._present = present
            self._found = [
                replace(each, is_present=is_present)
                for each, is_present in zip(rules.findings, present, strict=True)
            ]
        return self._found

    def _current_rules(self) -> _FailsafeRules:
        """What the parameters say, read anew where one has changed."""
        revision = self._parameters.revision
        if revision != self._revision:
            self._revision, self._rules = revision, _failsafe_rules(self._parameters)
            self._present = None
        return self._rules

    def warn_of_battery(self) -> None:
        """A text when the charge falls under BAT_LOW_THR."""
        is_low = self._aircraft.battery.share <= self._parameters["BAT_LOW_THR"]
        if is_low and not self._has_warned:
            self._aircraft.say(mavlink.MAV_SEVERITY_WARNING, "Low battery level")
        self._has_warned = is_low
