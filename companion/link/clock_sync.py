"""Time synchronisation with the autopilot, by TIMESYNC.

Theory of operation. We send our time, the autopilot mirrors it and adds its own; half a round trip
later its answer is here. The offset between the clocks follows from the middle of that trip, and
is wrong by at most half of it, where the two ways differ. An answer counts only if its round trip
is within 10 ms of the best of the last sixteen, because what is slow is slow on one way only. The
offset is smoothed, yet a drift of 100 ppm leaves a millisecond only; an exchange that deviates by
more than 100 ms is left out, and five of them in a row are a new clock.

Only the answer to a question of ours counts, and once: somebody else's, a late one's or an invented
one cannot move the clock. And a later question is not answered from an earlier time, but for what
the line may mix up: a clock that went back farther is that of an autopilot that restarted.

Source: MAVLink guide, "Time Synchronization"; PX4 `Timesync.hpp` for filtering and reset.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum

from companion.mav.dialect import Message, mavlink
from companion.mav.timebase import REBOOT_BACKWARD_S
from companion.mav.timesync import TargetedTimesync

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
        self._open: deque[int] = deque(maxlen=MAX_OPEN)
        self._next_s = 0.0
        self._round_trips_s: deque[float] = deque(maxlen=BEST_OF)
        self._best_s: float | None = None
        self._offset_s: float | None = None
        self._used = 0
        self._deviations = 0
        self._newest: tuple[float, int] | None = None
        """When the latest question that was answered was sent, and the autopilot's time then."""
        self._went_back = False
        self._prompt_s = -math.inf
        """When a question was answered promptly last, and when late."""
        self._slow_s = -math.inf

    @property
    def offset_s(self) -> float | None:
        """Our time minus the autopilot's, seconds; None as long as it is not known."""
        return self._offset_s

    @property
    def round_trip_s(self) -> float | None:
        """The best of the last exchanges; None before the first."""
        return self._best_s

    def due(self, now_s: float, system_id: int, component_id: int) -> Message | None:
        """The question to send now, if any."""
        if now_s < self._next_s:
            return None
        self._next_s = now_s + (FIRST_PERIOD_S if self._used < FIRST_EXCHANGES else PERIOD_S)
        self.asked += 1
        sent_ns = max(1, round(now_s * NS_PER_S))
        self._open.append(sent_ns)
        return TargetedTimesync(0, sent_ns, system_id, component_id)

    def heard(self, message: Message, now_s: float) -> None:
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
        self._best_s = min(self._round_trips_s)
        if self._round_trips_s[-1] > self._best_s + SLOWER_S:
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

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self._newest, self._went_back = None, False
        self._open.clear()
        self._round_trips_s.clear()
        self._best_s = None
        self._offset_s = None
        self._used = self._deviations = 0
        self._next_s = 0.0

    def record(self) -> dict[str, object]:
        """The figures for the event log."""
        return {
            "clock_offset_s": self._offset_s,
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
        if self._offset_s is None:
            self._offset_s, self._used = offset_s, 1
            return
        deviation_s = offset_s - self._offset_s
        if abs(deviation_s) > DEVIATION_S:
            self._deviations += 1
            if self._deviations >= RESET_AFTER:
                self.resets += 1
                self._offset_s, self._used, self._deviations = offset_s, 1, 0
            return
        self._deviations = 0
        self._used += 1
        self._offset_s += max(1.0 / self._used, GAIN) * deviation_s
