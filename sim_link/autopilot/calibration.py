"""Calibration of the sensors: nothing to calibrate, but it takes its time and tells of it.

Source: MAVLink common, MAV_CMD_PREFLIGHT_CALIBRATION; MAVLink guide, "Long Running Commands".
"""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.base import Outgoing
from sim_link.autopilot.protocols.commands import Command, CommandResult, Commands

NUMBER = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
DURATION_S = 3.0
REPORT_S = 0.5


class Calibration:
    """At most one at a time.

    Args:
        commands: Keeps it open and answers.
    """

    def __init__(self, commands: Commands) -> None:
        self._commands = commands
        self._started_s = 0.0
        self._report_s = 0.0

    def begin(self, command: Command, now_s: float, *, is_armed: bool) -> CommandResult:
        """Start it; refused while armed, and if it names no sensor."""
        if is_armed:
            return CommandResult.TEMPORARILY_REJECTED
        if not any(value > 0.0 for value in command.params):
            return CommandResult.DENIED
        self._started_s = now_s
        self._report_s = now_s + REPORT_S
        return CommandResult.IN_PROGRESS

    def step(self, now_s: float) -> list[Outgoing]:
        """Progress, and the end."""
        if now_s < self._report_s or not self._commands.is_running(NUMBER):
            return []
        self._report_s = now_s + REPORT_S
        share = (now_s - self._started_s) / DURATION_S
        if share >= 1.0:
            return self._commands.finish(NUMBER, CommandResult.ACCEPTED, now_s)
        return self._commands.report(NUMBER, round(100.0 * share), now_s)
