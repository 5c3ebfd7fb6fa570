"""Systems under study, a filter with a planner, under the names of the paper's tables.

Most fly as kernels, see `walk`. The others fly here, in the loop of `walk` over the companion's
classes: the same truth, the same draws and the same record; between them stand a `TargetFilter` or
`TargetTracker`, and a `Planner` called with a `PlanRequest`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec
import numpy as np

from companion.domain import EstimateState, PositionEnu, RangingMeasurement, TargetEstimate
from companion.errors import ConfigError
from companion.estimation.filters.target_filter import FilterParams, FilterState, TargetFilter
from companion.estimation.hypotheses import first_hypotheses
from companion.estimation.measurement_model import MODALITIES, RANGE_OFFSET
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector
from companion.planning.crossing import LatchedCrossing
from companion.planning.fim import (
    ALL_AROUND,
    FimParams,
    FimPlanner,
    candidate_poses_m,
    candidate_ring_m,
    model_of,
)
from companion.planning.planner import Planner, PlanRequest
from sim_link.world.environment import NO_MEMORY
from tools.study import case as cases
from tools.study import walk
from tools.study.admm_ekf import RECURSIVE, AdmmEkf
from tools.study.case import Case, RunTruth, Scene
from tools.study.metrics import r95_m
from tools.study.reactive_crossing import ReactiveCrossing
from tools.study.walk import WalkFilter, WalkSteering

STEP_S = 1.0
"""Time between two measurements; the target is stationary, so that only their order counts."""
EMITTER_ID = 1

Fuse = Callable[[RangingMeasurement, PositionEnu], tuple[TargetEstimate, Matrix]]
"""Fuses a measurement from a position; returns the estimated target position, and the (4, 4)
covariance of [east, north, range offset, bearing offset]."""
Steer = Callable[[int, Point, TargetEstimate, Matrix], Point]
"""Position of a step, from the previous position and the result of `Fuse` there."""


def fuse_by_filter(
    target_filter: TargetFilter, params: FilterParams, start_enu_m: Point | None = None
) -> Fuse:
    """Return a recursive filter from its first fix on: a start, or else the first measurement."""
    state: FilterState | None = None
    if start_enu_m is not None:
        mean, sigmas = params.prior
        mean[:2] = start_enu_m
        state = FilterState.of(0.0, mean, np.diag(sigmas**2))

    def fuse(seen: RangingMeasurement, sensor: PositionEnu) -> tuple[TargetEstimate, Matrix]:
        """Start or update the filter with a measurement."""
        nonlocal state
        if state is None:
            state = first_hypotheses(seen, sensor, params)[0].state
        else:
            predicted = target_filter.predict(state, seen.measured_at_s)
            state = target_filter.update(predicted, seen, sensor).state
        return _estimate_of(state, seen.measured_at_s), state.covariance[:4, :4]

    return fuse


def _estimate_of(state: FilterState, now_s: float) -> TargetEstimate:
    (ee, en), (_, nn) = state.covariance[:2, :2].tolist()
    return TargetEstimate(
        time_s=now_s,
        state=EstimateState.LOCALISED,
        position_enu_m=(float(state.mean[0]), float(state.mean[1])),
        covariance_m2=((ee, en), (en, nn)),
        r95_m=float(r95_m(np.array([ee, en, nn]))),
        range_offset_m=float(state.mean[2]),
        bearing_offset_rad=float(state.mean[3]),
        measurements=0,
    )


def fuse_by_tracker(tracker: TargetTracker) -> Fuse:
    """Return the companion's tracker, with its window and everything that makes it consistent."""

    def fuse(seen: RangingMeasurement, sensor: PositionEnu) -> tuple[TargetEstimate, Matrix]:
        """Update the tracker with a measurement."""
        tracker.fuse(seen, sensor, seen.measured_at_s)
        estimate = tracker.estimate(seen.measured_at_s)
        assert estimate is not None
        return estimate, tracker.hypotheses[0].state.covariance[:4, :4]

    return fuse


def steer_along(track_enu_m: Matrix) -> Steer:
    """Return a pilot that flies a given track, (steps, 2)."""
    return lambda step, *_: (float(track_enu_m[step, 0]), float(track_enu_m[step, 1]))


def steer_by_planner(planner: Planner[Any], step_m: float) -> Steer:
    """Return a pilot that flies a step towards a planner's waypoint, or to it if that is nearer."""
    memory: Any = None

    def steer(step: int, sensor: Point, estimate: TargetEstimate, joint: Matrix) -> Point:
        """Return the position after a step towards the planner's waypoint."""
        nonlocal memory
        request = PlanRequest(
            vehicle_enu_m=sensor, estimate=estimate, time_s=STEP_S * step, joint_covariance=joint
        )
        plan = planner.plan(request, memory)
        memory = plan.memory
        return cases.stepped(*sensor, *plan.waypoint.position_enu_m, step_m)

    return steer


def flown(
    draws: Matrix, start_enu_m: Point, truth: RunTruth, scene: Scene, fuse: Fuse, steer: Steer
) -> tuple[Matrix, Vector]:
    """Return a run's record, (steps, 9) as in `walk`, and R95, (steps,), by draws (steps, 6)."""
    steps = len(draws)
    record, radii = np.empty((steps, walk.COLUMNS)), np.empty(steps)
    sensor, memory = start_enu_m, NO_MEMORY
    for step in range(steps):
        range_m, bearing_rad, memory = cases.measured_in(draws[step], *sensor, truth, scene, memory)
        seen = RangingMeasurement(
            EMITTER_ID, STEP_S * step, range_m=range_m, bearing_enu_rad=bearing_rad
        )
        estimate, joint = fuse(seen, (*sensor, 0.0))
        (ee, en), (_, nn) = estimate.covariance_m2
        offsets = (estimate.range_offset_m, estimate.bearing_offset_rad)
        record[step] = (*sensor, *estimate.position_enu_m, *offsets, ee, en, nn)
        radii[step] = estimate.r95_m
        if step + 1 < steps:
            sensor = steer(step + 1, sensor, estimate, joint)
    return record, radii


