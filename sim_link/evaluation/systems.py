"""Systems under study, a filter with a planner, under the names of the paper's tables."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec
import numpy as np

from companion.domain import RangingMeasurement
from companion.errors import ConfigError
from companion.estimation.filters.kalman import KINDS, AdmmEkf, RecursiveFilter, filter_of
from companion.estimation.filters.target_filter import TargetFilter
from companion.estimation.measurement_model import MODALITIES
from companion.estimation.tracker import TargetTracker, TrackerParams
from companion.kernel import Matrix, Vector
from companion.planning.crossing import LatchedCrossing, ReactiveCrossing, ReactiveCrossingParams
from companion.planning.fim import FimParams, FimPlanner, candidate_ring_m
from companion.planning.planner import Planner
from sim_link.evaluation.case import Case
from sim_link.evaluation.objects import (
    Estimator,
    FilterEstimator,
    FixedPilot,
    Pilot,
    PlannerPilot,
    TrackerEstimator,
)
from sim_link.evaluation.tracks import lawnmower_track
from sim_link.evaluation.walk import (
    FIM,
    FIXED,
    LATCHED,
    PRINTED_FIM,
    REACTIVE,
    Belief,
    Steering,
)
from sim_link.evaluation.window import Window, prior_of

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
    )


def window_of_system(case: Case, system: System) -> Window:
    """The objective that corrects the system's filter, as the compiled walk takes it."""
    belief = belief_of(case, system)
    information, pull = prior_of(belief.prior_mean, belief.prior_sigmas)
    return Window(
        is_solved=system.filter == "map",
        sigma=belief.sigma,
        own_sigma_m=belief.model.own_sigma_m,
        thresholds=belief.thresholds,
        bounds=belief.bounds,
        information=information,
        pull=pull,
        prior_mean=belief.prior_mean,
    )


def steering_of(case: Case, system: System) -> Steering:
    """The system's planner, as the compiled walk takes it."""
    return Steering(
        PLANNERS[system.planner],
        case.step_m,
        case.crossing_distance_m,
        case.stop_distance_m,
        case.latched.rule(),
        np.array(candidate_ring_m(case.step_m, case.fim_headings)),
        np.ones(case.fim_headings, dtype=np.bool_),
    )


def recursive_filter_of(case: Case, system: System) -> RecursiveFilter:
    """The companion's filter of that name; that of the window is the one-sided filter.

    Raises:
        ValueError: It is none of them.
    """
    for kind in KINDS:
        if kind == ("asymmetric_huber" if system.filter == "map" else system.filter):
            return filter_of(kind, case.belief)
    raise ValueError(f"{system.filter} is no recursive filter of the companion")


def estimator_of(case: Case, system: System, start_enu_m: Vector) -> Estimator:
    """A fresh estimator of the system; the tracker makes its own start.

    Args:
        case: With what is believed.
        system: Whose filter.
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
        from sim_link.evaluation.filterpy_ekf import FilterpyEkf  # a second, for one row of tables

        target_filter = FilterpyEkf(case.belief)
    else:
        target_filter = recursive_filter_of(case, system)
    east_m, north_m = start_enu_m.tolist()
    start = None if math.isnan(east_m) else (east_m, north_m)
    return FilterEstimator(target_filter, case.belief, start)


def pilot_of(case: Case, system: System) -> Pilot:
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
