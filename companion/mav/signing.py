"""MAVLink 2 message signing: frames are accepted or rejected before any message class sees them.

Theory of operation. One `Signing` belongs to one system and all its links: it holds the key, the
monotonic timestamp, and the last timestamp of every received stream, a stream being system,
component and link id. A frame is accepted only if, in this order, its signature is right, its
timestamp is newer than its stream's last one, and, for a new stream, at most a minute behind ours.
Nothing from a frame is stored before its signature was verified: a forger can then neither lock out
the real sender with a timestamp from the future nor fill the table of streams. (pymavlink, which
stores the timestamp first, could not guarantee that.)

`SigningPolicy` may be stricter than the guide, for a receiver that gets each component over one
link only. A frame recorded on another link of a component is then not accepted as the first of a
new stream, but is a replay. A sender with the key whose clock is far ahead is rejected, because it
would advance our timestamp permanently. And a new stream is compared with our own clock, not with
the newest timestamp, by which one sender almost a minute ahead would make another, whose clock is
right, too old.

An unsigned frame, MAVLink 1 among them, is a downgrade: with a key it is rejected unless its
message is on the short list of those that cannot be signed (RADIO_STATUS, which radios inject), or
on the longer list of its link, or the link is trusted by configuration, as a simulated autopilot's
own port may be. A bad signature is rejected on every link.

Source: MAVLink developer guide, "Message Signing".
"""

from __future__ import annotations

import hashlib
import hmac
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from companion.errors import ConfigError, LocalProtocolError
from companion.mav.codec import (
    CRC_LENGTH,
    HEADER_LENGTH,
    INCOMPAT_SIGNED,
    MAGIC_V2,
    SIGNATURE_LENGTH,
    frame_crc,
    message_id,
)
from companion.mav.dialect import Message, mavlink

KEY_LENGTH = 32
HASH_LENGTH = 6
TIMESTAMP_LENGTH = 6
EPOCH_UNIX_S = 1_420_070_400
"""Unix time of 1 January 2015, the epoch of signing timestamps."""
TICKS_PER_S = 100_000
MAX_BEHIND = 6_000_000
"""Largest lag behind ours of a new stream's first timestamp, in units of 10 us: one minute."""
MAX_TIMESTAMP = 2**48 - 1
MAX_HEARD = MAX_TIMESTAMP - 2**40
"""Largest accepted timestamp, 127 days below the maximum: a peer must not exhaust ours."""
MAX_STREAMS = 16
"""Limit of streams: forgetting one would allow replays of its old frames."""
UNSIGNED_ALLOWED = frozenset({mavlink.MAVLINK_MSG_ID_RADIO_STATUS})


class SignatureVerdict(Enum):
    """Result of verifying a received frame."""

    SIGNED = "signed"
    """Authentic: the sender has the key, and the frame is not a replay."""
    UNSIGNED_ALLOWED = "unsigned, allowed"
    UNSIGNED = "unsigned"
    BAD_SIGNATURE = "bad signature"
    REPLAYED = "replayed"
    """The timestamp is not newer than that of its stream's last frame."""
    TOO_OLD = "too old"
    """The frame is the first of its stream, and more than a minute behind."""
    TOO_FAR_AHEAD = "too far ahead"
    """Signed correctly, but by a clock that is far ahead of ours."""
    TIMESTAMP_OVERFLOW = "timestamp too late"
    """Signed correctly, but with a timestamp that leaves no room for our own frames."""
    TOO_MANY_STREAMS = "too many streams"

    @property
    def is_accepted(self) -> bool:
        """True if the frame may be decoded and used."""
        return self in (SignatureVerdict.SIGNED, SignatureVerdict.UNSIGNED_ALLOWED)


@dataclass(frozen=True, slots=True)
class SigningKey:
    """Shared secret of 32 bytes, not all zero; neither its repr nor its str shows it."""

    secret: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.secret) != KEY_LENGTH:
            raise ConfigError(f"a signing key has {KEY_LENGTH} bytes, not {len(self.secret)}")
        if not any(self.secret):
            raise ConfigError("a signing key of zeros means no signing; leave it out instead")

    def signature_of(self, signed_part: bytes) -> bytes:
        """Return the six bytes that end a frame, from all of it up to its timestamp."""
        return hashlib.sha256(self.secret + signed_part).digest()[:HASH_LENGTH]


