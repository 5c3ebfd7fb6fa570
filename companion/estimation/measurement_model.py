"""What a filter believes about a measurement: slant range, bearing and elevation of one target.

The state is [east, north, range offset, bearing offset], followed by a range scale and by the
target's height where these are not known:

    range       (1 + scale) |target - sensor| + range offset        slant
    bearing     atan2(north difference, east difference) + bearing offset
    elevation   atan2(height difference, ground range)

A measurement is three numbers in that order, NaN where nothing was measured: inside the kernels
they are one array. With a known height and no elevation the arithmetic is that of the plane.

Paper: eq. (1) with h of the range lifted to the flown altitude, because a radio measures slant
range (the paper works in the plane of flight). Deviations: scale, height and elevation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.kernel import Matrix, Vector, kernel

EAST, NORTH, RANGE_OFFSET, BEARING_OFFSET = 0, 1, 2, 3
"""Places in the state that always exist."""

RANGE, BEARING = 0, 1
"""Rows of a measurement; the third is the elevation."""
MODALITIES = 3

ABSENT = -1
"""Index of a component that is not part of the state."""

MIN_RANGE_M = 1e-3
"""Closer than this the direction to the target has no meaning."""


class RangingModel(NamedTuple):
    """The constants of the model, as the kernels take them."""

    height_m: float
    """Height of the target above the local origin, where it is not in the state."""
    height_index: int
    """Place of the height in the state, or `ABSENT`."""
    scale_index: int
    """Place of the range scale in the state, or `ABSENT`."""
    own_sigma_m: float
    """How well the vehicle knows its own place, per axis."""
    near_target_terms: bool
    """Whether variances contain the second-order terms."""
    bearing_inflation: float = 1.0
    """How much worse than thermal bearings are. The own position's error does not grow with that,
    so that it counts for less beside them."""


@kernel
def target_height_m(mean: Vector, model: RangingModel) -> float:
    """Height of the target above the local origin, estimated or known."""
    if model.height_index >= 0:
        return float(mean[model.height_index])
    return model.height_m


@kernel
def range_factor(mean: Vector, model: RangingModel) -> float:
    """What the true distance is multiplied by."""
    if model.scale_index >= 0:
        return 1.0 + float(mean[model.scale_index])
    return 1.0


@kernel
def predicted(mean: Vector, sensor_enu_m: Vector, model: RangingModel) -> Vector:
    """Range, bearing and elevation expected, (3,), of a state; metres, radians, not wrapped."""
    de = float(mean[0]) - float(sensor_enu_m[0])
    dn = float(mean[1]) - float(sensor_enu_m[1])
    du = target_height_m(mean, model) - float(sensor_enu_m[2])
    ground = math.sqrt(de * de + dn * dn)
    slant = math.sqrt(de * de + dn * dn + du * du)
    z = np.empty(3)
    z[0] = range_factor(mean, model) * slant + mean[2]
    z[1] = math.atan2(dn, de) + mean[3]
    z[2] = math.atan2(du, ground)
    return z


@kernel
def jacobian(mean: Vector, sensor_enu_m: Vector, model: RangingModel) -> Matrix:
    """Partials by the state, (3, n); the position's are zero where a direction has no meaning."""
    de = float(mean[0]) - float(sensor_enu_m[0])
    dn = float(mean[1]) - float(sensor_enu_m[1])
    du = target_height_m(mean, model) - float(sensor_enu_m[2])
    ground2 = de * de + dn * dn
    slant2 = ground2 + du * du
    H = np.zeros((3, mean.size))
    H[0, 2] = 1.0
    H[1, 3] = 1.0
    if model.scale_index >= 0:
        H[0, model.scale_index] = math.sqrt(slant2)
    if slant2 > MIN_RANGE_M * MIN_RANGE_M:
        by_slant = range_factor(mean, model) / math.sqrt(slant2)
        H[0, 0] = de * by_slant
        H[0, 1] = dn * by_slant
        if model.height_index >= 0:
            H[0, model.height_index] = du * by_slant
            H[2, model.height_index] = math.sqrt(ground2) / slant2
    if ground2 > MIN_RANGE_M * MIN_RANGE_M:
        H[1, 0] = -dn / ground2
        H[1, 1] = de / ground2
        down = -du / (slant2 * math.sqrt(ground2))
        H[2, 0] = de * down
        H[2, 1] = dn * down
    return H


@kernel
def variances(
    P: Matrix, mean: Vector, sensor_enu_m: Vector, sigma: Vector, model: RangingModel
) -> Vector:
    """Variances of range, bearing and elevation about the model, (3,), m^2 and rad^2.

    Radio noise `sigma` (3,), the vehicle's own position (for angles by the angle it spans from the
    target), and the spread of the model's second-order part: (tr P / 2r)^2 for the range,
    (tr P / r^2)^2 with r along the ground for the bearing. Without these an EKF believes a
    linearisation that is meaningless near the target, and diverges. The elevation's cone above the
    target is as sharp.
    """
    de = float(mean[0]) - float(sensor_enu_m[0])
    dn = float(mean[1]) - float(sensor_enu_m[1])
    du = target_height_m(mean, model) - float(sensor_enu_m[2])
    ground2 = max(de * de + dn * dn, MIN_RANGE_M * MIN_RANGE_M)
    slant2 = max(de * de + dn * dn + du * du, MIN_RANGE_M * MIN_RANGE_M)
    own2 = model.own_sigma_m * model.own_sigma_m
    R = sigma * sigma
    R[0] += own2
    R[1] += own2 / ground2
    R[2] += own2 / slant2
    if model.near_target_terms:
        trace = float(P[0, 0] + P[1, 1])
        R[1] += (trace / ground2) ** 2
        if model.height_index >= 0:
            trace += float(P[model.height_index, model.height_index])
        R[0] += trace * trace / (4.0 * slant2)
        R[2] += (trace / slant2 * (1.0 + 0.5 * abs(du) / math.sqrt(ground2))) ** 2
    return R
