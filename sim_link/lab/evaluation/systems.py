"""Systems under study, a filter with a planner, as kernels and as the classes that fly.

A run of what is not a kernel: the loop of `walk` over estimator and planner objects.

The same truth, the same draws and the same record; between them stand the classes that fly:
`TargetFilter` or `TargetTracker`, and a `Planner` asked by `PlanRequest`.

Systems under study, a filter with a planner, under the names of the paper's tables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import msgspec
import numpy as np

from companion.domain import EstimateState, PositionEnu, RangingMeasurement, TargetEstimate
from companion.errors import ConfigError
from companion.estimation.filters.kalman import KINDS, AdmmEkf, filter_of
from companion.estimation.filters.target_filter import FilterParams, FilterState, TargetFilter
from companion.estimation.hypotheses import HypothesisParams, first_hypotheses
from companion.estimation.measurement_model import MODALITIES
from companion.estimation.tracker import TargetTracker, TrackerParams
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector
from companion.planning.crossing import LatchedCrossing, ReactiveCrossing, ReactiveCrossingParams
from companion.planning.fim import FimParams, FimPlanner, candidate_ring_m
from companion.planning.planner import Planner, PlanRequest
from sim_link.lab.evaluation.case import (
    Case,
    RunTruth,
    Scene,
    lawnmower_track,
    measured_in,
    stepped,
)
from sim_link.lab.evaluation.metrics import r95_m
from sim_link.lab.evaluation.walk import (
    COLUMNS,
    FIM,
    FIXED,
    LATCHED,
    PRINTED_FIM,
    REACTIVE,
    Belief,
    WalkSteering,
    prior_of,
)
from sim_link.world.environment import NO_MEMORY

STEP_S = 1.0
"""Between two measurements; the target lies still, so that only their order counts."""
EMITTER_ID = 1


class RunEstimator(Protocol):
    """Turns measurements into an estimate."""

    def fuse(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        """Take in one measurement."""

    def estimate(self, now_s: float) -> TargetEstimate:
        """Where the target is believed to be, after at least one measurement."""

    def joint_covariance(self) -> Matrix:
        """(4, 4) of [east, north, range offset, bearing offset]."""


class FilterEstimator:
    """A recursive filter from its first fix on.

    Args:
        start_enu_m: Place of the first estimate; None: from the first measurement.
    """

    def __init__(
        self, target_filter: TargetFilter, params: FilterParams, start_enu_m: Point | None = None
    ) -> None:
        self._filter = target_filter
        self._params = params
        self._state: FilterState | None = None
        if start_enu_m is not None:
            mean, sigmas = params.prior
            mean[:2] = start_enu_m
            self._state = FilterState.of(0.0, mean, np.diag(sigmas**2))

    def fuse(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        """Take in one measurement."""
        if self._state is None:
            first = first_hypotheses(measurement, sensor_enu_m, self._params, HypothesisParams())
            self._state = first[0].state
            return
        state = self._filter.predict(self._state, measurement.measured_at_s)
        self._state = self._filter.update(state, measurement, sensor_enu_m).state

    def estimate(self, now_s: float) -> TargetEstimate:
        """The mean, its covariance and the R95 of that."""
        assert self._state is not None
        mean, covariance = self._state.mean, self._state.covariance
        (ee, en), (_, nn) = covariance[:2, :2].tolist()
        return TargetEstimate(
            time_s=now_s,
            state=EstimateState.LOCALISED,
            position_enu_m=(float(mean[0]), float(mean[1])),
            covariance_m2=((ee, en), (en, nn)),
            r95_m=float(r95_m(np.array([ee, en, nn]))),
            range_offset_m=float(mean[2]),
            bearing_offset_rad=float(mean[3]),
            measurements=0,
        )

    def joint_covariance(self) -> Matrix:
        """Of the filter's state."""
        assert self._state is not None
        return self._state.covariance[:4, :4]


