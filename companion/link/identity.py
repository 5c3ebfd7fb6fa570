"""Continuity check: frames under one pair of ids must continue as those of one vehicle.

Theory of operation. System and component ids are not an identity: two vehicles of a fleet may be
delivered as 1/1, and a router may bring both from one address. One vehicle is recognised by
continuity: `time_boot_ms` grows as our own clock does, its position is reachable from the last one,
and its sequence numbers follow each other. `IdentityCourse` follows that at one address.

A stamp that contradicts the course begins another one in parallel, and is withheld until it is
classified. Delayed frames are late, but do not alternate with prompt ones. A clock that slips, and
a restart, leave the old course permanently: a slip is by seconds and keeps position or sequence, a
restarted clock shows no more time than has passed. Any other permanent change is another vehicle in
its place. If frames return to the old course several times, two vehicles send. Position alone is
not proof of two, because a bad estimator may flip between two positions: then the sequence numbers
must be those of two counters, too.

The hardware id reliably distinguishes vehicles with the same ids. AUTOPILOT_VERSION contains it,
and autopilots send that on request only. So it is requested when an autopilot is bound, again when
its address changed or it was silent for a while, and as long as two ids are answered. Nothing waits
for the answer, and an autopilot that reports none, as many simulators do, is not doubted for it.

Source: MAVLink common, `time_boot_ms`, and AUTOPILOT_VERSION, `uid2` ("if this is non-zero, use
this field, otherwise use uid"); MAVLink developer guide, "Packet Loss" (one counter a
component and channel).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from companion.mav.dialect import Message, mavlink

WRAP_S = 2**32 / 1000.0
"""Period of `time_boot_ms`, 49.7 days."""
AHEAD_S = 3.0
"""Lead of a stamp above which its clock is another one, or slipped: no delay does that."""
LATE_S = 10.0
"""Longest delay on a link that also delivers promptly."""
SLIP_S = 10.0
"""Longest time for which a flying autopilot's clock stands still."""
YOUNG_S = 5.0
"""Excess of a restarted clock over the time since its sender was last received."""
SPEED_MPS, NEAR_M = 25.0, 10.0
"""Speed of a multicopter carried by the wind, and jump of its estimator, at most."""
NOISE_M = 2.0
"""Noise of a position, without a jump."""
JITTER_S = 1.0
"""Arrival jitter of frames of one clock."""
CONFIRM_STAMPS, CONFIRM_S = 3, 0.3
"""Stamps, and time, for which another course must continue alone before the old one is left."""
SPAN_S = 1.0
"""Minimum duration of a course from which frames return."""
RETURNS, MIN_RETURNS, RETURNS_WITHIN_S = 3, 2, 5.0
"""Returns to the old course in a time that prove two senders; fewer where waiting costs nothing."""
FAR_STEP, BACK_STEP = 16, 240
"""Steps of one counter are smaller than the one, or, for reordered frames, larger than the other,
modulo 256, unless a whole burst was lost."""
BREAKS = 6
"""Larger steps within that time that prove two counters."""
DOUBT_S = 5.0
"""Time without contradiction after which doubt ends."""

PositionNed = tuple[float, float, float]


class Sign(NamedTuple):
    """Evidence of its sender in a message."""

    stamp_s: float
    """Time since its boot."""
    position_ned_m: PositionNed | None = None


STAMPED = (
    mavlink.MAVLink_local_position_ned_message
    | mavlink.MAVLink_attitude_message
    | mavlink.MAVLink_global_position_int_message
    | mavlink.MAVLink_system_time_message
)


def exchange_sign_of(message: Message) -> Sign | None:
    """Return the clock in a TIMESYNC answer to any component; None: not an answer.

    It may differ from the clock of `time_boot_ms`. A sender of nothing else answers our requests,
    so this detects two vehicles even if one is nearly silent.
    """
    if isinstance(message, mavlink.MAVLink_timesync_message) and message.tc1 > 0:
        return Sign(message.tc1 / 1e9)
    return None


