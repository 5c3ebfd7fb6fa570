"""Intake of a link: frames of known senders, within a budget and with verified signatures.

Theory of operation of the budget. Input between two control ticks is limited, so that no flood
delays one. The autopilot's own address, and any line with one end, has a budget that is far above
an autopilot's traffic; all others share a much smaller one, with a share for each source, so that
unknown peers are dropped first and none of them displaces the others. Bytes are counted before they
are split into frames, frames before they are verified, messages before they are used. Input over
budget is dropped and counted, and the budgets are reset with each control tick. The number of
sources per tick is limited. A link that held everything back delivers more at once than a tick
reads, and the newest mode last: so HEARTBEATs of the autopilot's address have a budget of their
own.

PX4 1.15 sends 405 frames a second on its busiest link: 20 between two ticks. The bytes are limited
such that the worst of them, all magic, are split in less than a tick (1.3 us each).

A radio's own format is passed raw and split by its decoder, in plain Python. Its link has an
account of bytes: a tick adds twice the throughput of a serial port at 921600 baud, and a page that
is polled may use the savings.

Theory of operation of signing. With a key every frame of every link must be verified before it is
decoded; the codecs do that. The time in signatures continues from the wall clock at the start by
the control tick's own clock, so that a wall clock that is set in flight has no effect; it is
followed only before an autopilot is bound. Rejections are announced within a second, then once a
period in one text, because a forger must not fill the log. RADIO_STATUS may be unsigned. It is
logged and not used otherwise: unverified, it is not evidence about the autopilot, not even that it
is there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.text_gate import CAUSE_PERIOD_S
from companion.mav.codec import (
    CRC_LENGTH,
    HEADER_LENGTH,
    MAGIC_V2,
    SIGNATURE_LENGTH,
    MavCodec,
    message_id,
)
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.signing import (
    UNSIGNED_ALLOWED,
    LinkSigning,
    SignatureVerdict,
    Signing,
    is_signed,
)


class RateLimit:
    """Token bucket: `burst` at once, then `per_s` per second; refusals are counted."""

    def __init__(self, per_s: float, burst: int = 1) -> None:
        self.refused = 0
        self._per_s = per_s
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s = -math.inf

    def acquire(self, now_s: float) -> bool:
        """Return True if one more may pass now."""
        if now_s > self._seen_s:
            self._left = min(self._burst, self._left + (now_s - self._seen_s) * self._per_s)
            self._seen_s = now_s
        if self._left < 1.0:
            self.refused += 1
            return False
        self._left -= 1.0
        return True


MAX_SOURCES = 64
"""Unknown peers with separate accounts in one tick; further ones are dropped."""


class Resource(IntEnum):
    """Resources with a budget."""

    BYTES = 0
    FRAMES = 1
    """Frames with a correct CRC."""
    MESSAGES = 2
    """Messages in verified frames, or in any without signing."""


Amounts = tuple[int, int, int]

KNOWN: Amounts = (32_768, 2_000, 500)
UNKNOWN_PEERS: Amounts = (16_384, 400, 100)
"""Budget of all unknown peers together."""
ONE_UNKNOWN_PEER: Amounts = (4_096, 100, 50)
RAW_BYTES, MAX_RAW_BYTES = 8_192, 32_768
"""Bytes that a tick adds to the account of a link with a radio's own format, and its limit."""
HEARTBEATS = 200
"""Separate budget for HEARTBEATs of the autopilot's address: they alone carry the mode. One a
second, and those requested after a silence, of more than two minutes."""


