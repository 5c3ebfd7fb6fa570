"""What the links did, for the event log and for views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

from companion.guidance.records import health_fields
from companion.guidance.session import GuidanceSession
from companion.link.authenticity import Authenticity
from companion.link.binding import AutopilotBinding
from companion.link.health import LinkHealth
from companion.link.intake import Intake
from companion.link.journal import Journal
from companion.link.outlet import Outlet

RECORD_PERIOD_S = 10.0
"""How often the health of the links goes to the event log."""


class LinkCounters:
    """Gathers the counters that the parts of the link keep.

    Args:
        session: The guidance, for what became of the measurements.
        intakes: Of all links.
        binding: The autopilot.
        health: How well it is heard.
        authenticity: Who was believed.
        outlet: The way out.
        journal: Where to report.
    """

    def __init__(
        self,
        session: GuidanceSession,
        intakes: Sequence[Intake],
        binding: AutopilotBinding,
        health: LinkHealth,
        authenticity: Authenticity,
        outlet: Outlet,
        journal: Journal,
    ) -> None:
        self._session = session
        self._intakes = intakes
        self._binding = binding
        self._health = health
        self._authenticity = authenticity
        self._outlet = outlet
        self._journal = journal
        self._next_record_s = -math.inf

    @property
    def bad_frames(self) -> int:
        """Frames that failed their CRC or could not be decoded, on all links."""
        codecs = [intake.codec for intake in self._intakes]
        return sum(codec.counters.bad_crc + codec.undecodable for codec in codecs)

    @property
    def dropped_unread(self) -> int:
        """Datagrams, frames and messages that were over a budget, on all links."""
        return sum(intake.budget.dropped_unread for intake in self._intakes)

    def report(self, now_s: float) -> None:
        """Write to the event log what is due."""
        if now_s < self._next_record_s:
            return
        self._next_record_s = now_s + RECORD_PERIOD_S
        self._journal.record("link", self._link_record(now_s), now_s)
        self._journal.record("health", health_fields(self._session.tracker, now_s), now_s)

    def _link_record(self, now_s: float) -> dict[str, object]:
        """Counters of all links, and what became of the measurements."""
        emitters = self._session.situation.emitters
        return {
            "links": [
                asdict(intake.codec.counters) | {"over_budget": intake.budget.dropped}
                for intake in self._intakes
            ],
            **self._health.record(now_s),
            **self._authenticity.record(),
            "undecodable": sum(intake.codec.undecodable for intake in self._intakes),
            "strangers": self._binding.strangers,
            "moves": self._binding.moves,
            "echoes": self._outlet.own_frames.echoes,
            "setpoints": self._outlet.setpoints_sent,
            "setpoint_rate_hz": self._outlet.setpoint_rate_hz(now_s),
            "accepted": emitters.accepted,
            "refused": {reason.value: count for reason, count in emitters.refusals.items()},
            "restarts": emitters.restarts,
        }
