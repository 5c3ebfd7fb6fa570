"""ArduCopter's failsafes: what is wrong, since when, and the mode that is asked for.

A failsafe changes the mode once, on entering, and nothing changes it back.

Source: ArduPilot documentation, "Failsafe Functions", "EKF Failsafe", "Simple GeoFence";
`ArduCopter/ekf_check.cpp`; parameters FS_THR_ENABLE, FS_GCS_ENABLE, FS_OPTIONS, FS_EKF_ACTION,
BATT_FS_LOW_ACT, FENCE_ACTION.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sim_link.autopilot.aircraft import CELLS, Aircraft
from sim_link.autopilot.flavours.ardupilot.firmware_profile import (
    ALT_HOLD,
    BRAKE,
    GUIDED,
    LAND,
    RTL,
    SMART_RTL,
    CopterMode,
)
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore

REACTIONS: dict[str, tuple[CopterMode | None, ...]] = {
    "FS_GCS_ENABLE": (None, RTL, RTL, SMART_RTL, SMART_RTL, LAND, RTL, BRAKE),
    "FS_THR_ENABLE": (None, RTL, RTL, LAND, SMART_RTL, SMART_RTL, RTL, BRAKE),
    "FENCE_ACTION": (None, RTL, LAND, SMART_RTL, BRAKE, SMART_RTL),
    "BATT_FS_LOW_ACT": (None, LAND, RTL, SMART_RTL, SMART_RTL, None, RTL, BRAKE),
    "BATT_FS_CRT_ACT": (None, LAND, RTL, SMART_RTL, SMART_RTL, None, RTL, BRAKE),
    "FS_EKF_ACTION": (None, LAND, ALT_HOLD, LAND),
}
"""The mode that each value of a parameter asks for; None: at most a text."""
TERMINATE = 5
"""Value of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT."""
EVEN_WITHOUT_POSITION = 3
"""Value of FS_EKF_ACTION: also in modes that need no position."""
CONTINUE_IN_GUIDED = 4
"""Bit of FS_OPTIONS: GUIDED goes on without the transmitter."""
TWO_VOTES = 2
EKF_PATIENCE_S = 1.0
"""Time for which the estimate must be bad, and then good again."""
ROUNDING_S = 1e-6
FENCE, EKF, STATION, STICKS = "Fence breached", "EKF Failsafe", "GCS Failsafe", "Radio Failsafe"
BATTERY_LEVELS = (
    ("BATT_LOW_VOLT", "BATT_LOW_MAH", "Battery 1 is low", "BATT_FS_LOW_ACT"),
    ("BATT_CRT_VOLT", "BATT_CRT_MAH", "Battery 1 is critical", "BATT_FS_CRT_ACT"),
)
"""Parameters of the least voltage and charge, the failsafe's name, and what it does."""


@dataclass(frozen=True, slots=True)
class FailsafeEvent:
    """A failsafe begins or ends."""

    text: str
    reaction: CopterMode | None = None
    stops_motors: bool = False
    names_mode: bool = False
    """True if a second text names the new mode."""


def cleared(name: str) -> FailsafeEvent:
    """Return the event of a failsafe that ended."""
    return FailsafeEvent(f"{name} Cleared")


class CopterFailsafes:
    """Set of active failsafes."""

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self.active: set[str] = set()
        self._aircraft = aircraft
        self._parameters = parameters
        self._had_sticks = False
        self._bad_estimate_s = 0.0

    def clear(self) -> None:
        """Clear failsafes when the vehicle disarms."""
        self.active.clear()
        self._bad_estimate_s = 0.0

    def watch(self, mode: CopterMode, margin_m: float, now_s: float) -> Iterator[FailsafeEvent]:
        """Yield the failsafes that begin or end in this physics step of an armed vehicle."""
        heard_s = self._aircraft.stations_s.get(int(self._parameters["SYSID_MYGCS"]))
        is_silent = heard_s is not None and now_s - heard_s > self._parameters["FS_GCS_TIMEOUT"]
        station, sticks = self._reaction("FS_GCS_ENABLE"), self._reaction("FS_THR_ENABLE")
        if self._changes(STATION, is_silent and station is not None):
            yield self._event(STATION, station)
        has_sticks = self._aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        if mode is GUIDED and int(self._parameters["FS_OPTIONS"]) & CONTINUE_IN_GUIDED:
            sticks = None
        if self._changes(STICKS, self._had_sticks and not has_sticks and sticks is not None):
            yield self._event(STICKS, sticks)
        value, battery = self._parameters, self._aircraft.battery
        volts = CELLS * battery.cell_mv / 1e3
        left_mah = battery.share * value["BATT_CAPACITY"]
        for least_v, least_mah, name, action in BATTERY_LEVELS:
            is_under = volts <= value[least_v] or 0.0 < value[least_mah] >= left_mah
            if self._changes(name, is_under):
                text = f"{name} {volts:.2f}V used {battery.consumed_mah} mAh"
                event = FailsafeEvent(text, self._reaction(action), value[action] == TERMINATE)
                yield event if is_under else cleared(name)
        if self._changes(FENCE, margin_m < 0.0):
            yield self._event(FENCE, self._reaction("FENCE_ACTION"))
        estimator, value = self._aircraft.estimator, self._parameters
        is_bad = not estimator.is_position_valid or self._is_outvoted()
        change_s = STEP_S if is_bad else -STEP_S
        self._bad_estimate_s = min(EKF_PATIENCE_S, max(0.0, self._bad_estimate_s + change_s))
        limit_s = ROUNDING_S if EKF in self.active else EKF_PATIENCE_S - ROUNDING_S
        concerns = mode.needs_position or value["FS_EKF_ACTION"] == EVEN_WITHOUT_POSITION
        reaction = self._reaction("FS_EKF_ACTION") if concerns else None
        if self._changes(EKF, self._bad_estimate_s >= limit_s):
            yield self._event(EKF, reaction, names_mode=reaction is not None)

    def _is_outvoted(self) -> bool:
        """Return True by two votes of three, or the velocity at twice the threshold."""
        ratio, threshold = self._aircraft.estimator.test_ratio, self._parameters["FS_EKF_THRESH"]
        votes = sum(ratio(of) >= threshold for of in ("velocity", "position", "compass"))
        return votes >= TWO_VOTES or ratio("velocity") >= 2.0 * threshold

    def _reaction(self, parameter: str) -> CopterMode | None:
        reactions, number = REACTIONS[parameter], int(self._parameters[parameter])
        return reactions[number] if 0 <= number < len(reactions) else None

    def _changes(self, name: str, is_present: bool) -> bool:
        """Record if a failsafe is active; return True if that changed."""
        if is_present == (name in self.active):
            return False
        (self.active.add if is_present else self.active.discard)(name)
        return True

    def _event(
        self, name: str, reaction: CopterMode | None, *, names_mode: bool = False
    ) -> FailsafeEvent:
        """Return the event of a failsafe that has just begun or ended."""
        if name in self.active:
            return FailsafeEvent(name, reaction, names_mode=names_mode)
        return cleared(name)