class TrackerEstimator:
    """The companion's tracker, with its window and all else that makes it honest."""

    def __init__(self, tracker: TargetTracker) -> None:
        self._tracker = tracker

    def fuse(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> None:
        """Take in one measurement."""
        self._tracker.fuse(measurement, sensor_enu_m, measurement.measured_at_s)

    def estimate(self, now_s: float) -> TargetEstimate:
        """What the tracker says."""
        estimate = self._tracker.estimate(now_s)
        assert estimate is not None
        return estimate

    def joint_covariance(self) -> Matrix:
        """Of the best hypothesis."""
        return self._tracker.hypotheses[0].state.covariance[:4, :4]


class RunPilot(Protocol):
    """Says where the next measurement is made."""

    def next_place(
        self, step: int, place_enu_m: Point, estimate: TargetEstimate | None, joint: Matrix
    ) -> Point:
        """The place of step `step`, from the one before.

        Args:
            joint: (4, 4) covariance of position and offsets.
        """


class FixedPilot:
    """Flies a given track.

    Args:
        track_enu_m: (steps, 2).
    """

    def __init__(self, track_enu_m: Matrix) -> None:
        self._track = track_enu_m

    def next_place(
        self, step: int, place_enu_m: Point, estimate: TargetEstimate | None, joint: Matrix
    ) -> Point:
        """The next place of the track."""
        del place_enu_m, estimate, joint
        return (float(self._track[step, 0]), float(self._track[step, 1]))


class PlannerPilot:
    """Flies a step towards the waypoint of a planner."""

    def __init__(self, planner: Planner[Any], step_m: float) -> None:
        self._planner = planner
        self._step_m = step_m
        self._memory = planner.initial_memory()

    def next_place(
        self, step: int, place_enu_m: Point, estimate: TargetEstimate | None, joint: Matrix
    ) -> Point:
        """One step towards the waypoint, or the waypoint where that is nearer."""
        plan = self._planner.plan(
            PlanRequest(
                vehicle_enu_m=place_enu_m,
                estimate=estimate,
                time_s=STEP_S * step,
                joint_covariance=joint,
            ),
            self._memory,
        )
        self._memory = plan.memory
        return stepped(*place_enu_m, *plan.waypoint.position_enu_m, self._step_m)


def flown(
    draws: Matrix,
    start_enu_m: Point,
    truth: RunTruth,
    scene: Scene,
    estimator: RunEstimator,
    pilot: RunPilot,
) -> tuple[Matrix, Vector]:
    """The record of a run, (steps, 9) as `walk` has it, and its R95, (steps,), metres.

    Args:
        draws: (steps, 6) of the channel.
    """
    steps = len(draws)
    record, radii = np.empty((steps, COLUMNS)), np.empty(steps)
    place, memory = start_enu_m, NO_MEMORY
    estimate: TargetEstimate | None = None
    for step in range(steps):
        if step:
            place = pilot.next_place(step, place, estimate, estimator.joint_covariance())
        now_s = STEP_S * step
        range_m, bearing_rad, memory = measured_in(draws[step], *place, truth, scene, memory)
        estimator.fuse(
            RangingMeasurement(EMITTER_ID, now_s, range_m=range_m, bearing_enu_rad=bearing_rad),
            (*place, 0.0),
        )
        estimate = estimator.estimate(now_s)
        (ee, en), (_, nn) = estimate.covariance_m2
        offsets = (estimate.range_offset_m, estimate.bearing_offset_rad)
        record[step] = (*place, *estimate.position_enu_m, *offsets, ee, en, nn)
        radii[step] = estimate.r95_m
    return record, radii


FilterName = Literal["ekf", "filterpy", "huber", "admm", "asymmetric_huber", "map", "tracker"]
PlannerName = Literal["passive", "reactive", "latched", "fim", "fim_printed"]

FILTER_LABELS: dict[FilterName, str] = {
    "ekf": "EKF",
    "filterpy": "EKF (filterpy)",
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
PLANNERS: dict[PlannerName, int] = {
    "passive": FIXED,
    "reactive": REACTIVE,
    "latched": LATCHED,
    "fim": FIM,
    "fim_printed": PRINTED_FIM,
}
"""As the compiled walk numbers them."""


@dataclass(frozen=True, slots=True)
class System:
    """A filter with a planner."""

    filter: FilterName
    planner: PlannerName

    @property
    def label(self) -> str:
        """As the paper's tables have it: Proposed (Reactive)."""
        return f"{FILTER_LABELS[self.filter]} ({PLANNER_LABELS[self.planner]})"

    @property
    def is_compiled(self) -> bool:
        """Whether its run is one compiled loop."""
        return self.filter == "map" or self.filter in KINDS


def system_named(name: str) -> System:
    """The system of a name like "asymmetric_huber/latched".

    Raises:
        ConfigError: There is no such filter or planner.
    """
    filter_name, _, planner = name.partition("/")
    for value, kind in ((filter_name, FilterName), (planner, PlannerName)):
        if value not in get_args(kind):
            known = ", ".join(get_args(kind))
            raise ConfigError(f"system {name!r}: {value!r} is none of {known}")
    return msgspec.convert({"filter": filter_name, "planner": planner}, System)


def track_of(case: Case) -> Matrix:
    """The lawnmower's places, (steps, 2); the first one is where every system starts."""
    return lawnmower_track(
        case.area_m,
        case.start_enu_m,
        case.lane_spacing_m,
        case.step_m,
        case.steps,
        case.first_lane_north_m,
    )


def belief_of(case: Case, system: System) -> Belief:
    """What the system's recursive filter believes, as the compiled walk takes it."""
    target_filter = recursive_filter_of(case, system)
    params = target_filter.params
    mean, sigmas = params.prior
    _, sigma = params.seen(RangingMeasurement(emitter_id=0, measured_at_s=0.0))
    information, pull = prior_of(mean, sigmas)
    iterations, penalty = 0, 1.0
    if isinstance(target_filter, AdmmEkf):
        iterations, penalty = target_filter.admm.iterations, target_filter.admm.penalty
    return Belief(
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
        information=information,
        pull=pull,
    )


def steering_of(case: Case, system: System) -> WalkSteering:
    """The system's planner, as the compiled walk takes it."""
    return WalkSteering(
        PLANNERS[system.planner],
        case.step_m,
        case.crossing_distance_m,
        case.stop_distance_m,
        case.latched.rule(),
        np.array(candidate_ring_m(case.step_m, case.fim_headings)),
        np.ones(case.fim_headings, dtype=np.bool_),
    )


def recursive_filter_of(case: Case, system: System) -> TargetFilter:
    """The companion's filter of that name; that of the window is the one-sided filter.

    Raises:
        ValueError: It is none of them.
    """
    for kind in KINDS:
        if kind == ("asymmetric_huber" if system.filter == "map" else system.filter):
            return filter_of(kind, case.belief)
    raise ValueError(f"{system.filter} is no recursive filter of the companion")


def estimator_of(case: Case, system: System, start_enu_m: Vector) -> RunEstimator:
    """A fresh estimator of the system; the tracker makes its own start.

    Args:
        start_enu_m: (2,) place of the first estimate; NaN: from the first measurement.

    Raises:
        ValueError: The system's filter has no class of its own: `map`, which is `tracker` there.
    """
    if system.filter == "map":
        raise ValueError("the window alone is no class: fly the tracker, which has one")
    if system.filter == "tracker":
        return TrackerEstimator(TargetTracker(TrackerParams(filter=case.belief)))
    target_filter: TargetFilter
    if system.filter == "filterpy":
        from sim_link.lab.evaluation.filterpy_ekf import (
            FilterpyEkf,  # a second, for one row of tables
        )

        target_filter = FilterpyEkf(case.belief)
    else:
        target_filter = recursive_filter_of(case, system)
    east_m, north_m = start_enu_m.tolist()
    start = None if math.isnan(east_m) else (east_m, north_m)
    return FilterEstimator(target_filter, case.belief, start)


def pilot_of(case: Case, system: System) -> RunPilot:
    """A fresh pilot with the system's planner.

    Raises:
        ValueError: The planner has no class: `fim_printed`, which only the studies fly.
    """
    p = case.belief
    planners: dict[PlannerName, Planner[Any]] = {
        "reactive": ReactiveCrossing(
            ReactiveCrossingParams(
                step_m=case.step_m,
                crossing_distance_m=case.crossing_distance_m,
                stop_distance_m=case.stop_distance_m,
            )
        ),
        "latched": LatchedCrossing(case.latched),
        "fim": FimPlanner(
            FimParams(step_m=case.step_m, headings=case.fim_headings),
            p.range_sigma_m,
            math.radians(p.bearing_sigma_deg),
        ),
    }
    if system.planner == "passive":
        return FixedPilot(track_of(case))
    if system.planner not in planners:
        raise ValueError(f"{system.planner} is no planner that flies")
    return PlannerPilot(planners[system.planner], case.step_m)
