"""Between bytes and messages on all links of a vehicle: routing, proof, version, sequence numbers.

Theory of operation. What arrives is cut into frames by peer, passed on to others as it is, and only
then, if it proves itself where there is a key, decoded for the vehicle. What the vehicle says
leaves each link with the link's own sequence number, in the link's MAVLink version, signed where
there is a key. A frame to a link goes to everyone on it: a sequence number that somebody did not
get would look like a loss to them.

Source: MAVLink developer guide, "Routing", "MAVLink Versions", "Message Signing".
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
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
        trusted_links: Links that nobody else can hear (a wire, loopback): unsigned frames are
            welcome there, and a key may be set up over them.
    """

    def __init__(
        self,
        system_id: int,
        component_ids: tuple[int, ...],
        links: int = 1,
        signing: Signing | None = None,
        trusted_links: frozenset[int] = frozenset(),
    ) -> None:
        self.signing = signing
        self.router = Router(system_id, component_ids, links)
        self._system_id = system_id
        self._component_ids = component_ids
        self._links = range(links)
        self._trusted = trusted_links
        self._receivers = FrameReceivers()
        self._versions = [WireVersion() for _ in self._links]
        self._codecs = {
            (link, component): MavCodec(system_id, component)
            for link in self._links
            for component in component_ids
        }
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
            message = self._codecs[chunk.link, self._component_ids[0]].decode_frame(frame)
            if message is None:
                continue
            self._versions[chunk.link].observe(frame)
            if isinstance(message, mavlink.MAVLink_setup_signing_message):
                self._set_up(message, chunk.link)
            else:
                arrivals.append(Arrival(message, channel))
        return arrivals, forwarded

    def send(self, outgoing: Outgoing, component_id: int | None = None) -> list[Chunk]:
        """The chunks of a message, for one link or all.

        Args:
            outgoing: What is to be sent where.
            component_id: Whose it is; None for the autopilot's.
        """
        links = self._links if outgoing.to is None else (outgoing.to.link,)
        component = self._component_ids[0] if component_id is None else component_id
        return [
            Chunk(
                link,
                self._codecs[link, component].encode(
                    outgoing.message, is_mavlink1=self._versions[link].is_mavlink1
                ),
            )
            for link in links
            if self._versions[link].can_carry(outgoing.message)
        ]

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
            is_trusted_link=link in self._trusted,
        )
        if setup is None:
            return
        self._setup = setup
        newest = 0 if self.signing is None else self.signing.timestamp
        self.signing = (
            None if setup.key is None else Signing(setup.key, max(newest, setup.initial_timestamp))
        )
        self._use_key()

    def _use_key(self) -> None:
        for (link, _), codec in self._codecs.items():
            codec.signing = (
                None
                if self.signing is None
                else LinkSigning(self.signing, link % 256, link in self._trusted)
            )
        if self.signing is not None:
            self._versions = [WireVersion(is_signed=True) for _ in self._links]
