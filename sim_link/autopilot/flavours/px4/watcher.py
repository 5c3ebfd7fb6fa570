"""What is wrong with a PX4 now, and what its parameters do about it.

Source: PX4 user guide, "Safety Configuration"; Parameter Reference, COM_*, NAV_*, BAT_*, GF_*.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.flavours.px4.failsafes import (
    FENCE_REACTION,
    LINK_LOSS_REACTION,
    OFFBOARD_LOSS_REACTION,
    Cause,
    Finding,
    Reaction,
)
from sim_link.autopilot.protocols.parameter_store import ParameterStore

EXCEPT_MISSION, EXCEPT_HOLD, EXCEPT_OFFBOARD = 1, 2, 4
"""Bits of COM_RCL_EXCEPT."""
EXCEPTION_OF = {
    FlightMode.MISSION: EXCEPT_MISSION,
    FlightMode.HOLD: EXCEPT_HOLD,
    FlightMode.OFFBOARD: EXCEPT_OFFBOARD,
}


@dataclass(frozen=True, slots=True)
class _Rules:
    """What the parameters say of failsafes."""

    findings: tuple[Finding, ...]
    """Every cause that is watched, as if it were not there."""
    excepted: int
    station_loss_s: float
    critical_share: float
    emergency_share: float


def _rules_of(value: ParameterStore) -> _Rules:
    action = int(value["COM_LOW_BAT_ACT"])
    critical = {2: Reaction.LAND, 3: Reaction.RETURN}.get(action, Reaction.WARN)
    emergency = Reaction.WARN if action == 0 else Reaction.LAND
    setpoints = OFFBOARD_LOSS_REACTION.get(int(value["COM_OBL_RC_ACT"]), Reaction.POSITION)
    findings = (
        Finding(Cause.NO_SETPOINTS, False, setpoints, waits=False, ends=True),
        Finding(Cause.NO_STICKS, False, LINK_LOSS_REACTION.get(int(value["NAV_RCL_ACT"]))),
        Finding(Cause.NO_STATION, False, LINK_LOSS_REACTION.get(int(value["NAV_DLL_ACT"]))),
        Finding(Cause.NO_POSITION, False, Reaction.LAND),
        Finding(Cause.FENCE, False, FENCE_REACTION.get(int(value["GF_ACTION"]))),
        Finding(Cause.BATTERY_CRITICAL, False, critical, ends=True),
        Finding(Cause.BATTERY_EMERGENCY, False, emergency, ends=True),
    )
    return _Rules(
        findings,
        int(value["COM_RCL_EXCEPT"]),
        value["COM_DL_LOSS_T"],
        value["BAT_CRIT_THR"],
        value["BAT_EMERGEN_THR"],
    )


class Watcher:
    """Looks at one aircraft.

    Args:
        aircraft: Which.
        parameters: What is done about a finding.
    """

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self._aircraft = aircraft
        self._parameters = parameters
        self._revision = parameters.revision
        self._rules = _rules_of(parameters)
        self._present: tuple[bool, ...] | None = None
        """Which causes were there at the last look, in the order of the rules' findings."""
        self._found: list[Finding] = []
        self._had_sticks = False
        self._has_warned = False

    def findings(
        self, intention: FlightMode, fence_margin_m: float, now_s: float, *, is_stream_alive: bool
    ) -> list[Finding]:
        """Every cause that is watched, whether it is there or not; the vehicle is armed.

        Args:
            intention: The mode that the operator chose.
            fence_margin_m: Distance from a breach, negative in one.
            now_s: Seconds since boot.
            is_stream_alive: Whether setpoints come.
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

    def _current_rules(self) -> _Rules:
        """What the parameters say, read anew where one has changed."""
        revision = self._parameters.revision
        if revision != self._revision:
            self._revision, self._rules = revision, _rules_of(self._parameters)
            self._present = None
        return self._rules

    def warn_of_battery(self) -> None:
        """A text when the charge falls under BAT_LOW_THR."""
        is_low = self._aircraft.battery.share <= self._parameters["BAT_LOW_THR"]
        if is_low and not self._has_warned:
            self._aircraft.say(mavlink.MAV_SEVERITY_WARNING, "Low battery level")
        self._has_warned = is_low