def timestamp_at(unix_s: float) -> int:
    """Return the signing timestamp of a time, in units of 10 us since 2015; 0 before."""
    if not math.isfinite(unix_s):
        return 0
    return min(max(0, round((unix_s - EPOCH_UNIX_S) * TICKS_PER_S)), MAX_HEARD)


Stream = tuple[int, ...]
"""System, component and, unless links are joined, link id of a sender."""


@dataclass(frozen=True, slots=True)
class SigningPolicy:
    """Rules of a receiver that may be stricter than the guide."""

    max_ahead: int | None = None
    """Largest lead of a timestamp over our clock, in units of 10 us; None: unlimited."""
    joins_links: bool = False
    """True: one stream per component, regardless of the link id of its frames."""


AS_THE_GUIDE = SigningPolicy()
ONE_LINK_EACH = SigningPolicy(max_ahead=6_000_000, joins_links=True)
"""Policy of a companion: clocks agree to a minute, and every component uses one link."""


class Signing:
    """Signer and verifier of the frames of one system.

    It continues from the state that an earlier run stored: the newest timestamp, that of each
    stream, and its `clock`, where it differs from the timestamp.
    """

    def __init__(
        self,
        key: SigningKey,
        stored_timestamp: int = 0,
        streams: Mapping[Stream, int] | None = None,
        rules: SigningPolicy = AS_THE_GUIDE,
        *,
        stored_clock: int | None = None,
    ) -> None:
        self._key = key
        self._rules = rules
        self.timestamp = min(max(0, stored_timestamp), MAX_HEARD)
        """Newest timestamp used or accepted; to be stored at least once a minute."""
        self.clock = self.timestamp if stored_clock is None else max(0, stored_clock)
        """Our own time, which no peer changes; to be stored with `timestamp`."""
        self.streams: dict[Stream, int] = dict(streams or {})
        """Last timestamp of each stream; to be stored with `timestamp`."""
        self.verdicts: dict[SignatureVerdict, int] = dict.fromkeys(SignatureVerdict, 0)

    def advance(self, unix_s: float) -> None:
        """Advance to the clock's time; a clock that is behind, or runs back, has no effect."""
        self.clock = max(self.clock, timestamp_at(unix_s))
        self.timestamp = max(self.timestamp, self.clock)

    def verify(
        self,
        frame: bytes,
        *,
        is_trusted_link: bool = False,
        unsigned_ids: frozenset[int] = UNSIGNED_ALLOWED,
    ) -> SignatureVerdict:
        """Verify a frame of right CRC; `unsigned_ids`, or all on trusted links, may be unsigned."""
        verdict = self._judge(frame, is_trusted_link or message_id(frame) in unsigned_ids)
        self.verdicts[verdict] += 1
        return verdict

    def _judge(self, frame: bytes, is_allowed: bool) -> SignatureVerdict:
        if not is_signed(frame):
            return SignatureVerdict.UNSIGNED_ALLOWED if is_allowed else SignatureVerdict.UNSIGNED
        expected = self._key.signature_of(frame[:-HASH_LENGTH])
        if not hmac.compare_digest(expected, frame[-HASH_LENGTH:]):
            return SignatureVerdict.BAD_SIGNATURE
        timestamp = int.from_bytes(frame[-HASH_LENGTH - TIMESTAMP_LENGTH : -HASH_LENGTH], "little")
        stream: Stream = (frame[5], frame[6])
        if not self._rules.joins_links:
            stream += (frame[-SIGNATURE_LENGTH],)
        refusal = self._staleness(stream, timestamp)
        if refusal is not None:
            return refusal
        self.streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return SignatureVerdict.SIGNED

    def _staleness(self, stream: Stream, timestamp: int) -> SignatureVerdict | None:
        last = self.streams.get(stream)
        present = self.timestamp if self._rules.max_ahead is None else self.clock
        if last is not None:
            if timestamp <= last:
                return SignatureVerdict.REPLAYED
        elif timestamp + MAX_BEHIND < present:
            return SignatureVerdict.TOO_OLD
        elif len(self.streams) >= MAX_STREAMS:
            return SignatureVerdict.TOO_MANY_STREAMS
        if self._rules.max_ahead is not None and timestamp > self.clock + self._rules.max_ahead:
            return SignatureVerdict.TOO_FAR_AHEAD
        return SignatureVerdict.TIMESTAMP_OVERFLOW if timestamp > MAX_HEARD else None

    def sign(self, frame: bytes, link_id: int, crc_extra: int) -> bytes:
        """Return our unsigned MAVLink 2 frame, signed with a new timestamp and the link's id."""
        if frame[0] != MAGIC_V2 or is_signed(frame):
            raise LocalProtocolError("only an unsigned MAVLink 2 frame can be signed")
        self.timestamp += 1
        end = HEADER_LENGTH[MAGIC_V2] + frame[1]
        head = frame[:2] + bytes((frame[2] | INCOMPAT_SIGNED,)) + frame[3:end]
        head += frame_crc(head, crc_extra).to_bytes(CRC_LENGTH, "little")
        head += bytes((link_id,)) + self.timestamp.to_bytes(TIMESTAMP_LENGTH, "little")
        return head + self._key.signature_of(head)


