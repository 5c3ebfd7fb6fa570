"""E-optimality against generic linear algebra, and what it makes the vehicle do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, TargetEstimate, WaypointReason
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import jacobian, variances
from companion.geometry.polygons import Point
from companion.kernel import Matrix, frozen
from companion.planning import fim
from companion.planning.fim import (
    ALL_AROUND,
    HEADINGS,
    STAY,
    FimParams,
    FimPlanner,
    best_candidate,
    candidate_poses_m,
    candidate_ring_m,
    model_of,
    turned,
    worst_variances_m2,
)
from companion.planning.planner import PlanRequest
from companion.planning.views import Antenna

RANGE_M2, BEARING_RAD2 = 1.5**2, math.radians(2.0) ** 2
SIGMA = np.array([1.5, math.radians(2.0), math.inf])
RANGES_ONLY = np.array([1.5, math.inf, math.inf])
MODEL = model_of(None, near_target_terms=True)
PRIOR = np.diag([900.0, 900.0, 25.0, math.radians(5.0) ** 2])
ALL = np.ones(HEADINGS, dtype=np.bool_)


def _target(situation: Point, covariance: Matrix = PRIOR) -> TargetEstimate:
    (a, b), (c, d) = covariance[:2, :2].tolist()
    return TargetEstimate(
        0.0, EstimateState.SEARCHING, situation, ((a, b), (c, d)), 5.0, 0.0, 0.0, 1
    )


def _marginal_information(
    P: Matrix, du_m: float, de_m: float, dn_m: float, bearing: bool, near: bool
) -> Matrix:
    """Prior plus expected information, offsets eliminated by a Schur complement."""
    ground2, slant = de_m**2 + dn_m**2, math.sqrt(de_m**2 + dn_m**2 + du_m**2)
    trace = P[0, 0] + P[1, 1] if near else 0.0
    J = np.linalg.inv(P)
    h = np.array([de_m / slant, dn_m / slant, 1.0, 0.0])
    J = J + np.outer(h, h) / (RANGE_M2 + (trace / (2.0 * slant)) ** 2)
    if bearing:
        h = np.array([-dn_m / ground2, de_m / ground2, 0.0, 1.0])
        J = J + np.outer(h, h) / (BEARING_RAD2 + (trace / ground2) ** 2)
    return np.asarray(J[:2, :2] - J[:2, 2:] @ np.linalg.solve(J[2:, 2:], J[2:, :2]))


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 10**6),
    st.floats(-60.0, 60.0),
    st.floats(0.5, 60.0),
    st.floats(-30.0, 30.0),
    st.booleans(),
    st.booleans(),
)
def test_it_is_the_smallest_eigenvalue_of_the_marginal_information(
    seed: int, de_m: float, dn_m: float, du_m: float, bearing: bool, near: bool
) -> None:
    root = np.random.default_rng(seed).standard_normal((4, 4)) * np.array(
        [[9.0], [9.0], [2.0], [0.1]]
    )
    P = root @ root.T + np.diag([1.0, 1.0, 0.1, 1e-4])
    information = _marginal_information(P, du_m, de_m, dn_m, bearing, near)
    least = float(np.linalg.eigvalsh(information)[0])
    sigma = SIGMA if bearing else RANGES_ONLY
    model = MODEL._replace(near_target_terms=near, height_m=du_m)
    at = np.array([de_m, dn_m, 0.0, 0.0])
    (worst,) = worst_variances_m2(P, at, np.zeros((3, 1)), sigma, ALL_AROUND, model)
    assert 1.0 / worst == pytest.approx(least, rel=1e-6)


def test_the_best_candidate_is_the_best_of_all() -> None:
    poses, rng = candidate_poses_m(5.0), np.random.default_rng(4)
    assert poses[:2, :-1].T.tolist() == candidate_ring_m(5.0).tolist()
    assert not poses[2].any()
    assert not poses[:, -1].any()
    model = MODEL._replace(height_m=-20.0)
    for _ in range(50):
        at = np.array([*rng.uniform(-40.0, 40.0, 2), 0.0, 0.0])
        alone = [
            float(worst_variances_m2(PRIOR, at, each[:, None], SIGMA, ALL_AROUND, model)[0])
            for each in poses.T
        ]
        best = best_candidate(PRIOR, at, poses, ALL, SIGMA, ALL_AROUND, model)
        assert alone[best] == pytest.approx(min(alone), rel=1e-12)


def test_a_candidate_that_may_not_be_flown_to_is_not_chosen() -> None:
    situation = (PRIOR, np.array([30.0, 0.0, 0.0, 0.0]), candidate_poses_m(5.0))
    first = best_candidate(*situation, ALL, SIGMA, ALL_AROUND, MODEL)
    without = ALL.copy()
    without[first] = False
    second = best_candidate(*situation, without, SIGMA, ALL_AROUND, MODEL)
    assert second not in (first, STAY)
    none = np.zeros(HEADINGS, dtype=np.bool_)
    assert best_candidate(*situation, none, SIGMA, ALL_AROUND, MODEL) == STAY


def test_known_offsets_and_a_sure_target_leave_nothing_to_choose() -> None:
    zero, at, poses = np.zeros((4, 4)), np.array([3.0, 4.0, 0.0, 0.0]), candidate_poses_m(5.0)
    assert best_candidate(zero, at, poses, ALL, SIGMA, ALL_AROUND, MODEL) == STAY


def test_the_ring_has_sixteen_headings_of_the_step_length() -> None:
    ring = candidate_ring_m(7.0)
    assert ring.shape == (HEADINGS, 2)
    assert np.linalg.norm(ring, axis=1) == pytest.approx(7.0)
    assert ring[4] == pytest.approx((0.0, 7.0))


def test_printed_it_flies_at_the_target_whose_bearing_it_believes_in() -> None:
    planner = FimPlanner(FimParams(near_target_terms=False))
    far = _target((0.0, 100.0))  # nearer, the offset of ranges is worst, wherever it flies
    plan = planner.plan(PlanRequest((0.0, 0.0), far), None)
    assert plan.waypoint.position_enu_m == pytest.approx((0.0, 5.0))
    assert plan.waypoint.reason is WaypointReason.INFORMATION
    assert plan.waypoint.detail == "heading 000 is expected to give the most information"


def test_the_joint_covariance_decides_where_there_is_one() -> None:
    """Known to the north, unknown to the east: only a view along the east adds information."""
    known_north = frozen(np.diag([100.0, 0.01, 1e-6, 1e-6]))
    planner = FimPlanner(FimParams(), 1.5, 0.5)
    request = PlanRequest((0.0, 0.0), _target((0.0, 30.0)), joint_covariance=known_north)
    east, _ = planner.plan(request, None).waypoint.position_enu_m
    assert abs(east) > 4.0


def test_without_bearings_only_ranges_count() -> None:
    """From straight above, a range says nothing; a step aside is a beginning."""
    planner = FimPlanner(FimParams(near_target_terms=False))
    above = _target((0.0, 0.0), np.diag([900.0, 400.0]))
    request = PlanRequest((0.0, 0.0), above, baseline_m=20.0, height_m=20.0)
    east, north = planner.plan(request, None).waypoint.position_enu_m
    assert abs(east) == pytest.approx(5.0)
    assert north == pytest.approx(0.0)


def test_a_power_alone_is_a_range_whose_noise_grows_with_the_distance() -> None:
    joint, is_other = np.array(PRIOR), False
    joint[:2, :2], joint[0, 2], joint[2, 0] = [[900.0, 300.0], [300.0, 400.0]], 60.0, 60.0
    for target in ((20.0, 0.0), (0.0, -40.0), (90.0, 60.0)):
        request = PlanRequest(
            (0.0, 0.0), _target(target), baseline_m=20.0, height_m=20.0, joint_covariance=joint
        )
        by_power = replace(request, sigmas=(math.inf, math.inf, 0.3))
        plan, sigma_m = FimPlanner(FimParams()).plan(by_power, None), 0.3 * math.hypot(*target, 20)
        assert plan == FimPlanner(FimParams(), sigma_m).plan(request, None)
        is_other = is_other or plan != FimPlanner(FimParams()).plan(request, None)
    assert is_other


def test_with_ranges_alone_and_no_worst_direction_it_stalls() -> None:
    """One range informs on one direction; the other one's variance stays, wherever it is taken."""
    planner = FimPlanner(FimParams(near_target_terms=False))
    request = PlanRequest((0.0, 0.0), _target((30.0, 0.0)), baseline_m=20.0, height_m=20.0)
    assert planner.plan(request, None).waypoint.reason is WaypointReason.HOLD


