"""Conversion of a sender's stamps to the companion's clock, by their arrival.

Theory of operation. A remote stamp (`time_boot_ms`, `time_usec`) becomes local seconds by the
smallest difference arrival - stamp seen so far: delay only ever adds to it, so the smallest is the
nearest to the truth. The minimum is forgotten slowly, so that a drifting clock is followed. A clock
that runs slow by per cents is identified by its minima of eight seconds, if they lie on a straight
line; a link that becomes slower once does not have such minima.

A stamp that goes back has one of four causes: the counter wrapped, the frame is late, the clock
slipped, or the sender restarted. A wrap is a step by almost exactly 2**32 ms. The last two are
confirmed by stamps of the new clock that continue for a while, as fast as time passes, with none of
the old one in between. Until then they are treated as late. A restarted sender has not been up for
longer than it was silent; one that shows more has a clock that slipped.

The autopilot's clock is known better, by the exchange of times (`clock_sync`). A slip or rate that
the exchange shows takes precedence, and its stamps are resynchronised.

Source: Moon, Skelly, Towsley, "Estimation and Removal of Clock Skew from Network Delay
Measurements" (1999), for the rate as the slope under one-sided delays.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from companion.link.conversion.clock_sync import (
    DATED_BACK_S,
    DRIFT_ALLOWANCE,
    MAX_RATE,
    NO_RATE,
    REBOOT_BACKWARD_S,
    ClockSync,
    Lateness,
    Rate,
)

CONFIRM_S = 0.3
"""Time over which a new clock must be received."""
CONFIRM_STAMPS = 3
"""Stamps of a new clock before it is accepted."""
BACKWARD_S = 0.1
"""Largest step back by which a stamp is only reordered."""
CONFIRM_JITTER_S = 1.0
"""Tolerated jitter of the new clock's stamps before it is accepted."""
WRAP_S = 2**32 / 1000.0
"""Period of `time_boot_ms`, 49.7 days; its wrap is not a reboot."""
MAX_WRAP_GAP_S = 60.0
"""Silence, or delay, over which a wrap is still recognised."""
MAX_LATE_S = 5.0
"""Delay of a slow link that lasts; a longer one shows a clock that restarted."""
PROMPT_LATE_S = 1.5
"""Delay that shows a restarted clock where exchanges of times show that the link is prompt."""
LATE_CONFIRM_S = 1.0
"""Longest burst of delayed frames."""
RUN_WINDOW_S = 2.0
"""Span in which a clock's gain is summed."""
MAX_GAIN_S = 1.0
"""Gain of a clock on ours within that span above which it is unusable.

Every gain also looks like a link that has become faster, so it must exceed any delay; a clock at
twice the speed is detected after a second.
"""


class ClockStep(Enum):
    """Step of a clock before a stamp."""

    NONE = "it went on"
    SLIP = "it slipped, or stood still"
    RESTART = "its sender restarted"


class StampReading(NamedTuple):
    """Converted stamp."""

    time_s: float
    """Time on the companion's clock, never in the future."""
    step: ClockStep = ClockStep.NONE


BUCKET_S = 1.0
"""Length of an interval whose least delay is kept, seconds."""
BUCKETS = 8
"""Number of those intervals."""
MIN_BUCKETS = 4
"""Minimum number of intervals for a fit."""
STRAIGHT_S = 0.010
"""Largest distance of the minima of a steady clock from their line."""
SIGNIFICANT = 4.0
"""Number of uncertainties above which a rate is significant."""


@dataclass(slots=True)
class _NewClock:
    """Stamps that went back, possibly of another clock."""

    remote_s: float
    local_s: float
    offset_s: float
    stamps: int = 1