@dataclass(frozen=True, slots=True)
class LinkSigning:
    """Signing of one link's codec."""

    signing: Signing
    link_id: int
    """Number of the link, 0 to 255; part of the identity of our streams."""
    is_trusted: bool = False
    """True: unsigned frames are accepted on this link."""
    unsigned_ids: frozenset[int] = UNSIGNED_ALLOWED
    """Messages that may be unsigned on a link that is not trusted."""

    def accepts(self, frame: bytes) -> bool:
        """Return True if a received frame may be decoded."""
        return self.signing.verify(
            frame, is_trusted_link=self.is_trusted, unsigned_ids=self.unsigned_ids
        ).is_accepted

    def sign(self, frame: bytes, crc_extra_by_id: Mapping[int, int]) -> bytes:
        """Return the frame in the form sent on this link."""
        return self.signing.sign(frame, self.link_id, crc_extra_by_id[message_id(frame)])


@dataclass(frozen=True, slots=True)
class SigningSetup:
    """Request of a SETUP_SIGNING that may be obeyed."""

    key: SigningKey | None
    """New key; None: end signing."""
    initial_timestamp: int


def setup_from(
    message: Message, system_id: int, component_id: int, *, is_trusted_link: bool
) -> SigningSetup | None:
    """Return the request of a SETUP_SIGNING that `Signing.verify` accepted; None: ignore it.

    A key is accepted only over a link that others cannot receive (a wire, or loopback), and only
    when it is addressed to this very component: a broadcast would have disclosed it. The message is
    never forwarded and never logged, see `is_secret`.
    """
    if not isinstance(message, mavlink.MAVLink_setup_signing_message) or not is_trusted_link:
        return None
    if (message.target_system, message.target_component) != (system_id, component_id):
        return None
    secret = bytes(message.secret_key)
    timestamp = int(message.initial_timestamp)
    if not any(secret):
        return SigningSetup(None, 0)
    return SigningSetup(SigningKey(secret), min(timestamp, MAX_HEARD))


SETUP_SIGNING = int(mavlink.MAVLINK_MSG_ID_SETUP_SIGNING).to_bytes(3, "little")


def is_signed(frame: bytes) -> bool:
    """Return True if a frame carries a signature, right or wrong."""
    return frame[0] == MAGIC_V2 and bool(frame[2] & INCOMPAT_SIGNED)


def is_secret(frame: bytes) -> bool:
    """Return True if a frame carries a key: never broadcast, forwarded or written to a log."""
    return frame[7:10] == SETUP_SIGNING and frame[0] == MAGIC_V2  # MAVLink 1 has no such id
