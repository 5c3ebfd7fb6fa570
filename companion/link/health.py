"""How well the autopilot is heard: order, loss, and the pace that follows from it."""

from __future__ import annotations

from companion.link.pacing import Pacing, TickWatch
from companion.link.params import LinkParams
from companion.link.sequence import SequenceMonitor
from companion.mav.dialect import Message


class LinkHealth:
    """What is known about the line to the bound autopilot.

    Args:
        params: How the line is used.
    """

    def __init__(self, params: LinkParams) -> None:
        self.sequence = SequenceMonitor()
        self.pacing = Pacing(params)
        self.ticks = TickWatch()
        self.overtaken = 0
        """Messages that came after a newer one of their kind."""

    def heard(self, message: Message, now_s: float) -> int:
        """Take in a message of the bound autopilot; its place in the order of sending."""
        return self.sequence.take(message.get_seq(), now_s)

    def tick(self, now_s: float) -> float | None:
        """Judge the line once more; how long the control tick stood still, if that is a stall."""
        stalled_s = self.ticks.tick(self.pacing.period_s, now_s)
        if stalled_s is not None:
            self.sequence.skip()  # the socket kept the oldest of what came meanwhile
        self.pacing.observe(self.sequence.loss(now_s), now_s)
        return stalled_s

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self.sequence.restart()

    def record(self, now_s: float) -> dict[str, object]:
        """The figures for the event log."""
        sequence = self.sequence
        return {
            "loss": sequence.loss(now_s),
            "received": sequence.received,
            "lost": sequence.lost,
            "late": sequence.late,
            "duplicates": sequence.duplicates,
            "overtaken": self.overtaken,
            "tick_s": self.pacing.period_s,
            "missed_ticks": self.ticks.missed,
            "stalls": self.ticks.stalls,
        }
