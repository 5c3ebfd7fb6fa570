"""E-optimal planner: the next measurement with the least expected worst-case error.

Candidates are the ends of steps in even directions about the vehicle, and staying. With the joint
information J = P^-1 before and the expected measurement's H^T R^-1 H, the criterion is the smallest
eigenvalue of the *marginal* information about the position, the offsets being nuisance:

    J' = J + H^T R^-1 H,    I(s) = J'_pp - J'_po J'_oo^-1 J'_op,    s* = argmax lambda_min(I(s))

I(s) is the inverse of the position block of the updated covariance, so that block is computed
instead, P_pp - G S^-1 G^T with G = (P H^T)_p and S = H P H^T + R: the same s*, by two-by-two
algebra only, and it needs no inverse of P, which may be singular.

Paper: section V-B, eq. (FIM objective). Deviations: the paper leaves the candidates, the prior
information and the offsets open (with them known, any new position looks equally good); ranges are
slant, as the radio measures them; and `near_target_terms` adds the second-order variances of the
filter, without which the bearing from a position above the estimate counts as perfect. Without them
the criterion is the linearised one.

With an antenna array the rows are those of its own measurement model, about a level vehicle that
keeps its heading: for an azimuth in the array's plane, sigma_0 over the sine off its normal, or for
direction cosines, sigma_0 each; outside the field of view there is no row.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.domain import Params, Positive, TargetEstimate, Waypoint, WaypointReason
from companion.geometry.coordinates import bearing_ned_from_enu
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector, frozen, kernel
from companion.planning.planner import Plan, PlanRequest, hold_position, route_to, way_finder
from companion.planning.views import Antenna, Triple

HEADINGS = 16
"""Default number of candidate directions."""
STAY = -1
"""Index of the candidate that stays."""
MIN_DISTANCE_M = 1e-3
"""Distance below which the direction to the target is undefined."""
NO_BEARINGS_RAD2 = math.inf
"""Bearing variance where bearings are not measured."""


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


@kernel
def worst_variance_m2(
    P: Matrix,
    de_m: float,
    dn_m: float,
    du_m: float,
    range_variance_m2: float,
    bearing_variance_rad2: float,
    near_target_terms: bool,
) -> float:
    """Return the largest eigenvalue of the position covariance after one expected measurement.

    Its inverse is the smallest eigenvalue of the marginal information. P is (4, 4), of [east,
    north, range offset, bearing offset]; `de_m` and `dn_m` lead from the measuring position to the
    estimate. A bearing variance is thermal noise; infinite: bearings are not measured.
    """
    ground2 = max(de_m * de_m + dn_m * dn_m, MIN_DISTANCE_M * MIN_DISTANCE_M)
    slant2 = ground2 + du_m * du_m
    slant = math.sqrt(slant2)
    trace = P[0, 0] + P[1, 1] if near_target_terms else 0.0
    ue, un = de_m / slant, dn_m / slant
    # columns of P H^T: of the range, (ue, un, 1, 0), and of the bearing, (ve, vn, 0, 1)
    ge = P[0, 0] * ue + P[0, 1] * un + P[0, 2]
    gn = P[1, 0] * ue + P[1, 1] * un + P[1, 2]
    go = P[2, 0] * ue + P[2, 1] * un + P[2, 2]
    s_rr = ue * ge + un * gn + go + range_variance_m2 + trace * trace / (4.0 * slant2)
    if math.isinf(bearing_variance_rad2):
        ee = P[0, 0] - ge * ge / s_rr
        en = P[0, 1] - ge * gn / s_rr
        nn = P[1, 1] - gn * gn / s_rr
    else:
        ve, vn = -dn_m / ground2, de_m / ground2
        he = P[0, 0] * ve + P[0, 1] * vn + P[0, 3]
        hn = P[1, 0] * ve + P[1, 1] * vn + P[1, 3]
        ho = P[3, 0] * ve + P[3, 1] * vn + P[3, 3]
        s_bb = ve * he + vn * hn + ho + bearing_variance_rad2 + (trace / ground2) ** 2
        s_rb = ue * he + un * hn + P[2, 0] * ve + P[2, 1] * vn + P[2, 3]
        det = s_rr * s_bb - s_rb * s_rb
        ee = P[0, 0] - (ge * ge * s_bb - 2.0 * ge * he * s_rb + he * he * s_rr) / det
        en = P[0, 1] - (ge * gn * s_bb - (ge * hn + he * gn) * s_rb + he * hn * s_rr) / det
        nn = P[1, 1] - (gn * gn * s_bb - 2.0 * gn * hn * s_rb + hn * hn * s_rr) / det
    return float(0.5 * (ee + nn) + math.hypot(0.5 * (ee - nn), en))


class View(NamedTuple):
    """Antenna array on a level vehicle, and its noise."""

    antenna: Antenna
    yaw_enu_rad: float
    sigmas: tuple[float, float]
    """Standard deviations of a range, m (infinite: not measured), and of a direction cosine."""


@kernel
def array_worst_variance_m2(
    P: Matrix, to_target_m: Triple, view: View, near_target_terms: bool
) -> float:
    """Return `worst_variance_m2` for an antenna array, updated row by row."""
    de, dn, du = to_target_m
    slant = max(math.sqrt(de * de + dn * dn + du * du), MIN_DISTANCE_M)
    u, antenna, cosine2 = (de / slant, dn / slant, du / slant), view.antenna, view.sigmas[1] ** 2
    spread = (P[0, 0] + P[1, 1]) / slant if near_target_terms else 0.0
    after, h = P.copy(), np.array([u[0], u[1], 1.0, 0.0])
    if not math.isinf(view.sigmas[0]):
        take_in(after, h, view.sigmas[0] ** 2 + 0.25 * spread * spread)
    second_order = (spread / slant) ** 2
    first, x = cosine_row(antenna.first, u, slant, view.yaw_enu_rad)
    second, y = cosine_row(antenna.second, u, slant, view.yaw_enu_rad)
    _, off = cosine_row(antenna.boresight, u, slant, view.yaw_enu_rad)
    edge = math.cos(antenna.half_view_rad)
    if antenna.is_planar:
        sine2 = max(x * x + y * y, MIN_DISTANCE_M * MIN_DISTANCE_M)
        if x >= math.sqrt(sine2) * edge:
            noise2 = cosine2 / sine2 * (1.0 + cosine2 / sine2) + second_order / (sine2 * sine2)
            take_in(after, (x * second - y * first) / sine2, noise2)
    elif abs(off) >= edge:
        take_in(after, first, cosine2 + second_order)
        if antenna.rows > 1:
            take_in(after, second, cosine2 + second_order)
    ee, en, nn = after[0, 0], after[0, 1], after[1, 1]
    return float(0.5 * (ee + nn) + math.hypot(0.5 * (ee - nn), en))


@kernel
def cosine_row(axis: Triple, u: Triple, slant_m: float, yaw_rad: float) -> tuple[Vector, float]:
    """Return the partials (4,) of the cosine along an axis of the level body, and the cosine."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    east, north = c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]
    cosine = east * u[0] + north * u[1] + axis[2] * u[2]
    by_east, by_north = (east - cosine * u[0]) / slant_m, (north - cosine * u[1]) / slant_m
    return np.array([by_east, by_north, 0.0, north * u[0] - east * u[1]]), cosine