def sign_of(message: Message) -> Sign | None:
    """Return the evidence in a message; None without evidence or a valid time."""
    if not isinstance(message, STAMPED) or not message.time_boot_ms:
        return None
    position_ned_m: PositionNed | None = None
    if isinstance(message, mavlink.MAVLink_local_position_ned_message):
        position_ned_m = (message.x, message.y, message.z)
        if not all(map(math.isfinite, position_ned_m)):
            position_ned_m = None
    return Sign(message.time_boot_ms / 1000.0, position_ned_m)


@dataclass(slots=True)
class Track:
    """Clock and position of one sender, by its latest signs."""

    offset_s: float
    """Our time minus its own, with the shortest delay."""
    first_s: float
    first_offset_s: float
    heard_s: float
    stamp_s: float
    count: int = 1
    position_ned_m: PositionNed | None = None
    position_s: float = -math.inf

    @classmethod
    def begin(cls, sign: Sign, now_s: float) -> Track:
        """Return the track of a first sign."""
        offset_s = now_s - sign.stamp_s
        position_s = -math.inf if sign.position_ned_m is None else now_s
        position = sign.position_ned_m
        return cls(offset_s, now_s, offset_s, now_s, sign.stamp_s, 1, position, position_s)

    def late_s(self, sign: Sign, now_s: float) -> float:
        """Return the delay of a sign over the shortest so far, seconds; negative: ahead of it."""
        late_s = now_s - sign.stamp_s - self.offset_s
        return late_s - WRAP_S * round(late_s / WRAP_S)

    def away_m(self, sign: Sign) -> float:
        """Return the distance of a sign from the last position; 0 if either is unknown."""
        if sign.position_ned_m is None or self.position_ned_m is None:
            return 0.0
        return math.dist(sign.position_ned_m, self.position_ned_m)

    def reaches(self, sign: Sign, now_s: float) -> bool:
        """Return True if the vehicle can have flown from the last position to that of a sign."""
        return self.away_m(sign) <= NEAR_M + SPEED_MPS * max(0.0, now_s - self.position_s)

    def continues(self, sign: Sign, now_s: float) -> bool:
        """Return True if a sign continues this track, whose time does not stand still."""
        is_later = sign.stamp_s > self.stamp_s or now_s == self.heard_s
        return is_later and abs(self.late_s(sign, now_s)) <= JITTER_S and self.reaches(sign, now_s)

    @property
    def is_steady(self) -> bool:
        """True if its clock ran like ours for a while; a constant stamp does not."""
        span_s = self.heard_s - self.first_s
        return span_s >= SPAN_S and abs(self.offset_s - self.first_offset_s) <= 0.5 * span_s

    def take(self, sign: Sign, now_s: float) -> None:
        """Follow a sign; the shortest delay is forgotten slowly, as clocks drift."""
        late_s = self.late_s(sign, now_s)
        self.offset_s += min(late_s, 0.1 * max(0.0, now_s - self.heard_s))
        self.heard_s, self.stamp_s = now_s, sign.stamp_s
        self.count += 1
        if sign.position_ned_m is not None:
            self.position_ned_m, self.position_s = sign.position_ned_m, now_s


class SignVerdict(Enum):
    """Verdict on a sign."""

    GOES_ON = "of the same vehicle"
    WITHHELD = "of another clock, perhaps"
    ANOTHER = "of another vehicle in its place"
    TWO = "of one of two vehicles"


