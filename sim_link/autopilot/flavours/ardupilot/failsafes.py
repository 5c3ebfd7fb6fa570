"""ArduCopter's failsafes and fence: what is wrong, since when, and the mode that is asked for.

A failsafe changes the mode once, on entering, and nothing changes it back. Parameters say which
parts of the fence are on, and what is done at a breach.

Source: ArduPilot documentation, "Failsafe Functions", "EKF Failsafe", "Simple GeoFence";
`ArduCopter/ekf_check.cpp`; parameters FS_THR_ENABLE, FS_GCS_ENABLE, FS_EKF_ACTION, BATT_FS_LOW_ACT,
FENCE_ACTION, FENCE_TYPE, FENCE_RADIUS, FENCE_ALT_MAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from companion.domain import PositionEnu
from sim_link.autopilot.aircraft import CELLS, Aircraft
from sim_link.autopilot.flavours.ardupilot.flight_modes import (
    ALT_HOLD,
    BRAKE,
    LAND,
    RTL,
    SMART_RTL,
    CopterMode,
)
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.parameter_store import ParameterStore

ALTITUDE_MAX, CIRCLE, POLYGON = 1, 2, 4
"""Bits of FENCE_TYPE."""


def fence_margin_m(place: PositionEnu, aircraft: Aircraft, parameters: ParameterStore) -> float:
    """Distance to the nearest breach, negative in one; infinite while the fence is off."""
    if not parameters["FENCE_ENABLE"]:
        return math.inf
    parts = int(parameters["FENCE_TYPE"])
    home = aircraft.home_enu_m
    margin = math.inf
    if parts & ALTITUDE_MAX:
        margin = min(margin, parameters["FENCE_ALT_MAX"] - (place[2] - home[2]))
    if parts & CIRCLE:
        margin = min(margin, parameters["FENCE_RADIUS"] - math.dist(place[:2], home[:2]))
    if parts & POLYGON:
        margin = min(margin, aircraft.fence.margin_m(place))
    return margin


STATION_MODES = dict(enumerate((RTL, RTL, SMART_RTL, SMART_RTL, LAND, RTL, BRAKE), 1))
"""FS_GCS_ENABLE; 0: nothing."""
STICK_MODES = dict(enumerate((RTL, RTL, LAND, SMART_RTL, SMART_RTL, RTL, BRAKE), 1))
"""FS_THR_ENABLE; 0: nothing."""
BATTERY_MODES = {1: LAND, 2: RTL, 3: SMART_RTL, 4: SMART_RTL, 6: RTL, 7: BRAKE}
"""BATT_FS_LOW_ACT and BATT_FS_CRT_ACT; 0: only a text."""
TERMINATE = 5
FENCE_MODES = {1: RTL, 2: LAND, 3: SMART_RTL, 4: BRAKE, 5: SMART_RTL}
"""FENCE_ACTION; 0: only a text."""
EKF_MODES = {1: LAND, 2: ALT_HOLD, 3: LAND}
"""FS_EKF_ACTION; 3 also where no position is needed."""
EVEN_WITHOUT_POSITION = 3
EKF_PATIENCE_S = 1.0
"""How long the estimate must be bad, and as long good again."""
ROUNDING_S = 1e-6
FENCE, EKF, STATION, STICKS = "Fence breached", "EKF Failsafe", "GCS Failsafe", "Radio Failsafe"

Margin = Callable[[PositionEnu], float]


@dataclass(frozen=True, slots=True)
class FailsafeEvent:
    """A failsafe begins or ends."""

    text: str
    reaction: CopterMode | None = None
    """None: the mode stays."""
    stops_motors: bool = False
    tells_mode: bool = False
    """Whether a second text names the new mode."""


class CopterFailsafes:
    """Which failsafes are active."""

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self.active: set[str] = set()
        self._aircraft = aircraft
        self._parameters = parameters
        self._had_sticks = False
        self._bad_estimate_s = 0.0

    def clear(self) -> None:
        """The vehicle disarmed."""
        self.active.clear()
        self._bad_estimate_s = 0.0

    def watch(self, mode: CopterMode, margin_m: Margin, now_s: float) -> Iterator[FailsafeEvent]:
        """What begins and ends in this physics step of an armed vehicle.

        Args:
            margin_m: Distance of a place from a breach of the fence, negative in one.
            now_s: Seconds since boot.
        """
        yield from self._watch_station(now_s)
        yield from self._watch_sticks(now_s)
        yield from self._watch_battery()
        has_breach = margin_m(self._aircraft.body.position_enu_m) < 0.0
        action = FENCE_MODES.get(int(self._parameters["FENCE_ACTION"]))
        yield from self._note(FENCE, has_breach, FailsafeEvent(FENCE, action))
        yield from self._watch_estimate(mode)

    def _watch_station(self, now_s: float) -> Iterator[FailsafeEvent]:
        """The ground station of SYSID_MYGCS, once one was heard."""
        heard_s = self._aircraft.stations_s.get(int(self._parameters["SYSID_MYGCS"]))
        action = STATION_MODES.get(int(self._parameters["FS_GCS_ENABLE"]))
        timeout_s = self._parameters["FS_GCS_TIMEOUT"]
        is_silent = heard_s is not None and now_s - heard_s > timeout_s and action is not None
        yield from self._note(STATION, is_silent, FailsafeEvent(STATION, action))

    def _watch_sticks(self, now_s: float) -> Iterator[FailsafeEvent]:
        has_sticks = self._aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        action = STICK_MODES.get(int(self._parameters["FS_THR_ENABLE"]))
        is_lost = self._had_sticks and not has_sticks and action is not None
        yield from self._note(STICKS, is_lost, FailsafeEvent(STICKS, action))

    def _watch_battery(self) -> Iterator[FailsafeEvent]:
        value, battery = self._parameters, self._aircraft.battery
        volts = CELLS * battery.cell_mv / 1e3
        left_mah = battery.share * value["BATT_CAPACITY"]
        for level, word in (("LOW", "low"), ("CRT", "critical")):
            is_under = volts <= value[f"BATT_{level}_VOLT"] or (
                0.0 < value[f"BATT_{level}_MAH"] >= left_mah
            )
            name = f"Battery 1 is {word}"
            if is_under == (name in self.active):
                continue  # nothing to say
            text = f"{name} {volts:.2f}V used {battery.consumed_mah} mAh"
            number = int(value[f"BATT_FS_{level}_ACT"])
            event = FailsafeEvent(text, BATTERY_MODES.get(number), stops_motors=number == TERMINATE)
            yield from self._note(name, is_under, event)

    def _watch_estimate(self, mode: CopterMode) -> Iterator[FailsafeEvent]:
        """A failsafe only where the mode needs the position, or FS_EKF_ACTION says so."""
        estimator, value = self._aircraft.estimator, self._parameters
        is_bad = estimator.test_ratio >= value["FS_EKF_THRESH"] or not estimator.is_position_valid
        change_s = STEP_S if is_bad else -STEP_S
        self._bad_estimate_s = min(EKF_PATIENCE_S, max(0.0, self._bad_estimate_s + change_s))
        limit_s = ROUNDING_S if EKF in self.active else EKF_PATIENCE_S - ROUNDING_S
        number = int(value["FS_EKF_ACTION"])
        concerns = mode.needs_position or number == EVEN_WITHOUT_POSITION
        action = EKF_MODES.get(number, LAND) if concerns else None
        event = FailsafeEvent(EKF, action, tells_mode=action is not None)
        yield from self._note(EKF, self._bad_estimate_s >= limit_s, event)

    def _note(self, name: str, is_present: bool, event: FailsafeEvent) -> Iterator[FailsafeEvent]:
        if is_present and name not in self.active:
            self.active.add(name)
            yield event
        elif not is_present and name in self.active:
            self.active.discard(name)
            yield FailsafeEvent(f"{name} Cleared")
