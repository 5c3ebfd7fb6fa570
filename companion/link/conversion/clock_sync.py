"""The autopilot's clock by TIMESYNC: how far it is from ours, and how fast it runs.

Theory of operation. We send our time, the autopilot mirrors it and adds its own; half a round trip
later its answer is here. The offset between the clocks follows from the middle of that trip, and
is wrong by at most half of it, where the two ways differ. An answer counts only if its round trip
is within 10 ms of the best of the last eight seconds, because what is slow is slow on one way only.

A simulated autopilot on a busy computer runs slow by per cents, so offset and rate are estimated
together, by a Kalman filter of two states. An exchange that deviates clearly from what they
foretell is left out; five in a row that agree with each other are a clock that slipped, or stood
still, and the filter starts over with them. While they do, questions follow each other quickly. An
answer that is dated back makes the offset too large, never too small: exchanges below what is
foretold stay in the row, although one above it agrees in between.

Only the answer to a question of ours counts, and once: another station's, a late or an invented
one cannot move the clock. A clock that went back is that of an autopilot that restarted only if it
shows no more time than can have passed since then; otherwise it slipped.

Source: MAVLink guide, "Time Synchronization"; PX4 `Timesync.hpp`, which tracks offset and skew too.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from enum import Enum
from typing import NamedTuple

from companion.mav.addressing import TargetedTimesync
from companion.mav.dialect import Message, mavlink

FIRST_PERIOD_S = 0.1
FIRST_EXCHANGES = 10
"""So many are asked for quickly, to know the offset within a second."""
PERIOD_S = 0.5
"""So often at least, because a restart shall be known within a second."""
BEST_OF = 16
"""Periods in which the shortest round trip is looked for, however many answers come at once."""
MAX_ROUND_TRIPS = 128
"""Of as many periods of quick questions, and of those that waited."""
SLOWER_S = 0.010
DEVIATION_S = 0.05
"""Farther from what was foretold than this, and than five sigma, is another clock."""
RESET_AFTER = 5
MAX_RATE = 0.06
"""Few clocks gain or lose more, seconds per second; what scatter alone shows is cut to this ..."""
MAX_PACE = 0.25
"""... and what exchanges on a straight line show to this: a simulated autopilot on a busy computer
was 10 % slow for seconds. What is beyond runs at another speed than we do, and is not followed."""
PACE_WINDOW_S = 3.0
CRYSTAL = 1e-4
"""How well a clock runs as a rule, one sigma; and what that changes by, per root second."""
SURPRISE = 3.0
BUSY = 0.03
"""What the rate may be as long as nothing is known of it, one sigma: the clock of a simulated
autopilot runs as its computer lets it. So also after two exchanges, to one side, that are off by
more than `SURPRISE` sigma."""
SIGNIFICANT = 4.0
"""A rate smaller than so many sigma is none."""
OFFSET_NOISE_S = 1e-5
EXCHANGE_SIGMA_S = 5e-4
DATED_BACK_S = 0.09
"""ArduPilot dates a TIMESYNC request back by what waits in its receive buffer, 10 bit a byte at
57,600 baud, on TCP and UDP, too: by 3 to 27 ms as a rule, by 512 bytes at most (AP_HAL_SITL
`UARTDriver::receive_time_constraint_us`). Stamps then seem to arrive before they were sent."""
MEDIAN_OF_CHORD = 0.6745 * math.sqrt(1.5)
"""Median distance, in sigma, of a normal value from the middle of two others."""
KNOWN_SIGMA_S = 0.02
PROMPT_S = 1.0
"""An answer that came sooner shows that the link is not slow ..."""
PROMPT_WITHIN_S = 3.0
"""... for so long; where half of questions and of answers get lost, one in six times none comes."""
SLOW_WITHIN_S = 15.0
"""A late one shows for so long that it is, if none comes promptly."""
MAX_OPEN = 32
"""Questions that may still be answered: those of three seconds, also while they are quick."""
REBOOT_BACKWARD_S = 1.0
"""A clock that went back by less did not restart."""
NS_PER_S = 1e9


class Rate(NamedTuple):
    """Of a clock, beside ours; seconds a second."""

    growth: float
    """Of our time minus the other's."""
    slack: float
    """How much faster it may be."""


