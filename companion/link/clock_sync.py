"""Remote clocks on the companion's time axis: by the arrival of stamps, and by TIMESYNC.

Theory of operation. A stamp (`time_boot_ms`, `time_usec`) becomes local seconds by the smallest
difference arrival - stamp seen so far: delay only ever adds to it, so the smallest is the nearest
to the truth. The minimum is forgotten slowly, so that a drifting clock is followed.

A stamp that went back is one of three: the counter wrapped, by a step of almost exactly 2**32 ms,
the frame is late, or the sender restarted. A restart shows itself by going on: stamps of the new
clock come for a while, as fast as time passes, and none of the old one in between.

TIMESYNC: we send our time, the autopilot mirrors it and adds its own. The offset follows from the
middle of the round trip, and is wrong by at most half of it. An answer counts only if its round
trip is within 10 ms of the best of the last sixteen, because what is slow is slow on one way only.
The offset is smoothed, yet a drift of 100 ppm leaves a millisecond only; an exchange that deviates
by more than 100 ms is left out, and five of them in a row are a new clock.

Only the answer to a question of ours counts, and once: nothing else can move the clock. A later
question is not answered from an earlier time, but for what the line may mix up: a clock that went
back farther is that of an autopilot that restarted.

Source: MAVLink guide, "Time Synchronization"; PX4 `Timesync.hpp` for filtering and reset.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum

from companion.mav.addressing import TargetedTimesync
from companion.mav.dialect import Message, mavlink

REBOOT_BACKWARD_S = 1.0
"""A stamp less older than the newest one than this is only reordered."""
REBOOT_CONFIRM_S = 0.3
REBOOT_STAMPS = 3
"""A new clock must be heard for so long, and so often, before it is believed."""
REBOOT_JITTER_S = 1.0
"""How unevenly its stamps may come meanwhile."""
WRAP_S = 2**32 / 1000.0
"""`time_boot_ms` starts again at zero after 49.7 days; that is not a reboot."""
MAX_WRAP_GAP_S = 60.0
"""Silence, or lateness, over which a wrap is still recognised."""
DRIFT_ALLOWANCE = 200e-6
"""How fast the minimum may rise, seconds per second: twice a poor crystal's drift."""


@dataclass(frozen=True, slots=True)
class StampReading:
    """One converted stamp."""

    time_s: float
    """On the companion's clock, never in the future."""
    is_reboot: bool
    """The sender's clock went back: it restarted."""


@dataclass(slots=True)
class _NewClock:
    """Stamps that went back, and may be those of a restarted sender."""

    remote_s: float
    local_s: float
    offset_s: float
    stamps: int = 1

    def continues_with(self, remote_s: float, now_s: float) -> bool:
        """Whether a stamp is of the same clock as the first one."""
        passed_s = now_s - self.local_s
        return abs((remote_s - self.remote_s) - passed_s) <= REBOOT_JITTER_S

    def take(self, remote_s: float, now_s: float) -> bool:
        """Take in one more; whether this is enough to believe in it."""
        self.stamps += 1
        self.offset_s = min(self.offset_s, now_s - remote_s)
        return self.stamps >= REBOOT_STAMPS and now_s - self.local_s >= REBOOT_CONFIRM_S


