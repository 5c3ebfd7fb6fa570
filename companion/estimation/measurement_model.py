"""What a filter believes about a measurement: slant range, bearing and elevation of one target.

The state is [east, north, range offset, bearing offset], followed by a range scale and by the
target's height where these are not known:

    range       (1 + scale) |target - sensor| + range offset        slant
    bearing     atan2(north difference, east difference) + bearing offset
    elevation   atan2(height difference, ground range)

A measurement is three numbers in that order, NaN where nothing was measured: inside the kernels
they are one array. With a known height and no elevation the arithmetic is that of the plane.

An antenna array does not measure an azimuth about the vertical. It measures the components of u,
the unit vector to the target, along axes a and b of its own, which the vehicle's attitude turns.
Then the bearing's and the elevation's place hold, with R(c) the turn by the bearing offset c,

    planar array      atan2(b . R(c) u, a . R(c) u)      its azimuth, clockwise from a to b
    any other         a . R(c) u   and   b . R(c) u      direction cosines

with noise s on each component. An azimuth's is s / rho then, with rho the length of u in the plane
of the array: nothing near its normal. There, where s / rho is no small angle, a phase says less
than its variance, by 1 + (s / rho)^2 to a good approximation (that of a Rician phase).

Paper: eq. (1) with h of the range lifted to the flown altitude, because a radio measures slant
range (the paper works in the plane of flight). Deviations: scale, height, elevation and arrays.
Source of the arrays: H. L. Van Trees, Optimum Array Processing (2002), chapters 2 and 4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.kernel import Matrix, Vector, kernel

EAST, NORTH, RANGE_OFFSET, BEARING_OFFSET = 0, 1, 2, 3
"""Places in the state that always exist."""

RANGE, BEARING, ELEVATION = 0, 1, 2
"""Rows of a measurement; of direction cosines the last two."""
MODALITIES = 3

ABSENT = -1
"""Index of a component that is not part of the state."""

MIN_RANGE_M = 1e-3
"""Closer than this the direction to the target has no meaning."""

AZIMUTH, PLANAR, COSINES = 0, 1, 2
"""What stands in the bearing's place: an azimuth about the vertical, as the paper has it, that of a
planar array in its own plane, or direction cosines."""
FIRST_AXIS, SECOND_AXIS, POSE_SIZE = 3, 6, 9
"""Where a sensor's pose has its antenna's axes, behind its place."""
MIN_SINE2 = 1e-6
"""Nearer to a planar array's normal than its root, an azimuth has no meaning."""


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
    antenna: int = AZIMUTH
    """`AZIMUTH`, `PLANAR` or `COSINES`."""
    range_share: float = 1.0
    """What a range is worth in the window's objective, as a share of an independent one."""
    direction_share: float = 1.0


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
def cosines(de: float, dn: float, du: float, turn_rad: float, pose: Vector) -> tuple[float, float]:
    """Components along the antenna's axes of the unit vector (de, dn, du), turned by `turn_rad`."""
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    east, north = c * de - s * dn, s * de + c * dn
    return (
        float(pose[3] * east + pose[4] * north + pose[5] * du),
        float(pose[6] * east + pose[7] * north + pose[8] * du),
    )


@kernel
def predicted(mean: Vector, sensor_enu_m: Vector, model: RangingModel) -> Vector:
    """Range, bearing and elevation expected, (3,), of a state; metres, radians, not wrapped.

    The sensor is its place, (3,), or with an antenna array its pose, (9,): place and two axes.
    """
    de = float(mean[0]) - float(sensor_enu_m[0])
    dn = float(mean[1]) - float(sensor_enu_m[1])
    du = target_height_m(mean, model) - float(sensor_enu_m[2])
    ground = math.sqrt(de * de + dn * dn)
    slant = math.sqrt(de * de + dn * dn + du * du)
    z = np.empty(3)
    z[0] = range_factor(mean, model) * slant + mean[2]
    if model.antenna == AZIMUTH:
        z[1] = math.atan2(dn, de) + mean[3]
        z[2] = math.atan2(du, ground)
        return z
    unit = 1.0 / max(slant, MIN_RANGE_M)
    z[1], z[2] = cosines(de * unit, dn * unit, du * unit, float(mean[3]), sensor_enu_m)
    if model.antenna == PLANAR:
        z[1] = math.atan2(z[2], z[1])
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
    if model.antenna != AZIMUTH:
        fill_array_partials(H, mean, de, dn, du, sensor_enu_m, model)
    elif ground2 > MIN_RANGE_M * MIN_RANGE_M:
        H[1, 0] = -dn / ground2
        H[1, 1] = de / ground2
        down = -du / (slant2 * math.sqrt(ground2))
        H[2, 0] = de * down
        H[2, 1] = dn * down
    return H


