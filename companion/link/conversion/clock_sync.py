"""Offset and rate of the autopilot's clock by TIMESYNC.

Theory of operation. We send our time, the autopilot returns it with its own; half a round trip
later its answer is here. The offset between the clocks follows from the middle of that trip, with
an error of at most half of it, if the two ways differ. An answer is used only if its round trip is
within 10 ms of the best of the last eight seconds, because slow exchanges are mostly delayed in one
direction only.

A simulated autopilot on a busy computer runs slow by per cents, so offset and rate are estimated
together, by a Kalman filter of two states. An exchange that deviates clearly from the prediction is
rejected; a series of five that agree with each other shows a clock that slipped or stood still, and
restarts the filter. Meanwhile requests follow each other quickly. An answer that is dated back
makes the offset too large, never too small: exchanges below the prediction remain in the series
even if one above it agrees in between.

Only the answer to a request of ours counts, and once: answers to another station, late or forged
ones cannot move the clock. A clock that went back is that of a restarted autopilot only if it shows
no more time than can have passed since then; otherwise it slipped.

Source: MAVLink guide, "Time Synchronization"; PX4 `Timesync.hpp`, which tracks offset and skew too.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from enum import Enum
from typing import NamedTuple

from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import TargetedTimesync

FIRST_PERIOD_S = 0.1
FIRST_EXCHANGES = 10
"""Number of quick requests, to know the offset within a second."""
PERIOD_S = 0.5
"""Interval of requests, because a restart must be noticed within a second."""
BEST_OF = 16
"""Periods in which the shortest round trip is searched, however many answers arrive at once."""
MAX_ROUND_TRIPS = 128
"""Largest number of stored round trips, prompt and delayed."""
SLOWER_S = 0.010
"""Excess over the shortest round trip above which an exchange is ignored."""
DEVIATION_S = 0.05
"""Deviation from the prediction that, with five sigma, shows another clock."""
RESET_AFTER = 5
"""Consecutive deviating exchanges that agree with each other, before the filter starts over."""
MAX_RATE = 0.06
"""Limit of rates from single exchanges, seconds per second; few clocks exceed it."""
MAX_PACE = 0.25
"""Limit of rates from exchanges on a straight line: a simulated autopilot on a busy computer was 10
% slow for seconds. A clock beyond it runs at another speed, and is not followed."""
PACE_WINDOW_S = 3.0
"""Span of the exchanges that must lie on a line."""
CRYSTAL = 1e-4
"""Rate of a usual clock, one sigma; and its random walk, per root second."""
OUTLIER_SIGMAS = 3.0
"""Innovation, in sigma, of a surprising exchange."""
BUSY = 0.03
"""Rate of an unknown clock, one sigma: the clock of a simulated autopilot depends on its computer's
load. Also used after two surprising exchanges to the same side."""
SIGNIFICANT = 4.0
"""Number of sigmas above which a rate is significant."""
OFFSET_NOISE_S = 1e-5
"""Random walk of the offset, per root second."""
EXCHANGE_SIGMA_S = 5e-4
"""Standard deviation of an exchange with the shortest round trip."""
DATED_BACK_S = 0.09
"""Largest dating back of a TIMESYNC request by ArduPilot, which subtracts the time of its receive
buffer, 10 bit a byte at 57,600 baud, on TCP and UDP, too: 3 to 27 ms as a rule, 512 bytes at most
(AP_HAL_SITL `UARTDriver::receive_time_constraint_us`). Stamps then seem to arrive before they were
sent."""
MEDIAN_OF_CHORD = 0.6745 * math.sqrt(1.5)
"""Median distance of a normal value from the mean of two others, in sigma."""
KNOWN_SIGMA_S = 0.02
"""Largest standard deviation of a known offset."""
PROMPT_S = 1.0
"""Longest round trip of a prompt answer, which shows that the link is not slow."""
PROMPT_WITHIN_S = 3.0
"""Time for which a prompt answer shows that; with half of all lost it is missed once in six."""
SLOW_WITHIN_S = 15.0
"""Time for which a late answer shows a slow link, if none is prompt."""
MAX_OPEN = 32
"""Maximum number of unanswered requests: those of three seconds, also at the quick interval."""
REBOOT_BACKWARD_S = 1.0
"""Smallest step back of a clock that restarted."""
NS_PER_S = 1e9


class Rate(NamedTuple):
    """Rate of a clock relative to ours, seconds per second."""

    growth: float
    """Growth of our time minus the other's."""
    slack: float
    """Uncertainty of the growth, towards larger values."""


DRIFT_ALLOWANCE = 200e-6
"""Allowance for drift, twice that of a poor crystal."""
NO_RATE = Rate(0.0, DRIFT_ALLOWANCE)


