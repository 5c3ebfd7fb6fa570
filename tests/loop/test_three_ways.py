"""The canonical scenario through kernels, through objects, and through MAVLink bytes.

The flights over MAVLink are the study's: the same draws of the channel, a measurement a second at
5 m/s, sensor and target at one height. What differs is what a vehicle adds: it takes time to speed
up and to turn, plans five times a second, finds its position between telemetry, and speaks in
single precision.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.config.schema import CompanionConfig, CrossingKind, PlannerConfig
from companion.config.tunables import Tunables
from companion.domain import PositionAccuracy, PositionEnu, RangingMeasurement, WaypointReason
from companion.estimation.stepwise import Steps
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from companion.flight_setup import build_planner
from companion.geometry.polygons import Point
from companion.guard.gate import Guard
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import EmitterQueue
from companion.guidance.session import GuidanceSession
from companion.kernel import Matrix
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import EndpointParams, VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink, message_from_ranging
from companion.planning.fim import FimParams
from companion.planning.planner import Plan, Planner, PlanRequest
from companion.planning.views import NO_LATCH
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import Loop
from tools.study.case import (
    TRUTH,
    Case,
    channel_draws,
    measured,
    run_seeds,
    stepped,
    stream,
    truth_of,
)
from tools.study.reactive_crossing import ReactiveCrossing
from tools.study.systems import PlannerName, System, belief_of, pilot_of, steering_of
from tools.study.trials import TrialResult, flown_trial, run_trial
from tools.study.walk import WalkFilter, first_fix, next_position, updated

STEPS = 150
FEW_STEPS = 60
"""Number of steps in the everyday tests."""
SEEDS = range(4)
WIRE_M = 1e-4
"""Error that bytes may add to an estimate; nearly all is the first view from 0.1 m too low."""
FLIGHT_M = 0.1
"""Largest change of a final estimate by flying: the views are from other positions."""
HEIGHT_M = 20.0
CASE = Case(steps=STEPS)
KINDS: Mapping[PlannerName, CrossingKind] = {"latched": "latched_crossing", "fim": "fim"}
FLOWN: tuple[PlannerName, ...] = ("reactive", *KINDS)
IN_PLANE = msgspec.structs.replace(CASE.belief, target_height_m=HEIGHT_M)
"""The study's belief, with the target as high as the vehicle flies."""
AS_FLOWN = TrackerParams(filter=IN_PLANE)
"""The companion's own, which the studies call `tracker`."""
FILTER_ALONE = TrackerParams(
    filter=IN_PLANE,
    window=WindowParams(enabled=False),
    adapt_inflation=False,
    range_gross_k=None,
)
"""The paper's filter and nothing else, as the kernels have it."""


def planner_of(name: PlannerName) -> Planner[Any]:
    """The companion's planner with its defaults, or the study's own."""
    if name == "reactive":
        return ReactiveCrossing(Case())
    return build_planner(CompanionConfig(planner=PlannerConfig(kind=KINDS[name])))


@dataclass(slots=True)
class StudyRadio:
    """A radio on a link of its own whose channel is that of a study's run."""

    seed: int
    steps: int
    positions: list[PositionEnu] = field(default_factory=list)
    """True position of the vehicle at each measurement."""
    z: list[tuple[float, float]] = field(default_factory=list)
    """Measured values there, metres and radians."""
    codec: MavCodec = field(default_factory=lambda: MavCodec(1, mavlink.MAV_COMP_ID_PERIPHERAL))

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        """A measurement once the vehicle is up, as long as there are draws."""
        # The vehicle hovers where its navigation says, and that is off by a tenth of a metre.
        body, run = sim.vehicle.body, run_seeds(self.seed, 1)[0]
        step = len(self.z)
        if step == self.steps or (step == 0 and body.height_m < HEIGHT_M - 0.11):
            return None
        east_m, north_m, _ = body.position_enu_m
        truth = truth_of(CASE, stream(run, TRUTH))
        range_m, bearing_rad = measured(channel_draws(CASE, run)[step], east_m, north_m, truth)
        self.positions.append(body.position_enu_m)
        self.z.append((range_m, bearing_rad))
        seen = RangingMeasurement(1, now_s, range_m=range_m, bearing_enu_rad=bearing_rad)
        return self.codec.encode(message_from_ranging(seen, round(1e6 * now_s)))


