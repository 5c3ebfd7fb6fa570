"""Link layer of a vehicle: routing, signatures, MAVLink version and sequence numbers.

Theory of operation. What arrives is cut into frames by peer, forwarded to the others as it is, and
only then, if its signature holds where there is a key, decoded for the vehicle. What the vehicle
sends leaves each link with the link's own sequence number, in the link's MAVLink version, signed
where there is a key. Peers that share a link share its frames: a sequence number that one of them
did not get would look like a loss to it. A peer that is to get other frames than the rest (other
streams, MAVLink 1) is separated: from then on it has sequence numbers of its own, which continue
those of the link.

Routing. A component heard on a channel can be reached there; one component may be heard on several.
A broadcast goes to every other channel, an addressed frame only to where its target was heard, and
never back to where it came from. A frame is passed on as its bytes are, whether or not we can
decode or accept it, so routes are read from the bytes too. SETUP_SIGNING stays here. ArduPilot
drops what is not in its dialect, because it cannot prove it a frame: it is neither heard nor passed
on.

A SYSTEM_TIME whose time since boot went back means that its sender's system restarted: its routes
are learnt again.

Source: MAVLink developer guide, "Packet Serialization", "Routing", "MAVLink Versions", "Message
Signing".
"""

from __future__ import annotations

from collections.abc import Collection, Container
from typing import NamedTuple

from companion.mav.codec import (
    CRC_EXTRA_BY_ID,
    MAGIC_V2,
    MAX_MAVLINK1_ID,
    FrameSplitter,
    MavCodec,
    message_id,
    sender_of,
)
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.payloads import boot_ms_of, targets_of_frame
from companion.mav.signing import LinkSigning, Signing, SigningSetup, is_secret, setup_from
from sim_link.autopilot.protocols.addressing import Channel, Newest, Outgoing

MAX_STREAMS = 64


class FrameReceivers:
    """Cuts arriving bytes into frames, separately for each peer's byte stream.

    Several clients of one TCP port may each be in the middle of a frame; read as one stream, they
    would tear each other's frames apart.
    """

    def __init__(self) -> None:
        self._datagrams = FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=True)
        self._streams: Newest[Channel, FrameSplitter] = Newest(MAX_STREAMS)

    def split(self, chunk: Chunk) -> tuple[list[bytes], list[bytes]]:
        """Return the frames completed by a chunk: known ones, and those only to be forwarded."""
        splitter = self._datagrams if chunk.is_datagram else self._stream(chunk)
        frames = splitter.split(chunk.data, is_datagram=chunk.is_datagram)
        return frames, splitter.take_unknown()

    def forget(self, channel: Channel) -> None:
        """Drop the unfinished frame of a channel that is gone."""
        self._streams.pop(channel, None)

    def _stream(self, chunk: Chunk) -> FrameSplitter:
        channel = Channel(chunk.link, chunk.peer)
        splitter = self._streams.get(channel) or FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=True)
        self._streams[channel] = splitter
        return splitter


class WireVersion:
    """MAVLink version in which a link is sent.

    MAVLink 2 unless all that was ever heard is MAVLink 1; the first MAVLink 2 frame settles it
    for good. Messages that have no MAVLink 1 form are left out for such a link. Where signing is
    on there is only MAVLink 2.
    """

    def __init__(self, *, is_signed: bool = False) -> None:
        self._is_settled = is_signed
        self.is_mavlink1 = False
        """True if frames are sent in MAVLink 1."""

    def split_off(self) -> WireVersion:
        """Return the version of a peer that leaves the shared link: what it was heard with."""
        other = WireVersion()
        other._is_settled, other.is_mavlink1 = self._is_settled, self.is_mavlink1
        if self.is_mavlink1:
            self.is_mavlink1 = False
        elif not other.is_mavlink1:
            other._is_settled = False
        return other

    def observe(self, frame: bytes) -> None:
        """Note a received frame."""
        if not self._is_settled:
            self._is_settled = frame[0] == MAGIC_V2
            self.is_mavlink1 = not self._is_settled

    def can_carry(self, message: Message) -> bool:
        """Return True if a message has a form in the link's version."""
        return not self.is_mavlink1 or message.get_msgId() <= MAX_MAVLINK1_ID


MAX_COMPONENTS = 256
MAX_CHANNELS = 8
"""Maximum number of channels of one component; a component that changes ports drops its oldest."""
REBOOT_BACKWARD_MS = 1000
"""Step back of a time since boot that means a restart; less is a frame overtaken."""
WRAP_MS = 2**32
MAX_WRAP_GAP_MS = 60_000
"""Longest distance from a wrap, after 49.7 days, at which a step back is the wrap."""

