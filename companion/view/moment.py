"""One moment of a flight for a terminal, as plain values; the page has its own picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.guidance.commands import Severity
from companion.guidance.status import GuidanceStatus
from companion.link.endpoint import CompanionEndpoint
from companion.view.picture import ages_s

Told = tuple[float, Severity, str]
"""Time in seconds, severity and text."""


@dataclass(frozen=True, slots=True)
class Moment:
    """What a terminal shows."""

    status: GuidanceStatus
    setpoint_rate_hz: float
    bad_frames: int
    stop_radius_m: float
    ages_s: Mapping[str, float | None]
    """How long ago each input was last heard; None: never."""
    time_to_go_s: float | None = None
    texts: tuple[Told, ...] = ()
    """Shown below the figures, where there is no log beside them."""


def moment_of(
    endpoint: CompanionEndpoint,
    now_s: float,
    time_to_go_s: float | None = None,
    texts: tuple[Told, ...] = (),
) -> Moment:
    """The present moment of a flight."""
    return Moment(
        status=endpoint.session.status(now_s),
        setpoint_rate_hz=endpoint.setpoint_rate_hz(now_s),
        bad_frames=endpoint.bad_frames,
        stop_radius_m=endpoint.session.params.stop_radius_m,
        ages_s=ages_s(endpoint, now_s),
        time_to_go_s=time_to_go_s,
        texts=texts,
    )