class WatchedPlanner:
    """The planner of a flight; what it was asked and what it answered is kept."""

    def __init__(self, planner: Planner[Any]) -> None:
        self.asked: list[tuple[PlanRequest, Plan[Any]]] = []
        self.search_after_s = planner.search_after_s
        self._planner = planner

    def plan(self, request: PlanRequest, memory: Any) -> Plan[Any]:
        plan = self._planner.plan(request, memory)
        self.asked.append((request, plan))
        return plan


class WatchedTracker(TargetTracker):
    """The tracker of a flight; what it made of each measurement is kept."""

    def __init__(self, params: TrackerParams) -> None:
        super().__init__(params)
        self.means: list[list[float]] = []

    def fusion(
        self,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu | None,
        now_s: float,
        own: PositionAccuracy | None = None,
    ) -> Steps[FusionReport]:
        report = yield from super().fusion(measurement, sensor_enu_m, now_s, own)
        self.means.append(self.hypotheses[0].state.mean.tolist())
        return report


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight over MAVLink, and all that went into it."""

    config: CompanionConfig
    positions: list[PositionEnu]
    z: list[tuple[float, float]]
    means: list[list[float]]
    asked: list[tuple[PlanRequest, Plan[Any]]]
    estimate_enu_m: Point
    """Estimate at the end."""


@lru_cache
def flight(
    planner: PlannerName, estimation: TrackerParams, seed: int, steps: int = STEPS
) -> Flight:
    """Fly until every draw of the run is used."""
    config = CompanionConfig(
        vehicle=VehicleParams(system_id=1),
        mission=SessionParams(engage="auto", altitude_m=HEIGHT_M, stop_confirm_s=1e6),
        estimation=estimation,
    )
    watched, tracker = WatchedPlanner(planner_of(planner)), WatchedTracker(config.tracking)
    emitters = EmitterQueue.of(tracker)
    guard = Guard(config.limits.guard_limits())
    session = GuidanceSession(config.mission, emitters, watched, guard)
    radio = StudyRadio(seed, steps)
    emitter = EmitterParams(position_enu_m=CASE.target_enu_m, height_m=HEIGHT_M)
    loop = Loop(
        config,
        Scenario(emitter=emitter),
        payload_source=radio,
        payload_period_s=1.0,
        make_companion=lambda _, journal, links: CompanionEndpoint(
            session,
            EndpointParams(config.vehicle, config.link, tuple(links)),
            journal,
            tunables=Tunables(config, build_planner),
        ),
    )
    loop.run_until(lambda: len(tracker.means) == steps, steps + 30.0)
    assert tracker.accepted == steps
    estimate = session.estimate
    assert estimate is not None
    position = estimate.position_enu_m
    return Flight(config, radio.positions, radio.z, tracker.means, watched.asked, position)


def by_objects(case: Case, system: System, seed: int) -> TrialResult:
    """The study's run over estimator and planner classes."""
    return flown_trial(case, system, run_seeds(seed, 1)[0])


def decisions(
    planner: PlannerName, estimation: TrackerParams, steps: int = STEPS
) -> list[tuple[PlanRequest, Plan[Any]]]:
    """Return the planner's requests and plans in flight, from the first estimate on."""
    asked = flight(planner, estimation, 0, steps).asked
    return [(request, plan) for request, plan in asked if request.estimate is not None]


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (1, 2))]
)
@pytest.mark.parametrize("planner", ["passive", *FLOWN])
def test_objects_fly_where_kernels_do(planner: PlannerName, seed: int) -> None:
    system = System("asymmetric_huber", planner)
    kernels = run_trial(Case(), system, run_seeds(seed, 1)[0])
    objects = by_objects(Case(), system, seed)
    np.testing.assert_allclose(kernels.record, objects.record, rtol=1e-9, atol=1e-9)


def filter_means(positions: Matrix, z: Matrix, belief: WalkFilter) -> Matrix:
    """The mean of the recursive filter after every measurement, (steps, n)."""
    (east_m, north_m), (range_m, bearing_rad) = positions[0], z[0, :2]
    mean, covariance = first_fix(east_m, north_m, range_m, bearing_rad, belief)
    means = [mean]
    for position, seen in zip(positions[1:], z[1:], strict=True):
        sensor = np.array([*position, 0.0])
        mean, covariance = updated(mean, covariance, sensor, seen, belief)
        means.append(mean)
    return np.array(means)


