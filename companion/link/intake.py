"""From what a link brings to proved frames of known senders, within a budget.

Theory of operation of the budget. What arrives is looked at only so far between two control ticks,
so that no flood delays one. The autopilot's own address, and any line with one end, has a budget
that is far above what an autopilot sends; everyone else shares a much smaller one, with a share for
each source, so that unknown peers are dropped first and none of them crowds the others out. Bytes
are counted before they are cut into frames, frames before they are proved, messages before anyone
acts on them. What is over budget is dropped and counted, and the budgets begin anew with each
control tick. Of the sources a tick remembers only so many. A link that held everything back
delivers more at once than a tick reads, and the newest mode last: so HEARTBEATs of the autopilot's
address have a budget of their own.

PX4 1.15 sends 405 frames a second on its busiest link: 20 between two ticks. The bytes are what
the worst of them, all magic, can be cut up in less than a tick (1.3 us each).

A radio's own format comes raw and is cut by its decoder, in plain Python. Its link has an account
of bytes: a tick adds twice what a serial port at 921600 baud brings, and a page that is polled may
take what was saved.

Theory of operation of signing. With a key every frame of every link must prove itself before it is
decoded; the codecs see to that. The time in signatures goes on from the wall clock at the start by
the control tick's own clock, so that a wall clock that is set in flight changes nothing; only
before an autopilot is bound is it followed. What was refused is announced at once, and then
once a period in one text, because a forger must not be able to fill the log. RADIO_STATUS may
come unsigned. It is noted down and goes no further: unproved, it says nothing about the autopilot,
not even that it is there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from enum import IntEnum

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.texts import CAUSE_PERIOD_S
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2, SIGNATURE_LENGTH, message_id
from companion.mav.signing import (
    UNSIGNED_ALLOWED,
    LinkSigning,
    SignatureVerdict,
    Signing,
    is_signed,
)


class RateLimit:
    """Lets `burst` things through at once and then `per_s` a second; what it refuses is counted."""

    def __init__(self, per_s: float, burst: int = 1) -> None:
        self.refused = 0
        self._per_s = per_s
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s = -math.inf

    def acquire(self, now_s: float) -> bool:
        """Whether one more may pass now."""
        if now_s > self._seen_s:
            self._left = min(self._burst, self._left + (now_s - self._seen_s) * self._per_s)
            self._seen_s = now_s
        if self._left < 1.0:
            self.refused += 1
            return False
        self._left -= 1.0
        return True


MAX_SOURCES = 64
"""Unknown peers told apart in one tick; those beyond are dropped."""


class Resource(IntEnum):
    """What is counted."""

    BYTES = 0
    FRAMES = 1
    """With a right CRC."""
    MESSAGES = 2
    """Proved, or signing is off."""


Amounts = tuple[int, int, int]

KNOWN: Amounts = (32_768, 2_000, 500)
UNKNOWN_PEERS: Amounts = (16_384, 400, 100)
"""All of them together."""
ONE_UNKNOWN_PEER: Amounts = (4_096, 100, 50)
RAW_BYTES, MOST_RAW_BYTES = 8_192, 32_768
"""What a tick adds to the account of a link with a radio's own format, and the most there is."""
HEARTBEATS = 200
"""Of the autopilot's address, whatever else it sent: they alone tell who flies. One a second, and
those that are asked for after a silence, of more than two minutes."""


class FloodBudget:
    """The budgets of one link."""

    def __init__(self) -> None:
        self.dropped = [0, 0, 0]
        """Refusals so far, by what was used up: chunks, frames, messages."""
        self._raw_left = MOST_RAW_BYTES
        self.renew()

    def renew(self) -> None:
        """A control tick has passed."""
        self._known = [0, 0, 0]
        self._unknown = [0, 0, 0]
        self._by_source: dict[Address | None, list[int]] = {}
        self._heartbeats = 0
        self._raw_left = min(MOST_RAW_BYTES, self._raw_left + RAW_BYTES)

    @property
    def dropped_unread(self) -> int:
        """Refusals so far: chunks, frames and messages."""
        return sum(self.dropped)

    def spend_heartbeat(self) -> bool:
        """Whether one more HEARTBEAT of the autopilot's address may come beside all budgets."""
        self._heartbeats += 1
        return self._heartbeats <= HEARTBEATS

    def spend_raw(self, count: int) -> bool:
        """Whether so many bytes of a radio's own format may come."""
        if count > self._raw_left:
            self.dropped[Resource.BYTES] += 1
            return False
        self._raw_left -= count
        return True

    def spend(
        self, resource: Resource, amount: int, peer: Address | None, *, is_known: bool
    ) -> bool:
        """Whether a source may use so much more of a resource, which is then used."""
        if is_known:
            left = KNOWN[resource] - self._known[resource] - amount
            if left < 0:
                self.dropped[resource] += 1
                return False
            self._known[resource] += amount
            return True
        own = self._account_of(peer)
        if own is None:
            self.dropped[resource] += 1
            return False
        accounts = ((self._unknown, UNKNOWN_PEERS), (own, ONE_UNKNOWN_PEER))
        for used, allowed in accounts:
            if used[resource] + amount > allowed[resource]:
                self.dropped[resource] += 1
                return False
        for used, _ in accounts:
            used[resource] += amount
        return True

    def _account_of(self, peer: Address | None) -> list[int] | None:
        """What an unknown peer has used; None if there are too many of them to tell."""
        used = self._by_source.get(peer)
        if used is None and len(self._by_source) < MAX_SOURCES:
            used = self._by_source[peer] = [0, 0, 0]
        return used


HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
SHORTEST = HEADER_LENGTH[MAGIC_V2]
LONGEST_HEARTBEAT = HEADER_LENGTH[MAGIC_V2] + 9 + CRC_LENGTH + SIGNATURE_LENGTH


class Intake:
    """One link's way in: budget and proof.

    The address of the autopilot of `binding` has the large budget. `is_raw` where something other
    than MAVLink arrives, to be cut by a ranging source.
    """

    def __init__(
        self, codec: MavCodec, binding: AutopilotBinding | None = None, *, is_raw: bool = False
    ) -> None:
        self.codec = codec
        self.is_raw = is_raw
        self.budget = FloodBudget()
        self._binding = binding

    def take(self, chunk: Chunk) -> Iterator[bytes]:
        """The proved frames of a chunk, or a raw chunk as it is, as far as the budget goes."""
        if self.is_raw:
            if self.budget.spend_raw(len(chunk.data)):
                yield chunk.data
            return
        codec, spend, peer, binding = self.codec, self.budget.spend, chunk.peer, self._binding
        is_known = not chunk.is_datagram or (
            binding is not None and binding.is_bound and peer == binding.peer
        )
        is_free = is_known and _is_heartbeat(chunk) and self.budget.spend_heartbeat()
        if not (is_free or spend(Resource.BYTES, len(chunk.data), peer, is_known=is_known)):
            return
        for frame in codec.splitter.split(chunk.data, is_datagram=chunk.is_datagram):
            if not (is_free or spend(Resource.FRAMES, 1, peer, is_known=is_known)):
                return
            if not codec.proves(frame):
                continue
            if not (is_free or spend(Resource.MESSAGES, 1, peer, is_known=is_known)):
                return
            yield frame


def _is_heartbeat(chunk: Chunk) -> bool:
    """Whether a datagram is one HEARTBEAT by its header and its size; neither is proved yet."""
    data = chunk.data
    is_one = chunk.is_datagram and SHORTEST <= len(data) <= LONGEST_HEARTBEAT
    return is_one and data[0] in HEADER_LENGTH and message_id(data) == HEARTBEAT


REPORT_PERIOD_S = CAUSE_PERIOD_S
HINTS: Mapping[SignatureVerdict, str] = {
    SignatureVerdict.UNSIGNED: "does the autopilot sign, with this key?",
    SignatureVerdict.BAD_SIGNATURE: "is it the same key on both sides?",
    SignatureVerdict.TOO_FAR_AHEAD: "its sender has the key; set the clocks, ours or its",
    SignatureVerdict.TOO_OLD: "its sender has the key; set the clocks, ours or its",
}
ALARMS = frozenset(
    {
        SignatureVerdict.TOO_FAR_AHEAD,
        SignatureVerdict.TIMESTAMP_OVERFLOW,
        SignatureVerdict.TOO_MANY_STREAMS,
    }
)
"""What only somebody who has the key can cause."""


class Authenticity:
    """The companion's side of signing, on all links; without a key everyone is believed."""

    def __init__(self, signing: Signing | None = None, unix_minus_local_s: float = 0.0) -> None:
        self._signing = signing
        self._unix_minus_local_s = unix_minus_local_s
        self._told: dict[SignatureVerdict, int] = dict.fromkeys(SignatureVerdict, 0)
        self._next_report_s = -math.inf

    @property
    def is_on(self) -> bool:
        """Whether there is a key."""
        return self._signing is not None

    def of_link(
        self, number: int, unsigned_ids: frozenset[int] = frozenset()
    ) -> LinkSigning | None:
        """Return what a link's codec signs and proves by; None without a key.

        Messages of `unsigned_ids` may come unsigned on it, beside those that can never be signed.
        """
        if self._signing is None:
            return None
        allowed = UNSIGNED_ALLOWED | unsigned_ids
        return LinkSigning(self._signing, number % 256, unsigned_ids=allowed)

    def set_clock(self, unix_s: float, now_s: float) -> None:
        """Take the wall clock as it is now."""
        self._unix_minus_local_s = unix_s - now_s

    def is_proved(self, frame: bytes) -> bool:
        """Whether a frame that was accepted may say something about the autopilot."""
        return self._signing is None or is_signed(frame)

    def advance(self, now_s: float) -> None:
        """Let the time in signatures go on."""
        if self._signing is not None:
            self._signing.advance(now_s + self._unix_minus_local_s)

    def tick(self, now_s: float) -> list[Announce]:
        """The same at a control tick; what the operator is to be told."""
        self.advance(now_s)
        if self._signing is None or now_s < self._next_report_s:
            return []
        news = {
            verdict: count - self._told[verdict]
            for verdict, count in self._signing.verdicts.items()
            if not verdict.is_accepted and count > self._told[verdict]
        }
        if not news:
            return []
        self._told = dict(self._signing.verdicts)
        self._next_report_s = now_s + REPORT_PERIOD_S
        severity = Severity.ERROR if ALARMS & news.keys() else Severity.WARNING
        hints = {verdict: f" ({hint})" for verdict, hint in HINTS.items()}
        words = (f"{count} x {v.value}{hints.get(v, '')}" for v, count in news.items())
        return [Announce(severity, f"signing: refused {', '.join(words)}")]

    def record(self) -> dict[str, object]:
        """The figures for the event log: how many frames got which verdict."""
        if self._signing is None:
            return {}
        verdicts = self._signing.verdicts
        return {"signing": {v.value: count for v, count in verdicts.items() if count}}