class FloodBudget:
    """Budgets of one link."""

    def __init__(self) -> None:
        self.dropped = [0, 0, 0]
        """Refusals so far, by resource: chunks, frames, messages."""
        self._raw_left = MAX_RAW_BYTES
        self.renew()

    def renew(self) -> None:
        """Reset the budgets at a control tick."""
        self.known = [0, 0, 0]
        """Use by the autopilot's address, by resource."""
        self._unknown = [0, 0, 0]
        self._by_source: dict[Address | None, list[int]] = {}
        self._heartbeats = 0
        self._raw_left = min(MAX_RAW_BYTES, self._raw_left + RAW_BYTES)

    @property
    def dropped_unread(self) -> int:
        """Refusals so far: chunks, frames and messages."""
        return sum(self.dropped)

    def spend_heartbeat(self) -> bool:
        """Return True if one more HEARTBEAT of the autopilot's address may pass separately."""
        self._heartbeats += 1
        return self._heartbeats <= HEARTBEATS

    def spend_raw(self, count: int) -> bool:
        """Return True if this number of bytes of a radio's own format may pass."""
        if count > self._raw_left:
            self.dropped[Resource.BYTES] += 1
            return False
        self._raw_left -= count
        return True

    def spend(
        self, resource: Resource, amount: int, peer: Address | None, *, is_known: bool
    ) -> bool:
        """Charge a source for a resource; return False if that exceeds its budget."""
        if is_known:
            if self.known[resource] + amount > KNOWN[resource]:
                self.dropped[resource] += 1
                return False
            self.known[resource] += amount
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
        """Return the account of an unknown peer; None if there are too many of them."""
        used = self._by_source.get(peer)
        if used is None and len(self._by_source) < MAX_SOURCES:
            used = self._by_source[peer] = [0, 0, 0]
        return used


HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
SHORTEST = HEADER_LENGTH[MAGIC_V2]
LONGEST_HEARTBEAT = HEADER_LENGTH[MAGIC_V2] + 9 + CRC_LENGTH + SIGNATURE_LENGTH


class Intake:
    """Intake of one link: budget and verification.

    The address of the autopilot of `binding` has the large budget. `is_raw` is for other formats
    than MAVLink, to be split by a ranging source.
    """

    def __init__(
        self, codec: MavCodec, binding: AutopilotBinding | None = None, *, is_raw: bool = False
    ) -> None:
        self.codec = codec
        self.is_raw = is_raw
        self.budget = FloodBudget()
        self._binding = binding

    def take(self, chunk: Chunk) -> list[bytes]:
        """Return the verified frames of a chunk, or a raw chunk unchanged, within the budget."""
        if self.is_raw:
            return [chunk.data] if self.budget.spend_raw(len(chunk.data)) else []
        codec, spend, peer, binding = self.codec, self.budget.spend, chunk.peer, self._binding
        size, is_datagram = len(chunk.data), chunk.is_datagram
        is_known = not is_datagram or (
            binding is not None and binding.bound is not None and peer == binding.peer
        )
        may_be_heartbeat = is_known and is_datagram and size <= LONGEST_HEARTBEAT
        is_free = may_be_heartbeat and _is_heartbeat(chunk.data) and self.budget.spend_heartbeat()
        if not (is_free or spend(Resource.BYTES, size, peer, is_known=is_known)):
            return []
        found = codec.splitter.split(chunk.data, is_datagram=is_datagram)
        if codec.signing is None:  # frames that need no verification are messages
            if is_free:
                return found
            known, count = self.budget.known, len(found)
            if is_known and max(known[1] + count - KNOWN[1], known[2] + count - KNOWN[2]) <= 0:
                known[1] += count
                known[2] += count
                return found
        frames: list[bytes] = []
        for frame in found:
            if not (is_free or spend(Resource.FRAMES, 1, peer, is_known=is_known)):
                break
            if not codec.proves(frame):
                continue
            if not (is_free or spend(Resource.MESSAGES, 1, peer, is_known=is_known)):
                break
            frames.append(frame)
        return frames


def _is_heartbeat(data: bytes) -> bool:
    """Return True if a short datagram is one HEARTBEAT by its header, which is unverified."""
    return len(data) >= SHORTEST and data[0] in HEADER_LENGTH and message_id(data) == HEARTBEAT


SHIELD_UP_S = 10.0
"""Time after the last flood until the shield is lowered to test for it."""
SHARE_OF_SILENCE = 0.5
"""Silence of the autopilot that lowers the shield, as a share of that which frees its address."""


