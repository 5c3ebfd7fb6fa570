"""TIMESYNC and PING: what clocks say to each other.

Source: MAVLink developer guide, "Time Synchronization" and "Ping Protocol"; PX4 1.15 and
ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.mav.addressing import TargetedTimesync, targets_of_frame
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Addressing, Partner

NS_PER_S = 1_000_000_000
US_PER_S = 1_000_000
UINT32 = 0xFFFF_FFFF
TOLERANCE_S = 1e-6
"""A clock of whole steps may be early by rounding."""


class StampClock:
    """What the vehicle's own clock shows: it stamps all messages, and answers TIMESYNC.

    Physics and streams go by true time; only what is told of time goes by this.
    """

    def __init__(self) -> None:
        self._rates: list[tuple[float, float]] = []
        """From when on, and how fast: what is to come, latest first."""
        self._since_s = self._shown_s = 0.0
        self._rate = 1.0

    def read_s(self, now_s: float) -> float:
        """What it shows, seconds; never less than 0.

        Args:
            now_s: True seconds since boot.
        """
        while self._rates and self._rates[-1][0] <= now_s:
            from_s, rate = self._rates.pop()
            self._set(from_s, rate)
        return max(0.0, self._shown_s + self._rate * (now_s - self._since_s))

    def slip(self, step_s: float, now_s: float) -> None:
        """Jump, ahead if positive."""
        self._set(now_s, self._rate, step_s)

    def run(self, rate: float, now_s: float, until_s: float) -> None:
        """Show so many seconds a second; then one."""
        self._set(now_s, rate)
        self._rates = [(until_s, 1.0)]

    def _set(self, now_s: float, rate: float, step_s: float = 0.0) -> None:
        self._shown_s += self._rate * (now_s - self._since_s) + step_s
        self._since_s, self._rate = now_s, rate


@dataclass(frozen=True, slots=True)
class Clocks:
    """Answers for one vehicle.

    Args:
        names_targets: Whether a TIMESYNC answer names the asker, as the guide wants; ArduPilot
            sends the older form without targets.
    """

    addressing: Addressing
    names_targets: bool = True
    answers_ping: bool = True

    def timesync(self, message: Message, partner: Partner, boot_s: float) -> Message | None:
        """The answer to a TIMESYNC; None for an answer to ours, or a request to another."""
        if not isinstance(message, mavlink.MAVLink_timesync_message) or message.tc1 != 0:
            return None
        system_id, component_id = targets_of_frame(bytes(message.get_msgbuf()))
        own = self.addressing
        if system_id not in (0, own.system_id) or component_id not in (0, own.component_id):
            return None
        own_ns = max(1, round(NS_PER_S * boot_s))
        if not self.names_targets:
            return mavlink.MAVLink_timesync_message(own_ns, message.ts1)
        return TargetedTimesync(own_ns, message.ts1, *partner.ids)

    def ping(self, message: Message, partner: Partner) -> Message | None:
        """The answer to a PING request; None for a PING with a target, which is an answer."""
        if not self.answers_ping or not isinstance(message, mavlink.MAVLink_ping_message):
            return None
        if message.target_system != 0 or message.target_component != 0:
            return None
        return mavlink.MAVLink_ping_message(message.time_usec, message.seq, *partner.ids)


class ClockRequests:
    """TIMESYNC and PING requests of the vehicle's own, to everyone.

    Args:
        timesync_period_s: Time between two of the first; the first one waits as long.
        ping_period_s: Of the other; None: it never asks.
    """

    def __init__(self, timesync_period_s: float, ping_period_s: float | None) -> None:
        self._timesync_period_s = timesync_period_s
        self._ping_period_s = ping_period_s
        self._timesync_due_s = timesync_period_s
        self._ping_due_s = math.inf if ping_period_s is None else ping_period_s
        self._pings = 0

    def take_due(self, boot_s: float, shown_s: float) -> list[Message]:
        """What is asked at a physics step, at what its own clock shows."""
        messages: list[Message] = []
        if boot_s + TOLERANCE_S >= self._timesync_due_s:
            self._timesync_due_s = boot_s + self._timesync_period_s
            messages.append(mavlink.MAVLink_timesync_message(0, max(1, round(NS_PER_S * shown_s))))
        if self._ping_period_s is not None and boot_s + TOLERANCE_S >= self._ping_due_s:
            self._ping_due_s = boot_s + self._ping_period_s
            ping = mavlink.MAVLink_ping_message(round(US_PER_S * shown_s), self._pings, 0, 0)
            messages.append(ping)
            self._pings = (self._pings + 1) & UINT32
        return messages
