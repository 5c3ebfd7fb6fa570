"""From what a link brings to messages: within a budget, cut, proved, decoded.

Budget: how much of what arrives is looked at between two control ticks, so that no flood delays
one.

Theory of operation. The autopilot's own address, and any line with one end, has a budget that is
far above what an autopilot sends; everyone else shares a much smaller one, with a share for each
source, so that strangers are dropped first and none of them crowds the others out. Bytes are
counted before they are cut into frames, frames before they are proved, messages before anyone acts
on them. What is over budget is dropped and counted, and the budgets begin anew with each control
tick. Of the sources a tick remembers only so many. A link that held everything back delivers more
at once than a tick reads, and the newest mode last: so HEARTBEATs of the autopilot's address have
a budget of their own.

PX4 1.15 sends 405 frames a second on its busiest link: 20 between two ticks. The bytes are what
the worst of them, all magic, can be cut up in less than a tick (1.3 us each).

Shield: when a flood makes it worth while to hear nobody but the autopilot.

The filter itself is the shell's, and the kernel's; see `companion.io.source_filter`. It is up only
while strangers exceed their budget, because without it they are told to the operator, and only
while the autopilot speaks, because it may come back from another address.

Alarms: what the operator is told about strangers and floods: at once, and then rarely.

Watches counters that others keep, so that nothing a stranger sends makes a text of its own.

Authenticity: signing on all links, its clock, and what the operator is told about it.

Theory of operation. With a key every frame of every link must prove itself before it is decoded;
the codecs see to that. The time in signatures goes on from the wall clock at the start by the
control tick's own clock, so that a wall clock that is set in flight changes nothing; only before
an autopilot is bound is it followed. What was refused is told at once, and then at most every ten
seconds in one text, because a forger must not be able to fill the log.

RADIO_STATUS may come unsigned. It is noted down and goes no further: unproved, it says nothing
about the autopilot, not even that it is there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2, SIGNATURE_LENGTH, message_id
from companion.mav.signing import LinkSigning, Signing, Verdict, is_signed


class RateLimit:
    """Lets `burst` things through at once and then `per_s` a second; what it refuses is counted.

    Args:
        per_s: How fast what was used comes back.
        burst: How much there is at most.
    """

    def __init__(self, per_s: float, burst: int = 1) -> None:
        self.refused = 0
        self._per_s = per_s
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s = -math.inf

    def allows(self, now_s: float) -> bool:
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
"""Strangers told apart in one tick; those beyond are dropped."""


class Resource(IntEnum):
    """What is counted."""

    BYTES = 0
    FRAMES = 1
    """With a right CRC."""
    MESSAGES = 2
    """Proved, or signing is off."""


Amounts = tuple[int, int, int]
"""Of each resource."""

KNOWN: Amounts = (32_768, 2_000, 500)
UNKNOWN_PEERS: Amounts = (16_384, 400, 100)
"""All of them together."""
ONE_UNKNOWN_PEER: Amounts = (4_096, 100, 50)
HEARTBEATS = 200
"""Of the autopilot's address, whatever else it sent: they alone tell who flies. One a second, and
those that are asked for after a silence, of more than two minutes."""


class FloodBudget:
    """The budgets of one link."""

    def __init__(self) -> None:
        self.dropped = [0, 0, 0]
        """Refusals so far, by what was used up: chunks, frames, messages."""
        self._known = [0, 0, 0]
        self._strangers = [0, 0, 0]
        self._by_source: dict[Address | None, list[int]] = {}
        self._heartbeats = 0

    def renew(self) -> None:
        """A control tick has passed."""
        self._known = [0, 0, 0]
        self._strangers = [0, 0, 0]
        self._by_source.clear()
        self._heartbeats = 0

    @property
    def dropped_unread(self) -> int:
        """Refusals so far: chunks, frames and messages."""
        return sum(self.dropped)

    def admits_heartbeat(self) -> bool:
        """Whether one more HEARTBEAT of the autopilot's address may come beside all budgets."""
        self._heartbeats += 1
        return self._heartbeats <= HEARTBEATS

    def admits(
        self, resource: Resource, amount: int, peer: Address | None, *, is_known: bool
    ) -> bool:
        """Whether a source may use so much more of a resource, which is then used."""
        accounts: tuple[tuple[list[int], Amounts], ...] = ((self._known, KNOWN),)
        if not is_known:
            own = self._account_of(peer)
            if own is None:
                self.dropped[resource] += 1
                return False
            accounts = ((self._strangers, UNKNOWN_PEERS), (own, ONE_UNKNOWN_PEER))
        for used, allowed in accounts:
            if used[resource] + amount > allowed[resource]:
                self.dropped[resource] += 1
                return False
        for used, _ in accounts:
            used[resource] += amount
        return True

    def _account_of(self, peer: Address | None) -> list[int] | None:
        """What a stranger has used; None if there are too many of them to tell."""
        used = self._by_source.get(peer)
        if used is None and len(self._by_source) < MAX_SOURCES:
            used = self._by_source[peer] = [0, 0, 0]
        return used


HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
SHORTEST = HEADER_LENGTH[MAGIC_V2]
LONGEST_HEARTBEAT = HEADER_LENGTH[MAGIC_V2] + 9 + CRC_LENGTH + SIGNATURE_LENGTH


class Intake:
    """One link's way in.

    Args:
        binding: The autopilot, whose address has the large budget; None on links without one.
    """

    def __init__(self, codec: MavCodec, binding: AutopilotBinding | None) -> None:
        self.codec = codec
        self.budget = FloodBudget()
        self._binding = binding

    def is_known(self, chunk: Chunk) -> bool:
        """Whether a chunk is from the autopilot's address, or over a line with one end."""
        if not chunk.is_datagram:
            return True
        binding = self._binding
        return binding is not None and binding.is_bound and chunk.peer == binding.peer

    def take(self, chunk: Chunk) -> Iterator[Message]:
        """The messages in a chunk, as far as the budget goes."""
        codec, admits, peer = self.codec, self.budget.admits, chunk.peer
        is_known = self.is_known(chunk)
        is_free = is_known and _is_heartbeat(chunk) and self.budget.admits_heartbeat()
        if not (is_free or admits(Resource.BYTES, len(chunk.data), peer, is_known=is_known)):
            return
        for frame in codec.split(chunk.data, is_datagram=chunk.is_datagram):
            if not (is_free or admits(Resource.FRAMES, 1, peer, is_known=is_known)):
                return
            if not codec.proves(frame):
                continue
            if not (is_free or admits(Resource.MESSAGES, 1, peer, is_known=is_known)):
                return
            message = codec.decode_proved(frame)
            if message is not None:
                yield message


def _is_heartbeat(chunk: Chunk) -> bool:
    """Whether a datagram is one HEARTBEAT by its header and its size; neither is proved yet."""
    data = chunk.data
    is_one = chunk.is_datagram and SHORTEST <= len(data) <= LONGEST_HEARTBEAT
    return is_one and data[0] in HEADER_LENGTH and message_id(data) == HEARTBEAT


SHIELD_UP_S = 10.0
"""How long after the last flood it stays up; then it is looked whether the flood goes on."""
SHARE_OF_SILENCE = 0.5
"""Of the silence after which another address is believed: so long the autopilot may be quiet."""


class FloodShield:
    """Looks at one link's budget once per control tick."""

    def __init__(self, intake: Intake, binding: AutopilotBinding) -> None:
        self._intake = intake
        self._binding = binding
        self._dropped = 0
        self._flooded_s = -math.inf

    def tick(self, now_s: float) -> None:
        """Note whether anything was over budget."""
        dropped = self._intake.budget.dropped_unread
        if dropped > self._dropped:
            self._dropped = dropped
            self._flooded_s = now_s

    def sole_peer(self, now_s: float) -> Address | None:
        """Whom alone to hear now; None: everybody."""
        binding = self._binding
        if now_s - self._flooded_s > SHIELD_UP_S or not binding.is_bound or binding.heard_s is None:
            return None
        is_quiet = now_s - binding.heard_s > SHARE_OF_SILENCE * binding.silence_s
        return None if is_quiet else binding.peer


ALARM_TEXTS_PER_S = 0.1
"""Texts of one kind."""


