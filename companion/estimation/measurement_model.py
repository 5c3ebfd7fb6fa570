"""Measurement model: range, bearing, elevation and received power of one target, h(x), H and R.

The state is [east, north, range offset, bearing offset], followed by a range scale and by the
target's height where these are not known, and by the power at 1 m, P0 in dBm, and the path-loss
exponent n where power is used:

    range       (1 + scale) |target - sensor| + range offset        slant
    bearing     atan2(north difference, east difference) + bearing offset
    elevation   atan2(height difference, ground range)
    power       P0 - 10 n log10(|target - sensor| / 1 m)             slant

A measurement is three or, in a model with P0, four numbers in that order, NaN where nothing was
measured: inside the kernels they are one array. With a known height and no elevation the geometry
is that of the plane.

This module is the only definition of h, H and R. Each function takes one measurement, a pose (3,)
or (9,), or n of them at once, a pose (3, n) or (9, n), and its result has the same last axis: the
filters update with one, the window solves and planners compare many. The first axis of a result is
the modality; only the leading ones that it has room for are computed.

An antenna array does not measure an azimuth about the vertical. It measures the components of u,
the unit vector to the target, along its own axes a and b, which turn with the vehicle's attitude.
The rows of bearing and elevation then hold, with R(c) the rotation by the bearing offset c,

    planar array      atan2(b . R(c) u, a . R(c) u)      its azimuth, clockwise from a to b
    any other         a . R(c) u   and   b . R(c) u      direction cosines

with noise s on each component. The noise of an azimuth is then s / rho, with rho the length of u in
the plane of the array: near its normal an azimuth has no information. Where s / rho is not a
small angle, a phase has less information than its variance suggests, by 1 + (s / rho)^2 to a good
approximation (that of a Rician phase).

Obstruction makes a range longer and a signal weaker, never the reverse, so that power has the same
one-sided loss as ranges, on the side of weak signals.

Paper: eq. (1), in the plane of flight. Deviations: slant range, which is what a radio measures,
scale, height, elevation, power and arrays. Sources: T. S. Rappaport, Wireless Communications
(2002), section 4.9, for power; H. L. Van Trees, Optimum Array Processing (2002), chapters 2 and 4.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from companion.estimation.number_or_array import (
    arctan2,
    components,
    larger,
    natural_log,
    root,
    wrapped,
)
from companion.kernel import Matrix, Vector, kernel

EAST, NORTH, RANGE_OFFSET, BEARING_OFFSET = 0, 1, 2, 3
"""Indices of the state that always exist."""

RANGE, BEARING, ELEVATION, POWER = 0, 1, 2, 3
"""Rows of a measurement; an array's direction cosines are in the second and third."""
MODALITIES = 3
"""Number of rows of a measurement without power; `rows_of` is the number of a model."""
POSSIBLE_SIDE = {RANGE: 1.0, POWER: -1.0}
"""Sign of the innovations that obstruction can cause: longer ranges, weaker signals."""

ABSENT = -1
"""Index of a component that is not part of the state."""
DB_PER_NEPER = 10.0 / math.log(10.0)
"""dB of power for each unit of its natural logarithm."""

NEAREST2_M2 = 0.05**2
"""Lower limit of squared distances where they divide: a direction to a target nearer than the
accuracy of any vehicle position is undefined."""

AZIMUTH, PLANAR, COSINES = 0, 1, 2
"""Content of the bearing row: an azimuth about the vertical, as in the paper, the azimuth of a
planar array in its own plane, or direction cosines."""
MIN_SINE2 = 1e-6
"""Lower limit of the squared sine of the angle to a planar array's normal, where an azimuth is
undefined: 0.06 degrees, far below any antenna's accuracy."""


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
    so that its relative effect is smaller with inflated bearings."""
    antenna: int = AZIMUTH
    """`AZIMUTH`, `PLANAR` or `COSINES`."""
    range_share: float = 1.0
    """Weight of a range in the window's objective, as a share of an independent one."""
    direction_share: float = 1.0
    """Weight of a direction, as a share of an independent one."""
    power_index: int = ABSENT
    """Index of P0 in the state, which the exponent follows, or `ABSENT`."""


@kernel
def rows_of(model: RangingModel) -> int:
    """Return the number of rows of a measurement, 3, or 4 with power."""
    return MODALITIES + 1 if model.power_index >= 0 else MODALITIES


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


class Sight(NamedTuple):
    """Line from sensor to target: numbers for one measurement, arrays (n,) for many."""

    east_m: Any
    north_m: Any
    up_m: Any
    ground2_m2: Any
    slant2_m2: Any