FilterName = Literal["ekf", "huber", "admm", "asymmetric_huber", "map", "tracker"]
PlannerName = Literal["passive", "reactive", "latched", "fim", "fim_printed"]

FILTER_LABELS: dict[FilterName, str] = {
    "ekf": "EKF",
    "huber": "Huber",
    "admm": "ADMM",
    "asymmetric_huber": "Proposed",
    "map": "MAP",
    "tracker": "Companion",
}
PLANNER_LABELS: dict[PlannerName, str] = {
    "passive": "Passive",
    "reactive": "Reactive",
    "latched": "Latched",
    "fim": "FIM",
    "fim_printed": "FIM as printed",
}
PLANNERS = dict(zip(PLANNER_LABELS, range(walk.FIXED, walk.PRINTED_FIM + 1), strict=True))
"""Planners as the compiled walk numbers them."""


@dataclass(frozen=True, slots=True)
class System:
    """A filter with a planner."""

    filter: FilterName
    planner: PlannerName

    @property
    def label(self) -> str:
        """Name as in the paper's tables: Proposed (Reactive)."""
        return f"{FILTER_LABELS[self.filter]} ({PLANNER_LABELS[self.planner]})"

    @property
    def is_compiled(self) -> bool:
        """True if its run is one compiled loop."""
        return self.filter == "map" or self.filter in RECURSIVE


def system_named(name: str, where: str = "") -> System:
    """Return the system of a name like "asymmetric_huber/latched"; a ConfigError if unknown."""
    filter_name, _, planner = name.partition("/")
    for value, kind in ((filter_name, FilterName), (planner, PlannerName)):
        if value not in get_args(kind):
            known = ", ".join(get_args(kind))
            raise ConfigError(f"{where}system {name!r}: {value!r} is none of {known}")
    return msgspec.convert({"filter": filter_name, "planner": planner}, System)


def belief_of(case: Case, system: System) -> WalkFilter:
    """Return the system's filter parameters, as the compiled walk takes them."""
    target_filter = recursive_filter_of(case, system)
    params = target_filter.params
    mean, sigmas = params.prior
    sigma = np.array(params.effective_sigmas(RangingMeasurement(emitter_id=0, measured_at_s=0.0)))
    weights = 1.0 / sigmas**2
    weights[:RANGE_OFFSET] = 0.0
    iterations, penalty = 0, 1.0
    if isinstance(target_filter, AdmmEkf):
        iterations, penalty = target_filter.admm.iterations, target_filter.admm.penalty
    return WalkFilter(
        sigma=sigma,
        thresholds=params.thresholds,
        bounds=params.bounds,
        prior_mean=mean,
        prior_sigmas=sigmas,
        inflation=np.ones(MODALITIES),
        model=params.model,
        iterations=iterations,
        penalty=penalty,
        is_window_solved=system.filter == "map",
        information=np.diag(weights),
        pull=weights * mean,
    )


def steering_of(case: Case, system: System) -> WalkSteering:
    """Return the system's planner, as the compiled walk takes it."""
    return WalkSteering(
        PLANNERS[system.planner],
        case.step_m,
        case.crossing_distance_m,
        case.stop_distance_m,
        case.latched.rule(),
        np.array(candidate_ring_m(case.step_m, case.fim_headings)),
        np.ones(case.fim_headings, dtype=np.bool_),
        candidate_poses_m(case.step_m, case.fim_headings),
        ALL_AROUND,
        model_of(None, near_target_terms=True),
    )


def recursive_filter_of(case: Case, system: System) -> TargetFilter:
    """Return the recursive filter of that name, or a ValueError.

    The window's is the one-sided one.
    """
    name = "asymmetric_huber" if system.filter == "map" else system.filter
    if name not in RECURSIVE:
        raise ValueError(f"{name} is not a recursive filter")
    return RECURSIVE[name](case.belief)


def estimator_of(case: Case, system: System, start_enu_m: Vector) -> Fuse:
    """Return a fresh estimator of the system; the tracker makes its own start.

    The start (2,) is the position of the first estimate; NaN: from the first measurement. `map` has
    no class of its own (ValueError): it is `tracker` here.
    """
    if system.filter == "map":
        raise ValueError("the window alone is not a class: fly the tracker, which has one")
    if system.filter == "tracker":
        return fuse_by_tracker(TargetTracker(TrackerParams(filter=case.belief)))
    target_filter = recursive_filter_of(case, system)
    east_m, north_m = start_enu_m.tolist()
    start = None if math.isnan(east_m) else (east_m, north_m)
    return fuse_by_filter(target_filter, case.belief, start)


def pilot_of(case: Case, system: System) -> Steer:
    """Return a new pilot with the planner; raise ValueError for `fim_printed`."""
    planner: Planner[Any]
    match system.planner:
        case "passive":
            return steer_along(cases.track_of(case))
        case "reactive":
            planner = ReactiveCrossing(case)
        case "latched":
            planner = LatchedCrossing(case.latched)
        case "fim":
            planner = FimPlanner(
                FimParams(step_m=case.step_m, headings=case.fim_headings),
                case.belief.range_sigma_m,
                math.radians(case.belief.bearing_sigma_deg),
            )
        case _:
            raise ValueError(f"{system.planner} is not a planner that flies")
    return steer_by_planner(planner, case.step_m)