class Timebase:
    """Converter of the stamps of one sender's clock, at a `rate` if that is known.

    `offset_s` is local minus remote time at `now_s`, with the shortest delay.
    """

    def __init__(
        self, rate: Rate | None = None, offset_s: float | None = None, now_s: float = 0.0
    ) -> None:
        self.known_rate = rate
        """Rate known better than by arrival; None: unknown."""
        self.max_late_s = MAX_LATE_S
        """Largest delay of the last stamp before a restart."""
        self.rate = rate or NO_RATE
        """Rate at the latest stamp."""
        self._offset_s = offset_s
        self._arrival_rate = NO_RATE
        """Rate by the shortest delays of the last seconds."""
        self._minima: deque[tuple[float, float]] = deque(maxlen=BUCKETS)
        """Arrival and offset of the shortest delay of each interval."""
        self._bucket_until_s = 0.0
        self.gain_s = 0.0
        """Gain of the clock on ours that the latest stamp showed, seconds; 0: none."""
        self._new_clock: _NewClock | None = None
        self._newest_remote_s = 0.0 if offset_s is None else now_s - offset_s
        self._updated_s = now_s
        self._wraps = 0

    def offset_at_s(self, time_s: float) -> float | None:
        """Return local minus remote time, shortest delay included; None before the first stamp."""
        if self._offset_s is None:
            return None
        return self._offset_s + self.rate.growth * (time_s - self._updated_s)

    def raise_to(self, offset_s: float, now_s: float) -> None:
        """Correct an offset that is smaller than possible, as after a wrong rate."""
        known_s = self.offset_at_s(now_s)
        if self._offset_s is not None and known_s is not None:
            self._offset_s += max(0.0, offset_s - known_s)

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Return the local time of a remote stamp that arrived at `now_s`, both in seconds."""
        raw_s = remote_s
        if self._wraps or self._newest_remote_s - remote_s > WRAP_S - MAX_WRAP_GAP_S:
            remote_s = self._unwrapped(remote_s)
        former, self.rate = self.rate, self.known_rate or self._arrival_rate
        if self._offset_s is None:
            return self._start(remote_s, now_s, now_s - remote_s)
        passed_s = now_s - self._updated_s
        foreseen_s = self._offset_s + former.growth * passed_s
        before_s = self._offset_s + self.rate.growth * passed_s
        self.gain_s = max(0.0, foreseen_s - before_s)
        if remote_s < self._newest_remote_s - BACKWARD_S:
            if self._is_new_clock(raw_s, now_s) and self._new_clock is not None:
                is_young = raw_s <= now_s - self._updated_s + self.max_late_s
                is_far = self._newest_remote_s - remote_s > REBOOT_BACKWARD_S
                step = ClockStep.RESTART if is_young and is_far else ClockStep.SLIP
                self._wraps = 0
                return self._start(raw_s, now_s, self._new_clock.offset_s, step)
            return StampReading(min(now_s, remote_s + before_s))
        self._new_clock = None
        offset_s = now_s - remote_s
        risen_s = before_s + self.rate.slack * max(0.0, passed_s)
        if not self._minima or now_s >= self._bucket_until_s:
            least_s = self._fit_rate(now_s)
            if least_s is not None and self.known_rate is None:
                risen_s = max(risen_s, least_s)
            self._minima.append((now_s, offset_s))
            self._bucket_until_s = now_s + BUCKET_S
        elif offset_s < self._minima[-1][1]:
            self._minima[-1] = (now_s, offset_s)
        self._offset_s = min(risen_s, offset_s)
        self.gain_s = max(0.0, foreseen_s - self._offset_s)
        self._newest_remote_s = max(self._newest_remote_s, remote_s)
        self._updated_s = now_s
        late_s = max(0.0, now_s - remote_s - self._offset_s)
        return StampReading(min(now_s, remote_s + self._offset_s - self.rate.growth * late_s))

    def _fit_rate(self, now_s: float) -> float | None:
        """Fit the rate by arrival; return the smallest offset if just determined, or None."""
        if len(self._minima) < MIN_BUCKETS:
            return None
        times_s, offsets_s = zip(*self._minima, strict=True)
        line = statistics.linear_regression(times_s, offsets_s)
        beside_s = max(
            abs(offset_s - line.intercept - line.slope * time_s)
            for time_s, offset_s in self._minima
        )
        if beside_s > STRAIGHT_S or abs(line.slope) > MAX_RATE:
            return None
        uncertainty = DRIFT_ALLOWANCE + 2.0 * beside_s / (times_s[-1] - times_s[0])
        is_significant = abs(line.slope) > SIGNIFICANT * uncertainty
        before = self._arrival_rate
        self._arrival_rate = rate = Rate(line.slope, uncertainty) if is_significant else NO_RATE
        if rate.growth - before.growth <= rate.slack:
            return None
        return min(o + rate.growth * (now_s - t) for t, o in self._minima)

    def _start(
        self, remote_s: float, now_s: float, offset_s: float, step: ClockStep = ClockStep.NONE
    ) -> StampReading:
        self._offset_s, self.gain_s = offset_s, 0.0
        self._newest_remote_s = remote_s
        self._updated_s = now_s
        self._new_clock = None
        return StampReading(min(now_s, remote_s + offset_s), step)

    def _is_new_clock(self, remote_s: float, now_s: float) -> bool:
        """Return True if a stamp that went back confirms a new clock."""
        new, offset_s = self._new_clock, now_s - remote_s
        if new is not None:
            apart_s = (remote_s - new.remote_s) - (now_s - new.local_s)
        if new is None or not abs(apart_s) <= CONFIRM_JITTER_S:
            self._new_clock = _NewClock(remote_s, now_s, offset_s)
            return False
        new.stamps += 1
        new.offset_s = min(new.offset_s, offset_s)
        return new.stamps >= CONFIRM_STAMPS and now_s - new.local_s >= CONFIRM_S

    def _unwrapped(self, remote_s: float) -> float:
        """Return the stamp without wraps of its counter; one from before the last wrap may be late.

        Only a step back by almost exactly one wrap is one: a sender that falls from Unix time to
        its time since boot goes back much further, and has restarted.
        """
        remote_s += self._wraps * WRAP_S
        if self._offset_s is None:
            return remote_s
        behind_s = self._newest_remote_s - remote_s
        if WRAP_S - MAX_WRAP_GAP_S < behind_s <= WRAP_S + REBOOT_BACKWARD_S:
            self._wraps += 1
            return remote_s + WRAP_S
        if self._wraps and -WRAP_S <= behind_s < -WRAP_S + MAX_WRAP_GAP_S:
            return remote_s - WRAP_S
        return remote_s


class SenderClock:
    """Converter of one sender's stamps to local time.

    `Timebase` detects a restart by a stamp that goes back. After a silence longer than the sender's
    former uptime the stamps of the new clock are ahead of the old ones, and every reading would be
    late permanently: that is a restart too, unless the link itself is as late.
    """

    def __init__(self, timebase: Timebase | None = None) -> None:
        self.timebase = timebase or Timebase()
        """Replaced when a clock restarts without a stamp that goes back."""
        self._late_since_s: float | None = None
        self._prompt_s: float | None = None
        """Arrival of the latest stamp that was not late."""
        self._gains: deque[tuple[float, float]] = deque()
        """Times and sizes of the clock's gains on ours."""

    @property
    def is_too_fast(self) -> bool:
        """True if it runs too fast for its stamps to be used."""
        return self.gained_s > MAX_GAIN_S

    @property
    def gained_s(self) -> float:
        """Recent gain on our clock, seconds."""
        return sum([gain_s for _, gain_s in self._gains]) if self._gains else 0.0

    def forget_gains(self) -> None:
        """Clear the gains after they were identified as a slip."""
        self._gains.clear()

    def read(
        self, remote_s: float, now_s: float, *, late_confirm_s: float = LATE_CONFIRM_S
    ) -> StampReading:
        """Return the local time, s, of a stamp; one late for `late_confirm_s` is of a new clock."""
        reading = self.timebase.read(remote_s, now_s)
        if reading.step is not ClockStep.NONE:
            self._gains.clear()
        elif self.timebase.gain_s > 0.0:
            self._gains.append((now_s, self.timebase.gain_s))
        while self._gains and self._gains[0][0] <= now_s - RUN_WINDOW_S:
            self._gains.popleft()
        if now_s - reading.time_s <= MAX_LATE_S:
            self._late_since_s, self._prompt_s = None, now_s
            return reading
        if self._late_since_s is None:
            self._late_since_s = now_s
        if now_s - self._late_since_s < late_confirm_s:
            return reading
        silence_s = now_s - (self._late_since_s if self._prompt_s is None else self._prompt_s)
        self._late_since_s = None
        self.timebase = Timebase(self.timebase.known_rate)
        self._gains.clear()
        is_young = remote_s <= silence_s + MAX_LATE_S
        step = ClockStep.RESTART if is_young else ClockStep.SLIP
        return StampReading(self.timebase.read(remote_s, now_s).time_s, step)


