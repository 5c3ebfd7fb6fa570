"""What is wrong with a PX4 now, and what its parameters do about it.

Source: PX4 user guide, "Safety Configuration"; Parameter Reference, COM_*, NAV_*, BAT_*, GF_*.
"""

from __future__ import annotations

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


class Watcher:
    """Looks at one aircraft.

    Args:
        aircraft: Which.
        parameters: What is done about a finding.
    """

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self._aircraft = aircraft
        self._parameters = parameters
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
        value, aircraft = self._parameters, self._aircraft
        has_sticks = aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        is_excepted = bool(int(value["COM_RCL_EXCEPT"]) & EXCEPTION_OF.get(intention, 0))
        heard_s = aircraft.station_heard_s
        return [
            Finding(
                Cause.NO_SETPOINTS,
                intention is FlightMode.OFFBOARD and not is_stream_alive,
                OFFBOARD_LOSS_REACTION.get(int(value["COM_OBL_RC_ACT"]), Reaction.POSITION),
                waits=False,
                ends=True,
            ),
            Finding(
                Cause.NO_STICKS,
                self._had_sticks and not has_sticks and not is_excepted,
                LINK_LOSS_REACTION.get(int(value["NAV_RCL_ACT"])),
            ),
            Finding(
                Cause.NO_STATION,
                heard_s is not None and now_s - heard_s > value["COM_DL_LOSS_T"],
                LINK_LOSS_REACTION.get(int(value["NAV_DLL_ACT"])),
            ),
            Finding(Cause.NO_POSITION, not aircraft.estimator.is_position_valid, Reaction.LAND),
            Finding(Cause.FENCE, fence_margin_m < 0.0, FENCE_REACTION.get(int(value["GF_ACTION"]))),
            *self._battery_findings(),
        ]

    def _fence_finding(self, margin_m: float) -> Finding:
        reaction = FENCE_REACTION.get(int(self._parameters["GF_ACTION"]))
        return Finding(Cause.FENCE, margin_m < 0.0, reaction, waits=reaction is not Reaction.HOLD)

    def _battery_findings(self) -> list[Finding]:
        value, share = self._parameters, self._aircraft.battery.share
        action = int(value["COM_LOW_BAT_ACT"])
        critical = {2: Reaction.LAND, 3: Reaction.RETURN}.get(action, Reaction.WARN)
        emergency = Reaction.WARN if action == 0 else Reaction.LAND
        return [
            Finding(Cause.BATTERY_CRITICAL, share <= value["BAT_CRIT_THR"], critical, ends=True),
            Finding(
                Cause.BATTERY_EMERGENCY, share <= value["BAT_EMERGEN_THR"], emergency, ends=True
            ),
        ]

    def warn_of_battery(self) -> None:
        """A text when the charge falls under BAT_LOW_THR."""
        is_low = self._aircraft.battery.share <= self._parameters["BAT_LOW_THR"]
        if is_low and not self._has_warned:
            self._aircraft.say(mavlink.MAV_SEVERITY_WARNING, "Low battery level")
        self._has_warned = is_low
