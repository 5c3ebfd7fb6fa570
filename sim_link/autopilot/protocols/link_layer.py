"""Between bytes and messages on all links of a vehicle: routing, proof, version, sequence numbers.

Theory of operation. What arrives is cut into frames by peer, passed on to others as it is, and only
then, if it proves itself where there is a key, decoded for the vehicle. What the vehicle says
leaves each link with the link's own sequence number, in the link's MAVLink version, signed where
there is a key. Peers that share a link share its frames: a sequence number that somebody did not
get would look like a loss to them. A peer that is to get other frames than the rest (other
streams, MAVLink 1) is kept apart: from then on it has sequence numbers of its own, which go on from
the link's.

Source: MAVLink developer guide, "Routing", "MAVLink Versions", "Message Signing".
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.signing import LinkSigning, Signing, SigningSetup, setup_from
from companion.mav.targets import source_of
from sim_link.autopilot.protocols.base import Channel, Outgoing
from sim_link.autopilot.protocols.channels import FrameReceivers, WireVersion
from sim_link.autopilot.protocols.routing import Router


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that may be believed, and where it came from."""

    message: Message
    channel: Channel


class LinkLayer:
    """All links of one vehicle.

    Args:
        system_id: Of the vehicle.
        component_ids: Of its components, the autopilot first.
        links: How many links there are.
        signing: The vehicle's, with its key; None to begin without.
        trusted_links: Links that nobody else can hear (a wire): unsigned frames are welcome
            there, and a key may be set up over them.
        setup_links: Links over which a key may be set up, too (loopback); once there is one, they
            need signatures like any other.
    """

    def __init__(
        self,
        system_id: int,
        component_ids: tuple[int, ...],
        links: int = 1,
        signing: Signing | None = None,
        trusted_links: frozenset[int] = frozenset(),
        setup_links: frozenset[int] = frozenset(),
    ) -> None:
        self.signing = signing
        self.router = Router(system_id, component_ids, links)
        self._system_id = system_id
        self._component_ids = component_ids
        self._links = range(links)
        self._trusted = trusted_links
        self._may_set_up = trusted_links | setup_links
        self._receivers = FrameReceivers()
        self._versions = {Channel(link): WireVersion() for link in self._links}
        """Of every link, and of every peer that is kept apart."""
        self._codecs = {
            (channel, component): MavCodec(system_id, component)
            for channel in self._versions
            for component in component_ids
        }
        self._apart: list[frozenset[Address]] = [frozenset() for _ in self._links]
        """By link, the peers that are kept apart."""
        self._setup: SigningSetup | None = None
        self._use_key()

    def receive(self, chunk: Chunk) -> tuple[list[Arrival], list[Chunk]]:
        """Take in bytes.

        Returns:
            Messages to obey, whether for us or not, and frames to pass on.
        """
        channel = Channel(chunk.link, chunk.peer)
        frames, unknown = self._receivers.split(chunk)
        arrivals: list[Arrival] = []
        forwarded = [each for frame in unknown for each in self.router.route(frame, channel)]
        for frame in frames:
            if source_of(frame)[0] == 0:
                continue  # 0 is no source (MAVLink developer guide, "Packet Serialization")
            forwarded += self.router.route(frame, channel)
            codec = self._codecs[Channel(chunk.link), self._component_ids[0]]
            message = codec.decode_frame(frame)
            if message is None:
                continue
            self.speaks_as(channel, frame)
            if isinstance(message, mavlink.MAVLink_setup_signing_message):
                self._set_up(message, chunk.link)
            else:
                arrivals.append(Arrival(message, channel))
        return arrivals, forwarded

    def send(self, outgoing: Outgoing, component_id: int | None = None) -> list[Chunk]:
        """The chunks of a message, for one link or all.

        Args:
            outgoing: What is to be sent where; to a peer that shares a link means to the link.
            component_id: Whose it is; None for the autopilot's.
        """
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
        """An ACK is heard by all peers of its link: a companion learns of a mode change from it."""
        if outgoing.to is None:
            return list(self._versions)
        if isinstance(outgoing.message, mavlink.MAVLink_command_ack_message):
            return [each for each in self._versions if each.link == outgoing.to.link]
        return [self._sent_as(outgoing.to)]

    def keep_apart(self, channels: Collection[Channel]) -> None:
        """Send to these peers what is theirs alone; those not named share their links again."""
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
                    self._codecs[channel, component] = shared.twin()
        self._apart = [
            frozenset(each.peer for each in wanted if each.link == link and each.peer is not None)
            for link in self._links
        ]
        self._use_key()

    def speaks_as(self, channel: Channel, frame: bytes) -> None:
        """Send to a channel in the MAVLink version of a frame that came from it."""
        self._versions[self._sent_as(channel)].observe(frame)

    def take_setup(self) -> SigningSetup | None:
        """What a client set up since the last call, in force already; a shell stores the key."""
        setup, self._setup = self._setup, None
        return setup

    def forget(self, channel: Channel) -> None:
        """Drop what is known of a channel that is gone."""
        self.router.forget(channel)
        self._receivers.forget(channel)

    def _set_up(self, message: Message, link: int) -> None:
        setup = setup_from(
            message,
            self._system_id,
            self._component_ids[0],
            is_trusted_link=link in self._may_set_up,
        )
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
