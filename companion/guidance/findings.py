"""Findings of a session's watches, and the verdict that each leads to.

At every tick each watch may return a finding; the worst one decides the phase. A finding has a
reason, which is counted, and a text, which is announced. A new failsafe is a reason here, a `Watch`
in this folder, and an entry in `Watches`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, IntEnum

from companion.domain import FlightMode
from companion.guidance.events import Event


class Verdict(IntEnum):
    """Reaction that a finding needs, by severity.

    Yielding ranks above handing back: requesting a mode while another system commands would be a
    fight for the vehicle.
    """

    SLOW = 1
    """Continue, slower: DEGRADED."""
    HOLD = 2
    """Stay in place: HOLD."""
    HAND_BACK = 3
    """Request a mode in which the autopilot flies by itself: HANDBACK."""
    YIELD = 4
    """Be silent: YIELD."""


class Reason(Enum):
    """Reason why the plan is not followed, or not at full speed."""

    NO_LINK = "autopilot link lost"
    MODE_UNKNOWN = "autopilot's mode is unknown"
    POSITION_STALE = "vehicle position is stale"
    NO_HOME = "home is unknown"
    NO_ORIGIN = "origin is unknown"
    INPUT_MISSING = "something that control needs is missing"
    NO_RANGING_YET = "waiting for ranging"
    RANGING_AGES = "ranging ages"
    NO_RANGING = "no ranging"
    RANGING_IS_BACK = "ranging is back, too few measurements"
    ESTIMATE_VAGUE = "estimate is too vague to coast on"
    FILTER_DIVERGED = "filter is recovering"
    WRONG_UNIT = "measurements seem to be in a wrong unit"
    FRAME_MOVED = "local frame moved"
    HOME_MOVED = "home moved"
    OWN_JUMP = "vehicle position or heading jumped"
    FENCE = "the fence is not known, or cannot be kept"
    CHECKING = "checking its inputs"
    OPERATOR_HOLDS = "the operator asked to hold"
    OPERATOR_RETURNS = "the operator asked to return"
    SECOND_SOURCE = "second source of setpoints"
    SETPOINTS_LOST = "setpoints do not arrive"
    NO_ECHO = "setpoints are not echoed"
    STICKS = "the pilot moves the sticks"
    ESTIMATOR_POOR = "autopilot doubts its position"
    NO_FIX = "autopilot lost GNSS fix"
    FAILSAFE = "autopilot reports a failsafe"
    LANDED_DOUBTED = "autopilot reports landed in flight"
    BATTERY_CRITICAL = "battery critical"
    INTERNAL_ERROR = "internal error"


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem, with the reaction that it needs."""

    verdict: Verdict
    reason: Reason
    text: str
    mode: FlightMode = FlightMode.HOLD
    """Mode to request on a hand-back."""
    since_s: float = -math.inf
    """Time of the first sign of it, in seconds; -inf where that decides nothing."""


class Watch:
    """Base of all watches; every method does nothing unless a watch overrides it."""

    is_idle: bool = False
    """True while nothing is wrong that `step` could find, whatever the time: it is not called."""

    def handle(self, event: Event) -> None:
        """Apply an event."""

    def begin(self, now_s: float) -> None:
        """Note the start of control."""

    def step(self, now_s: float) -> Finding | None:
        """Advance to the time of a control tick, in control or not; return the worst finding."""


def worst(findings: Iterable[Finding | None]) -> Finding | None:
    """Return the most severe finding, the first of several; None if there is none."""
    found = [finding for finding in findings if finding is not None]
    return max(found, key=lambda finding: finding.verdict, default=None)