@kernel
def take_in(P: Matrix, h: Vector, variance: float) -> None:
    """Update a covariance (4, 4) in place with one row (4,), as a Kalman filter does."""
    Ph = (P * h).sum(axis=1)
    P -= np.outer(Ph, Ph) / ((Ph * h).sum() + variance)


@kernel
def best_array_candidate(
    P: Matrix,
    to_target_m: Triple,
    ring_m: Matrix,
    may_fly: NDArray[np.bool_],
    view: View,
    near: bool,
) -> int:
    """Return the result of `best_candidate` for an antenna array."""
    de, dn, du = to_target_m
    best, least = STAY, array_worst_variance_m2(P, to_target_m, view, near)
    for index in range(ring_m.shape[0]):
        if may_fly[index]:
            there = (de - ring_m[index, 0], dn - ring_m[index, 1], du)
            variance = array_worst_variance_m2(P, there, view, near)
            if variance < least:
                best, least = index, variance
    return best


@kernel
def best_candidate(
    P: Matrix,
    de_m: float,
    dn_m: float,
    du_m: float,
    ring_m: Matrix,
    may_fly: NDArray[np.bool_],
    range_variance_m2: float,
    bearing_variance_rad2: float,
    near_target_terms: bool,
) -> int:
    """Return the index of the E-optimal row of `ring_m` (k, 2) that `may_fly` (k,), or `STAY`."""
    best = STAY
    least = worst_variance_m2(
        P, de_m, dn_m, du_m, range_variance_m2, bearing_variance_rad2, near_target_terms
    )
    for index in range(ring_m.shape[0]):
        if may_fly[index]:
            variance = worst_variance_m2(
                P,
                de_m - ring_m[index, 0],
                dn_m - ring_m[index, 1],
                du_m,
                range_variance_m2,
                bearing_variance_rad2,
                near_target_terms,
            )
            if variance < least:
                best, least = index, variance
    return best


def candidate_ring_m(step_m: float, headings: int = HEADINGS) -> Matrix:
    """Return the steps of the candidates, (headings, 2) ENU, counter-clockwise from east."""
    bearings_rad = 2.0 * np.pi * np.arange(headings) / headings
    return frozen(step_m * np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad)]))


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
        self._ring_m = candidate_ring_m(params.step_m, params.headings)
        self._range_variance_m2 = range_sigma_m**2
        self._bearing_variance_rad2 = bearing_sigma_rad**2
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
        de_m, dn_m, du_m = target[0] - vehicle[0], target[1] - vehicle[1], -request.height_m
        P, near = self._covariance(request, estimate), self.params.near_target_terms
        ring_m, may_fly = self._ring_m, self._may_fly(request)
        if self._antenna is not None:
            yaw_rad = request.yaw_enu_rad
            ahead_rad = math.atan2(dn_m, de_m) if yaw_rad is None else yaw_rad
            view = View(self._antenna, ahead_rad, request.sigmas or self._sigmas)
            return best_array_candidate(P, (de_m, dn_m, du_m), ring_m, may_fly, view, near)
        bearing2 = NO_BEARINGS_RAD2 if request.baseline_m > 0.0 else self._bearing_variance_rad2
        range2 = self._range_variance_m2
        return best_candidate(P, de_m, dn_m, du_m, ring_m, may_fly, range2, bearing2, near)

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
        east_m, north_m = self._ring_m[index].tolist()
        return (vehicle[0] + east_m, vehicle[1] + north_m)
