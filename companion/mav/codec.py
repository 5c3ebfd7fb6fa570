"""Bytes to messages and back: one codec per link.

pymavlink's generated class packs and decodes payloads, except those of `plain_messages`; framing,
the CRC check and the sequence number are ours (`pack` does not advance it, and pymavlink's own
parser loses the good frame behind a truncated one), and so are signatures: a frame is verified
before pymavlink sees it.
Nothing that a peer sends raises out of here.
"""

from __future__ import annotations

from companion.errors import LocalProtocolError, RemoteProtocolError
from companion.mav.dialect import Message, mavlink
from companion.mav.framing import FrameCounters, FrameSplitter
from companion.mav.plain_messages import pack_plain, unpack_plain
from companion.mav.signing import LinkSigning

CRC_EXTRA_BY_ID = {
    number: message_class.crc_extra for number, message_class in mavlink.mavlink_map.items()
}

MAX_MAVLINK1_ID = 255


class MavCodec:
    """Encodes with one identity and decodes what arrives on one link.

    Args:
        system_id: Our system id, 1 to 255.
        component_id: Our component id, 1 to 255.
        signing: Signs what is sent and verifies what arrives; None does neither.
    """

    def __init__(
        self, system_id: int, component_id: int, signing: LinkSigning | None = None
    ) -> None:
        self.signing = signing
        """May be replaced, when a key is set up or taken away."""
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._splitter = FrameSplitter(CRC_EXTRA_BY_ID)
        self.undecodable = 0
        """Frames with a good CRC whose payload pymavlink refused."""
        self.unproved = 0
        """Frames with a good CRC that signing refused."""

    @property
    def counters(self) -> FrameCounters:
        """What arrived so far."""
        return self._splitter.counters

    @property
    def system_id(self) -> int:
        """The system id that our frames carry."""
        return int(self._mav.srcSystem)

    @system_id.setter
    def system_id(self, value: int) -> None:
        """Send as another system from now on."""
        self._mav.srcSystem = value

    @property
    def component_id(self) -> int:
        """The component id that our frames carry."""
        return int(self._mav.srcComponent)

    def twin(self) -> MavCodec:
        """A codec of the same identity that goes on from the same sequence number, unsigned."""
        other = MavCodec(self.system_id, self.component_id)
        other._mav.seq = self._mav.seq
        return other

    def encode(
        self, message: Message, component_id: int | None = None, *, is_mavlink1: bool = False
    ) -> bytes:
        """The frame of `message`, with the link's next sequence number, signed if signing is on.

        Args:
            message: What to send.
            component_id: Sends as another component of ours over the same link.
            is_mavlink1: For a peer that cannot read MAVLink 2.

        Raises:
            LocalProtocolError: A field does not fit its type on the wire, or the frame has no
                form in MAVLink 1 (a message id over 255, or a signature).
        """
        if is_mavlink1 and (message.get_msgId() > MAX_MAVLINK1_ID or self.signing is not None):
            raise LocalProtocolError(f"{message.get_type()} cannot be sent in MAVLink 1")
        own_component = self._mav.srcComponent
        if component_id is not None:
            self._mav.srcComponent = component_id
        try:
            frame = self._pack(message, is_mavlink1=is_mavlink1)
        except Exception as error:  # struct.error, TypeError, OverflowError: always our mistake
            raise LocalProtocolError(f"{message.get_type()} cannot be packed: {error}") from error
        finally:
            self._mav.srcComponent = own_component
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame if self.signing is None else self.signing.sign(frame, CRC_EXTRA_BY_ID)

    def _pack(self, message: Message, *, is_mavlink1: bool) -> bytes:
        mav = self._mav
        if not is_mavlink1:
            frame = pack_plain(message, mav.seq, mav.srcSystem, mav.srcComponent)
            if frame is not None:
                return frame
        return bytes(message.pack(mav, force_mavlink1=is_mavlink1))

    def decode(self, data: bytes, *, is_datagram: bool = True) -> list[Message]:
        """The messages completed by `data`; bad bytes are counted, never raised."""
        messages = []
        for frame in self._splitter.split(data, is_datagram=is_datagram):
            message = self.decode_frame(frame)
            if message is not None:
                messages.append(message)
        return messages

    def split(self, data: bytes, *, is_datagram: bool = True) -> list[bytes]:
        """The frames completed by `data`, for a router, which passes on what nobody believes."""
        return self._splitter.split(data, is_datagram=is_datagram)

    def decode_frame(self, frame: bytes) -> Message | None:
        """The message of one whole frame; None, and counted, if it is refused."""
        return self.decode_proved(frame) if self.proves(frame) else None

    def proves(self, frame: bytes) -> bool:
        """Whether signing, if it is on, lets one whole frame in; refusals are counted."""
        if self.signing is None or self.signing.accepts(frame):
            return True
        self.unproved += 1
        return False

    def decode_proved(self, frame: bytes) -> Message | None:
        """The message of a frame that was let in; None, and counted, if it cannot be decoded."""
        try:
            return self._decode_frame(frame)
        except RemoteProtocolError:
            self.undecodable += 1
            return None

    def _decode_frame(self, frame: bytes) -> Message:
        plain = unpack_plain(frame)
        if plain is not None:
            return plain
        try:
            return self._mav.decode(bytearray(frame))
        except Exception as error:  # MAVError, UnicodeDecodeError: whatever a payload provokes
            raise RemoteProtocolError(str(error)) from error