class IdentityCourse:
    """Course of one vehicle's frames at one address, and contradicting evidence."""

    def __init__(self) -> None:
        self.main: Track | None = None
        self.other: Track | None = None
        self.difference = ""
        """Description of how the other course differs."""
        self.is_out_of_sequence = False
        """True if the last frame's number was far from that of the frame before."""
        self.is_continuation: bool | None = None
        """True if it began where the course at another address ended; None: not decided yet."""
        self.uid: str | None = None
        """Hardware id that was answered at another address."""
        self._sequence: int | None = None
        self._breaks: deque[float] = deque(maxlen=BREAKS)
        self._returns: deque[float] = deque(maxlen=RETURNS)
        self._run, self.other_since_s = 0, 0.0
        """Signs of the other course since the last one of this one, and when they began."""

    def note_sequence(self, sequence: int, now_s: float) -> bool:
        """Process the number of any frame, before its sign; return True if it is out of order."""
        before = sequence if self._sequence is None else self._sequence
        self.is_out_of_sequence = FAR_STEP < (sequence - before) % 256 < BACK_STEP
        if self.is_out_of_sequence:
            self._breaks.append(now_s)
        self._sequence = sequence
        return self.is_out_of_sequence

    def take(self, sign: Sign, now_s: float, *, is_cautious: bool = False) -> SignVerdict:
        """Judge a sign, and follow it; if cautious, fewer returns prove two vehicles."""
        main = self.main
        if main is None:
            self.main = Track.begin(sign, now_s)
            return SignVerdict.GOES_ON
        late_s = main.late_s(sign, now_s)
        is_of_clock = -AHEAD_S <= late_s <= LATE_S
        if is_of_clock and main.reaches(sign, now_s):
            main.take(sign, now_s)
            is_conclusive = sign.position_ned_m is not None or self._clocks_s > AHEAD_S
            is_return = self._run > 0 and is_conclusive
            if not is_return:
                return SignVerdict.GOES_ON
            return self._note_return(now_s, is_cautious=is_cautious)
        if self.other is None or not self.other.continues(sign, now_s):
            self.other, self._run = Track.begin(sign, now_s), 0
        else:
            self.other.take(sign, now_s)
        if self._run == 0:
            self.other_since_s = now_s
        self._run += 1
        if self._run >= CONFIRM_STAMPS and now_s - self.other_since_s >= CONFIRM_S:
            return self._judge_other(sign, is_of_clock, now_s)
        is_restart = late_s > LATE_S and self.is_young(sign, now_s)
        return SignVerdict.GOES_ON if is_of_clock or is_restart else SignVerdict.WITHHELD

    @property
    def is_steady(self) -> bool:
        """True if one clock was followed for a while."""
        return self.main is not None and self.main.is_steady

    def adopt_other(self) -> None:
        """Continue with the other course as the vehicle's."""
        self.main, self.other, self._run = self.other, None, 0
        self._returns.clear()

    def is_of_main(self, sign: Sign, now_s: float) -> bool:
        """Return True if a sign from any address continues this course."""
        main = self.main
        return main is None or (
            -AHEAD_S <= main.late_s(sign, now_s) <= LATE_S and main.reaches(sign, now_s)
        )

    def is_of_clock(self, sign: Sign, now_s: float) -> bool:
        """Return True if a sign from any address matches the clock of this course only."""
        return self.main is None or abs(self.main.late_s(sign, now_s)) <= JITTER_S

    def compare_beginning(
        self, other: IdentityCourse, sequence: int, sign: Sign | None, now_s: float
    ) -> None:
        """Decide if a course elsewhere continues this one: next sequence number, near position."""
        if other.is_continuation is not None:
            return
        is_first = other._sequence is None
        if is_first and (self._sequence is None or (sequence - self._sequence) % 256 > FAR_STEP):
            other.is_continuation = False
        elif sign is not None and sign.position_ned_m is not None and self.main is not None:
            way_m = NOISE_M + SPEED_MPS * max(0.0, now_s - self.main.position_s)
            is_near = self.main.away_m(sign) <= way_m
            other.is_continuation = is_near and self.is_of_clock(sign, now_s)

    def describe(self, sign: Sign, now_s: float) -> str:
        """Describe the deviation of a sign from this course."""
        assert self.main is not None
        late_s = abs(self.main.late_s(sign, now_s))
        if late_s > AHEAD_S or self.main.reaches(sign, now_s):
            return f"boot clocks {late_s:.0f} s apart"
        return f"positions {self.main.away_m(sign):.0f} m apart"

    def is_young(self, sign: Sign, now_s: float) -> bool:
        """Return True if a sign may be from this vehicle after a restart."""
        main = self.main
        return main is not None and sign.stamp_s <= now_s - main.heard_s + YOUNG_S

    @property
    def _clocks_s(self) -> float:
        """Seconds between the clocks of both courses."""
        if self.main is None or self.other is None:
            return 0.0
        return abs(self.other.offset_s - self.main.offset_s)

    def _note_return(self, now_s: float, *, is_cautious: bool) -> SignVerdict:
        """Count a return of frames from the other course to this one."""
        self._run = 0
        assert self.main is not None
        other, clocks_s = self.other, self._clocks_s
        if other is None or now_s - other.heard_s > SPAN_S:
            return SignVerdict.GOES_ON
        if not (other.is_steady or (is_cautious and other.count > 1)):
            return SignVerdict.GOES_ON
        self._returns.append(now_s)
        enough = MIN_RETURNS if is_cautious else RETURNS
        lately = [at_s for at_s in self._returns if now_s - at_s <= RETURNS_WITHIN_S]
        is_often = len(lately) >= enough
        are_two_counters = len(self._breaks) == BREAKS and now_s - self._breaks[0] <= (
            RETURNS_WITHIN_S
        )
        if not is_often or not (clocks_s > AHEAD_S or are_two_counters):
            return SignVerdict.GOES_ON
        self.difference = f"boot clocks {clocks_s:.0f} s apart"
        if clocks_s <= AHEAD_S and other.position_ned_m and self.main.position_ned_m:
            away_m = math.dist(other.position_ned_m, self.main.position_ned_m)
            self.difference = f"positions {away_m:.0f} m apart"
        return SignVerdict.TWO

    def _judge_other(self, sign: Sign, is_of_clock: bool, now_s: float) -> SignVerdict:
        """Classify the departure from the old course: slip, restart, jump, or another vehicle."""
        main, other = self.main, self.other
        assert main is not None
        assert other is not None
        left_s = main.position_s if is_of_clock else main.heard_s
        is_in_sequence = not any(broken_s >= left_s for broken_s in self._breaks)
        is_near = main.reaches(sign, now_s)
        late_s, silent_s = main.late_s(sign, now_s), other.first_s - main.heard_s
        is_slip = abs(late_s) <= SLIP_S and is_near
        is_jump = is_of_clock and is_in_sequence
        is_held_up = is_in_sequence and is_near and 0.0 <= late_s <= silent_s + LATE_S
        if is_slip or is_jump or is_held_up or self.is_young(sign, now_s):
            self.adopt_other()
            return SignVerdict.GOES_ON
        self.difference = self.describe(sign, now_s)
        return SignVerdict.ANOTHER


