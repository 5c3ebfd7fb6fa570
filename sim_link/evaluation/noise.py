"""The channel's randomness drawn ahead, so that every system of a run suffers the same.

A run has three streams of its own, for the truth (offsets, first estimate), the channel and the
planner. What the channel draws does not depend on the case: with the same seed, a run with more
NLOS or less noise has the same obstructed paths and a few more, the same bends and the same noise
on another scale. The numbers are those of `sim_link.world.radio_channel` for the same stream.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.estimation.filters.robust_update import wrapped
from companion.kernel import Matrix, Vector, kernel
from sim_link.evaluation.case import Case
from sim_link.world.environment import (
    Environment,
    OpenPath,
    Shadow,
    ShadowMemory,
    obstruction,
)
from sim_link.world.line_of_sight import Surroundings
from sim_link.world.radio_channel import MIN_RANGE_M

OBSTRUCTED, EXCESS, BEND, RANGE_NOISE, BEARING_NOISE, BENT = range(6)
"""Columns of what is drawn: a uniform, a standard exponential, three standard normals, and the
uniform that decides about the bearing, which is the first one again unless the case parts them."""
COLUMNS = 6

TRUTH, CHANNEL, PLANNER, BEARING_CHANNEL = range(4)
"""Streams of a run."""

RunSeed = int | np.random.SeedSequence
"""What all randomness of one run follows from."""


class Truth(NamedTuple):
    """What is true in one run, as the kernels take it."""

    east_m: float
    """Of the target."""
    north_m: float
    range_offset_m: float
    bearing_offset_rad: float
    p_nlos: float
    mean_bias_m: float
    bend_sigma_rad: float
    range_sigma_m: float
    bearing_sigma_rad: float


class Scene(NamedTuple):
    """What stands between sensor and target, as the kernels take it."""

    surroundings: Surroundings
    shadow: Shadow


def run_seeds(seed: int, runs: int, first: int = 0) -> list[np.random.SeedSequence]:
    """The seeds of runs `first` to `first + runs` of a study; each its own whatever else is run."""
    return [np.random.SeedSequence(seed, spawn_key=(run,)) for run in range(first, first + runs)]


def stream(seed: RunSeed, which: int) -> np.random.Generator:
    """One of the streams of a run, from its beginning."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    key = (*root.spawn_key, which)
    return np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=key))


@kernel
def drawn(rng: np.random.Generator, steps: int) -> Matrix:
    """What the channel draws, (steps, 6)."""
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
    """What the channel of a run draws, (steps, 6)."""
    draws = drawn(stream(seed, CHANNEL), case.steps)
    if case.nlos_draws == "separate":
        draws[:, BENT] = stream(seed, BEARING_CHANNEL).random(case.steps)
    return draws


@kernel
def measured(draw: Vector, east_m: float, north_m: float, truth: Truth) -> tuple[float, float]:
    """Range and bearing through the true channel, metres and radians in [-pi, pi).

    Args:
        draw: (6,).
        east_m: Of the sensor.
        north_m: Of the sensor.
        truth: The constants.

    Paper: eq. (1).
    """
    excess_m = truth.mean_bias_m * draw[EXCESS] if draw[OBSTRUCTED] < truth.p_nlos else 0.0
    bend_rad = truth.bend_sigma_rad * draw[BEND] if draw[BENT] < truth.p_nlos else 0.0
    return received(draw, east_m, north_m, truth, excess_m, bend_rad)


@kernel
def measured_in(
    draw: Vector, east_m: float, north_m: float, truth: Truth, scene: Scene, memory: ShadowMemory
) -> tuple[float, float, ShadowMemory]:
    """The same among obstacles, and what the next shadowed measurement must remember.

    Args:
        draw: (6,).
        east_m: Of the sensor.
        north_m: Of the sensor.
        truth: The constants.
        scene: The obstacles, and what a path suffers that they block.
        memory: Of the measurement before; `NO_MEMORY` at first.
    """
    if scene.surroundings.edges.shape[0] == 0:
        range_m, bearing_rad = measured(draw, east_m, north_m, truth)
        return range_m, bearing_rad, memory
    excess_m, bend_rad, memory = obstruction(
        draw[OBSTRUCTED],
        draw[EXCESS],
        draw[BEND],
        east_m,
        north_m,
        0.0,
        OpenPath(truth.p_nlos, truth.mean_bias_m, truth.bend_sigma_rad),
        scene.shadow,
        scene.surroundings,
        memory,
    )
    range_m, bearing_rad = received(draw, east_m, north_m, truth, excess_m, bend_rad)
    return range_m, bearing_rad, memory


@kernel
def received(
    draw: Vector, east_m: float, north_m: float, truth: Truth, excess_m: float, bend_rad: float
) -> tuple[float, float]:
    """Range and bearing with their offsets, what stands in the way, and thermal noise."""
    de, dn = truth.east_m - east_m, truth.north_m - north_m
    range_m = math.hypot(de, dn) + truth.range_offset_m
    bearing_rad = math.atan2(dn, de) + truth.bearing_offset_rad
    range_m += excess_m + truth.range_sigma_m * draw[RANGE_NOISE]
    bearing_rad += bend_rad + truth.bearing_sigma_rad * draw[BEARING_NOISE]
    return max(MIN_RANGE_M, range_m), wrapped(bearing_rad)


def scene_of(case: Case) -> Scene:
    """The obstacles of a case about its target."""
    environment = Environment(case.obstacles, case.shadow)
    return Scene(environment.around((*case.target_enu_m, 0.0)), environment.shadow)


def truth_of(case: Case, rng: np.random.Generator) -> Truth:
    """What is true in a run; draws two numbers whether the case needs them or not."""
    channel, belief = case.channel, case.belief
    range_offset_m, bearing_offset_deg = channel.range_offset_m, channel.bearing_offset_deg
    draws = rng.standard_normal(2)
    if case.offsets == "prior":
        range_offset_m = belief.range_offset_sigma_m * float(draws[0])
        bearing_offset_deg = belief.bearing_offset_sigma_deg * float(draws[1])
    return Truth(
        *case.target_enu_m,
        range_offset_m,
        math.radians(bearing_offset_deg),
        channel.p_nlos,
        channel.range_bias_mean_m,
        math.radians(channel.bearing_bias_sigma_deg),
        channel.range_sigma_m,
        math.radians(channel.bearing_sigma_deg),
    )
