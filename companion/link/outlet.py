"""What leaves by our links: encoded, noted down, queued for the shell, counted.

The autopilot passes on what is broadcast, so ground stations behind it hear that; a link of their
own gets the same beside. Setpoints and commands only ever leave by the vehicle link.

A router that forwards to everyone sends our frames back to us, byte by byte as they were. A frame
with our ids that we did not send is somebody else's: two companions on one vehicle would both obey
its operator and fight over its setpoints. It is heard as long as its frames come, the
HEARTBEAT of each second at the least.
"""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Sequence

from companion.guidance.authority.control_authority import ID_CONFLICT_S
from companion.guidance.commands import Announce, Severity
from companion.link import outbound
from companion.link.binding import AutopilotBinding
from companion.link.interface import Journal, LinkRole
from companion.link.texts import TextGate
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2

KEPT = 1024
"""Frames of ours that are remembered: 20 s at the fastest pace."""
FOREIGN_FRAMES = 3
FOREIGN_SPAN_S = 1.0
"""So many that are not ours, over no less than the span, are another companion's; fewer may be left
over from a run before this one, on a slow way back."""


class OwnFrames:
    """Remembers what we sent."""

    def __init__(self) -> None:
        self.echoes = 0
        self.foreign = 0
        """Frames with our ids that we did not send."""
        self._order: deque[int] = deque()
        self._sent: dict[int, int] = {}
        self._run = 0
        """Foreign frames without a long silence between them, ..."""
        self._began_s = self._heard_s = -math.inf
        """... the first of them, and the last."""

    def record_sent(self, frame: bytes) -> None:
        """Note a frame of ours."""
        number = zlib.crc32(frame)
        self._order.append(number)
        self._sent[number] = self._sent.get(number, 0) + 1
        if len(self._order) > KEPT:
            oldest = self._order.popleft()
            self._sent[oldest] -= 1
            if not self._sent[oldest]:
                del self._sent[oldest]

    def record_received(self, frame: bytes, now_s: float) -> bool:
        """Note a received frame with our ids; whether another companion uses them."""
        if zlib.crc32(frame) in self._sent:
            self.echoes += 1
            return False
        self.foreign += 1
        if now_s - self._heard_s > ID_CONFLICT_S:
            self._run, self._began_s = 0, now_s
        self._run += 1
        self._heard_s = now_s
        return self._run >= FOREIGN_FRAMES and now_s - self._began_s >= FOREIGN_SPAN_S


COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""191: what ground stations expect an onboard computer to be."""
RATE_WINDOW_S = 2.0
STATUSTEXT_BYTES = HEADER_LENGTH[MAGIC_V2] + 54 + CRC_LENGTH
"""A full STATUSTEXT of MAVLink 2, not signed."""


class Outlet:
    """The one way out of the companion, by all links but those for ranging."""

    def __init__(
        self,
        links: Sequence[tuple[LinkRole, MavCodec]],
        binding: AutopilotBinding,
        journal: Journal,
        downlink_bytes_s: float,
    ) -> None:
        self.setpoints_sent = 0
        self.texts_sent = 0
        self.own_frames = OwnFrames()
        self.gate = TextGate(downlink_bytes_s)
        self._codecs = [codec for _, codec in links]
        roles = [role for role, _ in links]
        self._vehicle_link = roles.index(LinkRole.VEHICLE)
        self._gcs_links = [n for n, role in enumerate(roles) if role is LinkRole.GCS]
        self._codec = self._codecs[self._vehicle_link]
        self.own_ids = (self._codec.system_id, self._codec.component_id)
        """System and component that our frames carry."""
        self._binding = binding
        self._journal = journal
        self._is_conflict_told = False
        self._text_id = 0
        self._setpoint_times_s: list[float] = []
        self._output: list[Chunk] = []

    @property
    def target_ids(self) -> tuple[int, int]:
        """System and component of the autopilot."""
        return (self._binding.system_id or 1, self._binding.component_id)

    def adopt(self, system_id: int) -> None:
        """Take the vehicle's system id."""
        for codec in self._codecs:
            codec.system_id = system_id
        self.own_ids = (system_id, self._codec.component_id)

    def send(self, message: Message, now_s: float, *, is_droppable: bool = False) -> None:
        """Queue a message for the autopilot's address; a slow line does without a droppable one."""
        data = self._codec.encode(message)
        self.own_frames.record_sent(data)
        self._journal.frame(data, now_s)
        peer = self._binding.peer
        self._output.append(Chunk(self._vehicle_link, data, peer, is_droppable=is_droppable))

    def ask_elsewhere(self, message: Message, peer: Address | None) -> None:
        """Queue a question for an address that is not the autopilot's, or not yet."""
        data = self._codec.encode(message)
        self.own_frames.record_sent(data)
        self._output.append(Chunk(self._vehicle_link, data, peer, is_droppable=True))

    def broadcast(self, message: Message, now_s: float, *, is_droppable: bool = False) -> None:
        """Queue a message for everybody: the autopilot, and stations on links of their own."""
        self.send(message, now_s, is_droppable=is_droppable)
        self.send_to_stations(message)

    def send_to_stations(self, message: Message) -> None:
        """Queue a message for ground stations on links of their own, once the vehicle is known."""
        if not self._binding.is_bound:
            return  # under which system id we speak is not known yet
        for link in self._gcs_links:
            data = self._codecs[link].encode(message)
            self.own_frames.record_sent(data)
            self._output.append(Chunk(link, data, None, is_droppable=True))

    def send_setpoint(self, message: Message, now_s: float) -> None:
        """The same for a setpoint, which is counted."""
        self.send(message, now_s)
        self.setpoints_sent += 1
        self._setpoint_times_s.append(now_s)
        if self._setpoint_times_s[0] < now_s - 2.0 * RATE_WINDOW_S:
            self._setpoint_times_s = [
                t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S
            ]

    def record_own_ids(self, frame: bytes, now_s: float) -> bool:
        """Note a received frame that carries our own ids; whether another companion uses them."""
        if not self._binding.is_bound:
            return False  # under which system id we speak is not known yet
        if not self.own_frames.record_received(frame, now_s):
            return False
        if not self._is_conflict_told:
            self._is_conflict_told = True
            system_id, component_id = self.own_ids
            text = f"someone else sends as {system_id}/{component_id}: two companions, one vehicle?"
            self.announce(Announce(Severity.ERROR, text), now_s)
        return True

    def announce(self, text: Announce, now_s: float) -> None:
        """Announce a text, if its cause was not announced just now."""
        if self.gate.admit(text, now_s):
            self._publish(text, now_s)

    def announce_due(self, now_s: float) -> None:
        """Announce the states that were withheld and still stand."""
        for text in self.gate.due(now_s):
            self._publish(text, now_s)

    def _publish(self, text: Announce, now_s: float) -> None:
        """Pass a text to the journal, and as STATUSTEXT to the autopilot once one is bound."""
        self._journal.text(text.severity, text.text, now_s)
        self.texts_sent += 1
        if not self._binding.is_bound:
            return
        self._text_id = self._text_id % 0xFFFF + 1
        chunks = outbound.status_text(text.severity.value, text.text, self._text_id)
        if self.gate.fits(text, len(chunks) * STATUSTEXT_BYTES, now_s):
            for message in chunks:
                self.broadcast(message, now_s, is_droppable=True)

    def take(self) -> list[Chunk]:
        """What is to be sent, in order; taken once."""
        output, self._output = self._output, []
        return output

    def setpoint_rate_hz(self, now_s: float) -> float:
        """Setpoints sent per second over the last two seconds."""
        recent = [t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S]
        return len(recent) / RATE_WINDOW_S
