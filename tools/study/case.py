"""A study case: the scene, the fixed track, and random draws made in advance.

The defaults are the paper's canonical scenario ("Simulation Setup"), and where it is open:

    bearing noise            sigma_theta = 2 deg
    NLOS                     one draw per step decides for range and bearing together
    Exp(8.0)                 mean 8 m
    horizon                  500 steps, a measurement each, the first one at the start
    first estimate           the first range and bearing, inverted; offsets zero;
                             P0 = diag(30 m, 30 m, 5 m, 5 deg)^2; or a uniform draw over the area
    thresholds               k_rtt = k_aoa = 1.5
    FIM candidates           16 headings at the step length, and staying
    lawnmower                5 m lanes over the whole area, the first at y = 2.5 m
    eps_stop                 0
    plane                    sensor and target at one height, the sensor's position known exactly

Truth, channel and planner of a run have separate random streams, so that every system meets the
same errors. The channel's draws do not depend on the case: with the same seed, a run with more NLOS
or less noise has the same obstructed paths and a few more, and scaled copies of the same errors.
They are the numbers of `sim_link.world.radio_channel` for the same stream.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np

from companion.domain import NonNegative, Params, Positive
from companion.estimation.antenna import AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.number_or_array import wrapped
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector, kernel
from companion.planning.crossing import LatchedCrossingParams
from companion.planning.fim import HEADINGS
from sim_link.world.environment import (
    ChannelParams,
    Environment,
    ObstacleParams,
    OpenPath,
    Shadow,
    ShadowMemory,
    ShadowParams,
    obstruction,
)
from sim_link.world.line_of_sight import Surroundings
from sim_link.world.radio_channel import MIN_RANGE_M

FirstEstimate = Literal["measured", "uniform"]
Offsets = Literal["fixed", "prior"]
NlosDraws = Literal["joint", "separate"]

PAPER_BELIEF = FilterParams(own_position_sigma_m=0.0, antenna=AntennaParams(kind="azimuth"))
"""Assumptions of every filter in the canonical scenario."""

STUDY_SHADOW = ShadowParams(
    detour_share=0.0,
    pull_share=0.0,
    extra_bias_mean_m=15.0,
    bearing_bias_sigma_deg=10.0,
    correlation_m=0.0,
)
"""Structured obstacle of the studies: only blocking matters, draws are independent."""


class Case(Params, frozen=True):
    """One cell of a study."""

    area_m: tuple[Positive, Positive] = (100.0, 100.0)
    """Width and depth, from the origin to the east and north."""
    start_enu_m: Point = (10.0, 10.0)
    target_enu_m: Point = (50.0, 50.0)
    channel: ChannelParams = ChannelParams()
    """The truth, outside of shadows."""
    nlos_draws: NlosDraws = "joint"
    """`joint`: one draw decides whether range and bearing are obstructed; otherwise one draw
    each."""
    obstacles: tuple[ObstacleParams, ...] = ()
    """Obstacles to the radio, not to the flight."""
    shadow: ShadowParams = STUDY_SHADOW
    """The truth behind them."""
    belief: FilterParams = PAPER_BELIEF
    """Noise model that the filter assumes."""
    steps: Annotated[int, msgspec.Meta(ge=1)] = 500
    step_m: Positive = 5.0
    """Distance between two measurements. Paper: eta."""
    first_estimate: FirstEstimate = "measured"
    """The first measurement inverted, or a draw over the area that it then corrects."""
    offsets: Offsets = "fixed"
    """Source of the offsets: the channel, or a draw from the filter's priors for each run."""
    lane_spacing_m: Positive = 5.0
    first_lane_north_m: NonNegative | None = None
    """First lane from the south; None: half a spacing inside the area."""
    crossing_distance_m: Positive = 20.0
    """Crossing distance of reactive crossing. Paper: l."""
    stop_distance_m: NonNegative = 0.0
    """Stopping distance of reactive crossing; above zero it stops over its estimate and gains no
    information. Paper: eps_stop."""
    latched: LatchedCrossingParams = LatchedCrossingParams()
    fim_headings: Annotated[int, msgspec.Meta(ge=3, le=360)] = HEADINGS

    def __post_init__(self) -> None:
        """Refuse combinations that the compiled walk does not support."""
        if self.belief.process_noise_m_per_sqrt_s > 0.0:
            raise ValueError("belief.process_noise_m_per_sqrt_s must be 0: the target lies still")
        if self.belief.target_height_m != 0.0 or self.belief.target_height_sigma_m > 0.0:
            raise ValueError("belief.target_height_m must be 0 and known: studies are plane")
        if self.obstacles and self.nlos_draws == "separate":
            raise ValueError("nlos_draws must be joint among obstacles: a shadow takes the path")


