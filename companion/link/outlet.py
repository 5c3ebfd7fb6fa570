"""What leaves by our links: encoded, noted down, queued for the shell, counted.

The autopilot passes on what is broadcast, so ground stations behind it hear that; a link of their
own gets the same beside. Setpoints and commands only ever leave by the vehicle link.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.guidance.commands import Announce, Severity
from companion.link import outbound
from companion.link.binding import AutopilotBinding
from companion.link.journal import Journal
from companion.link.own_frames import OwnFrames
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk

VEHICLE_LINK = 0
COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""191: what ground stations expect an onboard computer to be."""
RATE_WINDOW_S = 2.0


class Outlet:
    """The one way out of the companion.

    Args:
        codecs: Of all links; those that carry only ranging do not send.
        binding: The autopilot that everything goes to.
        journal: Where to report.
        gcs_links: Numbers of the links to ground stations.
    """

    def __init__(
        self,
        codecs: Sequence[MavCodec],
        binding: AutopilotBinding,
        journal: Journal,
        gcs_links: Sequence[int] = (),
    ) -> None:
        self.setpoints_sent = 0
        self.texts_sent = 0
        self._codecs = codecs
        self.own_frames = OwnFrames()
        self._codec = codecs[VEHICLE_LINK]
        self._binding = binding
        self._journal = journal
        self._gcs_links = tuple(gcs_links)
        self._text_id = 0
        self._setpoint_times_s: list[float] = []
        self._output: list[Chunk] = []

    @property
    def own_ids(self) -> tuple[int, int]:
        """System and component that our frames carry."""
        return (self._codec.system_id, self._codec.component_id)

    @property
    def target_ids(self) -> tuple[int, int]:
        """System and component of the autopilot."""
        return (self._binding.system_id or 1, self._binding.component_id)

    def adopt(self, system_id: int) -> None:
        """Take the vehicle's system id."""
        for codec in self._codecs:
            codec.system_id = system_id

    def send(self, message: Message, now_s: float, *, can_be_spared: bool = False) -> None:
        """Queue a message for the autopilot's address.

        Args:
            message: What to send.
            now_s: The present.
            can_be_spared: A line that is too slow for everything does without it.
        """
        data = self._codec.encode(message)
        self.own_frames.sent(data)
        self._journal.frame(data, now_s)
        self._output.append(
            Chunk(VEHICLE_LINK, data, self._binding.peer, can_be_spared=can_be_spared)
        )

    def broadcast(self, message: Message, now_s: float, *, can_be_spared: bool = False) -> None:
        """Queue a message for everybody: the autopilot, and ground stations on links of their own.

        Args:
            message: Without a target, or with that of a ground station.
            now_s: The present.
            can_be_spared: As of `send`.
        """
        self.send(message, now_s, can_be_spared=can_be_spared)
        self.send_to_stations(message)

    def send_to_stations(self, message: Message) -> None:
        """Queue a message for ground stations on links of their own, once the vehicle is known."""
        if not self._binding.is_bound:
            return  # under which system id we speak is not known yet
        for link in self._gcs_links:
            data = self._codecs[link].encode(message)
            self.own_frames.sent(data)
            self._output.append(Chunk(link, data, None, can_be_spared=True))

    def send_setpoint(self, message: Message, now_s: float) -> None:
        """The same for a setpoint, which is counted."""
        self.send(message, now_s)
        self.setpoints_sent += 1
        self._setpoint_times_s.append(now_s)
        if self._setpoint_times_s[0] < now_s - 2.0 * RATE_WINDOW_S:
            self._setpoint_times_s = [
                t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S
            ]

    def came_back(self, frame: bytes, now_s: float) -> bool:
        """Take note of a frame that carries our own ids; whether a twin of ours sent it."""
        if not self._binding.is_bound:
            return False  # under which system id we speak is not known yet
        if not self.own_frames.came_back(frame, now_s):
            return False
        if self.own_frames.is_news():
            system_id, component_id = self.own_ids
            text = f"someone else sends as {system_id}/{component_id}: two companions, one vehicle?"
            self.announce(Announce(Severity.ERROR, text), now_s)
        return True

    def announce(self, text: Announce, now_s: float) -> None:
        """Tell the operator: to the journal, and as STATUSTEXT if there is an autopilot."""
        self._journal.text(text.severity, text.text, now_s)
        self.texts_sent += 1
        if not self._binding.is_bound:
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for message in outbound.status_text(text.severity.value, text.text, self._text_id):
            self.broadcast(message, now_s, can_be_spared=True)

    def take(self) -> list[Chunk]:
        """What is to be sent, in order; taken once."""
        output, self._output = self._output, []
        return output

    def setpoint_rate_hz(self, now_s: float) -> float:
        """Setpoints sent per second over the last two seconds."""
        recent = [t for t in self._setpoint_times_s if t > now_s - RATE_WINDOW_S]
        return len(recent) / RATE_WINDOW_S
