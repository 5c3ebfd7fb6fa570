"""How much of what arrives is looked at between two control ticks, so that no flood delays one.

Theory of operation. The autopilot's own address, and any line with one end, has a budget that is
far above what an autopilot sends; everyone else shares a much smaller one, with a share for each
source, so that strangers are dropped first and none of them crowds the others out. Bytes are
counted before they are cut into frames, frames before they are proved, messages before anyone acts
on them. What is over budget is dropped and counted, and the budgets begin anew with each control
tick. Of the sources a tick remembers only so many. A link that held everything back delivers more
at once than a tick reads, and the newest mode last: so HEARTBEATs of the autopilot's address have
a budget of their own.

PX4 1.15 sends 405 frames a second on its busiest link: 20 between two ticks. The bytes are what
the worst of them, all magic, can be cut up in less than a tick (1.3 us each).
"""

from __future__ import annotations

from enum import IntEnum

from companion.mav.endpoint import Address

MAX_SOURCES = 64
"""Strangers told apart in one tick; those beyond are dropped."""


class Resource(IntEnum):
    """What is counted."""

    BYTES = 0
    FRAMES = 1
    """With a right CRC."""
    MESSAGES = 2
    """Proved, or signing is off."""


Amounts = tuple[int, int, int]
"""Of each resource."""

KNOWN: Amounts = (32_768, 2_000, 500)
STRANGERS: Amounts = (16_384, 400, 100)
"""All of them together."""
ONE_STRANGER: Amounts = (4_096, 100, 50)
HEARTBEATS = 200
"""Of the autopilot's address, whatever else it sent: they alone tell who flies. One a second, and
those that are asked for after a silence, of more than two minutes."""


class FloodBudget:
    """The budgets of one link."""

    def __init__(self) -> None:
        self.dropped = [0, 0, 0]
        """Refusals so far, by what was used up: chunks, frames, messages."""
        self._known = [0, 0, 0]
        self._strangers = [0, 0, 0]
        self._by_source: dict[Address | None, list[int]] = {}
        self._heartbeats = 0

    def renew(self) -> None:
        """A control tick has passed."""
        self._known = [0, 0, 0]
        self._strangers = [0, 0, 0]
        self._by_source.clear()
        self._heartbeats = 0

    @property
    def dropped_unread(self) -> int:
        """Refusals so far: chunks, frames and messages."""
        return sum(self.dropped)

    def admits_heartbeat(self) -> bool:
        """Whether one more HEARTBEAT of the autopilot's address may come beside all budgets."""
        self._heartbeats += 1
        return self._heartbeats <= HEARTBEATS

    def admits(
        self, resource: Resource, amount: int, peer: Address | None, *, is_known: bool
    ) -> bool:
        """Whether a source may use so much more of a resource, which is then used."""
        accounts: tuple[tuple[list[int], Amounts], ...] = ((self._known, KNOWN),)
        if not is_known:
            own = self._account_of(peer)
            if own is None:
                self.dropped[resource] += 1
                return False
            accounts = ((self._strangers, STRANGERS), (own, ONE_STRANGER))
        for used, allowed in accounts:
            if used[resource] + amount > allowed[resource]:
                self.dropped[resource] += 1
                return False
        for used, _ in accounts:
            used[resource] += amount
        return True

    def _account_of(self, peer: Address | None) -> list[int] | None:
        """What a stranger has used; None if there are too many of them to tell."""
        used = self._by_source.get(peer)
        if used is None and len(self._by_source) < MAX_SOURCES:
            used = self._by_source[peer] = [0, 0, 0]
        return used