LANE_SLACK = 1e-9
"""Share of a spacing by which the last lane may lie outside through rounding."""


@kernel
def stepped(
    east_m: float, north_m: float, to_east_m: float, to_north_m: float, step_m: float
) -> tuple[float, float]:
    """Return the position one step on the way to a waypoint, or the waypoint if that is nearer."""
    de, dn = to_east_m - east_m, to_north_m - north_m
    distance_m = math.hypot(de, dn)
    if distance_m <= step_m:
        return to_east_m, to_north_m
    share = step_m / distance_m
    return east_m + share * de, north_m + share * dn


def lane_corners(
    area_m: tuple[float, float], spacing_m: float, first_north_m: float | None = None
) -> list[Point]:
    """Return corners of east-west lanes over an area, the first half a spacing inside."""
    width_m, depth_m = area_m
    if first_north_m is None:
        first_north_m = 0.5 * spacing_m
    corners: list[Point] = []
    for lane in range(max(1, math.floor((depth_m - first_north_m) / spacing_m + LANE_SLACK) + 1)):
        north_m = first_north_m + spacing_m * lane
        ends = [(0.0, north_m), (width_m, north_m)]
        corners += ends if lane % 2 == 0 else ends[::-1]
    return corners


def track_of(case: Case) -> Matrix:
    """Return the lawnmower's positions at even steps, (steps, 2); all systems start at the first.

    The path from the start to the first lane is part of the track; at the end of the last lane it
    turns around and goes back lane by lane.
    """
    sweep = lane_corners(case.area_m, case.lane_spacing_m, case.first_lane_north_m)
    corners = [case.start_enu_m, *sweep]
    length_m = case.step_m * (case.steps - 1)
    turns = 0
    while sum(math.dist(a, b) for a, b in itertools.pairwise(corners)) < length_m:
        turns += 1
        corners += (sweep[::-1] if turns % 2 else sweep)[1:]
    return along(np.array(corners), case.step_m, case.steps)


def along(corners: Matrix, step_m: float, steps: int) -> Matrix:
    """Return positions at even steps along a polyline (k, 2), (steps, 2), waiting at its end."""
    legs_m = np.hypot(*np.diff(corners, axis=0).T)
    corner_at_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    at_m = step_m * np.arange(steps)
    return np.column_stack([np.interp(at_m, corner_at_m, axis) for axis in corners.T])


OBSTRUCTED, EXCESS, BEND, RANGE_NOISE, BEARING_NOISE, BENT = range(6)
"""Columns of what is drawn: a uniform, a standard exponential, three standard normals, and the
uniform that decides about the bearing, which is the first one again unless the case parts them."""
COLUMNS = 6

TRUTH, CHANNEL, PLANNER, BEARING_CHANNEL = range(4)

RunSeed = int | np.random.SeedSequence
"""Seed of all randomness of one run."""


class RunTruth(NamedTuple):
    """True parameters of one run, as the kernels take them."""

    east_m: float
    north_m: float
    range_offset_m: float
    bearing_offset_rad: float
    p_nlos: float
    mean_bias_m: float
    bend_sigma_rad: float
    range_sigma_m: float
    bearing_sigma_rad: float


class Scene(NamedTuple):
    """Obstacles between sensor and target, as the kernels take them."""

    surroundings: Surroundings
    shadow: Shadow


def run_seeds(seed: int, runs: int, first: int = 0) -> list[np.random.SeedSequence]:
    """Return the seeds of runs `first` to `first + runs` of a study, independent of other runs."""
    return [np.random.SeedSequence(seed, spawn_key=(run,)) for run in range(first, first + runs)]


def stream(seed: RunSeed, which: int) -> np.random.Generator:
    """Return one of the streams of a run, from its beginning."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    key = (*root.spawn_key, which)
    return np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=key))


@kernel
def drawn(rng: np.random.Generator, steps: int) -> Matrix:
    """Draw the channel's random numbers, (steps, 6)."""
    draws = np.empty((steps, COLUMNS))
    for index in range(steps):
        draws[index, OBSTRUCTED] = rng.random()
        draws[index, EXCESS] = rng.standard_exponential()
        draws[index, BEND] = rng.standard_normal()
        draws[index, RANGE_NOISE] = rng.standard_normal()
        draws[index, BEARING_NOISE] = rng.standard_normal()
        draws[index, BENT] = draws[index, OBSTRUCTED]
    return draws