@kernel
def fill_array_partials(
    H: Matrix,
    mean: Vector,
    de: float,
    dn: float,
    du: float,
    pose: Vector,
    model: RangingModel,
) -> None:
    """The rows of H, (3, n), of an array: those of its cosines, or of its azimuth."""
    slant = max(math.sqrt(de * de + dn * dn + du * du), MIN_RANGE_M)
    e, n, up = de / slant, dn / slant, du / slant
    c, s = math.cos(mean[3]), math.sin(mean[3])
    H[1, :] = 0.0
    H[2, :] = 0.0
    for row in range(2):
        axis = pose[3 + 3 * row : 6 + 3 * row]
        east, north = c * axis[0] + s * axis[1], c * axis[1] - s * axis[0]
        cosine = east * e + north * n + axis[2] * up
        H[1 + row, 0] = (east - cosine * e) / slant
        H[1 + row, 1] = (north - cosine * n) / slant
        H[1 + row, 3] = north * e - east * n
        if model.height_index >= 0:
            H[1 + row, model.height_index] = (axis[2] - cosine * up) / slant
    if model.antenna == PLANAR:
        x, y = cosines(e, n, up, float(mean[3]), pose)
        H[1, :] = (x * H[2] - y * H[1]) / max(x * x + y * y, MIN_SINE2)
        H[2, :] = 0.0


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
    if model.antenna != AZIMUTH:
        return array_variances(P, mean, sensor_enu_m, sigma, model)
    ranged, borne, elevated = float(sigma[0]), float(sigma[1]), float(sigma[2])
    ranged = ranged * ranged + own2
    borne = borne * borne + own2 / ground2
    elevated = elevated * elevated + own2 / slant2
    if model.near_target_terms:
        trace = float(P[0, 0]) + float(P[1, 1])
        bend = trace / ground2
        borne += bend * bend
        if model.height_index >= 0:
            trace += float(P[model.height_index, model.height_index])
        ranged += trace * trace / (4.0 * slant2)
        bend = trace / slant2 * (1.0 + 0.5 * abs(du) / math.sqrt(ground2))
        elevated += bend * bend
    R = np.empty(3)
    R[0], R[1], R[2] = ranged, borne, elevated
    return R


@kernel
def array_variances(
    P: Matrix, mean: Vector, pose: Vector, sigma: Vector, model: RangingModel
) -> Vector:
    """The same as `variances` for an antenna array; `sigma` of a component, (3,)."""
    de = float(mean[0]) - float(pose[0])
    dn = float(mean[1]) - float(pose[1])
    du = target_height_m(mean, model) - float(pose[2])
    slant2 = max(de * de + dn * dn + du * du, MIN_RANGE_M * MIN_RANGE_M)
    own2 = model.own_sigma_m * model.own_sigma_m
    trace = 0.0
    if model.near_target_terms:
        trace = float(P[0, 0] + P[1, 1])
        if model.height_index >= 0:
            trace += float(P[model.height_index, model.height_index])
    R = sigma * sigma
    R[0] += own2 + trace * trace / (4.0 * slant2)
    view2 = slant2
    if model.antenna == PLANAR:
        unit = 1.0 / math.sqrt(slant2)
        x, y = cosines(de * unit, dn * unit, du * unit, float(mean[3]), pose)
        sine2 = max(x * x + y * y, MIN_SINE2)
        view2 = slant2 * sine2
        R[1] /= sine2
        R[1] *= 1.0 + R[1]  # what a phase that is no small angle says less
    R[1] += own2 / view2 + (trace / view2) ** 2
    R[2] += own2 / slant2 + (trace / slant2) ** 2
    return R