class FloodShield:
    """Shield against floods on one link, by its budget."""

    def __init__(self, intake: Intake, binding: AutopilotBinding) -> None:
        self._intake = intake
        self._binding = binding
        self._dropped = 0
        self._flooded_s = -math.inf

    def sole_peer(self, now_s: float) -> Address | None:
        """Return the exclusive peer from this control tick to the next; None: all."""
        binding, dropped = self._binding, sum(self._intake.budget.dropped)
        if dropped > self._dropped:
            self._dropped, self._flooded_s = dropped, now_s
        if now_s - self._flooded_s > SHIELD_UP_S or not binding.is_bound or binding.heard_s is None:
            return None
        is_quiet = now_s - binding.heard_s > SHARE_OF_SILENCE * binding.silence_s
        return None if is_quiet else binding.peer


REPORT_PERIOD_S = CAUSE_PERIOD_S
HINTS: Mapping[SignatureVerdict, str] = {
    SignatureVerdict.UNSIGNED: "does the autopilot sign, with this key?",
    SignatureVerdict.BAD_SIGNATURE: "is it the same key on both sides?",
    SignatureVerdict.TOO_FAR_AHEAD: "the sender has the key; set its clock or ours",
    SignatureVerdict.TOO_OLD: "the sender has the key; set its clock or ours",
}
ALARMS = frozenset(
    {
        SignatureVerdict.TOO_FAR_AHEAD,
        SignatureVerdict.TIMESTAMP_OVERFLOW,
        SignatureVerdict.TOO_MANY_STREAMS,
    }
)
"""Rejections that only a holder of the key can cause."""


class Authenticity:
    """Signing of the companion on all links; without a key every frame is accepted."""

    def __init__(self, signing: Signing | None = None, unix_minus_local_s: float = 0.0) -> None:
        self._signing = signing
        self.is_on = signing is not None
        """True if there is a key."""
        self._unix_minus_local_s = unix_minus_local_s
        self._announced: dict[SignatureVerdict, int] = dict.fromkeys(SignatureVerdict, 0)
        self._next_report_s = -math.inf

    def of_link(
        self, number: int, unsigned_ids: frozenset[int] = frozenset()
    ) -> LinkSigning | None:
        """Return the signing of a link's codec; None without a key.

        Messages of `unsigned_ids` may be unsigned on it, besides those that can never be signed.
        """
        if self._signing is None:
            return None
        allowed = UNSIGNED_ALLOWED | unsigned_ids
        return LinkSigning(self._signing, number % 256, unsigned_ids=allowed)

    def set_clock(self, unix_s: float, now_s: float) -> None:
        """Set the time in signatures to the current wall clock."""
        self._unix_minus_local_s = unix_s - now_s

    def is_proved(self, frame: bytes) -> bool:
        """Return True if an accepted frame may be used as evidence about the autopilot."""
        return self._signing is None or is_signed(frame)

    def advance(self, now_s: float) -> None:
        """Advance the time in signatures."""
        if self._signing is not None:
            self._signing.advance(now_s + self._unix_minus_local_s)

    def texts(self, now_s: float) -> list[Announce]:
        """Return texts for the operator about refused frames."""
        if self._signing is None or now_s < self._next_report_s:
            return []
        news = {
            verdict: count - self._announced[verdict]
            for verdict, count in self._signing.verdicts.items()
            if not verdict.is_accepted and count > self._announced[verdict]
        }
        if not news:
            return []
        self._announced = dict(self._signing.verdicts)
        self._next_report_s = now_s + REPORT_PERIOD_S
        severity = Severity.ERROR if ALARMS & news.keys() else Severity.WARNING
        hints = {verdict: f" ({hint})" for verdict, hint in HINTS.items()}
        words = (f"{count} x {v.value}{hints.get(v, '')}" for v, count in news.items())
        return [Announce(severity, f"signing: refused {', '.join(words)}")]

    def record(self) -> dict[str, object]:
        """Return the figures for the event log: frames by verdict."""
        if self._signing is None:
            return {}
        verdicts = self._signing.verdicts
        return {"signing": {v.value: count for v, count in verdicts.items() if count}}