Component = tuple[int, int]


class Router:
    """Knows where components were heard; frames for the vehicle's own components stay here."""

    def __init__(self, system_id: int, own_components: tuple[int, ...], links: int = 1) -> None:
        self._system_id = system_id
        self._own_components = own_components
        self._links = range(links)
        self._routes: Newest[Component, Newest[Channel, None]] = Newest(MAX_COMPONENTS)
        self._boot_ms: Newest[Component, int] = Newest(MAX_COMPONENTS)

    def route(self, frame: bytes, channel: Channel) -> list[Chunk]:
        """Return the chunks by which a received frame, of a known message or not, is passed on."""
        source = sender_of(frame)
        if source[0] == 0 or is_secret(frame):
            return []
        self._notice_reboot(source, frame)
        channels = self._routes.get(source) or Newest(MAX_CHANNELS)
        channels[channel] = None
        self._routes[source] = channels
        system_id, component_id = targets_of_frame(frame)
        if system_id == 0:
            chunks = [Chunk(each, frame) for each in self._links if each != channel.link]
            if channel.peer is not None:
                chunks.insert(0, Chunk(channel.link, frame, None, frozenset({channel.peer})))
            return chunks
        if system_id == self._system_id and component_id in self._own_components:
            return []
        return [
            Chunk(each.link, frame, each.peer)
            for each in self._channels_of(system_id, component_id)
            if each != channel
        ]

    def knows(self, system_id: int, component_id: int) -> bool:
        """Return True if a component is ours, or was heard."""
        if system_id == self._system_id and component_id in self._own_components:
            return True
        return bool(self._channels_of(system_id, component_id))

    def forget(self, channel: Channel) -> None:
        """Drop the routes over a channel that is gone."""
        for source in list(self._routes):
            self._routes[source].pop(channel, None)
            if not self._routes[source]:
                del self._routes[source]

    def _channels_of(self, system_id: int, component_id: int) -> list[Channel]:
        found = [
            channel
            for (system, component), channels in self._routes.items()
            if system == system_id and component_id in (0, component)
            for channel in channels
        ]
        return list(dict.fromkeys(found))

    def _notice_reboot(self, source: Component, frame: bytes) -> None:
        boot_ms = boot_ms_of(frame)
        if boot_ms is None:
            return
        before_ms = self._boot_ms.get(source)
        self._boot_ms[source] = boot_ms
        if before_ms is None:
            return
        back_ms = before_ms - boot_ms
        if REBOOT_BACKWARD_MS < back_ms < WRAP_MS - MAX_WRAP_GAP_MS:
            for known in [each for each in self._routes if each[0] == source[0]]:
                del self._routes[known]


class LinkSecurity(NamedTuple):
    """Signing of a vehicle, and the links that it trusts without."""

    signing: Signing | None = None
    """Signing with its key; None: neither checks nor signs, until a client sets a key up."""
    trusted_links: frozenset[int] = frozenset()
    """Links without listeners (a wire): unsigned frames are welcome, keys may be set up."""
    setup_links: frozenset[int] = frozenset()
    """Keys may be set up over these, too (loopback); then they need signatures like any other."""
    started_unix_s: float = 0.0
    """Unix time at boot, for the timestamps of signatures."""


NO_SECURITY = LinkSecurity()