@kernel
def sight_of(mean: Vector, pose: Matrix, model: RangingModel) -> Sight:
    """Return the line to a target at `mean` from a sensor's pose, (3 or 9,) or (3 or 9, n)."""
    m, p = components(mean), components(pose)
    de, dn, du = m[0] - p[0], m[1] - p[1], target_height_m(mean, model) - p[2]
    ground2 = de * de + dn * dn
    return Sight(de, dn, du, ground2, ground2 + du * du)


@kernel
def cosines(sight: Sight, mean: Vector, pose: Matrix) -> tuple[Any, Any]:
    """Return the unit vector to the target, turned by the bearing offset, along both axes."""
    p, turn_rad = components(pose), float(mean[BEARING_OFFSET])
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    east = c * sight.east_m - s * sight.north_m
    north = s * sight.east_m + c * sight.north_m
    slant = root(larger(sight.slant2_m2, NEAREST2_M2))
    first = (p[3] * east + p[4] * north + p[5] * sight.up_m) / slant
    return first, (p[6] * east + p[7] * north + p[8] * sight.up_m) / slant


@kernel
def sine2_off_normal(sight: Sight, mean: Vector, pose: Matrix) -> Any:
    """Return the squared sine of the angle to a planar array's normal, limited below."""
    x, y = cosines(sight, mean, pose)
    return larger(x * x + y * y, MIN_SINE2)


@kernel
def fill_predicted(
    z: Matrix, sight: Sight, mean: Vector, pose: Matrix, model: RangingModel
) -> None:
    """Fill the first modalities of z, (m,) or (m, n), as a state predicts them, not wrapped."""
    z[RANGE] = range_factor(mean, model) * root(sight.slant2_m2) + float(mean[RANGE_OFFSET])
    if z.shape[0] > POWER:
        # 10 log10(slant) is half of 10 log10(slant^2)
        loss_db = 0.5 * DB_PER_NEPER * natural_log(larger(sight.slant2_m2, NEAREST2_M2))
        p0, exponent = float(mean[model.power_index]), float(mean[model.power_index + 1])
        z[POWER] = p0 - exponent * loss_db
    if z.shape[0] == 1:
        return
    if model.antenna == AZIMUTH:
        z[BEARING] = arctan2(sight.north_m, sight.east_m) + float(mean[BEARING_OFFSET])
        if z.shape[0] > ELEVATION:
            z[ELEVATION] = arctan2(sight.up_m, root(sight.ground2_m2))
        return
    x, y = cosines(sight, mean, pose)
    z[BEARING] = arctan2(y, x) if model.antenna == PLANAR else x
    if z.shape[0] > ELEVATION:
        z[ELEVATION] = y


@kernel
def predicted(mean: Vector, pose: Vector, model: RangingModel) -> Vector:
    """Return the values that a state predicts, (3 or 4,); metres, radians, dBm, not wrapped.

    The pose is the sensor's position, (3,), or with an antenna array also its two axes, (9,).
    """
    z = np.empty(rows_of(model))
    fill_predicted(z, sight_of(mean, pose, model), mean, pose, model)
    return z


@kernel
def innovations_of(
    z: Matrix, sight: Sight, mean: Vector, pose: Matrix, model: RangingModel
) -> Matrix:
    """Return measured minus predicted, of the shape of z, (m,) or (m, n); angles wrapped.

    NaN where not measured.
    """
    y = np.empty(z.shape)
    fill_predicted(y, sight, mean, pose, model)
    y = z - y
    if z.shape[0] > BEARING and model.antenna != COSINES:
        y[BEARING] = wrapped(y[BEARING])
    return y


@kernel
def innovations(z: Matrix, mean: Vector, pose: Matrix, model: RangingModel) -> Matrix:
    """Return `innovations_of` measurements from these poses."""
    return innovations_of(z, sight_of(mean, pose, model), mean, pose, model)


@kernel
def range_partials(sight: Sight, factor: float) -> tuple[Any, Any]:
    """Return the partials of a range by east and north; its factor is 1 + scale."""
    by_slant = factor / root(larger(sight.slant2_m2, NEAREST2_M2))
    return sight.east_m * by_slant, sight.north_m * by_slant


@kernel
def azimuth_partials(sight: Sight) -> tuple[Any, Any]:
    """Return the partials of an azimuth by east and north, radians per metre."""
    ground2 = larger(sight.ground2_m2, NEAREST2_M2)
    return -sight.north_m / ground2, sight.east_m / ground2