class LinkAlarms:
    """Looks at the counters once per control tick.

    Args:
        binding: Who the autopilot is, and who else says so.
    """

    def __init__(self, binding: AutopilotBinding, intakes: Sequence[Intake]) -> None:
        self._binding = binding
        self._intakes = intakes
        self._strangers = 0
        self._moves = 0
        self._others = 0
        self._dropped = 0
        self._may_tell_strangers = RateLimit(ALARM_TEXTS_PER_S)
        self._may_tell_moves = RateLimit(ALARM_TEXTS_PER_S)
        self._may_tell_floods = RateLimit(ALARM_TEXTS_PER_S)

    def tick(self, now_s: float) -> list[Announce]:
        """What is news."""
        binding, texts = self._binding, []
        dropped = sum(intake.budget.dropped_unread for intake in self._intakes)
        for other in binding.others[self._others :]:
            texts.append(
                f"another autopilot is on this link, system {other}; ours is {binding.system_id} "
                "(vehicle.system_id chooses)"
            )
        self._others = len(binding.others)
        if binding.moves > self._moves and self._may_tell_moves.allows(now_s):
            self._moves = binding.moves
            texts.append(f"the autopilot is heard from another address now: {_place(binding)}")
        if binding.strangers > self._strangers and self._may_tell_strangers.allows(now_s):
            count, self._strangers = binding.strangers - self._strangers, binding.strangers
            texts.append(f"{count} frames with the autopilot's ids from elsewhere were ignored")
        if dropped > self._dropped and self._may_tell_floods.allows(now_s):
            count, self._dropped = dropped - self._dropped, dropped
            texts.append(f"flood: {count} datagrams or frames were dropped unread")
        return [Announce(Severity.WARNING, text) for text in texts]


def _place(binding: AutopilotBinding) -> str:
    return "the line" if binding.peer is None else f"{binding.peer[0]}:{binding.peer[1]}"


REPORT_PERIOD_S = 10.0
HINTS: Mapping[Verdict, str] = {
    Verdict.UNSIGNED: "does the autopilot sign, with this key?",
    Verdict.BAD_SIGNATURE: "is it the same key on both sides?",
    Verdict.TOO_FAR_AHEAD: "its sender has the key; set the clocks, ours or its",
    Verdict.TOO_OLD: "its sender has the key; set the clocks, ours or its",
}
ALARMS = frozenset({Verdict.TOO_FAR_AHEAD, Verdict.TIMESTAMP_OVERFLOW, Verdict.TOO_MANY_STREAMS})
"""What only somebody who has the key can cause."""


class Authenticity:
    """The companion's side of signing.

    Args:
        signing: Proves and signs; None: there is no key, and everyone is believed.
        unix_minus_local_s: Unix time minus the time that is passed in.
    """

    def __init__(self, signing: Signing | None, unix_minus_local_s: float) -> None:
        self._signing = signing
        self._unix_minus_local_s = unix_minus_local_s
        self._told: dict[Verdict, int] = dict.fromkeys(Verdict, 0)
        self._next_report_s = -math.inf

    @property
    def is_on(self) -> bool:
        """Whether there is a key."""
        return self._signing is not None

    def of_link(self, number: int, *, is_trusted: bool) -> LinkSigning | None:
        """What the codec of a link needs.

        Args:
            number: Of the link, from 0.
            is_trusted: Unsigned frames are welcome on it, by configuration.
        """
        if self._signing is None:
            return None
        return LinkSigning(self._signing, number % 256, is_trusted)

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
        return [Announce(severity, f"signing: refused {_in_words(news)}")]

    def record(self) -> dict[str, object]:
        """The figures for the event log: how many frames got which verdict."""
        if self._signing is None:
            return {}
        verdicts = self._signing.verdicts
        return {"signing": {v.value: count for v, count in verdicts.items() if count}}


def _in_words(news: Mapping[Verdict, int]) -> str:
    parts = []
    for verdict, count in news.items():
        hint = f" ({HINTS[verdict]})" if verdict in HINTS else ""
        parts.append(f"{count} x {verdict.value}{hint}")
    return ", ".join(parts)