ASK_PERIOD_S = 1.0
MAX_REQUESTS = 5
"""Requests for each cause: some autopilots do not support the message. Where 30 % of all frames are
lost, all five remain unanswered in one of thirty cases."""


def uid_of(message: Message) -> str | None:
    """Return the hardware id in a message as hexadecimal digits; None if it has none."""
    if not isinstance(message, mavlink.MAVLink_autopilot_version_message):
        return None
    uid2 = bytes(message.uid2)
    if any(uid2):
        return uid2.hex()
    return f"{message.uid:016x}" if message.uid else None


class HardwareId:
    """Hardware id of one bound autopilot, and the schedule of its requests."""

    def __init__(self) -> None:
        self.uid: str | None = None
        self.heard_s = -math.inf
        """Time of the latest answer."""
        self._asks = 0
        self._asked_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Return True if the id is to be requested now, and count the request."""
        if self._asks >= MAX_REQUESTS or now_s - self._asked_s < ASK_PERIOD_S:
            return False
        self._asks, self._asked_s = self._asks + 1, now_s
        return True

    def ask_again(self) -> None:
        """Request it again, because the sender may have changed."""
        self._asks = 0

    def confirm(self, now_s: float, age_s: float) -> None:
        """Request it again if the latest answer is older than this, in seconds."""
        if self.uid is not None and now_s - self.heard_s > age_s:
            self.ask_again()

    def differs(self, uid: str, now_s: float) -> bool:
        """Process an answered id; return True if a different one was answered before."""
        if self.uid is None:
            self.uid = uid
        if uid == self.uid:
            self._asks, self.heard_s = MAX_REQUESTS, now_s
            return False
        self.ask_again()
        return True