@kernel
def fill_partials(H: Matrix, sight: Sight, mean: Vector, pose: Matrix, model: RangingModel) -> None:
    """Fill the partials by the state, (m, k) or (m, k, n), which are zero before."""
    de, dn, du = sight.east_m, sight.north_m, sight.up_m
    H[RANGE, EAST], H[RANGE, NORTH] = range_partials(sight, range_factor(mean, model))
    H[RANGE, RANGE_OFFSET] = 1.0
    if model.scale_index >= 0:
        H[RANGE, model.scale_index] = root(sight.slant2_m2)
    if model.height_index >= 0:
        slant = root(larger(sight.slant2_m2, NEAREST2_M2))
        H[RANGE, model.height_index] = du * (range_factor(mean, model) / slant)
    if H.shape[0] > POWER:
        fill_power_partials(H, sight, mean, model)
    if H.shape[0] == 1:
        return
    if model.antenna != AZIMUTH:
        fill_array_partials(H, sight, mean, pose, model)
        return
    H[BEARING, EAST], H[BEARING, NORTH] = azimuth_partials(sight)
    H[BEARING, BEARING_OFFSET] = 1.0
    if H.shape[0] > ELEVATION:
        ground2 = larger(sight.ground2_m2, NEAREST2_M2)
        ground, slant2 = root(ground2), ground2 + du * du
        down = -du / (slant2 * ground)
        H[ELEVATION, EAST] = de * down
        H[ELEVATION, NORTH] = dn * down
        if model.height_index >= 0:
            H[ELEVATION, model.height_index] = root(sight.ground2_m2) / slant2


@kernel
def fill_power_partials(H: Matrix, sight: Sight, mean: Vector, model: RangingModel) -> None:
    """Fill the row of received power of H with its partials by the state."""
    index, slant2 = model.power_index, larger(sight.slant2_m2, NEAREST2_M2)
    by_slant2 = -DB_PER_NEPER * float(mean[index + 1]) / slant2
    H[POWER, EAST] = sight.east_m * by_slant2
    H[POWER, NORTH] = sight.north_m * by_slant2
    if model.height_index >= 0:
        H[POWER, model.height_index] = sight.up_m * by_slant2
    H[POWER, index] = 1.0
    H[POWER, index + 1] = -0.5 * DB_PER_NEPER * natural_log(slant2)


@kernel
def jacobian(mean: Vector, pose: Vector, model: RangingModel) -> Matrix:
    """Return the partials by the state, (3 or 4, k); zero where a direction is undefined."""
    H = np.zeros((rows_of(model), mean.size))
    fill_partials(H, sight_of(mean, pose, model), mean, pose, model)
    return H


@kernel
def fill_array_partials(
    H: Matrix, sight: Sight, mean: Vector, pose: Matrix, model: RangingModel
) -> None:
    """Fill the direction rows of H with an antenna array's partials (cosines or azimuth)."""
    p = components(pose)
    slant = root(larger(sight.slant2_m2, NEAREST2_M2))
    e, n, up = sight.east_m / slant, sight.north_m / slant, sight.up_m / slant
    c, s = math.cos(mean[BEARING_OFFSET]), math.sin(mean[BEARING_OFFSET])
    x, y = cosines(sight, mean, pose)
    first, second = np.zeros(H.shape[1:]), np.zeros(H.shape[1:])
    for axis in range(2):
        by_state, cosine = (first, x) if axis == 0 else (second, y)
        axis_e, axis_n, axis_up = p[3 + 3 * axis], p[4 + 3 * axis], p[5 + 3 * axis]
        east, north = c * axis_e + s * axis_n, c * axis_n - s * axis_e
        by_state[EAST] = (east - cosine * e) / slant
        by_state[NORTH] = (north - cosine * n) / slant
        by_state[BEARING_OFFSET] = north * e - east * n
        if model.height_index >= 0:
            by_state[model.height_index] = (axis_up - cosine * up) / slant
    if model.antenna == PLANAR:
        H[BEARING] = (x * second - y * first) / larger(x * x + y * y, MIN_SINE2)
        return
    H[BEARING] = first
    if H.shape[0] > ELEVATION:
        H[ELEVATION] = second


@kernel
def range_bend_m2(space_m2: float, sight: Sight) -> Any:
    """Return the variance of a range by the model's second-order part, see `add_second_order`."""
    return space_m2 * space_m2 / (4.0 * larger(sight.slant2_m2, NEAREST2_M2))


@kernel
def azimuth_bend_rad2(ground_m2: float, sight: Sight) -> Any:
    """Return the variance of an azimuth by the model's second-order part."""
    bend = ground_m2 / larger(sight.ground2_m2, NEAREST2_M2)
    return bend * bend


