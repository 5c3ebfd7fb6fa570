"""Which messages are sent by themselves, and how often.

Rates are kept on average: a 30 Hz stream on a 50 Hz clock leaves after 40, 40 and 20 ms, as PX4's
do. HEARTBEAT cannot be changed. Source: MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL.
"""

from __future__ import annotations

from collections.abc import Mapping

from companion.mav.dialect import mavlink
from sim_link.autopilot.flavours.px4.rates import DEFAULT_RATE_HZ
from sim_link.autopilot.pilot import STEP_S

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
DUE_TOLERANCE_S = 1e-6
EARLIEST_CATCH_UP_S = STEP_S


class StreamTable:
    """When each message is due next on one link.

    Args:
        rates_hz: What is sent unasked, by message id; 0: only on request.
    """

    def __init__(self, rates_hz: Mapping[int, float] = DEFAULT_RATE_HZ) -> None:
        self._rates_hz = rates_hz
        self._interval_s = {
            number: 1.0 / rate_hz if rate_hz else 0.0 for number, rate_hz in rates_hz.items()
        }
        self._due_s = dict.fromkeys(self._interval_s, 0.0)

    def take_due(self, now_s: float) -> list[int]:
        """Ids of the messages due at `now_s`; each is taken once, whatever was missed before."""
        due = [
            number
            for number, due_s in self._due_s.items()
            if due_s <= now_s + DUE_TOLERANCE_S and self._interval_s[number]
        ]
        for number in due:
            next_s = self._due_s[number] + self._interval_s[number]
            self._due_s[number] = max(next_s, now_s - EARLIEST_CATCH_UP_S)
        return due

    def interval_us(self, number: int) -> int:
        """MESSAGE_INTERVAL.interval_us: -1 if the stream is off, 0 if there is no such message."""
        if number not in self._interval_s:
            return 0
        return round(1e6 * self._interval_s[number]) or -1

    def set_interval_us(self, number: int, interval_us: float, now_s: float) -> bool:
        """Change a rate; intervals under a physics step are lengthened to it.

        Args:
            number: Message id.
            interval_us: Microseconds; -1 stops the stream, 0 restores its default.
            now_s: When; the next one is due at once.

        Returns:
            Whether such a stream exists and may be changed.
        """
        if number not in self._interval_s or number == HEARTBEAT:
            return False
        if interval_us == -1.0:
            self._interval_s[number] = 0.0
        elif interval_us == 0.0:
            rate_hz = self._rates_hz[number]
            self._interval_s[number] = 1.0 / rate_hz if rate_hz else 0.0
        else:
            self._interval_s[number] = max(STEP_S, interval_us / 1e6)
        self._due_s[number] = now_s
        return True