CLOCK_TOLERANCE_S = 0.03
"""Tolerance of comparisons between stamps and exchange."""
ONE_SLIP_S = 5.0
"""Time within which stamps and exchange show the same slip, unless the stamps gained so much again
that the clock is unusable: that is another slip."""
CONFIRM_BY_LATENESS_S = {
    Lateness.NONE: LATE_CONFIRM_S,
    Lateness.UNKNOWN: 10.0,
    Lateness.SLOW: 60.0,
}
"""Time for which late stamps are attributed to a slow link before a restarted autopilot."""


class VehicleClock:
    """The autopilot's clock: by its stamps' arrival, and by exchange, if of the same clock."""

    def __init__(self, sync: ClockSync) -> None:
        self.sync = sync
        self.slips = 0
        """Number of slips; sources that share this clock resynchronise then."""
        self._stamps = SenderClock()
        self._is_same_clock = False
        """True if the exchange was once of the clock that stamps."""
        self._delay_s = 0.0
        """Shortest delay when both last agreed; negative where answers are dated back."""
        self._apart_since_s: float | None = None
        self.excess_rate: Rate | None = None
        """Clock rate from the time exchange if it exceeds `MAX_RATE`, else None."""
        self._resets = sync.resets
        self._slipped_s = -math.inf
        """Time of the latest reported slip."""

    def offset_at_s(self, now_s: float) -> float | None:
        """Return local minus autopilot time; by exchange where its one way is shorter than both."""
        by_arrival_s = self._stamps.timebase.offset_at_s(now_s)
        exchange = self.sync.filter
        if by_arrival_s is None or exchange is None:
            return by_arrival_s
        # as `exchange.at_s`, without two calls for every stamp
        by_exchange_s = exchange.offset_s + exchange.rate * (now_s - exchange.updated_s)
        delay_s, round_trip_s = by_arrival_s - by_exchange_s, self.sync.round_trip_s
        is_way = round_trip_s is not None and 0.0 <= delay_s <= round_trip_s + CLOCK_TOLERANCE_S
        return by_exchange_s if is_way else by_arrival_s

    @property
    def is_too_fast(self) -> bool:
        """True if it runs too fast for its stamps to be used."""
        return self._stamps.is_too_fast

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Return the local time of one of its stamps that arrived at `now_s`, both in seconds."""
        has_slipped = self._follow_exchange(now_s)
        lateness = self.sync.lateness(now_s)
        is_prompt = self.sync.round_trip_s is not None and lateness is Lateness.NONE
        self._stamps.timebase.max_late_s = PROMPT_LATE_S if is_prompt else MAX_LATE_S
        late_confirm_s = CONFIRM_BY_LATENESS_S[lateness]
        reading = self._stamps.read(remote_s, now_s, late_confirm_s=late_confirm_s)
        if reading.step is not ClockStep.NONE:
            self.slips += 1
            self._slipped_s = now_s
            return reading
        best_s = self.offset_at_s(reading.time_s)
        by_arrival_s = self._stamps.timebase.offset_at_s(reading.time_s)
        time_s = reading.time_s
        if best_s is not None and by_arrival_s is not None:
            time_s += best_s - by_arrival_s
        return StampReading(time_s, ClockStep.SLIP if has_slipped else ClockStep.NONE)

    def restart(self) -> None:
        """Forget its stamps, because the exchange of times showed that it restarted."""
        self._stamps = SenderClock()
        self._is_same_clock = False
        self._apart_since_s = self.excess_rate = None
        self.slips += 1

    def _follow_exchange(self, now_s: float) -> bool:
        """Resynchronise where exchanges show that the clock slipped; return True if they do.

        An exchange is wrong by at most half of its round trip. Stamps that differ by more than that
        and one way, while five exchanges agree with each other, refer to another time than before.
        """
        by_arrival_s = self._stamps.timebase.offset_at_s(now_s)
        offset_s, round_trip_s = self.sync.offset_at_s(now_s), self.sync.round_trip_s
        is_known = self.sync.is_known(now_s)
        if by_arrival_s is None or offset_s is None or round_trip_s is None or not is_known:
            self._stamps.timebase.known_rate = self._apart_since_s = self.excess_rate = None
            return False
        delay_s = by_arrival_s - offset_s
        half_s = round_trip_s / 2.0 + CLOCK_TOLERANCE_S
        if not self._is_same_clock and -DATED_BACK_S <= delay_s <= round_trip_s + half_s:
            self._is_same_clock, self._delay_s = True, delay_s
        rate = self.sync.rate if self._is_same_clock else None
        self._stamps.timebase.known_rate = rate
        self.excess_rate = rate if rate is not None and abs(rate.growth) > MAX_RATE else None
        shortest_s = min(0.0, self._delay_s) - half_s
        if not self._is_same_clock or shortest_s <= delay_s <= round_trip_s + half_s:
            self._apart_since_s, self._delay_s = None, max(-half_s, delay_s)
            self._stamps.timebase.raise_to(offset_s - half_s, now_s)
            return self._note_gain(now_s)
        if self._apart_since_s is None:
            self._apart_since_s = now_s
        if not self.sync.agrees_since(self._apart_since_s):
            return False
        self._stamps = SenderClock(Timebase(self.sync.rate, offset_s + self._delay_s, now_s))
        self._apart_since_s = None
        self._resets = self.sync.resets
        self._slipped_s = now_s
        self.slips += 1
        return True

    def _note_gain(self, now_s: float) -> bool:
        """Return True if the exchange shows a slip ahead, which the stamps already followed."""
        if self._resets == self.sync.resets:
            return False
        self._resets = self.sync.resets
        least_s = MAX_GAIN_S if now_s - self._slipped_s <= ONE_SLIP_S else BACKWARD_S
        if self._stamps.gained_s <= least_s:
            return False  # a link that is late one way shifts the exchange, not the stamps
        self._stamps.forget_gains()
        self._slipped_s = now_s
        return True