@kernel
def fill_noise(
    R: Matrix, sigma: Matrix, sight: Sight, mean: Vector, pose: Matrix, model: RangingModel
) -> None:
    """Fill the variances R, (m,) or (m, n), with those of radio and vehicle position.

    `sigma` of the radio has at least the modalities of R. The position error is for angles the one
    that it subtends at the target. Where bearings are inflated it is scaled down accordingly:
    otherwise it would excuse any bearing to a target near the vehicle.
    """
    own2 = model.own_sigma_m * model.own_sigma_m
    R[RANGE] = sigma[RANGE] * sigma[RANGE] + own2
    if R.shape[0] > POWER:
        per_share2 = (DB_PER_NEPER * float(mean[model.power_index + 1])) ** 2
        subtended2 = own2 / larger(sight.slant2_m2, NEAREST2_M2)
        R[POWER] = sigma[POWER] * sigma[POWER] + per_share2 * subtended2
    if R.shape[0] == 1:
        return
    share2 = own2 / model.bearing_inflation
    slant2 = larger(sight.slant2_m2, NEAREST2_M2)
    thermal = sigma[BEARING] * sigma[BEARING]
    if model.antenna == AZIMUTH:
        R[BEARING] = thermal + share2 / larger(sight.ground2_m2, NEAREST2_M2)
    elif model.antenna == PLANAR:
        sine2 = sine2_off_normal(sight, mean, pose)
        thermal = thermal / sine2
        # Rician phase: a large angle carries less information than its variance
        R[BEARING] = thermal * (1.0 + thermal) + share2 / (slant2 * sine2)
    else:
        R[BEARING] = thermal + share2 / slant2
    if R.shape[0] > ELEVATION:
        subtended2 = own2 / slant2 if model.antenna == AZIMUTH else share2 / slant2
        R[ELEVATION] = sigma[ELEVATION] * sigma[ELEVATION] + subtended2


@kernel
def add_second_order(
    R: Matrix,
    ground_m2: float,
    space_m2: float,
    sight: Sight,
    mean: Vector,
    pose: Matrix,
    model: RangingModel,
) -> None:
    """Add the spread of the model's second-order part to the variances R, (m,) or (m, n).

    (tr P / 2r)^2 for the range, (tr P / r^2)^2 with the ground range r for the bearing; the
    elevation is as nonlinear right above the target. Without these an EKF trusts a linearisation
    that is meaningless near the target, and diverges. `ground_m2` is the trace of the horizontal
    position's covariance, `space_m2` that with the height's variance.
    """
    slant2 = larger(sight.slant2_m2, NEAREST2_M2)
    R[RANGE] += range_bend_m2(space_m2, sight)
    if R.shape[0] > POWER:
        # ln(slant) bends by +-1 / slant^2 along and across: 1/2 tr (H P)^2 at most
        bend = DB_PER_NEPER * float(mean[model.power_index + 1]) * space_m2 / slant2
        R[POWER] += 0.5 * bend * bend
    if R.shape[0] == 1:
        return
    if model.antenna == AZIMUTH:
        R[BEARING] += azimuth_bend_rad2(ground_m2, sight)
        if R.shape[0] > ELEVATION:
            ground2 = larger(sight.ground2_m2, NEAREST2_M2)
            rise_m = larger(sight.up_m, -sight.up_m)
            bend = space_m2 / slant2 * (1.0 + 0.5 * rise_m / root(ground2))
            R[ELEVATION] += bend * bend
        return
    bend = space_m2 / slant2
    if R.shape[0] > ELEVATION:
        R[ELEVATION] += bend * bend
    if model.antenna == PLANAR:
        bend = bend / sine2_off_normal(sight, mean, pose)
    R[BEARING] += bend * bend


@kernel
def fill_variances(
    R: Matrix,
    P: Matrix,
    sight: Sight,
    mean: Vector,
    pose: Matrix,
    sigma: Matrix,
    model: RangingModel,
) -> None:
    """Fill the variances R about the model, (m,) or (m, n), with the state's covariance P."""
    fill_noise(R, sigma, sight, mean, pose, model)
    if model.near_target_terms:
        ground_m2 = float(P[0, 0]) + float(P[1, 1])
        space_m2 = ground_m2
        if model.height_index >= 0:
            space_m2 += float(P[model.height_index, model.height_index])
        add_second_order(R, ground_m2, space_m2, sight, mean, pose, model)


@kernel
def variances(P: Matrix, mean: Vector, pose: Vector, sigma: Vector, model: RangingModel) -> Vector:
    """Return the variances of the modalities, (3 or 4,), m^2, rad^2 and dB^2."""
    R = np.empty(rows_of(model))
    fill_variances(R, P, sight_of(mean, pose, model), mean, pose, sigma, model)
    return R


@kernel
def linearised(
    z: Vector, P: Matrix, mean: Vector, pose: Vector, sigma: Vector, model: RangingModel
) -> tuple[Vector, Matrix, Vector]:
    """Return innovations (m,), partials (m, k) and variances (m,) of one measurement."""
    sight, count = sight_of(mean, pose, model), rows_of(model)
    y = innovations_of(z, sight, mean, pose, model)
    H, R = np.zeros((count, mean.size)), np.empty(count)
    fill_partials(H, sight, mean, pose, model)
    fill_variances(R, P, sight, mean, pose, sigma, model)
    return y, H, R
