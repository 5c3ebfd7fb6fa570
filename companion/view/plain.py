"""The flight as a line now and then, where the output is no terminal."""

from __future__ import annotations

import logging
import math

from companion.guidance.states import HAS_VEHICLE, Phase
from companion.guidance.status import GuidanceStatus
from companion.link.endpoint import CompanionEndpoint
from companion.link.journal import Journal

log = logging.getLogger("companion.view")

PERIOD_S = 15.0
"""Seconds of the flight between two lines."""
TOLD_PHASES = HAS_VEHICLE | {Phase.LAUNCHING}
"""On the ground whatever happens has a text of its own, and a log must not grow for nothing."""


def plain_line(status: GuidanceStatus) -> str:
    """A flight in one line."""
    line = f"{status.time_s:7.1f} s  {status.phase.value}, flown {status.distance_m:.0f} m"
    if status.estimate is not None:
        line += f", {status.estimate.state.value} R95 {status.estimate.r95_m:.1f} m"
    return line


class PlainView:
    """Logs the lines of one flight; a `companion.run.FlightView`."""

    def __init__(self) -> None:
        self._next_s = -math.inf

    def listen(self, journal: Journal) -> Journal:
        """Texts are log lines already."""
        return journal

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Log a line, if it is time.

        Args:
            endpoint: The companion.
            now_s: The present.
        """
        if now_s < self._next_s or endpoint.session.phase not in TOLD_PHASES:
            return
        self._next_s = now_s + PERIOD_S
        log.info("%s", plain_line(endpoint.session.status(now_s)))

    def close(self) -> None:
        """There is nothing to close."""