DRIFT_ALLOWANCE = 200e-6
"""Twice a poor crystal's drift."""
NO_RATE = Rate(0.0, DRIFT_ALLOWANCE)


class Lateness(Enum):
    """How late what comes over the link may be."""

    NONE = "answers come promptly, or never came"
    UNKNOWN = "answers came, and come no more"
    SLOW = "answers come late"


class OffsetFilter:
    """Offset and rate of a clock from exchanges of times; a Kalman filter of two states.

    Args:
        offset_s: Our time minus the other's at the first exchange.
        at_s: When that was, on our clock.
        sigma_s: Of that exchange.
        before: Filter of the same clock before it slipped, which changed its rate by nothing.
    """

    def __init__(
        self, offset_s: float, at_s: float, sigma_s: float, before: OffsetFilter | None = None
    ) -> None:
        self.rate: float = 0.0 if before is None else before.rate
        """Seconds that the offset grows a second."""
        self._offset_s, self._at_s = offset_s, at_s
        self._offset_var, self._covar = sigma_s**2, 0.0
        self._rate_var: float = CRYSTAL**2 if before is None else before._rate_var
        self.max_rate = MAX_RATE
        """No rate beyond is taken from exchanges."""
        self._surprise_s = 0.0
        """By how much the exchange before was off, if that was much."""

    def at_s(self, time_s: float) -> float:
        """The offset at a time on our clock."""
        return self._offset_s + self.rate * (time_s - self._at_s)

    def sigma_s(self, time_s: float) -> float:
        """How well the offset is known at a time."""
        return math.sqrt(self._foretold(max(0.0, time_s - self._at_s))[0])

    @property
    def steady_rate(self) -> Rate:
        """The rate, if it is more than can be by chance; and what it may be more."""
        sigma = math.sqrt(self._rate_var)
        if abs(self.rate) > SIGNIFICANT * sigma:
            return Rate(self.rate, DRIFT_ALLOWANCE + 2.0 * sigma)
        is_crystal = sigma <= SIGNIFICANT * CRYSTAL
        return NO_RATE if is_crystal else Rate(0.0, DRIFT_ALLOWANCE + 2.0 * sigma)

    def _foretold(self, passed_s: float) -> tuple[float, float]:
        """Variance of the offset, and its covariance with the rate, so much later."""
        offset_var = (
            self._offset_var
            + passed_s * (2.0 * self._covar + passed_s * self._rate_var)
            + OFFSET_NOISE_S**2 * passed_s
            + CRYSTAL**2 * passed_s**3 / 3.0
        )
        return offset_var, self._covar + passed_s * (self._rate_var + CRYSTAL**2 * passed_s / 2.0)

    def update(self, offset_s: float, at_s: float, sigma_s: float) -> bool:
        """Take in an exchange; False if it deviates too much, and changed nothing."""
        passed_s = max(0.0, at_s - self._at_s)
        innovation_s = offset_s - self.at_s(at_s)
        offset_var, covar = self._foretold(passed_s)
        innovation_var = offset_var + sigma_s**2
        if abs(innovation_s) > max(DEVIATION_S, 5.0 * math.sqrt(innovation_var)):
            return False
        is_surprise = innovation_s**2 > SURPRISE**2 * innovation_var
        if is_surprise and innovation_s * self._surprise_s > 0.0:
            self._rate_var = BUSY**2
            offset_var, covar = self._foretold(passed_s)
            innovation_var = offset_var + sigma_s**2
        self._surprise_s = innovation_s if is_surprise else 0.0
        gain, rate_gain = offset_var / innovation_var, covar / innovation_var
        self._offset_s = self.at_s(at_s) + gain * innovation_s
        rate = self.rate + rate_gain * innovation_s
        self.rate = min(self.max_rate, max(-self.max_rate, rate))
        self._at_s = max(self._at_s, at_s)
        self._rate_var += CRYSTAL**2 * passed_s - rate_gain * covar
        self._offset_var = (1.0 - gain) * offset_var
        self._covar = (1.0 - gain) * covar
        return True


