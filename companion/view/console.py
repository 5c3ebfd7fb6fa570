"""The flight as a line now and then, where there is no live screen."""

from __future__ import annotations

import logging
import math

from companion.guidance.messages import radii_of
from companion.guidance.phases import HAS_VEHICLE, Phase
from companion.link.endpoint import CompanionEndpoint
from companion.run import FlightView

log = logging.getLogger("companion.view")

PERIOD_S = 15.0
"""Seconds of the flight between two lines."""
REPORTED_PHASES = HAS_VEHICLE | {Phase.LAUNCHING}
"""Phases that are reported; on the ground every event has a text of its own, and a log must not
grow without need."""


class PlainView(FlightView):
    """Logs the lines of one flight, whose texts are log lines already."""

    def __init__(self) -> None:
        self._next_s = -math.inf

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Log a line if one is due."""
        if now_s < self._next_s or endpoint.session.phase not in REPORTED_PHASES:
            return
        self._next_s = now_s + PERIOD_S
        status = endpoint.session.status(now_s)
        line = f"{status.time_s:7.1f} s  {status.phase.value}, flown {status.distance_m:.0f} m"
        if status.estimate is not None:
            line += f", {status.estimate.state.value} {radii_of(status.estimate)}"
        log.info("%s", line)
