"""Which measurements never reach a filter, and why."""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import Enum

from companion.domain import RangingMeasurement
from companion.params import Params, Positive


class Refusal(Enum):
    """Why a measurement was refused; the filter is untouched by it."""

    OTHER_EMITTER = "other emitter"
    NOTHING_MEASURED = "nothing measured"
    NOT_FINITE = "not finite"
    DENORMAL = "denormal"
    RANGE_NOT_POSITIVE = "range not positive"
    RANGE_ABSURD = "range absurd"
    BEARING_ABSURD = "bearing absurd"
    ELEVATION_ABSURD = "elevation absurd"
    SIGMA_NOT_POSITIVE = "sigma not positive"
    FROM_THE_FUTURE = "from the future"
    STALE = "stale"
    TOO_MANY = "too many at once"
    DUPLICATE = "duplicate"
    FROZEN = "frozen while the vehicle moves"
    WRONG_UNIT = "in a wrong unit, as it seems"
    RANGE_OUTLIER = "range too short for the estimate"
    BEARING_OUTLIER = "bearing off the estimate"
    NO_POSITION = "own position unknown at its time"
    NO_YAW = "own yaw unknown at its time"
    OWN_JUMP = "own position or yaw jumped about its time"


class AcceptanceParams(Params, frozen=True):
    """What counts as a plausible and timely measurement."""

    max_range_m: Positive = 2000.0
    """A longer range is a fault of the radio or its unit."""
    max_age_s: Positive = 1.0
    """An older measurement is refused; a younger one is fused at its own time."""


FUTURE_TOLERANCE_S = 0.1
MAX_ELEVATION_RAD = 0.5 * math.pi + 1e-6
"""A right angle, which in the wire's 32 bits is a little more than one."""
MAX_BEARING_RAD = math.pi + 1e-6
"""Half a turn, in the same way; more is most likely another unit."""
LEAST_NORMAL = 2.0**-126
"""Of 32 bits. Nothing is measured as finely: what is smaller, but not zero, was no float."""


def refusal_of(
    measurement: RangingMeasurement, now_s: float, params: AcceptanceParams
) -> Refusal | None:
    """Why the measurement cannot be used, judged by itself, or None if it can."""
    m = measurement
    values = (m.range_m, m.bearing_enu_rad, m.bearing_body_rad)
    if all(value is None for value in values):
        return Refusal.NOTHING_MEASURED
    sigmas = (m.range_sigma_m, m.bearing_sigma_rad, m.elevation_sigma_rad)
    measured = [v for v in (*values, m.elevation_rad, *sigmas) if v is not None]
    if not all(map(math.isfinite, (*measured, m.measured_at_s))):
        return Refusal.NOT_FINITE
    if any(0.0 < abs(number) < LEAST_NORMAL for number in measured):
        return Refusal.DENORMAL
    if m.range_m is not None and m.range_m <= 0.0:
        return Refusal.RANGE_NOT_POSITIVE
    if m.range_m is not None and m.range_m > params.max_range_m:
        return Refusal.RANGE_ABSURD
    bearings = (m.bearing_enu_rad, m.bearing_body_rad)
    if any(b is not None and abs(b) > MAX_BEARING_RAD for b in bearings):
        return Refusal.BEARING_ABSURD
    if m.elevation_rad is not None and abs(m.elevation_rad) > MAX_ELEVATION_RAD:
        return Refusal.ELEVATION_ABSURD
    if any(sigma is not None and sigma <= 0.0 for sigma in sigmas):
        return Refusal.SIGMA_NOT_POSITIVE
    if m.measured_at_s > now_s + FUTURE_TOLERANCE_S:
        return Refusal.FROM_THE_FUTURE
    if now_s - m.measured_at_s > params.max_age_s:
        return Refusal.STALE
    return None


def identity_of(measurement: RangingMeasurement) -> Hashable:
    """What two copies of one measurement share: the stamp alone is shared by range and bearing.

    Not the bearing that was turned from the body frame, because a copy may see a later yaw.
    """
    m = measurement
    bearing_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
    stamp = m.measured_at_s if m.stamp_us is None else m.stamp_us
    return (stamp, m.range_m, bearing_rad, m.elevation_rad)
