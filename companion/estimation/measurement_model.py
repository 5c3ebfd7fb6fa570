"""Measurement model: slant range, bearing and elevation of one target, h(x), H and R.

The state is [east, north, range offset, bearing offset], followed by a range scale and by the
target's height where these are not known:

    range       (1 + scale) |target - sensor| + range offset        slant
    bearing     atan2(north difference, east difference) + bearing offset
    elevation   atan2(height difference, ground range)

A measurement is three numbers in that order, NaN where nothing was measured: inside the kernels
they are one array. With a known height and no elevation the geometry is that of the plane.

An antenna array does not measure an azimuth about the vertical. It measures the components of u,
the unit vector to the target, along its own axes a and b, which turn with the vehicle's attitude.
The rows of bearing and elevation then hold, with R(c) the rotation by the bearing offset c,

    planar array      atan2(b . R(c) u, a . R(c) u)      its azimuth, clockwise from a to b
    any other         a . R(c) u   and   b . R(c) u      direction cosines

with noise s on each component. The noise of an azimuth is then s / rho, with rho the length of u in
the plane of the array: near its normal an azimuth has no information. Where s / rho is no small
angle, a phase has less information than its variance suggests, by 1 + (s / rho)^2 to a good
approximation (that of a Rician phase).

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
"""Indices of the state that always exist."""

RANGE, BEARING, ELEVATION = 0, 1, 2
"""Rows of a measurement; an array's direction cosines are in the last two."""
MODALITIES = 3
"""Number of rows of a measurement."""

ABSENT = -1
"""Index of a component that is not part of the state."""

MIN_RANGE_M = 1e-3
"""Distance below which the direction to the target is undefined."""

AZIMUTH, PLANAR, COSINES = 0, 1, 2
"""Content of the bearing row: an azimuth about the vertical, as in the paper, the azimuth of a
planar array in its own plane, or direction cosines."""
FIRST_AXIS = 3
"""Index of an antenna's first axis in a sensor's pose, behind the position."""
MIN_SINE2 = 1e-6
"""Lower limit of the squared sine of the angle to a planar array's normal, where an azimuth is
undefined."""


class RangingModel(NamedTuple):
    """Constants of the model, as the kernels take them."""

    height_m: float
    """Height of the target above the local origin, if it is not in the state."""
    height_index: int
    """Index of the height in the state, or `ABSENT`."""
    scale_index: int
    """Index of the range scale in the state, or `ABSENT`."""
    own_sigma_m: float
    """Standard deviation of the vehicle position, per axis."""
    near_target_terms: bool
    """True if variances contain the second-order terms."""
    bearing_inflation: float = 1.0
    """Variance of bearings over thermal noise. The vehicle's position error does not grow with it,
    so that it counts for less beside inflated bearings."""
    antenna: int = AZIMUTH
    """`AZIMUTH`, `PLANAR` or `COSINES`."""
    range_share: float = 1.0
    """Weight of a range in the window's objective, as a share of an independent one."""
    direction_share: float = 1.0
    """The same weight of a direction."""


@kernel
def target_height_m(mean: Vector, model: RangingModel) -> float:
    """Return the height of the target above the local origin, estimated or configured, metres."""
    if model.height_index >= 0:
        return float(mean[model.height_index])
    return model.height_m


@kernel
def range_factor(mean: Vector, model: RangingModel) -> float:
    """Return the factor on the true distance, 1 + scale."""
    if model.scale_index >= 0:
        return 1.0 + float(mean[model.scale_index])
    return 1.0


@kernel
def cosines(de: float, dn: float, du: float, turn_rad: float, pose: Vector) -> tuple[float, float]:
    """Return the unit vector (de, dn, du), turned by `turn_rad`, along the antenna's two axes."""
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    east, north = c * de - s * dn, s * de + c * dn
    return (
        float(pose[3] * east + pose[4] * north + pose[5] * du),
        float(pose[6] * east + pose[7] * north + pose[8] * du),
    )


@kernel
def predicted(mean: Vector, sensor_enu_m: Vector, model: RangingModel) -> Vector:
    """Return the range, bearing and elevation, (3,), of a state; metres and radians, not wrapped.

    The sensor is its position, (3,), or with an antenna array its pose, (9,): position and two
    axes.
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
    """Return the partials by the state, (3, n); zero where a direction is undefined."""
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
    """Fill the direction rows of H, (3, n), with an array's partials (cosines or azimuth)."""
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
    """Return the variances of range, bearing and elevation about the model, (3,), m^2 and rad^2.

    They contain the radio's noise `sigma` (3,), the vehicle's position error (for angles, the angle
    that it subtends at the target), and the spread of the model's second-order part: (tr P / 2r)^2
    for the range, (tr P / r^2)^2 with the ground range r for the bearing. Without these an EKF
    trusts a linearisation that is meaningless near the target, and diverges. The elevation is as
    nonlinear right above the target.
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
    """Return the variances as in `variances` for an antenna array; `sigma` of a component, (3,)."""
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
        R[1] *= 1.0 + R[1]  # Rician phase: a large angle carries less information than its variance
    R[1] += own2 / view2 + (trace / view2) ** 2
    R[2] += own2 / slant2 + (trace / slant2) ** 2
    return R
