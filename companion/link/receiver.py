"""What the vehicle link receives: the autopilot's messages and its answers."""

from __future__ import annotations

from companion.domain import Autopilot
from companion.guidance.commands import Severity
from companion.link.binding import AutopilotBinding
from companion.link.dialogues import Dialogues
from companion.link.executor import SessionExecutor
from companion.link.health import LinkHealth
from companion.link.inbound import VehicleInbound
from companion.link.journal import Journal
from companion.link.outlet import Outlet
from companion.link.rate_limit import RateLimit
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address

TEXTS_PER_S, TEXT_BURST = 10, 30
"""Texts of the autopilot that go to the log."""


class VehicleReceiver:
    """Sorts what arrives on the vehicle link.

    Args:
        binding: Says who the autopilot is.
        executor: Takes the events.
        dialogues: Hear the autopilot, too.
        health: So does this.
        outlet: The way back.
        journal: Where to report.
    """

    def __init__(
        self,
        binding: AutopilotBinding,
        executor: SessionExecutor,
        dialogues: Dialogues,
        health: LinkHealth,
        outlet: Outlet,
        journal: Journal,
    ) -> None:
        self._binding = binding
        self._executor = executor
        self._dialogues = dialogues
        self._health = health
        self._outlet = outlet
        self._journal = journal
        self._inbound = VehicleInbound(dialogues.clock)
        self._text_limit = RateLimit(TEXTS_PER_S, TEXT_BURST)

    @property
    def clock_offset_s(self) -> float | None:
        """Local time minus the autopilot's, seconds; None before its first stamp."""
        return self._inbound.clock_offset_s

    def receive(self, message: Message, peer: Address | None, now_s: float) -> None:
        """Take in a message of anyone but ourselves."""
        was_bound = self._binding.is_bound
        is_autopilot = self._binding.admits(message, peer, now_s)
        if not was_bound and self._binding.is_bound:
            self._on_bound(now_s)
        if is_autopilot:
            number = self._health.heard(message, now_s)
            for text in self._dialogues.heard(message, now_s):
                self._outlet.announce(text, now_s)
            events = self._inbound.events(message, now_s, number)
            self._health.overtaken = self._inbound.overtaken
            for event in events:
                self._executor.handle(event, now_s)
            fence = self._dialogues.fence_heard(message, now_s, self._outlet.own_ids)
            if fence is not None:
                self._executor.handle(fence, now_s)
            self._receive_answer(message, now_s, number)

    def _on_bound(self, now_s: float) -> None:
        binding, system_id = self._binding, self._binding.system_id or 1
        self._outlet.adopt(system_id)
        self._journal.record(
            "bound", {"autopilot": binding.autopilot.value, "system_id": system_id}, now_s
        )
        text = f"autopilot heard: {binding.autopilot.value}, system {system_id}"
        self._journal.text(Severity.INFO, text, now_s)
        if binding.autopilot is Autopilot.OTHER:
            text = "unknown autopilot: only PX4 and ArduPilot modes are understood"
            self._journal.text(Severity.WARNING, text, now_s)

    def _receive_answer(self, message: Message, now_s: float, order: int | None) -> None:
        match message:
            case mavlink.MAVLink_command_ack_message():
                if self._is_for_us(message.target_system, message.target_component):
                    self._executor.answered(message, now_s, order)
            case mavlink.MAVLink_statustext_message():
                if self._text_limit.allows(now_s):
                    text = {"text": _clean(message.text), "dropped": self._text_limit.refused}
                    self._journal.record("autopilot_text", text, now_s)

    def _is_for_us(self, target_system: int, target_component: int) -> bool:
        system_id, component_id = self._outlet.own_ids
        return target_system in (0, system_id) and target_component in (0, component_id)


def _clean(text: bytes | str) -> str:
    """A peer's text without control characters."""
    raw = text.decode("utf-8", errors="replace") if isinstance(text, bytes) else text
    return "".join(c if c.isprintable() else "?" for c in raw)