def test_where_staying_is_best_it_says_so() -> None:
    sure = _target((30.0, 0.0), np.zeros((4, 4)))
    waypoint = FimPlanner(FimParams()).plan(PlanRequest((0.0, 0.0), sure), None).waypoint
    assert waypoint.position_enu_m == (0.0, 0.0)
    assert waypoint.reason is WaypointReason.HOLD
    assert waypoint.detail == "staying is expected to give the most information"


def test_candidates_behind_a_wall_are_left_out() -> None:
    wall = ((2.0, -50.0), (3.0, -50.0), (3.0, 50.0), (2.0, 50.0))
    planner = FimPlanner(FimParams(near_target_terms=False))
    request = PlanRequest((0.0, 0.0), _target((40.0, 0.0)), keep_out_enu_m=(wall,))
    east, _ = planner.plan(request, None).waypoint.position_enu_m
    assert east < 2.0


def test_it_remembers_nothing_and_holds_without_an_estimate() -> None:
    plan = FimPlanner(FimParams()).plan(PlanRequest((1.0, 2.0)), None)
    assert plan.memory is None
    assert plan.waypoint.reason is WaypointReason.HOLD


@pytest.mark.skipif(not hasattr(best_candidate, "py_func"), reason="numba is not installed")
def test_compiled_and_plain_agree() -> None:
    plain = fim.best_candidate.py_func  # type: ignore[attr-defined]
    poses, rng = candidate_poses_m(5.0), np.random.default_rng(2)
    for index in range(100):
        root = rng.standard_normal((4, 4))
        at = np.array([*rng.uniform(-50.0, 50.0, 2), 0.0, 0.0])
        sigma = RANGES_ONLY if index % 3 == 0 else SIGMA
        model = MODEL._replace(near_target_terms=index % 2 == 0, height_m=rng.uniform(-50.0, 50.0))
        args = (root @ root.T, at, poses, ALL, sigma, ALL_AROUND, model)
        assert best_candidate(*args) == plain(*args)