class Lateness(Enum):
    """Delay of incoming messages on the link."""

    NONE = "answers arrive promptly, or never arrived"
    UNKNOWN = "answers stopped arriving"
    SLOW = "answers arrive late"

    __hash__ = object.__hash__  # as in `Phase`


class OffsetFilter:
    """Kalman filter of two states for offset and rate of a clock, from exchanges of times.

    `offset_s` is our time minus the other's at the first exchange, `at_s` on our clock, with its
    standard deviation; `before` is the filter before the clock slipped, which kept its rate.
    """

    def __init__(
        self, offset_s: float, at_s: float, sigma_s: float, before: OffsetFilter | None = None
    ) -> None:
        self.rate: float = 0.0 if before is None else before.rate
        """Growth of the offset, seconds per second."""
        self.offset_s, self.updated_s = offset_s, at_s
        """Offset at the latest exchange, and the time of that on our clock."""
        self._offset_var, self._covar = sigma_s**2, 0.0
        self._rate_var: float = CRYSTAL**2 if before is None else before._rate_var
        self.max_rate = MAX_RATE
        self._outlier_s = 0.0
        """Innovation of the exchange before, if surprising."""

    def at_s(self, time_s: float) -> float:
        """Return the offset at a time on our clock."""
        return self.offset_s + self.rate * (time_s - self.updated_s)

    def sigma_s(self, time_s: float) -> float:
        """Return the standard deviation of the offset at a time."""
        return math.sqrt(self._predicted(max(0.0, time_s - self.updated_s))[0])

    @property
    def steady_rate(self) -> Rate:
        """Rate if significant, and its uncertainty."""
        sigma = math.sqrt(self._rate_var)
        if abs(self.rate) > SIGNIFICANT * sigma:
            return Rate(self.rate, DRIFT_ALLOWANCE + 2.0 * sigma)
        is_crystal = sigma <= SIGNIFICANT * CRYSTAL
        return NO_RATE if is_crystal else Rate(0.0, DRIFT_ALLOWANCE + 2.0 * sigma)

    def _predicted(self, passed_s: float) -> tuple[float, float]:
        """Return the predicted variance of the offset, and its covariance with the rate."""
        offset_var = (
            self._offset_var
            + passed_s * (2.0 * self._covar + passed_s * self._rate_var)
            + OFFSET_NOISE_S**2 * passed_s
            + CRYSTAL**2 * passed_s**3 / 3.0
        )
        return offset_var, self._covar + passed_s * (self._rate_var + CRYSTAL**2 * passed_s / 2.0)

    def update(self, offset_s: float, at_s: float, sigma_s: float) -> bool:
        """Process an exchange; return False if it deviates too much, and changed nothing."""
        passed_s = max(0.0, at_s - self.updated_s)
        innovation_s = offset_s - self.at_s(at_s)
        offset_var, covar = self._predicted(passed_s)
        innovation_var = offset_var + sigma_s**2
        if abs(innovation_s) > max(DEVIATION_S, 5.0 * math.sqrt(innovation_var)):
            return False
        is_outlier = innovation_s**2 > OUTLIER_SIGMAS**2 * innovation_var
        if is_outlier and innovation_s * self._outlier_s > 0.0:
            self._rate_var = BUSY**2
            offset_var, covar = self._predicted(passed_s)
            innovation_var = offset_var + sigma_s**2
        self._outlier_s = innovation_s if is_outlier else 0.0
        gain, rate_gain = offset_var / innovation_var, covar / innovation_var
        self.offset_s = self.at_s(at_s) + gain * innovation_s
        rate = self.rate + rate_gain * innovation_s
        self.rate = min(self.max_rate, max(-self.max_rate, rate))
        self.updated_s = max(self.updated_s, at_s)
        self._rate_var += CRYSTAL**2 * passed_s - rate_gain * covar
        self._offset_var = (1.0 - gain) * offset_var
        self._covar = (1.0 - gain) * covar
        return True


class ExchangeScatter:
    """Spread of offsets about the line through their neighbours, which no steady rate causes.

    ArduPilot dates answers back by the content of its receive buffer (`DATED_BACK_S`), by another
    amount each time, which no round trip shows.
    """

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=3)
        self._beside_s: deque[float] = deque(maxlen=BEST_OF)

    def add(self, at_s: float, offset_s: float) -> None:
        """Process an exchange."""
        self._last.append((at_s, offset_s))
        if len(self._last) < 3:
            return
        (first_s, first), (middle_s, middle), (last_s, last) = self._last
        share = 0.5 if last_s <= first_s else (middle_s - first_s) / (last_s - first_s)
        self._beside_s.append(abs(middle - first - share * (last - first)))

    @property
    def sigma_s(self) -> float:
        """Standard deviation of an offset."""
        if len(self._beside_s) < RESET_AFTER:
            return max(self._beside_s, default=0.0)
        return statistics.median(self._beside_s) / MEDIAN_OF_CHORD