class ExchangeScatter:
    """Spread of offsets beside the line through their neighbours, which no steady rate causes.

    ArduPilot's answers are dated back by what waits in its receive buffer (`DATED_BACK_S`), by
    another amount each time, which no round trip shows.
    """

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=3)
        self._beside_s: deque[float] = deque(maxlen=BEST_OF)

    def add(self, at_s: float, offset_s: float) -> None:
        """Take in an exchange."""
        self._last.append((at_s, offset_s))
        if len(self._last) < 3:
            return
        (first_s, first), (middle_s, middle), (last_s, last) = self._last
        share = 0.5 if last_s <= first_s else (middle_s - first_s) / (last_s - first_s)
        self._beside_s.append(abs(middle - first - share * (last - first)))

    @property
    def sigma_s(self) -> float:
        """One sigma of an offset."""
        if len(self._beside_s) < RESET_AFTER:
            return max(self._beside_s, default=0.0)
        return statistics.median(self._beside_s) / MEDIAN_OF_CHORD


class ClockPace:
    """Seconds that the autopilot's clock goes on in one of ours, if not one."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float]] = deque(maxlen=MAX_OPEN)

    def add(self, at_s: float, remote_s: float) -> None:
        """Take in an exchange: our time in its middle, and the autopilot's."""
        if self._exchanges and at_s <= self._exchanges[-1][0]:
            return
        self._exchanges.append((at_s, remote_s))
        while at_s - self._exchanges[0][0] > PACE_WINDOW_S:
            self._exchanges.popleft()

    def wrong(self, now_s: float) -> float | None:
        """The pace where that is clearly not 1; None: it is, or no straight line shows it."""
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
    """The offset of the autopilot's clock."""

    def __init__(self) -> None:
        self.asked = 0
        self.answered = 0
        self.slow = 0
        """Answers that took too long to say anything."""
        self.resets = 0
        self._open: deque[int] = deque(maxlen=MAX_OPEN)
        self._next_s = 0.0
        self._round_trips: deque[tuple[float, float]] = deque(maxlen=MAX_ROUND_TRIPS)
        """When answers came, and their round trips, seconds."""
        self.round_trip_s: float | None = None
        """The best of the last exchanges; None before the first."""
        self._filter: OffsetFilter | None = None
        self._scatter = ExchangeScatter()
        self.pace = ClockPace()
        self._used = 0
        self._agreed_s: deque[float] = deque(maxlen=RESET_AFTER)
        """When the last exchanges were that agreed with what was foretold."""
        self._deviating: list[tuple[float, float]] = []
        """Exchanges, in a row, that deviate but agree: when, and the offset."""
        self._newest: tuple[float, int] | None = None
        """When the latest question that was answered was sent, and the autopilot's time then."""
        self._has_restarted = False
        self._prompt_s = -math.inf
        """When a question was answered promptly last, and when late."""
        self._slow_s = -math.inf

    def offset_at_s(self, now_s: float) -> float | None:
        """Our time minus the autopilot's, seconds, at a time; None as long as it is not known."""
        return None if self._filter is None else self._filter.at_s(now_s)

    @property
    def rate(self) -> Rate:
        """How fast the offset grows, positive where the autopilot's clock is slow."""
        return NO_RATE if self._filter is None else self._filter.steady_rate

    def is_known(self, now_s: float) -> bool:
        """Whether the offset is known well: exchanges came lately, and agreed."""
        return self._filter is not None and self._filter.sigma_s(now_s) <= KNOWN_SIGMA_S

    def agrees_since(self, time_s: float) -> bool:
        """Whether five exchanges were made after a time that all agreed."""
        return len(self._agreed_s) == RESET_AFTER and self._agreed_s[0] >= time_s

    def due(self, now_s: float, system_id: int, component_id: int) -> Message | None:
        """The question to send now, if any."""
        if now_s < self._next_s:
            return None
        is_quick = self._used < FIRST_EXCHANGES or bool(self._deviating)
        self._next_s = now_s + (FIRST_PERIOD_S if is_quick else PERIOD_S)
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
        """What the answers of the last seconds say about the link."""
        if self.answered == 0 or now_s - self._prompt_s <= PROMPT_WITHIN_S:
            return Lateness.NONE
        return Lateness.SLOW if now_s - self._slow_s <= SLOW_WITHIN_S else Lateness.UNKNOWN

    def take_restart(self) -> bool:
        """Whether the clock began anew since this was asked last."""
        has_restarted, self._has_restarted = self._has_restarted, False
        return has_restarted

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self._newest, self._has_restarted = None, False
        self._open.clear()
        self._round_trips.clear()
        self.round_trip_s = None
        self._filter = None
        self._scatter, self.pace = ExchangeScatter(), ClockPace()
        self._used = 0
        self._agreed_s.clear()
        self._deviating.clear()
        self._next_s = 0.0

    def _note_time(self, sent_s: float, remote_ns: int, now_s: float) -> None:
        """Look whether the clock began anew between one question and a later one."""
        if self._newest is not None:
            if sent_s < self._newest[0]:
                return
            passed_s = now_s - self._newest[0]
            back_s = (self._newest[1] - remote_ns) / NS_PER_S
            is_back = back_s > REBOOT_BACKWARD_S + now_s - sent_s
            self._has_restarted |= is_back and remote_ns / NS_PER_S <= passed_s + REBOOT_BACKWARD_S
        self._newest = (sent_s, remote_ns)

    def _is_below(self, at_s: float) -> bool:
        """Return True if exchanges of late deviate to the side to which no answer is dated."""
        if not self._deviating or self._filter is None:
            return False
        first_s, first_offset_s = self._deviating[0]
        is_late = at_s - first_s <= PACE_WINDOW_S
        return is_late and first_offset_s < self._filter.at_s(first_s)

    def _take(self, offset_s: float, at_s: float, sigma_s: float) -> None:
        if self._filter is None:
            first_sigma_s = sigma_s + (self.round_trip_s or 0.0) / 4.0
            self._filter, self._used = OffsetFilter(offset_s, at_s, first_sigma_s), 1
            return
        self._filter.max_rate = MAX_RATE if self.pace.wrong(at_s) is None else MAX_PACE
        if self._filter.update(offset_s, at_s, sigma_s):
            self._used += 1
            self._agreed_s.append(at_s)
            if not self._is_below(at_s):
                self._deviating.clear()
            return
        if not 0.0 < offset_s - self._filter.at_s(at_s) <= DATED_BACK_S:
            self._agreed_s.clear()
        if self._deviating:
            first_s, first_offset_s = self._deviating[0]
            allowed_s = DEVIATION_S + MAX_PACE * abs(at_s - first_s)
            if abs(offset_s - first_offset_s) > allowed_s:
                self._deviating.clear()
        self._deviating.append((at_s, offset_s))
        if len(self._deviating) >= RESET_AFTER:
            (begun_s, begun_offset_s), *others = self._deviating
            self._filter = OffsetFilter(begun_offset_s, begun_s, sigma_s, self._filter)
            self._used = 1
            for later_s, later_offset_s in others:
                self._filter.update(later_offset_s, later_s, sigma_s)
            self._deviating.clear()
            self.resets += 1