@pytest.mark.slow
@pytest.mark.parametrize("planner", FLOWN)
def test_bytes_change_no_estimate(planner: PlannerName) -> None:
    flown = flight(planner, FILTER_ALONE, 0)
    z = np.column_stack([flown.z, np.full(STEPS, math.nan)])
    positions = np.array(flown.positions)[:, :2].copy()
    means = filter_means(positions, z, belief_of(CASE, System("asymmetric_huber", planner)))
    misses_m = np.hypot(*(means[:, :2] - np.array(flown.means)[:, :2]).T)
    assert len(misses_m) == STEPS
    assert misses_m.max() <= WIRE_M
    np.testing.assert_allclose(np.array(flown.means)[:, 2], means[:, 2], rtol=0, atol=WIRE_M)


def test_the_companion_flies_by_the_studys_parameters() -> None:
    flown, studied = PlannerConfig(), Case()
    assert flown.kind == KINDS["latched"]
    assert flown.latched_crossing == studied.latched
    assert (FimParams().step_m, FimParams().headings) == (studied.step_m, studied.fim_headings)


@pytest.mark.slow
@pytest.mark.parametrize("estimation", [AS_FLOWN, FILTER_ALONE], ids=["tracker", "filter"])
@pytest.mark.parametrize("planner", FLOWN)
def test_every_decision_of_a_flight_is_the_planner_objects(
    planner: PlannerName, estimation: TrackerParams
) -> None:
    """Asked as the studies ask: without fence, setpoint or height."""
    fresh = planner_of(planner)
    memory: Any = None
    reasons = set()
    asked = decisions(planner, estimation)
    for request, in_flight in asked:
        bare = PlanRequest(
            request.vehicle_enu_m,
            request.estimate,
            time_s=request.time_s,
            joint_covariance=request.joint_covariance,
        )
        plan = fresh.plan(bare, memory)
        memory = plan.memory
        waypoint, flown = plan.waypoint, in_flight.waypoint
        assert (waypoint.reason, waypoint.detail) == (flown.reason, flown.detail)
        if flown.reason is not WaypointReason.HOLD:  # in flight it holds the setpoint, ahead of it
            assert waypoint.position_enu_m == pytest.approx(flown.position_enu_m, abs=1e-9)
        reasons.add(flown.reason)
    assert len(asked) > 5 * (STEPS - 10)
    assert reasons - {WaypointReason.HOLD}


@pytest.mark.slow
@pytest.mark.parametrize("planner", FLOWN)
def test_every_decision_of_a_flight_is_the_studys(planner: PlannerName) -> None:
    """By its pilot and by its kernel, each with a memory of its own, from the same estimates."""
    system = System("asymmetric_huber", planner)
    steer, latch = pilot_of(CASE, system), NO_LATCH
    belief, steering = belief_of(CASE, system), steering_of(CASE, system)
    moves = 0
    asked = decisions(planner, FILTER_ALONE, FEW_STEPS)
    for step, (request, in_flight) in enumerate(asked):
        at, estimate = request.vehicle_enu_m, request.estimate
        covariance = request.joint_covariance
        assert estimate is not None
        assert covariance is not None
        by_pilot = steer(step, at, estimate, covariance)
        mean = np.array([*estimate.position_enu_m, 0.0, 0.0])
        sensor, pick = np.array([*at, 0.0]), 0.5
        *by_kernel, latch = next_position(sensor, mean, covariance, pick, latch, belief, steering)
        assert by_kernel == pytest.approx(by_pilot, abs=1e-9)
        if in_flight.waypoint.reason is WaypointReason.HOLD:
            assert by_pilot == at
        else:
            target = in_flight.waypoint.position_enu_m
            assert by_pilot == pytest.approx(stepped(*at, *target, CASE.step_m), abs=1e-9)
            moves += 1
    assert moves > FEW_STEPS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "estimation"),
    [
        (System("asymmetric_huber", "latched"), FILTER_ALONE),
        (System("tracker", "latched"), AS_FLOWN),
    ],
    ids=["filter", "tracker"],
)
def test_flights_end_where_the_studys_runs_do(system: System, estimation: TrackerParams) -> None:
    flights = [flight("latched", estimation, seed) for seed in SEEDS]
    flown = np.array([each.estimate_enu_m for each in flights])
    objects = np.array([by_objects(CASE, system, seed).estimates_enu_m[-1] for seed in SEEDS])
    flown_m = np.hypot(*(flown - CASE.target_enu_m).T)
    objects_m = np.hypot(*(objects - CASE.target_enu_m).T)
    assert max(flown_m.max(), objects_m.max()) <= FLIGHT_M
    assert np.hypot(*(flown - objects).T).max() <= FLIGHT_M
    assert np.mean(flown_m**2) <= np.mean(objects_m**2)