class ClockPace:
    """Speed of the autopilot's clock relative to ours, if clearly not 1."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float]] = deque(maxlen=MAX_OPEN)

    def add(self, at_s: float, remote_s: float) -> None:
        """Process an exchange: our time in its middle, and the autopilot's."""
        if self._exchanges and at_s <= self._exchanges[-1][0]:
            return
        self._exchanges.append((at_s, remote_s))
        while at_s - self._exchanges[0][0] > PACE_WINDOW_S:
            self._exchanges.popleft()

    def wrong(self, now_s: float) -> float | None:
        """Return the speed if it is clearly not 1; None if it is 1 or no line fits."""
        recent = self._exchanges
        if len(recent) < RESET_AFTER or now_s - recent[-1][0] > PACE_WINDOW_S:
            return None
        span_s = recent[-1][0] - recent[0][0]
        if span_s < PACE_WINDOW_S / 2.0:
            return None
        line = statistics.linear_regression(*zip(*recent, strict=True))
        beside_s = max(abs(r - line.intercept - line.slope * t) for t, r in recent)
        is_straight = beside_s <= DEVIATION_S / 2.0
        return line.slope if is_straight and abs(line.slope - 1.0) > MAX_RATE else None


class ClockSync:
    """Synchronisation with the autopilot's clock."""

    def __init__(self) -> None:
        self.asked = 0
        self.answered = 0
        self.slow = 0
        """Number of answers that took too long to be used."""
        self.resets = 0
        self._open: deque[int] = deque(maxlen=MAX_OPEN)
        self.next_s = 0.0
        self._round_trips: deque[tuple[float, float]] = deque(maxlen=MAX_ROUND_TRIPS)
        """Times of answers and their round trips, seconds."""
        self.round_trip_s: float | None = None
        """Shortest round trip of the latest exchanges, seconds; None before the first one."""
        self.filter: OffsetFilter | None = None
        """Filter of offset and rate; None before the first exchange."""
        self._scatter = ExchangeScatter()
        self.pace = ClockPace()
        self._used = 0
        self._agreed_s: deque[float] = deque(maxlen=RESET_AFTER)
        """Times of the latest exchanges that agreed with the prediction."""
        self._deviating: list[tuple[float, float]] = []
        """Consecutive exchanges that deviate but agree: time and offset."""
        self._newest: tuple[float, int] | None = None
        """Time of the latest request that was answered, and the autopilot's time then."""
        self._has_restarted = False
        self._prompt_s = -math.inf
        """Times of the latest prompt and late answer."""
        self._slow_s = -math.inf

    def offset_at_s(self, now_s: float) -> float | None:
        """Return our time minus the autopilot's, seconds, at a time; None while unknown."""
        return None if self.filter is None else self.filter.at_s(now_s)

    @property
    def rate(self) -> Rate:
        """Growth of the offset, positive where the autopilot's clock is slow."""
        return NO_RATE if self.filter is None else self.filter.steady_rate

    def is_known(self, now_s: float) -> bool:
        """Return True if recent exchanges agreed, so that the offset is accurate."""
        return self.filter is not None and self.filter.sigma_s(now_s) <= KNOWN_SIGMA_S

    def agrees_since(self, time_s: float) -> bool:
        """Return True if five exchanges after a time all agreed."""
        return len(self._agreed_s) == RESET_AFTER and self._agreed_s[0] >= time_s

    def due(self, now_s: float, system_id: int, component_id: int) -> Message | None:
        """Return the request to send now, if any."""
        if now_s < self.next_s:
            return None
        is_quick = self._used < FIRST_EXCHANGES or bool(self._deviating)
        self.next_s = now_s + (FIRST_PERIOD_S if is_quick else PERIOD_S)
        self.asked += 1
        sent_ns = max(1, round(now_s * NS_PER_S))
        self._open.append(sent_ns)
        return TargetedTimesync(0, sent_ns, system_id, component_id)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of the autopilot."""
        if not isinstance(message, mavlink.MAVLink_timesync_message):
            return
        if message.tc1 <= 0 or message.ts1 not in self._open:
            return  # a request, or an answer to another station
        self._open.remove(message.ts1)
        self.answered += 1
        sent_s = message.ts1 / NS_PER_S
        self._note_time(sent_s, message.tc1, now_s)
        if now_s - sent_s <= PROMPT_S:
            self._prompt_s = now_s
        else:
            self._slow_s = now_s
        round_trip_s = max(0.0, now_s - sent_s)
        self._round_trips.append((now_s, round_trip_s))
        while now_s - self._round_trips[0][0] > BEST_OF * PERIOD_S:
            self._round_trips.popleft()
        round_trips_s = [each_s for _, each_s in self._round_trips]
        self.round_trip_s = min(round_trips_s)
        slower_s = round_trip_s - self.round_trip_s
        if slower_s > SLOWER_S:
            self.slow += 1
            return
        middle_s = (sent_s + now_s) / 2.0
        beyond_s = [each_s - self.round_trip_s for each_s in round_trips_s]
        counted_s = [each_s for each_s in beyond_s if each_s <= SLOWER_S]
        spread_s = statistics.median(counted_s[-BEST_OF:])
        sigma_s = EXCHANGE_SIGMA_S + slower_s / 2.0 + spread_s / 6.0
        self.pace.add(middle_s, message.tc1 / NS_PER_S)
        self._scatter.add(middle_s, middle_s - message.tc1 / NS_PER_S)
        sigma_s = math.hypot(sigma_s, self._scatter.sigma_s)
        self._take(middle_s - message.tc1 / NS_PER_S, middle_s, sigma_s)

    def lateness(self, now_s: float) -> Lateness:
        """Return the delay of the link by the answers of the last seconds."""
        if self.answered == 0 or now_s - self._prompt_s <= PROMPT_WITHIN_S:
            return Lateness.NONE
        return Lateness.SLOW if now_s - self._slow_s <= SLOW_WITHIN_S else Lateness.UNKNOWN

    def take_restart(self) -> bool:
        """Return True, once, if the autopilot's clock restarted since the last call."""
        has_restarted, self._has_restarted = self._has_restarted, False
        return has_restarted

    def restart(self) -> None:
        """Discard the estimate of the clock after a restart of the autopilot."""
        self._newest, self._has_restarted = None, False
        self._open.clear()
        self._round_trips.clear()
        self.round_trip_s = None
        self.filter = None
        self._scatter, self.pace = ExchangeScatter(), ClockPace()
        self._used = 0
        self._agreed_s.clear()
        self._deviating.clear()
        self.next_s = 0.0

    def _note_time(self, sent_s: float, remote_ns: int, now_s: float) -> None:
        """Check whether the clock restarted between one request and a later one."""
        if self._newest is not None:
            if sent_s < self._newest[0]:
                return
            passed_s = now_s - self._newest[0]
            back_s = (self._newest[1] - remote_ns) / NS_PER_S
            is_back = back_s > REBOOT_BACKWARD_S + now_s - sent_s
            self._has_restarted |= is_back and remote_ns / NS_PER_S <= passed_s + REBOOT_BACKWARD_S
        self._newest = (sent_s, remote_ns)

    def _is_below(self, at_s: float) -> bool:
        """Return True if recent exchanges deviate to the side to which no answer is dated."""
        if not self._deviating or self.filter is None:
            return False
        first_s, first_offset_s = self._deviating[0]
        is_late = at_s - first_s <= PACE_WINDOW_S
        return is_late and first_offset_s < self.filter.at_s(first_s)

    def _take(self, offset_s: float, at_s: float, sigma_s: float) -> None:
        if self.filter is None:
            first_sigma_s = sigma_s + (self.round_trip_s or 0.0) / 4.0
            self.filter, self._used = OffsetFilter(offset_s, at_s, first_sigma_s), 1
            return
        self.filter.max_rate = MAX_RATE if self.pace.wrong(at_s) is None else MAX_PACE
        if self.filter.update(offset_s, at_s, sigma_s):
            self._used += 1
            self._agreed_s.append(at_s)
            if not self._is_below(at_s):
                self._deviating.clear()
            return
        if not 0.0 < offset_s - self.filter.at_s(at_s) <= DATED_BACK_S:
            self._agreed_s.clear()
        if self._deviating:
            first_s, first_offset_s = self._deviating[0]
            allowed_s = DEVIATION_S + MAX_PACE * abs(at_s - first_s)
            if abs(offset_s - first_offset_s) > allowed_s:
                self._deviating.clear()
        self._deviating.append((at_s, offset_s))
        if len(self._deviating) >= RESET_AFTER:
            (begun_s, begun_offset_s), *others = self._deviating
            self.filter = OffsetFilter(begun_offset_s, begun_s, sigma_s, self.filter)
            self._used = 1
            for later_s, later_offset_s in others:
                self.filter.update(later_offset_s, later_s, sigma_s)
            self._deviating.clear()
            self.resets += 1