class LinkLayer:
    """All links of a vehicle, the autopilot first; `dialect` are the ids it can take, None: all."""

    def __init__(
        self,
        system_id: int,
        component_ids: tuple[int, ...],
        links: int = 1,
        security: LinkSecurity = NO_SECURITY,
        dialect: Container[int] | None = None,
    ) -> None:
        self.signing = security.signing
        self._dialect = dialect
        self.router = Router(system_id, component_ids, links)
        self._system_id = system_id
        self._component_ids = component_ids
        self._links = range(links)
        self._trusted = security.trusted_links
        self._may_set_up = security.trusted_links | security.setup_links
        self._receivers = FrameReceivers()
        self._versions = {Channel(link): WireVersion() for link in self._links}
        """Versions of every link, and of every separate peer."""
        self._codecs = {
            (channel, component): MavCodec(system_id, component)
            for channel in self._versions
            for component in component_ids
        }
        self._apart: list[frozenset[Address]] = [frozenset() for _ in self._links]
        """Separate peers, by link."""
        self._setup: SigningSetup | None = None
        self._use_key()

    def receive(self, chunk: Chunk) -> tuple[list[tuple[Message, Channel]], list[Chunk]]:
        """Return the accepted messages, each with its origin, and frames to pass on."""
        channel = Channel(chunk.link, chunk.peer)
        frames, unknown = map(self._of_its_dialect, self._receivers.split(chunk))
        arrivals: list[tuple[Message, Channel]] = []
        forwarded = [each for frame in unknown for each in self.router.route(frame, channel)]
        for frame in frames:
            forwarded += self.router.route(frame, channel)
            codec = self._codecs[Channel(chunk.link), self._component_ids[0]]
            message = codec.decode_frame(frame)
            if message is None:
                continue
            self.speaks_as(channel, frame)
            if isinstance(message, mavlink.MAVLink_setup_signing_message):
                self._set_up(message, chunk.link)
            else:
                arrivals.append((message, channel))
        return arrivals, forwarded

    def _of_its_dialect(self, frames: list[bytes]) -> list[bytes]:
        dialect = self._dialect
        return frames if dialect is None else [f for f in frames if message_id(f) in dialect]

    def send(self, outgoing: Outgoing, component_id: int | None = None) -> list[Chunk]:
        """Return the chunks of a component's message (None: autopilot), on one link or all."""
        to = self._receivers_of(outgoing)
        component = self._component_ids[0] if component_id is None else component_id
        return [
            Chunk(
                channel.link,
                self._codecs[channel, component].encode(
                    outgoing.message, is_mavlink1=self._versions[channel].is_mavlink1
                ),
                channel.peer,
                self._apart[channel.link] if channel.peer is None else frozenset(),
            )
            for channel in to
            if self._versions[channel].can_carry(outgoing.message)
        ]

    def _receivers_of(self, outgoing: Outgoing) -> list[Channel]:
        """Return the receivers; an ACK is for all peers of its link, as it shows mode changes."""
        if outgoing.to is None:
            return list(self._versions)
        if isinstance(outgoing.message, mavlink.MAVLink_command_ack_message):
            return [each for each in self._versions if each.link == outgoing.to.link]
        return [self._sent_as(outgoing.to)]

    def separate(self, channels: Collection[Channel]) -> None:
        """Send to these peers separately; those not named share their links again."""
        wanted = {each for each in channels if each.peer is not None}
        present = {each for each in self._versions if each.peer is not None}
        if wanted == present:
            return
        for channel in present - wanted:
            del self._versions[channel]
            for component in self._component_ids:
                del self._codecs[channel, component]
        for channel in channels:
            if channel in wanted - present:
                self._versions[channel] = self._versions[Channel(channel.link)].split_off()
                for component in self._component_ids:
                    shared = self._codecs[Channel(channel.link), component]
                    self._codecs[channel, component] = shared.unsigned_copy()
        self._apart = [
            frozenset(each.peer for each in wanted if each.link == link and each.peer is not None)
            for link in self._links
        ]
        self._use_key()

    def speaks_as(self, channel: Channel, frame: bytes) -> None:
        """Send to a channel in the MAVLink version of a frame that came from it."""
        self._versions[self._sent_as(channel)].observe(frame)

    def take_setup(self) -> SigningSetup | None:
        """Take the signing setup of a client, already in force, or None; a shell stores the key."""
        setup, self._setup = self._setup, None
        return setup

    def forget(self, channel: Channel) -> None:
        """Forget a channel that is gone."""
        self.router.forget(channel)
        self._receivers.forget(channel)

    def _set_up(self, message: Message, link: int) -> None:
        own = (self._system_id, self._component_ids[0])
        setup = setup_from(message, *own, is_trusted_link=link in self._may_set_up)
        if setup is None:
            return
        self._setup = setup
        newest = 0 if self.signing is None else self.signing.timestamp
        self.signing = (
            None if setup.key is None else Signing(setup.key, max(newest, setup.initial_timestamp))
        )
        self._use_key()

    def _sent_as(self, channel: Channel) -> Channel:
        return channel if channel in self._versions else Channel(channel.link)

    def _use_key(self) -> None:
        for (channel, _), codec in self._codecs.items():
            codec.signing = (
                None
                if self.signing is None
                else LinkSigning(self.signing, channel.link % 256, channel.link in self._trusted)
            )
        if self.signing is not None:
            for channel in self._versions:
                self._versions[channel] = WireVersion(is_signed=True)
