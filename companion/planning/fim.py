"""E-optimality: fly where one more measurement is expected to leave the least worst-case error.

Candidates are the ends of steps in even directions about the vehicle, and staying. With the
joint information J = P^-1 before and the expected measurement's H^T R^-1 H, the criterion is the
smallest eigenvalue of the *marginal* information about the position, the offsets being nuisance:

    J' = J + H^T R^-1 H,    I(s) = J'_pp - J'_po J'_oo^-1 J'_op,    s* = argmax lambda_min(I(s))

I(s) is the inverse of the position block of the updated covariance, so that block is computed
instead, P_pp - G S^-1 G^T with G = (P H^T)_p and S = H P H^T + R: the same s*, by two-by-two
algebra only, and it needs no inverse of P, which may be singular.

Paper: section V-B, eq. (FIM objective). Deviations: the paper leaves the candidates, the prior
information and the offsets open (with them known, any new place looks equally good); ranges are
slant, as the radio measures them; and `near_target_terms` adds the second-order variances that the
filter has too, without which the bearing of a place on top of the estimate is believed to be
perfect. Off, the criterion is the linearised one.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.domain import Params, Positive, TargetEstimate, Waypoint, WaypointReason
from companion.geometry.coordinates import bearing_ned_from_enu
from companion.geometry.polygons import Point
from companion.kernel import Matrix, frozen, kernel
from companion.planning.planner import Plan, PlanRequest, hold_position, route_to, way_finder

HEADINGS = 16
"""Directions of the candidates, where nothing else is said."""
STAY = -1
"""Index of the candidate that stays."""
MIN_DISTANCE_M = 1e-3
"""Closer than this the direction to the target has no meaning."""
NO_BEARINGS_RAD2 = math.inf


class FimParams(Params, frozen=True):
    """Candidates and prior knowledge of the E-optimal planner."""

    step_m: Positive = 5.0
    """How far from the vehicle the candidates are."""
    headings: Annotated[int, msgspec.Meta(ge=3, le=360)] = HEADINGS
    """In how many directions they are."""
    range_offset_sigma_m: Positive = 5.0
    """Prior of the range offset where the filter tells no joint covariance."""
    bearing_offset_sigma_deg: Positive = 5.0
    """The same of the bearing offset."""
    near_target_terms: bool = True
    """Whether variances contain the second-order terms; false: as the paper prints it."""


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
    """Largest eigenvalue of the position covariance after one expected measurement.

    Its inverse is the smallest eigenvalue of the marginal information. P is (4, 4), of [east,
    north, range offset, bearing offset]; `de_m` and `dn_m` lead from the measurement's place to the
    estimate. A bearing variance is thermal noise; infinite: bearings are not measured.
    """
    ground2 = max(de_m * de_m + dn_m * dn_m, MIN_DISTANCE_M * MIN_DISTANCE_M)
    slant2 = ground2 + du_m * du_m
    slant = math.sqrt(slant2)
    trace = P[0, 0] + P[1, 1] if near_target_terms else 0.0
    ue, un = de_m / slant, dn_m / slant
    # Columns of P H^T: of the range, (ue, un, 1, 0), and of the bearing, (ve, vn, 0, 1).
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
    """Index of the E-optimal row of `ring_m` (k, 2) that `may_fly` (k,), or, `STAY`."""
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
    """Steps of the candidates, (headings, 2) east and north, counter-clockwise from east."""
    bearings_rad = 2.0 * np.pi * np.arange(headings) / headings
    return frozen(step_m * np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad)]))


class FimPlanner:
    """The information-theoretic benchmark; it needs no memory."""

    search_after_s: float | None = None

    def __init__(
        self,
        params: FimParams,
        range_sigma_m: float = 1.5,
        bearing_sigma_rad: float = math.radians(2.0),
    ) -> None:
        self.params = params
        self._ring_m = candidate_ring_m(params.step_m, params.headings)
        self._range_variance_m2 = range_sigma_m**2
        self._bearing_variance_rad2 = bearing_sigma_rad**2
        self._offset_variances = (
            params.range_offset_sigma_m**2,
            math.radians(params.bearing_offset_sigma_deg) ** 2,
        )

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """The best candidate about the vehicle."""
        if request.estimate is None:
            return Plan(hold_position(request, "no estimate yet"), memory)
        vehicle, target = request.vehicle_enu_m, request.estimate.position_enu_m
        index = best_candidate(
            self._covariance(request, request.estimate),
            target[0] - vehicle[0],
            target[1] - vehicle[1],
            -request.height_m,
            self._ring_m,
            self._may_fly(request),
            self._range_variance_m2,
            NO_BEARINGS_RAD2 if request.baseline_m > 0.0 else self._bearing_variance_rad2,
            self.params.near_target_terms,
        )
        if index == STAY:
            return Plan(hold_position(request, "staying is expected to tell most"), memory)
        turn_rad = 2.0 * math.pi * index / self.params.headings
        heading_deg = math.degrees(bearing_ned_from_enu(turn_rad))
        heading_deg %= 360.0
        detail = f"heading {heading_deg:03.0f} is expected to tell most"
        waypoint = Waypoint(self._candidate(vehicle, index), WaypointReason.INFORMATION, detail)
        return Plan(route_to(request, waypoint), memory)

    def _covariance(self, request: PlanRequest, estimate: TargetEstimate) -> Matrix:
        """Of position and offsets, as the filter tells it or as it is known before the flight."""
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
