"""Everything that is watched for whether the plan may be flown, joined."""

from __future__ import annotations

from companion.domain import BatteryLevel, PositionEnu
from companion.guidance.battery import BatteryWatch
from companion.guidance.commands import Severity
from companion.guidance.contention import EchoWatch
from companion.guidance.events import (
    AutopilotRestarted,
    BatteryReported,
    Event,
    Retuned,
    SetpointEchoed,
    SticksReported,
)
from companion.guidance.findings import Finding, Reason, worst
from companion.guidance.health import HealthWatch
from companion.guidance.inputs import InputWatch
from companion.guidance.jumps import JumpWatch
from companion.guidance.situation import Situation
from companion.guidance.states import IN_CONTROL, Phase
from companion.guidance.sticks import StickWatch
from companion.guidance.wishes import WishWatch


class Watches:
    """All watches of one session.

    Args:
        situation: Of the session.
    """

    def __init__(self, situation: Situation) -> None:
        params = situation.params
        self.inputs = InputWatch(situation)
        self.battery = BatteryWatch(params.battery_low_pct, params.battery_critical_pct)
        self.wishes = WishWatch(situation)
        self.jumps = JumpWatch(situation)
        self._situation = situation
        self._echo = EchoWatch()
        self._sticks = StickWatch(params.on_sticks)
        self._health = HealthWatch()
        self._was_in_control = self._was_launching = False
        self._is_battery_told = False

    def handle(self, event: Event) -> None:
        """Take in what concerns one of them; other events change nothing."""
        self._health.handle(event)
        match event:
            case SetpointEchoed():
                self._echo.echoed(event)
            case SticksReported():
                self._sticks.reported(event)
            case BatteryReported():
                if self.battery.reported(event):
                    self._tell_battery()
            case Retuned(tuning=tuning):
                params = tuning.params
                self.battery.aim(params.battery_low_pct, params.battery_critical_pct)
            case AutopilotRestarted():
                self._health.forget()
                self.battery.forget()
                self._echo.frame_moved(event.time_s)

    def frame_moved(self, now_s: float) -> None:
        """The local frame has another zero."""
        self._echo.frame_moved(now_s)

    def tick(self, now_s: float) -> None:
        """Take note of what is there, and of control that begins or ends."""
        self.inputs.tick(now_s)
        self.wishes.tick()
        self.jumps.tick(now_s)
        phase = self._situation.phase
        is_in_control = phase in IN_CONTROL
        if is_in_control and not self._was_in_control:
            self._begin(now_s)
        elif self._was_in_control and not is_in_control:
            self._echo.end()
        if phase is Phase.LAUNCHING and not self._was_launching:
            self._sticks.begin(now_s)
        if phase is Phase.WAITING:
            self.battery.flight_over()
        self._was_in_control, self._was_launching = is_in_control, phase is Phase.LAUNCHING

    def handed_back(self, finding: Finding) -> None:
        """The vehicle was handed back for this."""
        if finding.reason is Reason.BATTERY_CRITICAL:
            self.battery.handed_back()

    def sent(self, place_enu_m: PositionEnu, now_s: float) -> None:
        """A setpoint was sent."""
        self._echo.sent(place_enu_m, now_s)

    def finding(self, now_s: float) -> Finding | None:
        """The worst that is wrong at a tick in control."""
        return worst(
            (
                self._echo.finding(now_s),
                self.wishes.finding(),
                self.launch_finding(now_s),
                self.jumps.finding(now_s),
                self._situation.passing_finding(now_s),
                self.inputs.finding(now_s),
            )
        )

    def launch_finding(self, now_s: float) -> Finding | None:
        """The worst that is wrong, in control or not, of what no vehicle is launched with."""
        health = self._health.findings(now_s, is_battery_low=self.battery.is_low)
        return worst(
            (
                self._sticks.finding(now_s),
                self.battery.finding(),
                self._situation.containment.finding(now_s),
                *health,
            )
        )

    def _begin(self, now_s: float) -> None:
        self._echo.begin(now_s)
        self._sticks.begin(now_s)
        self._health.begin()
        if self.battery.level is BatteryLevel.UNKNOWN and not self._is_battery_told:
            self._is_battery_told = True
            self._situation.announce(Severity.WARNING, "charge of the battery is unknown")

    def _tell_battery(self) -> None:
        level = self.battery.level
        if level is BatteryLevel.GOOD:
            return
        severity = Severity.ERROR if level is BatteryLevel.CRITICAL else Severity.WARNING
        self._is_battery_told = True
        self._situation.announce(severity, self.battery.text())
