"""Whether the pilot moves the sticks while the vehicle follows us.

PX4 ignores them in offboard unless COM_RC_OVERRIDE says otherwise, and ArduPilot does in GUIDED,
so a pilot who grabs the sticks flies nothing until somebody switches the mode. We take it as a
wish: stay at once, and give way if the sticks stay moved. A stick is moved if it is neither in the
middle nor where it was when control began: a throttle without a spring rests anywhere, and whoever
let go of the others after the mode switch did not move them.

Source: MAVLink common, RC_CHANNELS; PX4 COM_RC_STICK_OV (30 %).
"""

from __future__ import annotations

from companion.guidance.events import SticksReported
from companion.guidance.findings import Finding, Reason, Verdict
from companion.guidance.params import StickReaction as StickReaction

MOVED = 0.3
"""Deflection from rest that means a wish to fly."""
GIVE_WAY_S = 0.5
"""Moved for longer than this, they are not let go again."""
RELEASED_S = 2.0
"""Let go for less than this, they may be taken again."""
THROTTLE = 2
"""Its channel, counted from 0; ArduPilot RCMAP_THROTTLE 3."""
STALE_S = 1.0
"""An older report says nothing: there is no transmitter."""


class StickWatch:
    """Watches the sticks.

    Args:
        reaction: What moved sticks mean.
    """

    def __init__(self, reaction: StickReaction) -> None:
        self._reaction = reaction
        self._latest: SticksReported | None = None
        self._rest: tuple[float, ...] | None = None
        self._moved_s: float | None = None
        """Since when they are moved."""
        self._seen_moved_s: float | None = None
        """When they were moved last."""

    def begin(self, now_s: float) -> None:
        """Control begins: the sticks rest where they are."""
        latest = self._latest
        is_fresh = latest is not None and now_s - latest.time_s <= STALE_S
        self._rest = latest.deflections if latest is not None and is_fresh else None
        self._moved_s = self._seen_moved_s = None

    def reported(self, event: SticksReported) -> None:
        """Take in where they are."""
        self._latest = event
        if self._rest is None:
            throttle = event.deflections[THROTTLE]
            self._rest = tuple(
                throttle if n == THROTTLE else 0.0 for n in range(len(event.deflections))
            )
        if not self._are_moved(event, self._rest):
            self._moved_s = None
            return
        if self._moved_s is None:
            self._moved_s = event.time_s
        self._seen_moved_s = event.time_s

    def finding(self, now_s: float) -> Finding | None:
        """What the sticks mean at a tick in control."""
        seen_s, latest = self._seen_moved_s, self._latest
        if self._reaction == "ignore" or seen_s is None or latest is None:
            return None
        if now_s - latest.time_s > STALE_S:
            self._moved_s = None
        moved_s = self._moved_s
        if moved_s is None:
            is_held = now_s - seen_s < RELEASED_S
            return _finding(Verdict.HOLD) if is_held else None
        is_wish = seen_s - moved_s >= GIVE_WAY_S and self._reaction == "yield"
        return _finding(Verdict.GIVE_WAY if is_wish else Verdict.HOLD)

    @staticmethod
    def _are_moved(event: SticksReported, rest: tuple[float, ...]) -> bool:
        pairs = zip(event.deflections, rest, strict=True)
        return any(abs(now) > MOVED and abs(now - before) > MOVED for now, before in pairs)


def _finding(verdict: Verdict) -> Finding:
    return Finding(verdict, Reason.STICKS, "the pilot moves the sticks")
