"""TIMESYNC and PING: what clocks say to each other.

Source: MAVLink developer guide, "Time Synchronization" and "Ping Protocol"; PX4 1.15 and
ArduCopter 4.5 as observed.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.mav.addressing import TargetedTimesync, targets_of_frame
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Addressing, Partner

NS_PER_S = 1_000_000_000


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
