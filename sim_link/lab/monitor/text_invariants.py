"""I13: the operator's texts, as they leave for the ground."""

from __future__ import annotations

import re

from companion.mav.dialect import mavlink
from sim_link.lab.lockstep.observer import Frame
from sim_link.lab.monitor.scene import TICK_S, Invariant, ObservedScene

PERIOD_S = 30.0
CHUNK = 50
"""Bytes of a STATUSTEXT; a shorter chunk is the last one of its text."""
FIGURE = re.compile(r"(?<!system )(?<!emitter )\d+(\.\d+)*")
"""Without figures the words are the cause; the number of a system or an emitter belongs to it."""
BY_A_PERSON = frozenset({"COMMAND_LONG", "COMMAND_INT", "SET_MODE", "PARAM_SET"})
"""Messages that the companion answers with a text every time."""


class FewTexts(Invariant):
    """A text with the same words, whatever its figures, does not come twice within 30 s.

    What a person did since allows it once more: a changed mode, arming, or an order that was heard.
    """

    name = "I13"
    title = "a text of one cause comes once in 30 s, or in answer to a person"

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self._chunks: tuple[int, dict[int, str]] = (0, {})
        """Id of the text that is being sent, and its chunks by number."""
        self._last: dict[str, tuple[float, int]] = {}
        """Time at which a cause was sent last, and the number of operator actions by then."""
        self._deeds = 0
        self._flown: tuple[int, int] | None = None
        """Mode and flags of the autopilot's last HEARTBEAT."""

    def started(self) -> None:
        """A new process has said nothing yet."""
        self._last.clear()

    def heard(self, frame: Frame) -> None:
        """Count changes of mode and arming, and orders."""
        scene, message = self.scene, frame.message
        if message is None or not (scene.must_accept or scene.is_indistinct):
            return
        if message.get_type() in BY_A_PERSON:
            self._deeds += 1
        elif isinstance(message, mavlink.MAVLink_heartbeat_message) and scene.is_of_autopilot(
            frame
        ):
            flown = (message.custom_mode, message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self._deeds += flown != self._flown
            self._flown = flown

    def sent(self, frame: Frame) -> None:
        """Join the chunks of a text, and judge it once it is whole."""
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_statustext_message):
            return
        number, chunks = self._chunks
        if message.id == 0 or message.id != number:
            self._chunks = number, chunks = message.id, {}
        if message.chunk_seq in chunks:
            return  # to another link
        chunks[message.chunk_seq] = message.text
        if message.id == 0 or len(message.text.encode("utf-8")) < CHUNK:
            self._judge("".join(chunks[each] for each in sorted(chunks)))

    def _judge(self, text: str) -> None:
        now_s, cause = self.scene.now_s, FIGURE.sub("#", text)
        before_s, deeds = self._last.get(cause, (-PERIOD_S, self._deeds))
        self._last[cause] = (now_s, self._deeds)
        is_copy = now_s - before_s < TICK_S  # for another link
        if now_s - before_s < PERIOD_S and deeds == self._deeds and not is_copy:
            self.report(f"the same text again: {cause}", after_s=now_s - before_s)
