"""A run of what is not a kernel: the loop of `walk` over estimator and planner objects.

The same truth, the same draws and the same record; between them stand the classes that fly:
`TargetFilter` or `TargetTracker`, and a `Planner` asked by `PlanRequest`.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from companion.domain import (
    EstimateState,
    Point,
    PositionEnu,
    RangingMeasurement,
    TargetEstimate,
)
from companion.estimation.filters.target_filter import FilterParams, FilterState, TargetFilter
from companion.estimation.hypotheses import HypothesisParams, first_hypotheses
from companion.estimation.tracker import TargetTracker
from companion.kernel import Matrix, Vector
from companion.planning.planner import Planner, PlanRequest
from sim_link.evaluation.metrics import r95_m
from sim_link.evaluation.noise import Scene, Truth, measured_in
from sim_link.evaluation.tracks import stepped
from sim_link.evaluation.walk import COLUMNS
from sim_link.world.environment import NO_MEMORY

STEP_S = 1.0
"""Between two measurements; the target lies still, so that only their order counts."""
EMITTER_ID = 1


class Estimator(Protocol):
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
        target_filter: The filter.
        params: Its priors.
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
    """The companion's tracker, with its window and all else that makes it honest.

    Args:
        tracker: A fresh one.
    """

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


class Pilot(Protocol):
    """Says where the next measurement is made."""

    def next_place(
        self, step: int, place_enu_m: Point, estimate: TargetEstimate | None, joint: Matrix
    ) -> Point:
        """The place of step `step`, from the one before.

        Args:
            step: Number of the next measurement.
            place_enu_m: Of the last one.
            estimate: After the last one.
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
    """Flies a step towards the waypoint of a planner.

    Args:
        planner: Asked before every step.
        step_m: Between two measurements.
    """

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
    truth: Truth,
    scene: Scene,
    estimator: Estimator,
    pilot: Pilot,
) -> tuple[Matrix, Vector]:
    """The record of a run, (steps, 9) as `walk` has it, and its R95, (steps,), metres.

    Args:
        draws: (steps, 6) of the channel.
        start_enu_m: Place of the first measurement.
        truth: What is true.
        scene: What stands in the way.
        estimator: A fresh one.
        pilot: A fresh one.
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