class Timebase:
    """Converts the stamps of one sender's clock."""

    def __init__(self) -> None:
        self.offset_s: float | None = None
        """Local minus remote time, with the shortest delay seen in it; None before any stamp."""
        self._new_clock: _NewClock | None = None
        self._newest_remote_s = 0.0
        self._updated_s = 0.0
        self._wraps = 0

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds."""
        raw_s, remote_s = remote_s, self._unwrapped(remote_s)
        if self.offset_s is None:
            return self._start(remote_s, now_s, now_s - remote_s, is_reboot=False)
        if remote_s < self._newest_remote_s - REBOOT_BACKWARD_S:
            if self._is_new_clock(raw_s, now_s) and self._new_clock is not None:
                self._wraps = 0
                return self._start(raw_s, now_s, self._new_clock.offset_s, is_reboot=True)
        else:
            self._new_clock = None
            risen_s = self.offset_s + DRIFT_ALLOWANCE * max(0.0, now_s - self._updated_s)
            self.offset_s = min(risen_s, now_s - remote_s)
            self._newest_remote_s = max(self._newest_remote_s, remote_s)
            self._updated_s = now_s
        return StampReading(min(now_s, remote_s + self.offset_s), is_reboot=False)

    def _start(
        self, remote_s: float, now_s: float, offset_s: float, *, is_reboot: bool
    ) -> StampReading:
        self.offset_s = offset_s
        self._newest_remote_s = remote_s
        self._updated_s = now_s
        self._new_clock = None
        return StampReading(min(now_s, remote_s + offset_s), is_reboot)

    def _is_new_clock(self, remote_s: float, now_s: float) -> bool:
        if self._new_clock is None or not self._new_clock.continues_with(remote_s, now_s):
            self._new_clock = _NewClock(remote_s, now_s, now_s - remote_s)
            return False
        return self._new_clock.take(remote_s, now_s)

    def _unwrapped(self, remote_s: float) -> float:
        """The stamp without the wraps of its counter; one from before the last wrap may be late.

        Only a step back by almost exactly one wrap is one: a sender that falls from Unix time to
        its time since boot goes back much further, and has restarted.
        """
        remote_s += self._wraps * WRAP_S
        if self.offset_s is None:
            return remote_s
        behind_s = self._newest_remote_s - remote_s
        if WRAP_S - MAX_WRAP_GAP_S < behind_s <= WRAP_S + REBOOT_BACKWARD_S:
            self._wraps += 1
            return remote_s + WRAP_S
        if self._wraps and -WRAP_S <= behind_s < -WRAP_S + MAX_WRAP_GAP_S:
            return remote_s - WRAP_S
        return remote_s


MAX_LATE_S = 5.0
"""Few links deliver later than this for long; what looks like it is a clock that started anew."""
LATE_CONFIRM_S = 1.0
"""A burst of delayed frames is shorter than this."""
RUN_WINDOW_S = 2.0
MAX_GAIN_S = 1.0
"""A clock that gains more than this on ours within the window is no clock.

Every gain also looks like a link that has become faster than ever before, so it must be more than
a delay; a clock at twice the speed is found out after a second.
"""


class SenderClock:
    """Converts one sender's stamps to local time.

    `Timebase` knows a restart by a stamp that goes back. After a silence longer than the sender's
    former uptime the stamps of the new clock are ahead of the old ones, and every reading would
    be late, for good: that is a restart too, unless the link itself is as late.
    """

    def __init__(self) -> None:
        self.timebase = Timebase()
        """Begun anew by a clock that started anew without a stamp that goes back."""
        self._late_since_s: float | None = None
        self._gains: deque[tuple[float, float]] = deque()
        """When the clock gained on ours, and how much."""

    @property
    def is_wild(self) -> bool:
        """Whether it runs so fast that its stamps say nothing about the present."""
        return sum(gain_s for _, gain_s in self._gains) > MAX_GAIN_S

    def read(
        self, remote_s: float, now_s: float, *, late_confirm_s: float = LATE_CONFIRM_S
    ) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds.

        Stamps must be late for `late_confirm_s` before they are those of a new clock.
        """
        before_s = self.timebase.offset_s
        reading = self.timebase.read(remote_s, now_s)
        if reading.is_reboot:
            self._gains.clear()
        else:
            self._note_gain(before_s, now_s)
        if now_s - reading.time_s <= MAX_LATE_S:
            self._late_since_s = None
            return reading
        if self._late_since_s is None:
            self._late_since_s = now_s
        if now_s - self._late_since_s < late_confirm_s:
            return reading
        self._late_since_s = None
        self.timebase = Timebase()
        self._gains.clear()
        return StampReading(self.timebase.read(remote_s, now_s).time_s, is_reboot=True)

    def _note_gain(self, before_s: float | None, now_s: float) -> None:
        after_s = self.timebase.offset_s
        if before_s is not None and after_s is not None and after_s < before_s:
            self._gains.append((now_s, before_s - after_s))
        while self._gains and self._gains[0][0] <= now_s - RUN_WINDOW_S:
            self._gains.popleft()


