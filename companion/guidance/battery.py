"""The battery: low ends the mission in good order, critical ends it at once, unknown is not full.

Theory of operation. The charge is what the autopilot tells, in percent or as a state of its own;
one report may be wrong, so two in a row must agree. Low: the leg that is being flown is finished,
what is known of the target is reported, and the autopilot gets the mode that follows a report.
Critical: the vehicle is handed back at once by asking for the return, and only once in a flight:
who takes it again after that knows, and the vehicle then stays where it is.
"""

from __future__ import annotations

from companion.domain import BatteryLevel, FlightMode
from companion.guidance.events import BatteryReported
from companion.guidance.findings import Finding, Reason, Verdict

CONFIRMED_BY = 2
"""Reports that must agree."""
LEG_S = 20.0
"""A leg that takes longer is not finished on a low battery."""


class BatteryWatch:
    """Watches the charge.

    Args:
        low_pct: Charge from which on it is low, 0 to 100.
        critical_pct: Charge from which on it is critical.
    """

    def __init__(self, low_pct: float, critical_pct: float) -> None:
        self.level = BatteryLevel.UNKNOWN
        self.charge_pct: float | None = None
        """0 to 100; None: unknown."""
        self._low_pct = low_pct
        self._critical_pct = critical_pct
        self._candidate = BatteryLevel.UNKNOWN
        self._agreed = 0
        self._was_handed_back = False
        self._has_ended_mission = False

    def aim(self, low_pct: float, critical_pct: float) -> None:
        """Other charges from the next reports on; two of them must agree again."""
        self._low_pct, self._critical_pct = low_pct, critical_pct
        self._agreed = 0

    @property
    def is_low(self) -> bool:
        """Whether it is low, or worse."""
        return self.level >= BatteryLevel.LOW

    def reported(self, event: BatteryReported) -> bool:
        """Take in a report; whether the level changed."""
        self.charge_pct = event.charge_pct
        level = max(self._level_of(event.charge_pct), event.level)
        self._agreed = self._agreed + 1 if level is self._candidate else 1
        self._candidate = level
        if level is self.level or self._agreed < CONFIRMED_BY:
            return False
        self.level = level
        return True

    @property
    def ends_mission(self) -> bool:
        """Whether it is time to report and to go."""
        return self.is_low and not self._has_ended_mission

    def mission_ended(self) -> None:
        """The mission was ended for the battery."""
        self._has_ended_mission = True

    def handed_back(self) -> None:
        """The vehicle was handed back for the battery."""
        self._was_handed_back = True

    def flight_over(self) -> None:
        """The next flight is a new one."""
        self._was_handed_back = self._has_ended_mission = False

    def forget(self) -> None:
        """The autopilot restarted: nothing is known."""
        self.level = self._candidate = BatteryLevel.UNKNOWN
        self.charge_pct = None
        self._agreed = 0
        self.flight_over()

    def finding(self) -> Finding | None:
        """What a critical charge asks for."""
        if self.level is not BatteryLevel.CRITICAL:
            return None
        verdict = Verdict.HOLD if self._was_handed_back else Verdict.HAND_BACK
        text = f"battery critical{self._percent()}"
        return Finding(verdict, Reason.BATTERY_CRITICAL, text, FlightMode.RETURN)

    def text(self) -> str:
        """The level in words."""
        return f"battery {self.level.name.lower()}{self._percent()}"

    def _percent(self) -> str:
        return "" if self.charge_pct is None else f", {self.charge_pct:.0f} %"

    def _level_of(self, charge_pct: float | None) -> BatteryLevel:
        if charge_pct is None:
            return BatteryLevel.UNKNOWN
        if charge_pct <= self._critical_pct:
            return BatteryLevel.CRITICAL
        return BatteryLevel.LOW if charge_pct <= self._low_pct else BatteryLevel.GOOD
