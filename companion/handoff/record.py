"""The value that every hand-off format is made of."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from companion.domain import TargetEstimate
from companion.geometry.ellipse import ellipse_95
from companion.geometry.frames import LocalOrigin

Degrees = tuple[float, float]
"""Latitude and longitude, WGS84."""


@dataclass(frozen=True, slots=True)
class Handoff:
    """Where an emitter is, how wrong that may be, and when it was known."""

    emitter: str
    """Its id or name, as the operator knows it; any text, the formats escape it."""
    state: str
    place_deg: Degrees
    altitude_m: float
    """Above mean sea level: the assumed or estimated height of the emitter."""
    r95_m: float
    """Radius that holds the emitter with 95 % probability, rival places included."""
    ellipse_deg: tuple[Degrees, ...]
    """The 95 % ellipse of the main place."""
    alternative_deg: Degrees | None
    """The second place while the state is ambiguous."""
    measurements: int
    unix_s: float

    @property
    def time_utc(self) -> str:
        """When it was known, ISO 8601."""
        return utc_text(self.unix_s)


def utc_text(unix_s: float) -> str:
    """Seconds since 1970 as ISO 8601 in UTC, whole seconds."""
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def handoff_of(
    emitter: str, estimate: TargetEstimate, origin: LocalOrigin, unix_s: float
) -> Handoff:
    """The hand-off of an estimate.

    Args:
        emitter: Its id or name.
        estimate: In the local frame.
        origin: Zero of the local frame.
        unix_s: Wall clock of the estimate.
    """
    height_m = estimate.height_m

    def degrees(point: tuple[float, float]) -> Degrees:
        """A local point on the globe."""
        latitude_deg, longitude_deg, _ = origin.geodetic_from_enu((*point, height_m))
        return (latitude_deg, longitude_deg)

    alternative = estimate.alternative_enu_m
    ellipse = ellipse_95(estimate.position_enu_m, estimate.covariance_m2)
    return Handoff(
        emitter=emitter,
        state=estimate.state.value,
        place_deg=degrees(estimate.position_enu_m),
        altitude_m=origin.altitude_m + height_m,
        r95_m=estimate.r95_m,
        ellipse_deg=tuple(degrees(point) for point in ellipse.corners_enu_m()),
        alternative_deg=None if alternative is None else degrees(alternative),
        measurements=estimate.measurements,
        unix_s=unix_s,
    )
