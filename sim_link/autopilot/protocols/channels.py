"""What belongs to one channel before any message is read: its unfinished frame, its version.

Source: MAVLink developer guide, "Packet Serialization" and "MAVLink Versions".
"""

from __future__ import annotations

from collections import OrderedDict

from companion.mav.codec import CRC_EXTRA_BY_ID, MAX_MAVLINK1_ID
from companion.mav.dialect import Message
from companion.mav.endpoint import Chunk
from companion.mav.framing import MAGIC_V2, FrameSplitter
from sim_link.autopilot.protocols.base import Channel

MAX_STREAMS = 64


class FrameReceivers:
    """Cuts what arrives into frames, each peer's byte stream by itself.

    Several clients of one TCP port may each be in the middle of a frame; read as one stream, they
    would tear each other's frames apart.
    """

    def __init__(self) -> None:
        self._datagrams = FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=True)
        self._streams: OrderedDict[Channel, FrameSplitter] = OrderedDict()

    def split(self, chunk: Chunk) -> tuple[list[bytes], list[bytes]]:
        """The frames completed by a chunk.

        Returns:
            Those of known messages, and those that can only be passed on.
        """
        splitter = self._datagrams if chunk.is_datagram else self._stream(chunk)
        frames = splitter.split(chunk.data, is_datagram=chunk.is_datagram)
        return frames, splitter.take_unknown()

    def forget(self, channel: Channel) -> None:
        """Drop the unfinished frame of a channel that is gone."""
        self._streams.pop(channel, None)

    def _stream(self, chunk: Chunk) -> FrameSplitter:
        channel = Channel(chunk.link, chunk.peer)
        splitter = self._streams.get(channel)
        if splitter is None:
            splitter = FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=True)
            self._streams[channel] = splitter
        self._streams.move_to_end(channel)
        if len(self._streams) > MAX_STREAMS:
            self._streams.popitem(last=False)
        return splitter


class WireVersion:
    """Which MAVLink version a link is sent.

    MAVLink 2 unless all that was ever heard is MAVLink 1; the first MAVLink 2 frame settles it
    for good. Messages that have no MAVLink 1 form are left out for such a link. Where signing is
    on there is only MAVLink 2.
    """

    def __init__(self, *, is_signed: bool = False) -> None:
        self._is_settled = is_signed
        self._is_mavlink1 = False

    def split_off(self) -> WireVersion:
        """The version of a peer that leaves the shared link; what was heard so far was its own."""
        other = WireVersion()
        other._is_settled, other._is_mavlink1 = self._is_settled, self._is_mavlink1
        if self._is_mavlink1:
            self._is_mavlink1 = False
        elif not other._is_mavlink1:
            other._is_settled = False
        return other

    @property
    def is_mavlink1(self) -> bool:
        """Whether frames are to be sent in MAVLink 1."""
        return self._is_mavlink1

    def observe(self, frame: bytes) -> None:
        """Take note of a received frame."""
        if not self._is_settled:
            self._is_settled = frame[0] == MAGIC_V2
            self._is_mavlink1 = not self._is_settled

    def can_carry(self, message: Message) -> bool:
        """Whether a message has a form in the link's version."""
        return not self._is_mavlink1 or message.get_msgId() <= MAX_MAVLINK1_ID
