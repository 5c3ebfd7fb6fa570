"""What may be changed while the companion runs, and when.

What is tuned is how the mission is flown, never where it may be flown: fence, keep-outs and the
height band are read-only. A change comes as whole records that were checked together, and takes
effect with the next control tick; the guard moves from one speed to the other within its
acceleration, as from one waypoint to the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from companion.guard.gate import GuardLimits
from companion.guidance.params import SessionParams
from companion.guidance.states import Phase
from companion.planning.base import Planner


class When(Enum):
    """When a parameter may be changed."""

    ANY_TIME = "at any time but during launch and hand-back"
    DISARMED = "only while the vehicle is disarmed"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Tuning:
    """What the parts of a session work with."""

    params: SessionParams
    limits: GuardLimits
    """With the fence that the session began with."""
    planner: Planner[Any]
    """Of the same kind as before: it goes on with what the one before remembered."""


def objection_to_change(when: When, phase: Phase, *, is_armed: bool) -> str | None:
    """Why a parameter may not be changed now, in words, or None."""
    if when is When.NEVER:
        return "is read-only"
    if when is When.DISARMED and is_armed:
        return "can be changed while disarmed only"
    if phase in (Phase.LAUNCHING, Phase.HANDBACK):
        return f"cannot be changed during {phase.value}"
    return None
