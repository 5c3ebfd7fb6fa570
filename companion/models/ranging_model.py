"""What the filter believes about a measurement: range and bearing of a target at a known height.

The state is [east, north, range offset, bearing offset]; the measurement is

    range    = |target - sensor| + range offset      (slant, the height difference is known)
    bearing  = atan2(north difference, east difference) + bearing offset

Paper: eq. (1) with h of the range lifted to the flown altitude, because a radio measures slant
range (the paper works in the plane of flight).
"""

from __future__ import annotations

import math

import numpy as np

from companion.geometry.arrays import Vector
from companion.kernel import kernel

RANGE_OFFSET, BEARING_OFFSET = 2, 3
"""Places of the offsets in the state, after east and north."""

MIN_RANGE_M = 1e-3
"""Closer than this the direction to the target has no meaning."""


@kernel
def predicted_range(mean: Vector, sensor_enu_m: Vector, target_height_m: float) -> float:
    """Slant range plus offset, metres. Args: mean (4,); sensor_enu_m (3,)."""
    de, dn = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    du = target_height_m - sensor_enu_m[2]
    return math.sqrt(de * de + dn * dn + du * du) + float(mean[2])


@kernel
def range_jacobian(mean: Vector, sensor_enu_m: Vector, target_height_m: float) -> Vector:
    """Partials of the range by the state, (4,); zero position part at zero range."""
    row = np.zeros(4)
    de, dn = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    du = target_height_m - sensor_enu_m[2]
    slant = math.sqrt(de * de + dn * dn + du * du)
    if slant > 1e-3:
        row[0] = de / slant
        row[1] = dn / slant
    row[2] = 1.0
    return row


@kernel
def predicted_bearing(mean: Vector, sensor_enu_m: Vector) -> float:
    """Bearing plus offset, radians counter-clockwise from east, not wrapped."""
    return math.atan2(mean[1] - sensor_enu_m[1], mean[0] - sensor_enu_m[0]) + float(mean[3])


@kernel
def bearing_jacobian(mean: Vector, sensor_enu_m: Vector) -> Vector:
    """Partials of the bearing by the state, (4,); zero position part right overhead."""
    row = np.zeros(4)
    de, dn = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    ground2 = de * de + dn * dn
    if ground2 > 1e-6:
        row[0] = -dn / ground2
        row[1] = de / ground2
    row[3] = 1.0
    return row


@kernel
def range_variance(
    P: Vector,
    mean: Vector,
    sensor_enu_m: Vector,
    target_height_m: float,
    sigma_m: float,
    own_sigma_m: float,
    second_order: bool,
) -> float:
    """Variance of a range about the model, m^2: radio noise, own position, curvature.

    The curvature term (tr P / 2r)^2 is the spread of the range's second-order part; without it an
    EKF believes a linearisation that is meaningless near the target and diverges.
    """
    variance = sigma_m * sigma_m + own_sigma_m * own_sigma_m
    if second_order:
        de, dn = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
        du = target_height_m - sensor_enu_m[2]
        slant2 = max(de * de + dn * dn + du * du, 1e-6)
        trace = float(P[0, 0] + P[1, 1])
        variance += trace * trace / (4.0 * slant2)
    return variance


@kernel
def bearing_variance(
    P: Vector,
    mean: Vector,
    sensor_enu_m: Vector,
    sigma_rad: float,
    own_sigma_m: float,
    second_order: bool,
) -> float:
    """Variance of a bearing about the model, rad^2: radio noise, own position, curvature.

    The own position counts by the angle it spans from the target; the curvature term is
    (tr P / r^2)^2 with r along the ground.
    """
    de, dn = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    ground2 = max(float(de * de + dn * dn), 1e-6)
    variance = sigma_rad * sigma_rad + own_sigma_m * own_sigma_m / ground2
    if second_order:
        trace = float(P[0, 0] + P[1, 1])
        spread_rad = trace / ground2
        variance += spread_rad * spread_rad
    return variance
