"""What real processes show of the invariants: recorded as they fly, judged at the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from companion.config.schema import CompanionConfig
from sim_link.campaign.flights import rules_of
from sim_link.lockstep.observer import Frame
from sim_link.lockstep.wire import Lane
from sim_link.mission.hub import PERIOD_S
from sim_link.mission.record import FlightRecord, Violated
from sim_link.monitor.recording import Recording
from sim_link.monitor.scope import WIRE
from sim_link.monitor.wire import WireMonitor

MACHINE_S = 0.25
"""Real time that a process may wait for its turn without anybody noticing."""


class WireWatch:
    """Records what passes the hub.

    Args:
        speed: Seconds of the flight per second.
    """

    def __init__(self, speed: float) -> None:
        self.recording = Recording()
        """Knows also of the companion's process."""
        self._machine_s = MACHINE_S * speed
        self._late_s = 0.0
        self._looked_s: float | None = None
        self._events: list[tuple[float, str, Mapping[str, Any]]] = []
        """Of the companion's present process, at its own time."""

    @property
    def slack_s(self) -> float:
        """By how much frames may be late, in seconds of flight: the hub itself was, too."""
        return self._machine_s + self._late_s

    def sent(self, frame: bytes, now_s: float) -> None:
        """The companion sent this."""
        self.recording.sent(Frame(now_s, frame, Lane.TO_VEHICLE))

    def vehicle_sent(self, frame: bytes, now_s: float) -> None:
        """The vehicle sent this."""
        self.recording.vehicle_sent(Frame(now_s, frame, Lane.TO_COMPANION))

    def delivered(self, frame: bytes, now_s: float) -> None:
        """The companion is sent this."""
        self.recording.heard(Frame(now_s, frame, Lane.TO_COMPANION))

    def looked(self, now_s: float) -> None:
        """The hub looks at the mission; what it comes too late by tells how busy the machine is."""
        if self._looked_s is not None:
            self._late_s = max(self._late_s, now_s - self._looked_s - PERIOD_S)
        self._looked_s = now_s

    def noted(self, kind: str, fields: Mapping[str, Any], companion_s: float) -> None:
        """The companion wrote this into its log, at its own time."""
        self._events.append((companion_s, kind, fields))

    def date_events(self, offset_s: float | None) -> None:
        """The log of a process is complete.

        Args:
            offset_s: The mission's time minus the companion's; None: nothing was read.
        """
        if offset_s is not None:
            for time_s, kind, fields in self._events:
                self.recording.noted(kind, fields, time_s + offset_s)
        self._events.clear()

    def judge(self, config: CompanionConfig, record: FlightRecord) -> None:
        """Say in the record what was found, and what was judged."""
        monitor = WireMonitor(rules_of(config), self.slack_s)
        self.recording.play(monitor)
        record.scope, record.slack_s, record.late_s = WIRE, self.slack_s, self._late_s
        for found in monitor.violations:
            record.violations.append(Violated(found.time_s, found.invariant, found.what))
