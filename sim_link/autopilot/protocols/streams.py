"""Which messages a channel gets by themselves, how often, and who may change that.

Theory of operation. Every stream has a start and counts its messages from there: number n is due
at start + n / rate, so rounding never adds up and a stream of 30 Hz on a clock of 50 Hz leaves
after 40, 40 and 20 ms and has exactly 30 messages in each second. What a caller missed is
skipped, in step. Each channel has a table of its own, as each of PX4's and ArduPilot's links has.

Source: MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL, REQUEST_DATA_STREAM, MESSAGE_INTERVAL; PX4
1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.mav.dialect import mavlink

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
US_PER_S = 1e6
DUE_TOLERANCE_S = 1e-6
"""A clock of whole steps may be early by rounding."""
MAX_INTERVAL_US = 3600e6
OFF, DEFAULT = -1.0, 0.0
MAX_STALE = 4
"""Entries per stream that the queue may hold; a client that changes rates for ever adds some."""


@dataclass(frozen=True, slots=True)
class StreamRules:
    """The streams of an autopilot."""

    default_rates_hz: Mapping[int, float]
    """By message id; 0 for one that is sent only when it is asked for."""
    min_interval_s: float
    """Faster is not possible: PX4 sends 123 Hz where 1 ms is asked, ArduPilot 333 Hz."""
    fixed: frozenset[int] = frozenset({HEARTBEAT})
    """Cannot be changed."""
    groups: Mapping[int, tuple[int, ...]] = field(default_factory=dict)
    """Messages of each REQUEST_DATA_STREAM group; empty where that message is not known."""


@dataclass(slots=True)
class _Stream:
    interval_s: float
    started_s: float
    sent: int = 0

    @property
    def due_s(self) -> float:
        """When the next message is due."""
        return self.started_s + self.sent * self.interval_s


class StreamTable:
    """The streams of one channel.

    Args:
        rules: Of the autopilot that is played.
        started_s: When they begin.
    """

    def __init__(self, rules: StreamRules, started_s: float = 0.0) -> None:
        self._rules = rules
        self._streams: dict[int, _Stream] = {}
        self._queue: list[tuple[float, int]] = []
        for number in rules.default_rates_hz:
            self._start(number, self._default_interval_s(number), started_s)

    def take_due(self, now_s: float) -> list[int]:
        """Ids of the messages due at `now_s`, each once, whatever was missed before."""
        due: list[int] = []
        latest_s = now_s + DUE_TOLERANCE_S
        while self._queue and self._queue[0][0] <= latest_s:
            due_s, number = heapq.heappop(self._queue)
            stream = self._streams.get(number)
            if stream is None or stream.due_s != due_s:
                continue  # changed since it was queued
            missed = math.floor((latest_s - due_s) / stream.interval_s)
            stream.sent += 1 + missed
            heapq.heappush(self._queue, (stream.due_s, number))
            due.append(number)
        return due

    def next_due_s(self) -> float:
        """When the next message is due, or a little before; infinity if every stream is off."""
        return self._queue[0][0] if self._queue else math.inf

    def knows(self, number: int) -> bool:
        """Whether the autopilot has such a message."""
        return number in self._rules.default_rates_hz

    def can_change(self, number: int) -> bool:
        """Whether there is such a message, and its rate is not fixed."""
        return self.knows(number) and number not in self._rules.fixed

    def interval_us(self, number: int) -> int:
        """MESSAGE_INTERVAL.interval_us: -1 if the stream is off, 0 if there is no such message."""
        if not self.knows(number):
            return 0
        stream = self._streams.get(number)
        return -1 if stream is None else round(US_PER_S * stream.interval_s)

    def set_interval_us(self, number: int, interval_us: float, now_s: float) -> bool:
        """Change a stream.

        Args:
            number: Message id.
            interval_us: Microseconds; -1 stops the stream, 0 restores its default.
            now_s: When; the next message is due at once.

        Returns:
            Whether there is such a stream, it may be changed, and the interval makes sense.
        """
        if not self.can_change(number):
            return False
        if interval_us == DEFAULT:
            self._start(number, self._default_interval_s(number), now_s)
        elif interval_us == OFF:
            self._start(number, None, now_s)
        elif 0.0 < interval_us <= MAX_INTERVAL_US:
            self._start(number, interval_us / US_PER_S, now_s)
        else:
            return False
        return True

    def set_group(self, group: int, rate_hz: int, *, is_on: bool, now_s: float) -> None:
        """Obey a REQUEST_DATA_STREAM.

        Args:
            group: MAV_DATA_STREAM; 0 for all groups.
            rate_hz: Messages per second of each kind; 0 stops them too.
            is_on: Whether to start.
            now_s: When.
        """
        groups = self._rules.groups
        chosen = groups if group == mavlink.MAV_DATA_STREAM_ALL else {group} & groups.keys()
        interval_us = US_PER_S / rate_hz if is_on and rate_hz > 0 else OFF
        for number in sorted({number for each in chosen for number in groups[each]}):
            self.set_interval_us(number, interval_us, now_s)

    def _default_interval_s(self, number: int) -> float | None:
        rate_hz = self._rules.default_rates_hz[number]
        return 1.0 / rate_hz if rate_hz else None

    def _start(self, number: int, interval_s: float | None, now_s: float) -> None:
        if interval_s is None:
            self._streams.pop(number, None)
            return
        interval_s = max(interval_s, self._rules.min_interval_s)
        running = self._streams.get(number)
        if running is not None and running.interval_s == interval_s:
            return  # asked again for what it gets: its rhythm goes on
        self._streams[number] = _Stream(interval_s, now_s)
        if len(self._queue) > MAX_STALE * len(self._rules.default_rates_hz):
            self._queue = [(each.due_s, key) for key, each in self._streams.items()]
            heapq.heapify(self._queue)
        else:
            heapq.heappush(self._queue, (now_s, number))
