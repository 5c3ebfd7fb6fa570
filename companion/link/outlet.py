"""Outlet of the companion: frames are encoded, logged, queued for the shell, and counted.

The autopilot forwards broadcasts, so ground stations behind it receive them; a link of their own
gets the same in addition. Setpoints and commands only leave by the vehicle link.

A router that forwards to all sends our frames back to us, byte by byte as they were. A frame with
our ids that we did not send comes from another component. Another kind of component with our
component id, as MAVROS2 has 191, is not a conflict: where no id is configured the companion takes
the next free one, before it has control and never in flight. A second companion of this kind is
one, under whatever component id: both would obey the operator and alternate setpoints. It is
identified by setpoints and estimates, and by a mark that each companion sends once a second while
it receives another onboard computer of its vehicle.
"""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Callable, Sequence

from companion.guidance.commands import Announce, Severity
from companion.guidance.control_authority import ID_CONFLICT_S
from companion.link import outbound
from companion.link.binding import AutopilotBinding
from companion.link.interface import Journal, LinkRole
from companion.link.text_gate import TextGate
from companion.mav.codec import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2, MavCodec
from companion.mav.dialect import (
    SETPOINT_IDS,
    MAVLink_target_estimate_message,
    Message,
    mavlink,
)
from companion.mav.endpoint import Address, Chunk

KEPT = 1024
"""Number of our latest frames that are kept: 20 s at the highest rate."""
FOREIGN_FRAMES = 3
"""Foreign frames that prove another companion."""
FOREIGN_SPAN_S = 1.0
"""Minimum span of them; faster ones may be left over from an earlier run, on a slow way back."""


class OwnFrames:
    """Memory of our latest frames, to recognise echoes."""

    def __init__(self) -> None:
        self.echoes = 0
        self.foreign = 0
        """Frames with our ids that we did not send."""
        self._order: deque[int] = deque()
        self._sent: dict[int, int] = {}
        self._run = 0
        """Number of foreign frames without a long silence between them."""
        self._began_s = self._heard_s = -math.inf
        """Times of the first and the last of those frames."""

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

    def is_ours(self, frame: bytes) -> bool:
        """Return True if we sent a frame recently."""
        return zlib.crc32(frame) in self._sent

    def forget_foreign(self) -> None:
        """Start counting foreign frames again."""
        self._run, self._heard_s = 0, -math.inf

    def record_received(self, frame: bytes, now_s: float) -> bool:
        """Note a received frame with our ids; return True if another companion uses them."""
        if self.is_ours(frame):
            self.echoes += 1
            return False
        self.foreign += 1
        if now_s - self._heard_s > ID_CONFLICT_S:
            self._run, self._began_s = 0, now_s
        self._run += 1
        self._heard_s = now_s
        return self._run >= FOREIGN_FRAMES and now_s - self._began_s >= FOREIGN_SPAN_S


COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""Id 191, under which ground stations expect an onboard computer."""
SPARE_IDS = (
    mavlink.MAV_COMP_ID_ONBOARD_COMPUTER2,
    mavlink.MAV_COMP_ID_ONBOARD_COMPUTER3,
    mavlink.MAV_COMP_ID_ONBOARD_COMPUTER4,
)
ONBOARD_IDS = frozenset((COMPONENT_ID, *SPARE_IDS))
NAMED_VALUE_FLOAT = mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
"""Message of the mark by which companions of this kind recognise each other."""
RIVALS = SETPOINT_IDS | {MAVLink_target_estimate_message.id}
"""Messages that only a second companion sends under our ids."""


NEIGHBOUR_S = 10.0
"""Silence after which another onboard computer is gone."""


def is_marked(frame: bytes) -> bool:
    """Return True if a NAMED_VALUE_FLOAT is the mark of a companion of this kind."""
    name_at = HEADER_LENGTH[frame[0]] + 8  # behind a time and a value of four bytes each
    return frame[name_at : name_at + len(outbound.MARK)] == outbound.MARK


RATE_WINDOW_S = 2.0
STATUSTEXT_BYTES = HEADER_LENGTH[MAGIC_V2] + 54 + CRC_LENGTH
"""Size of a full STATUSTEXT of MAVLink 2, unsigned."""


class Outlet:
    """Only outlet of the companion, on all links but those for ranging."""

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
        """System and component id of our frames."""
        self._binding = binding
        self._journal = journal
        self._is_conflict_announced = False
        self._heard_ids: set[tuple[int, int]] = set()
        """Ids of other received components."""
        self._neighbour_s = -math.inf
        """Latest reception of another onboard computer of the vehicle."""
        self._is_rival = False
        """True if the sender with our ids is a second companion."""
        self._text_id = 0
        self._setpoint_times_s: list[float] = []
        self._output: list[Chunk] = []

    @property
    def target_ids(self) -> tuple[int, int]:
        """System and component of the autopilot."""
        bound = self._binding.bound
        return (1, 0) if bound is None else bound.ids

    def adopt(self, system_id: int) -> None:
        """Adopt the vehicle's system id."""
        for codec in self._codecs:
            codec.system_id = system_id
        self.own_ids = (system_id, self._codec.component_id)

    def send(self, message: Message, now_s: float, *, is_droppable: bool = False) -> None:
        """Queue a message for the autopilot's address; droppable ones are lost first."""
        data = self._codec.encode(message)
        self.own_frames.record_sent(data)
        self._journal.frame(data, now_s)
        peer = self._binding.peer
        self._output.append(Chunk(self._vehicle_link, data, peer, is_droppable=is_droppable))

    def ask_elsewhere(self, message: Message, peer: Address | None) -> None:
        """Queue a request for an address that is not the autopilot's, or not yet."""
        data = self._codec.encode(message)
        self.own_frames.record_sent(data)
        self._output.append(Chunk(self._vehicle_link, data, peer, is_droppable=True))

    def broadcast(self, message: Message, now_s: float, *, is_droppable: bool = False) -> None:
        """Queue a message for the autopilot, which forwards it, and stations on own links."""
        self.send(message, now_s, is_droppable=is_droppable)
        self.send_to_stations(message)

    def send_to_stations(self, message: Message) -> None:
        """Queue a message for ground stations on `--gcs` links, once the vehicle is known."""
        if not self._binding.is_bound:
            return  # our system id is not known yet
        for link in self._gcs_links:
            data = self._codecs[link].encode(message)
            self.own_frames.record_sent(data)
            self._output.append(Chunk(link, data, None, is_droppable=True))

    def send_setpoint(self, message: Message, now_s: float) -> None:
        """Queue a setpoint for the autopilot, and count it."""
        self.send(message, now_s)
        self.setpoints_sent += 1
        self._setpoint_times_s.append(now_s)
        if self._setpoint_times_s[0] < now_s - 2.0 * RATE_WINDOW_S:
            self._setpoint_times_s = [
                t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S
            ]

    def note_sender(
        self,
        frame: bytes,
        sender: tuple[int, int],
        number: int,
        now_s: float,
        may_move: Callable[[], bool],
    ) -> bool:
        """Note the sender of a verified frame; return True if it is a second companion.

        Otherwise, if our component id is taken, another one is chosen where it `may_move`.
        `sender` and the message's `number` are those in the frame's header. Only frames with our
        ids, those of an onboard computer, and NAMED_VALUE_FLOATs can be a companion's.
        """
        if sender[0] != self.own_ids[0]:
            return False
        is_same = sender == self.own_ids
        has_mark = number == NAMED_VALUE_FLOAT and is_marked(frame)
        is_beside = sender[1] in ONBOARD_IDS
        if not is_same:
            self._heard_ids.add(sender)
            if not (is_beside or has_mark):
                return False
        is_echo = self.own_frames.is_ours(frame)
        if (is_same or is_beside) and not is_echo:
            self._neighbour_s = now_s
        if not self._binding.is_bound or not (is_same or has_mark):
            return False  # unbound: our system id is not known yet
        self._is_rival |= (has_mark or number in RIVALS) and not is_echo
        if not self.own_frames.record_received(frame, now_s):
            return False
        free = [each for each in SPARE_IDS if (sender[0], each) not in self._heard_ids]
        if free and not self._is_rival and may_move():
            self._move_aside(free[0], now_s)
            return False
        if not self._is_conflict_announced:
            self._is_conflict_announced = True
            text = f"another companion sends as {sender[0]}/{sender[1]}: stop one"
            self.announce(Announce(Severity.ERROR, text), now_s)
        return True

    def has_neighbour(self, now_s: float) -> bool:
        """Return True while another onboard computer of the vehicle is received."""
        return self._binding.is_bound and now_s - self._neighbour_s <= NEIGHBOUR_S

    def _move_aside(self, component_id: int, now_s: float) -> None:
        """Take another component id, because another component uses ours."""
        taken = self.own_ids
        for codec in self._codecs:
            codec.component_id = component_id
        self.own_ids = (taken[0], component_id)
        self._heard_ids.add(taken)
        self.own_frames.forget_foreign()
        text = f"component id {taken[1]} is in use: sending as {component_id}, send grants to it"
        self.announce(Announce(Severity.WARNING, text), now_s)

    def announce(self, text: Announce, now_s: float) -> None:
        """Announce a text, unless its cause was announced recently."""
        if self.gate.admit(text, now_s):
            self._publish(text, now_s)

    def announce_due(self, now_s: float) -> None:
        """Announce the states that were withheld and still hold."""
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
        """Return the chunks to be sent, in order; each is returned once."""
        output, self._output = self._output, []
        return output

    def setpoint_rate_hz(self, now_s: float) -> float:
        """Return the setpoints sent per second over the last two seconds."""
        recent = [t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S]
        return len(recent) / RATE_WINDOW_S