DOWN = Antenna((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), 2, False, math.pi)
LEVEL = Antenna((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), 1, True, math.pi)
LINE = Antenna((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), 1, False, math.pi)
KINDS: dict[str, Antenna] = {"two_axis": DOWN, "planar": LEVEL, "line": LINE}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("measures_range", [True, False])
def test_an_antenna_array_counts_as_the_filters_own_model_has_it(
    kind: AntennaKind, measures_range: bool
) -> None:
    """The information of the filter's Jacobian and variances, offsets eliminated."""
    antenna, yaw_rad, rng = KINDS[kind], 0.7, np.random.default_rng(3)
    params = FilterParams(own_position_sigma_m=0.0, antenna=AntennaParams(kind=kind))
    axes = np.array([antenna.first, antenna.second])
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    axes = axes @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    for _ in range(20):
        root = rng.standard_normal((4, 4)) * np.array([[2.0], [2.0], [1.0], [0.1]])
        P = root @ root.T + np.diag([1.0, 1.0, 0.1, 1e-4])
        de_m, dn_m = rng.uniform(-40.0, 40.0, 2).tolist()
        pose = np.concatenate([[-de_m, -dn_m, 20.0], *axes])
        H = jacobian(np.zeros(4), pose, params.model)
        R = variances(P, np.zeros(4), pose, np.array([1.5, 0.05, 0.05]), params.model)
        rows = [1] if antenna.rows == 1 else [1, 2]
        rows += [0] if measures_range else []
        J = np.linalg.inv(P) + sum(np.outer(H[i], H[i]) / R[i] for i in rows)
        worst_m2 = float(np.linalg.eigvalsh(np.linalg.inv(J)[:2, :2])[-1])
        counted = _worst_m2(P, antenna, yaw_rad, (de_m, dn_m, -20.0), measures_range)
        assert counted == pytest.approx(worst_m2, rel=1e-6)


def _worst_m2(
    P: Matrix,
    antenna: Antenna,
    yaw_rad: float,
    to_target_m: tuple[float, float, float],
    measures_range: bool,
) -> float:
    """The worst variance after a measurement by an antenna with noise of 0.05 and 1.5 m."""
    axes, view = turned(antenna, yaw_rad)
    pose = np.concatenate([np.zeros(3), axes])[:, None]
    across = math.inf if antenna.rows == 1 else 0.05
    sigma = np.array([1.5 if measures_range else math.inf, 0.05, across])
    model = model_of(antenna, near_target_terms=True)._replace(height_m=to_target_m[2])
    at = np.array([*to_target_m[:2], 0.0, 0.0])
    return float(worst_variances_m2(P, at, pose, sigma, view, model)[0])


@pytest.mark.parametrize("antenna", [DOWN, LEVEL, LINE])
def test_what_is_out_of_view_tells_nothing(antenna: Antenna) -> None:
    narrow = antenna._replace(half_view_rad=math.radians(30.0))
    side = (40.0, 40.0, -20.0)
    vague_east = np.diag([900.0, 1.0, 25.0, 0.01])
    seen, unseen = (_worst_m2(vague_east, each, 0.0, side, False) for each in (antenna, narrow))
    assert seen < 900.0
    assert unseen == pytest.approx(900.0)


def test_an_array_is_planned_by_its_own_model() -> None:
    planner = FimPlanner(FimParams(), antenna=LEVEL)
    request = PlanRequest((0.0, 0.0), _target((0.0, 40.0)), height_m=20.0)
    waypoint = planner.plan(request, None).waypoint
    assert waypoint.reason is WaypointReason.INFORMATION
    turned = planner.plan(replace(request, yaw_enu_rad=2.0, sigmas=(0.5, 0.05, math.inf)), None)
    assert turned.waypoint.reason is WaypointReason.INFORMATION
