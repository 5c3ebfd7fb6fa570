"""E-optimal planner: the next measurement with the least expected worst-case error.

Candidates are the ends of steps in even directions about the vehicle, and staying. With the joint
information J = P^-1 before and the expected measurement's H^T R^-1 H, the criterion is the smallest
eigenvalue of the *marginal* information about the position, the offsets being nuisance:

    J' = J + H^T R^-1 H,    I(s) = J'_pp - J'_po J'_oo^-1 J'_op,    s* = argmax lambda_min(I(s))

I(s) is the inverse of the position block of the updated covariance, so that block is computed
instead, by a Kalman update with one row after the other: the same s*, and it needs no inverse of P,
which may be singular. H and R are those of `measurement_model`.

Paper: section V-B, eq. (FIM objective). Deviations: the paper leaves the candidates, the prior
information and the offsets open (with them known, any new position looks equally good); ranges are
slant, as the radio measures them; and `near_target_terms` adds the second-order variances of the
filter, without which the bearing from a position above the estimate would seem perfect. Without
them the criterion is the linearised one.

An antenna array is that of a level vehicle that keeps its heading; outside the field of view there
is no direction. Where received power replaces ranges, it counts as a range from the estimate's
distance.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.domain import Params, Positive, TargetEstimate, Waypoint, WaypointReason
from companion.estimation.measurement_model import (
    ABSENT,
    AZIMUTH,
    BEARING,
    COSINES,
    ELEVATION,
    MODALITIES,
    PLANAR,
    RANGE,
    RangingModel,
    Sight,
    azimuth_bend_rad2,
    azimuth_partials,
    cosines,
    fill_partials,
    fill_variances,
    range_bend_m2,
    range_partials,
    sight_of,
)
from companion.estimation.number_or_array import root
from companion.geometry.coordinates import bearing_ned_from_enu
from companion.geometry.polygons import Point
from companion.kernel import IS_COMPILED, Matrix, Vector, frozen, kernel
from companion.planning.planner import Plan, PlanRequest, hold_position, route_to, way_finder
from companion.planning.views import Antenna

HEADINGS = 16
"""Default number of candidate directions."""
STAY = -1
"""Index of the candidate that stays."""


class FimParams(Params, frozen=True):
    """Candidates and prior of the E-optimal planner."""

    step_m: Positive = 5.0
    """Distance of the candidates from the vehicle."""
    headings: Annotated[int, msgspec.Meta(ge=3, le=360)] = HEADINGS
    """Number of candidate directions."""
    range_offset_sigma_m: Positive = 5.0
    """Prior of the range offset where the filter has no joint covariance."""
    bearing_offset_sigma_deg: Positive = 5.0
    """Prior of the bearing offset, in the same way."""
    near_target_terms: bool = True
    """True: variances contain the second-order terms; false: as the paper prints it."""


class FieldOfView(NamedTuple):
    """Directions that an antenna sees."""

    boresight_enu: Vector
    """Unit vector, (3,)."""
    least_cosine: float
    """Cosine of the half angle about it; -1: all around."""


ALL_AROUND = FieldOfView(np.zeros(3), -1.0)
"""Field of view of an azimuth about the vertical."""


@kernel
def projected(P: Matrix, h: Matrix) -> tuple[Any, Any, Any, Any]:
    """Return P h^T of the partials h, (4,) or (4, n), by component."""
    return (
        P[0, 0] * h[0] + P[0, 1] * h[1] + P[0, 2] * h[2] + P[0, 3] * h[3],
        P[1, 0] * h[0] + P[1, 1] * h[1] + P[1, 2] * h[2] + P[1, 3] * h[3],
        P[2, 0] * h[0] + P[2, 1] * h[1] + P[2, 2] * h[2] + P[2, 3] * h[3],
        P[3, 0] * h[0] + P[3, 1] * h[1] + P[3, 2] * h[2] + P[3, 3] * h[3],
    )


@kernel
def product(h: Matrix, g: tuple[Any, Any, Any, Any]) -> Any:
    """Return h g of partials h, (4,) or (4, n), and four components."""
    return h[0] * g[0] + h[1] * g[1] + h[2] * g[2] + h[3] * g[3]


@kernel
def larger_eigenvalue(ee: Any, en: Any, nn: Any) -> Any:
    """Return the larger eigenvalue of [[ee, en], [en, nn]]."""
    half = 0.5 * (ee - nn)
    return 0.5 * (ee + nn) + root(half * half + en * en)


@kernel
def azimuth_worst_variance_m2(
    P: Matrix, sight: Sight, noise_m2: float, noise_rad2: float, spread_m2: float
) -> Any:
    """Return `worst_variance_m2` of a range and an azimuth, of one line of sight or of n, (n,).

    In closed form, with the partials (ue, un, 1, 0) and (ve, vn, 0, 1), because a decision compares
    many. `noise_m2` and `noise_rad2` are those of the radio, `spread_m2` is the trace of the
    position's covariance for the second-order terms, or 0.
    """
    ue, un = range_partials(sight, 1.0)
    ge = P[0, 0] * ue + P[0, 1] * un + P[0, 2]
    gn = P[1, 0] * ue + P[1, 1] * un + P[1, 2]
    go = P[2, 0] * ue + P[2, 1] * un + P[2, 2]
    gb = P[3, 0] * ue + P[3, 1] * un + P[3, 2]
    by_range = 1.0 / (ue * ge + un * gn + go + noise_m2 + range_bend_m2(spread_m2, sight))
    ve, vn = azimuth_partials(sight)
    share = (ve * ge + vn * gn + gb) * by_range
    ke = P[0, 0] * ve + P[0, 1] * vn + P[0, 3] - share * ge
    kn = P[1, 0] * ve + P[1, 1] * vn + P[1, 3] - share * gn
    kb = P[3, 0] * ve + P[3, 1] * vn + P[3, 3] - share * gb
    by_bearing = 1.0 / (ve * ke + vn * kn + kb + noise_rad2 + azimuth_bend_rad2(spread_m2, sight))
    return larger_eigenvalue(
        P[0, 0] - ge * ge * by_range - ke * ke * by_bearing,
        P[0, 1] - ge * gn * by_range - ke * kn * by_bearing,
        P[1, 1] - gn * gn * by_range - kn * kn * by_bearing,
    )


@kernel
def worst_variance_m2(P: Matrix, H: Matrix, R: Matrix) -> Any:
    """Return the largest eigenvalue of the position covariance after one expected measurement.

    Its inverse is the smallest eigenvalue of the marginal information. P is (4, 4), of [east,
    north, range offset, bearing offset]; H is (3, 4, n) for n measurements, with the variances R
    (3, n); infinite: not measured.
    """
    g = projected(P, H[0])
    S = product(H[0], g) + R[0]
    k = projected(P, H[1])
    share = product(H[1], g) / S
    k = (k[0] - share * g[0], k[1] - share * g[1], k[2] - share * g[2], k[3] - share * g[3])
    T = product(H[1], k) + R[1]
    first, second = product(H[2], g) / S, product(H[2], k) / T
    last = projected(P, H[2])
    last = (
        last[0] - first * g[0] - second * k[0],
        last[1] - first * g[1] - second * k[1],
        last[2] - first * g[2] - second * k[2],
        last[3] - first * g[3] - second * k[3],
    )
    U = product(H[2], last) + R[2]
    return larger_eigenvalue(
        P[0, 0] - g[0] * g[0] / S - k[0] * k[0] / T - last[0] * last[0] / U,
        P[0, 1] - g[0] * g[1] / S - k[0] * k[1] / T - last[0] * last[1] / U,
        P[1, 1] - g[1] * g[1] / S - k[1] * k[1] / T - last[1] * last[1] / U,
    )


@kernel
def worst_variances_m2(
    P: Matrix, mean: Vector, poses: Matrix, sigma: Vector, view: FieldOfView, model: RangingModel
) -> Vector:
    """Return `worst_variance_m2` of a measurement at each of the poses (3 or 9, n), (n,).

    The mean is (4,), `sigma` (3,) the noise of range and directions; infinite: not measured. The
    model is one of `model_of`, without the vehicle position's error.
    """
    n = poses.shape[1]
    if model.antenna == AZIMUTH:
        worst, noise_m2, noise_rad2 = np.empty(n), sigma[RANGE] ** 2, sigma[BEARING] ** 2
        spread_m2 = P[0, 0] + P[1, 1] if model.near_target_terms else 0.0
        if IS_COMPILED:
            for index in range(n):
                sight = sight_of(mean, poses[:, index], model)
                worst[index] = azimuth_worst_variance_m2(P, sight, noise_m2, noise_rad2, spread_m2)
        else:
            sights = sight_of(mean, poses, model)
            worst[:] = azimuth_worst_variance_m2(P, sights, noise_m2, noise_rad2, spread_m2)
        return worst
    H, R = np.zeros((MODALITIES, 4, n)), np.empty((MODALITIES, n))
    lines = sight_of(mean, poses, model)
    fill_partials(H, lines, mean, poses, model)
    fill_variances(R, P, lines, mean, poses, sigma, model)
    if view.least_cosine > -1.0:
        is_hidden = ~is_in_view(mean, poses, view, model)
        R[BEARING][is_hidden] = math.inf
        R[ELEVATION][is_hidden] = math.inf
    return np.asarray(worst_variance_m2(P, H, R))


@kernel
def is_in_view(mean: Vector, poses: Matrix, view: FieldOfView, model: RangingModel) -> Any:
    """Return a mask (n,) of the poses that see the target; arcsine antennas see behind, too."""
    sight = sight_of(mean, poses, model)
    if model.antenna == PLANAR:
        x, y = cosines(sight, mean, poses)
        return x >= np.sqrt(x * x + y * y) * view.least_cosine
    axis = view.boresight_enu
    along_m = axis[0] * sight.east_m + axis[1] * sight.north_m + axis[2] * sight.up_m
    return np.abs(along_m) >= view.least_cosine * np.sqrt(sight.slant2_m2)


@kernel
def best_candidate(
    P: Matrix,
    mean: Vector,
    poses: Matrix,
    may_fly: NDArray[np.bool_],
    sigma: Vector,
    view: FieldOfView,
    model: RangingModel,
) -> int:
    """Return the index of the E-optimal of the poses (3 or 9, k + 1), or `STAY`.

    The last pose is the current one; the others are candidates where `may_fly` (k,) is true.
    """
    worst = worst_variances_m2(P, mean, poses, sigma, view, model)
    best, least = STAY, worst[-1]
    for index in range(may_fly.size):
        if may_fly[index] and worst[index] < least:
            best, least = index, worst[index]
    return best


def candidate_ring_m(step_m: float, headings: int = HEADINGS) -> Matrix:
    """Return the steps of the candidates, (headings, 2) ENU, counter-clockwise from east."""
    bearings_rad = 2.0 * np.pi * np.arange(headings) / headings
    return frozen(step_m * np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad)]))


def candidate_poses_m(step_m: float, headings: int = HEADINGS) -> Matrix:
    """Return the candidates' positions about the vehicle, (3, headings + 1), staying the last."""
    poses_m = np.zeros((3, headings + 1))
    poses_m[:2, :headings] = candidate_ring_m(step_m, headings).T
    return poses_m