def channel_draws(case: Case, seed: RunSeed) -> Matrix:
    """Draw the random numbers of a run's channel, (steps, 6)."""
    draws = drawn(stream(seed, CHANNEL), case.steps)
    if case.nlos_draws == "separate":
        draws[:, BENT] = stream(seed, BEARING_CHANNEL).random(case.steps)
    return draws


@kernel
def measured(draw: Vector, east_m: float, north_m: float, truth: RunTruth) -> tuple[float, float]:
    """Return range and bearing, in [-pi, pi), by a draw (6,) of the channel. Paper: eq. (1)."""
    excess_m = truth.mean_bias_m * draw[EXCESS] if draw[OBSTRUCTED] < truth.p_nlos else 0.0
    bend_rad = truth.bend_sigma_rad * draw[BEND] if draw[BENT] < truth.p_nlos else 0.0
    return received(draw, east_m, north_m, truth, excess_m, bend_rad)


@kernel
def measured_in(
    draw: Vector, east_m: float, north_m: float, truth: RunTruth, scene: Scene, memory: ShadowMemory
) -> tuple[float, float, ShadowMemory]:
    """Return the same among obstacles, and the memory for the next call; at first `NO_MEMORY`."""
    if scene.surroundings.edges.shape[0] == 0:
        range_m, bearing_rad = measured(draw, east_m, north_m, truth)
        return range_m, bearing_rad, memory
    excess_m, bend_rad, memory = obstruction(
        (draw[OBSTRUCTED], draw[EXCESS], draw[BEND]),
        (east_m, north_m, 0.0),
        OpenPath(truth.p_nlos, truth.mean_bias_m, truth.bend_sigma_rad),
        scene.shadow,
        scene.surroundings,
        memory,
    )
    range_m, bearing_rad = received(draw, east_m, north_m, truth, excess_m, bend_rad)
    return range_m, bearing_rad, memory


@kernel
def received(
    draw: Vector, east_m: float, north_m: float, truth: RunTruth, excess_m: float, bend_rad: float
) -> tuple[float, float]:
    """Return range and bearing with offsets, the obstacle's excess and bend, and noise."""
    de, dn = truth.east_m - east_m, truth.north_m - north_m
    range_m = math.hypot(de, dn) + truth.range_offset_m
    bearing_rad = math.atan2(dn, de) + truth.bearing_offset_rad
    range_m += excess_m + truth.range_sigma_m * draw[RANGE_NOISE]
    bearing_rad += bend_rad + truth.bearing_sigma_rad * draw[BEARING_NOISE]
    return max(MIN_RANGE_M, range_m), wrapped(bearing_rad)


def scene_of(case: Case) -> Scene:
    """Return the obstacles of a case about its target."""
    environment = Environment(case.obstacles, case.shadow)
    return Scene(environment.around((*case.target_enu_m, 0.0)), environment.shadow)


def truth_of(case: Case, rng: np.random.Generator) -> RunTruth:
    """Draw the truth of a run; draws two numbers even if the case needs none."""
    channel, belief = case.channel, case.belief
    range_offset_m, bearing_offset_deg = channel.range_offset_m, channel.bearing_offset_deg
    draws = rng.standard_normal(2)
    if case.offsets == "prior":
        range_offset_m = belief.range_offset_sigma_m * float(draws[0])
        bearing_offset_deg = belief.bearing_offset_sigma_deg * float(draws[1])
    return RunTruth(
        *case.target_enu_m,
        range_offset_m,
        math.radians(bearing_offset_deg),
        channel.p_nlos,
        channel.range_bias_mean_m,
        math.radians(channel.bearing_bias_sigma_deg),
        channel.range_sigma_m,
        math.radians(channel.bearing_sigma_deg),
    )


def run_inputs(case: Case, seed: RunSeed) -> tuple[Matrix, RunTruth, Vector]:
    """Return channel draws, truth and first estimate of a run.

    The first estimate (2,) is drawn over the area; NaN: from the first measurement.
    """
    rng = stream(seed, TRUTH)
    truth = truth_of(case, rng)
    start_enu_m = rng.random(2) * np.array(case.area_m)
    if case.first_estimate == "measured":
        start_enu_m = np.full(2, math.nan)
    return channel_draws(case, seed), truth, start_enu_m
