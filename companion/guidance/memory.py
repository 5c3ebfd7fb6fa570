"""What a session knew, as a value that outlives its process."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.estimation.belief import Belief
from companion.geometry.frames import LocalOrigin
from companion.guidance.commands import ReportResult
from companion.guidance.states import Phase


@dataclass(frozen=True, slots=True)
class SessionMemory:
    """What a session knew at a moment."""

    phase: Phase
    origin: LocalOrigin | None
    """Of the frame that the rest is in."""
    belief: Belief | None
    report: ReportResult | None
    """What was reported last, if anything was."""
    fence_anchor: LocalOrigin | None = None
    """The origin that a fence in local metres is about; see `Fencing`."""
    others: tuple[Belief, ...] = ()
    """Of the emitters whose turn it was not."""
    earlier: tuple[ReportResult, ...] = ()
    """What was reported of other emitters, the newest last."""

    @property
    def problem(self) -> str | None:
        """Why it cannot be what a session knew, in words, or None."""
        problems = (_problem(self.origin), _problem(self.fence_anchor))
        return next((problem for problem in problems if problem is not None), None)


def _problem(origin: LocalOrigin | None) -> str | None:
    if origin is None:
        return None
    values = (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    if not all(math.isfinite(value) for value in values):
        return "an origin that is no place"
    if abs(origin.latitude_deg) > 90.0 or abs(origin.longitude_deg) > 180.0:
        return "an origin beyond the poles"
    return None