def model_of(antenna: Antenna | None, *, near_target_terms: bool) -> RangingModel:
    """Return the measurement model of an antenna, without the vehicle position's error."""
    kind = AZIMUTH if antenna is None else PLANAR if antenna.is_planar else COSINES
    return RangingModel(0.0, ABSENT, ABSENT, 0.0, near_target_terms, antenna=kind)


def turned(antenna: Antenna, yaw_rad: float) -> tuple[Vector, FieldOfView]:
    """Return both axes, (6,), and the field of view of a level vehicle's antenna, in ENU."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    body = np.array([antenna.first, antenna.second, antenna.boresight])
    axes = body @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return axes[:2].reshape(-1), FieldOfView(axes[2], math.cos(antenna.half_view_rad))


class FimPlanner:
    """Information-theoretic benchmark; it needs no memory."""

    search_after_s: float | None = None

    def __init__(
        self,
        params: FimParams,
        range_sigma_m: float = 1.5,
        bearing_sigma_rad: float = math.radians(2.0),
        antenna: Antenna | None = None,
    ) -> None:
        """Without an antenna bearings are azimuths about the vertical, as in the paper."""
        self.params = params
        self._antenna = antenna
        self._sigmas = (range_sigma_m, bearing_sigma_rad)
        self._model = model_of(antenna, near_target_terms=params.near_target_terms)
        self._poses_m = candidate_poses_m(params.step_m, params.headings)
        self._offset_variances = (
            params.range_offset_sigma_m**2,
            math.radians(params.bearing_offset_sigma_deg) ** 2,
        )

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """Return the best candidate about the vehicle."""
        if request.estimate is None:
            return Plan(hold_position(request, "no estimate yet"), memory)
        vehicle = request.vehicle_enu_m
        index = self._best(request, request.estimate)
        if index == STAY:
            return Plan(
                hold_position(request, "staying is expected to give the most information"), memory
            )
        turn_rad = 2.0 * math.pi * index / self.params.headings
        heading_deg = math.degrees(bearing_ned_from_enu(turn_rad))
        heading_deg %= 360.0
        detail = f"heading {heading_deg:03.0f} is expected to give the most information"
        waypoint = Waypoint(self._candidate(vehicle, index), WaypointReason.INFORMATION, detail)
        return Plan(route_to(request, waypoint), memory)

    def _best(self, request: PlanRequest, estimate: TargetEstimate) -> int:
        """Return the index of the best candidate, by the kind of bearings."""
        vehicle, target = request.vehicle_enu_m, estimate.position_enu_m
        away_m = (target[0] - vehicle[0], target[1] - vehicle[1])
        poses, view, sigmas = self._poses_m, ALL_AROUND, self._sigmas
        reported = request.sigmas or (*sigmas, math.inf)
        if self._antenna is not None:
            yaw_rad = request.yaw_enu_rad
            ahead_rad = math.atan2(away_m[1], away_m[0]) if yaw_rad is None else yaw_rad
            axes, view = turned(self._antenna, ahead_rad)
            poses = np.vstack([poses, np.repeat(axes[:, None], poses.shape[1], axis=1)])
            sigmas = reported[:2]
        elif request.baseline_m > 0.0:
            sigmas = (sigmas[0], math.inf)
        if reported[0] == math.inf > reported[2]:  # a power alone is the logarithm of the range
            sigmas = (reported[2] * math.hypot(*away_m, request.height_m), sigmas[1])
        across = math.inf if self._antenna is not None and self._antenna.rows == 1 else sigmas[1]
        return best_candidate(
            np.array(self._covariance(request, estimate)),  # one kind of array, one variant
            np.array([*away_m, 0.0, 0.0]),
            poses,
            self._may_fly(request),
            np.array([*sigmas, across]),
            view,
            self._model._replace(height_m=-request.height_m),
        )

    def _covariance(self, request: PlanRequest, estimate: TargetEstimate) -> Matrix:
        """Return the joint covariance of position and offsets, the filter's or the prior."""
        if request.joint_covariance is not None:
            return request.joint_covariance
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = estimate.covariance_m2
        covariance[2, 2], covariance[3, 3] = self._offset_variances
        return covariance

    def _may_fly(self, request: PlanRequest) -> NDArray[np.bool_]:
        finder, vehicle = way_finder(request), request.vehicle_enu_m
        if finder is None:
            return np.ones(self.params.headings, dtype=np.bool_)
        clear = [
            finder.space.is_clear(vehicle, self._candidate(vehicle, index))
            for index in range(self.params.headings)
        ]
        return np.array(clear, dtype=np.bool_)

    def _candidate(self, vehicle: Point, index: int) -> Point:
        east_m, north_m, _ = self._poses_m[:, index].tolist()
        return (vehicle[0] + east_m, vehicle[1] + north_m)