FIRST_PERIOD_S = 0.1
FIRST_EXCHANGES = 10
"""So many are asked for quickly, to know the offset within a second."""
PERIOD_S = 0.5
"""So often at least, because a restart shall be known within a second."""
BEST_OF = 16
SLOWER_S = 0.010
DEVIATION_S = 0.1
RESET_AFTER = 5
GAIN = 0.1
PROMPT_S = 1.0
"""An answer that came sooner shows that the link is not slow ..."""
PROMPT_WITHIN_S = 3.0
"""... for so long; where half of questions and of answers get lost, one in six times none comes."""
SLOW_WITHIN_S = 15.0
"""A late one shows for so long that it is, if none comes promptly."""
MAX_OPEN = 32
"""Questions that may still be answered: those of three seconds, also while they are quick."""
NS_PER_S = 1e9


class Lateness(Enum):
    """How late what comes over the link may be."""

    NONE = "answers come promptly, or never came"
    UNKNOWN = "answers came, and come no more"
    SLOW = "answers come late"


class ClockSync:
    """The offset of the autopilot's clock."""

    def __init__(self) -> None:
        self.asked = 0
        self.answered = 0
        self.slow = 0
        """Answers that took too long to say anything."""
        self.resets = 0
        self.restart()
        self._prompt_s = -math.inf
        """When a question was answered promptly last, and when late."""
        self._slow_s = -math.inf

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self._open: deque[int] = deque(maxlen=MAX_OPEN)
        self._next_s = 0.0
        self._round_trips_s: deque[float] = deque(maxlen=BEST_OF)
        self.round_trip_s: float | None = None
        """The best of the last exchanges; None before the first."""
        self.offset_s: float | None = None
        """Our time minus the autopilot's, seconds; None as long as it is not known."""
        self._used = self._deviations = 0
        self._newest: tuple[float, int] | None = None
        """When the latest question that was answered was sent, and the autopilot's time then."""
        self._went_back = False

    def due(self, now_s: float, system_id: int, component_id: int) -> Message | None:
        """The question to send now, if any."""
        if now_s < self._next_s:
            return None
        self._next_s = now_s + (FIRST_PERIOD_S if self._used < FIRST_EXCHANGES else PERIOD_S)
        self.asked += 1
        sent_ns = max(1, round(now_s * NS_PER_S))
        self._open.append(sent_ns)
        return TargetedTimesync(0, sent_ns, system_id, component_id)

    def receive(self, message: Message, now_s: float) -> None:
        """Take in a message of the autopilot."""
        if not isinstance(message, mavlink.MAVLink_timesync_message):
            return
        if message.tc1 <= 0 or message.ts1 not in self._open:
            return  # a question, or no answer to one of ours
        self._open.remove(message.ts1)
        self.answered += 1
        sent_s = message.ts1 / NS_PER_S
        self._note_time(sent_s, message.tc1, now_s)
        if now_s - sent_s <= PROMPT_S:
            self._prompt_s = now_s
        else:
            self._slow_s = now_s
        self._round_trips_s.append(max(0.0, now_s - sent_s))
        self.round_trip_s = min(self._round_trips_s)
        if self._round_trips_s[-1] > self.round_trip_s + SLOWER_S:
            self.slow += 1
            return
        self._take((sent_s + now_s) / 2.0 - message.tc1 / NS_PER_S)

    def lateness(self, now_s: float) -> Lateness:
        """What the answers of the last seconds say about the link."""
        if self.answered == 0 or now_s - self._prompt_s <= PROMPT_WITHIN_S:
            return Lateness.NONE
        return Lateness.SLOW if now_s - self._slow_s <= SLOW_WITHIN_S else Lateness.UNKNOWN

    def take_restart(self) -> bool:
        """Whether the clock went back since this was asked last."""
        went_back, self._went_back = self._went_back, False
        return went_back

    def record(self) -> dict[str, object]:
        """The figures for the event log."""
        return {
            "clock_offset_s": self.offset_s,
            "round_trip_s": self.round_trip_s,
            "asked": self.asked,
            "answered": self.answered,
            "slow": self.slow,
            "resets": self.resets,
        }

    def _note_time(self, sent_s: float, remote_ns: int, now_s: float) -> None:
        """Look whether the clock went back from one question to a later one."""
        if self._newest is not None:
            if sent_s < self._newest[0]:
                return
            back_s = (self._newest[1] - remote_ns) / NS_PER_S
            self._went_back |= back_s > REBOOT_BACKWARD_S + now_s - sent_s
        self._newest = (sent_s, remote_ns)

    def _take(self, offset_s: float) -> None:
        if self.offset_s is None:
            self.offset_s, self._used = offset_s, 1
            return
        deviation_s = offset_s - self.offset_s
        if abs(deviation_s) > DEVIATION_S:
            self._deviations += 1
            if self._deviations >= RESET_AFTER:
                self.resets += 1
                self.offset_s, self._used, self._deviations = offset_s, 1, 0
            return
        self._deviations = 0
        self._used += 1
        self.offset_s += max(1.0 / self._used, GAIN) * deviation_s


CLOCK_TOLERANCE_S = 0.03
LATE_CONFIRM_S_OF = {Lateness.NONE: LATE_CONFIRM_S, Lateness.UNKNOWN: 10.0, Lateness.SLOW: 60.0}
"""How long stamps that are late are a slow link's before they are a restarted autopilot's."""


class VehicleClock:
    """The autopilot's clock: by the arrival of its stamps and, better, by the exchange of times."""

    def __init__(self, sync: ClockSync) -> None:
        self.sync = sync
        self._stamps = SenderClock()

    @property
    def offset_s(self) -> float | None:
        """Local time minus the autopilot's, seconds; None before its first stamp.

        By arrival it is too large by the shortest delay. The exchange of times knows that delay,
        and is believed if one way takes no longer than both: otherwise it is of another clock.
        """
        by_arrival_s, by_exchange_s = self._stamps.timebase.offset_s, self.sync.offset_s
        round_trip_s = self.sync.round_trip_s
        if by_arrival_s is None or by_exchange_s is None or round_trip_s is None:
            return by_arrival_s
        delay_s = by_arrival_s - by_exchange_s
        is_plausible = 0.0 <= delay_s <= round_trip_s + CLOCK_TOLERANCE_S
        return by_exchange_s if is_plausible else by_arrival_s

    @property
    def is_wild(self) -> bool:
        """Whether it runs so fast that its stamps say nothing about the present."""
        return self._stamps.is_wild

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Local time of one of its stamps that arrived at `now_s`, both in seconds."""
        late_confirm_s = LATE_CONFIRM_S_OF[self.sync.lateness(now_s)]
        reading = self._stamps.read(remote_s, now_s, late_confirm_s=late_confirm_s)
        best_s, by_arrival_s = self.offset_s, self._stamps.timebase.offset_s
        if reading.is_reboot or best_s is None or by_arrival_s is None:
            return reading
        return StampReading(reading.time_s + best_s - by_arrival_s, is_reboot=False)

    def restart(self) -> None:
        """Forget its stamps, because the exchange of times showed that it restarted."""
        self._stamps = SenderClock()
