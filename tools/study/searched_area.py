"""Flights that check stated probabilities of detection in worlds unknown to the estimator.

The world is written apart from `companion.search`. An answer is received while 10 n log10(reach /
d) plus the reach's error, shadowing, fading and walls is positive. Shadowing is a Gaussian field
over the vehicle's positions with exponential correlation (M. Gudmundson, Electronics Letters 27,
1991) on top of a part that stays with the emitter; fading is Rice's. What the estimator assumes is
off as it is in the field: the reach by up to 6 dB, and exponent, shadowing, its correlation length
and the direct path's share by the usual uncertainty about a site.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from companion.geometry.polygons import Point
from companion.search.detection_model import PROPAGATION, DetectionModel, Environment, Wall
from companion.search.search_grid import SearchGrid, WeightedArea, grid_over
from companion.search.searched_area import SearchedArea, state_of
from tools.console import csv_text
from tools.study.case import along, lane_corners

Array = NDArray[np.float64]
Kind = Literal["open", "rubble", "walls"]
KINDS = get_args(Kind)
EMITTERS = 40
"""Positions of one flight at which an emitter is tried; the first is drawn from the POA."""
INTERVAL_S = 1.0
MAX_REACH_ERROR_DB = 6.0
EDGE_M = 20.0
"""Distance between the ends of a lane and the edges of the square."""


def box(west: float, south: float, east: float, north: float) -> tuple[Point, ...]:
    """Return a rectangle's corners."""
    return ((west, south), (east, south), (east, north), (west, north))


class Building(NamedTuple):
    """Rectangle of walls, axis-parallel; metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float
    height_m: float
    loss_db: float


@dataclass(frozen=True, slots=True)
class World:
    """Truth of one flight."""

    kind: Kind
    reach_m: float
    exponent: float
    shadowing_db: float
    emitter_share: float
    """Share of the shadowing's variance that stays with the emitter."""
    correlation_m: float
    rice_k: float
    """Power of the direct path over that of the scattered ones."""
    duty_cycle: float
    buildings: tuple[Building, ...]


@dataclass(frozen=True, slots=True)
class Trial:
    """Emitter at a position with its cell's stated probability, and whether it was detected."""

    flight: int
    kind: Kind
    pod: float
    pos: float
    is_first: bool
    """True for the emitter of the flight, drawn from the POA; the others serve the cells alone."""
    is_heard: bool


def draw_world(rng: np.random.Generator) -> tuple[World, DetectionModel]:
    """Return a world, and the detection model that a crew would configure for its kind."""
    kind: Kind = KINDS[rng.integers(len(KINDS))]
    environment: Environment = "buildings" if kind == "walls" else kind
    exponent, shadowing_db, correlation_m, rice_k_db = PROPAGATION[environment]
    reach_sigma_db = float(rng.choice([2.0, 3.0, 4.0]))
    error_db = _truncated_normal(rng, reach_sigma_db, MAX_REACH_ERROR_DB)
    stated_m = float(rng.uniform(60.0, 150.0))
    duty_cycle = float(rng.choice([1.0, 0.3, 0.1]))
    buildings = _draw_buildings(rng) if kind == "walls" else ()
    model = DetectionModel(
        reach_m=stated_m,
        reach_sigma_db=reach_sigma_db,
        environment=environment,
        interval_s=INTERVAL_S,
        duty_cycle=duty_cycle,
        # outlines and heights as on a map, the loss from a table
        walls=tuple(
            Wall(corners_enu_m=box(*each[:4]), height_m=each.height_m, loss_db=10.0)
            for each in buildings
        ),
    )
    true_exponent = exponent + rng.uniform(-0.2, 0.2)
    world = World(
        kind,
        stated_m * 10.0 ** (error_db / (10.0 * true_exponent)),
        true_exponent,
        shadowing_db * rng.uniform(0.8, 1.2),
        rng.uniform(0.35, 0.65),
        correlation_m * rng.uniform(0.7, 1.4),
        10.0 ** (0.1 * (rice_k_db + rng.uniform(-3.0, 3.0))),
        duty_cycle,
        buildings,
    )
    return world, model


def _truncated_normal(rng: np.random.Generator, sigma: float, most: float) -> float:
    while abs(value := float(rng.normal(0.0, sigma))) > most:
        pass
    return value


def _draw_buildings(rng: np.random.Generator) -> tuple[Building, ...]:
    buildings = []
    for _ in range(4):
        west, south = rng.uniform(50.0, 400.0, 2)
        width, depth = rng.uniform(25.0, 80.0, 2)
        height, loss = rng.uniform(6.0, 14.0), rng.uniform(7.0, 13.0)
        buildings.append(Building(west, south, west + width, south + depth, height, loss))
    return tuple(buildings)


def draw_track(rng: np.random.Generator, side_m: float) -> Array:
    """Draw (points, 3) lanes over a square, one point a second, ended anywhere."""
    spacing_m, speed_mps = rng.uniform(40.0, 160.0), rng.uniform(3.0, 8.0)
    height_m = rng.uniform(15.0, 50.0)
    corners = lane_corners((side_m - 2.0 * EDGE_M, side_m), spacing_m)
    path = np.add(corners, (EDGE_M, 0.0))
    end_m = np.hypot(*np.diff(path, axis=0).T).sum() * rng.uniform(0.25, 1.0)
    step_m = speed_mps * INTERVAL_S
    track = along(path, step_m, math.ceil(end_m / step_m))
    return np.column_stack((track, np.full(len(track), height_m)))


def walls_crossed(buildings: Iterable[Building], emitters: Array, track: Array) -> Array:
    """Return (emitters, points) losses of the walls and roofs between, dB, by ray marching."""
    shares = np.linspace(0.0, 1.0, 201)
    loss_db = np.zeros((len(emitters), len(track)))
    for number, emitter in enumerate(emitters):
        ways = emitter + shares[:, None, None] * (track[:, :2] - emitter)
        up = shares[:, None] * track[:, 2]
        for each in buildings:
            inside = (ways[..., 0] > each.west_m) & (ways[..., 0] < each.east_m)
            inside &= (ways[..., 1] > each.south_m) & (ways[..., 1] < each.north_m)
            inside &= up < each.height_m
            crossings = np.count_nonzero(inside[1:] != inside[:-1], axis=0)
            loss_db[number] += each.loss_db * crossings
    return loss_db


def are_heard(
    world: World, emitters: Array, track: Array, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return (emitters, points) True where an emitter is heard along the track."""
    shape = len(emitters), len(track)
    apart = emitters[:, None, :] - track[None, :, :2]
    distance_m = np.sqrt((apart**2).sum(axis=2) + track[:, 2] ** 2)
    margin_db = 10.0 * world.exponent * np.log10(world.reach_m / distance_m)
    gaps = track[:, None, :2] - track[None, :, :2]
    correlation = np.exp(-np.sqrt((gaps**2).sum(axis=2)) / world.correlation_m)
    root = np.linalg.cholesky(correlation + 1e-6 * np.eye(len(track)))
    path = rng.standard_normal(shape) @ root.T
    own = rng.standard_normal((len(emitters), 1))
    share = world.emitter_share
    margin_db += world.shadowing_db * (math.sqrt(share) * own + math.sqrt(1.0 - share) * path)
    margin_db += _fading_db(world.rice_k, shape, rng)
    if world.buildings:
        margin_db -= walls_crossed(world.buildings, emitters, track)
    is_awake = rng.random(shape) < world.duty_cycle
    heard: NDArray[np.bool_] = (margin_db > 0.0) & is_awake
    return heard


def _fading_db(rice_k: float, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Draw the power about its median, dB."""

    def power(size: tuple[int, ...]) -> Array:
        """Draw powers of Rician fading, with a scattered power of 2."""
        in_phase = math.sqrt(2.0 * rice_k) + rng.standard_normal(size)
        return in_phase**2 + rng.standard_normal(size) ** 2

    median = np.median(power((2001,)))
    faded: Array = 10.0 * np.log10(power(shape) / median)
    return faded


SIDE_M = 500.0


CELL_M = 20.0
WEIGHTS = (0.7, 0.2, 0.1)


def search_areas(rng: np.random.Generator) -> SearchGrid:
    """Return the POA of a flight over a square of `SIDE_M`: even, or of three polygons."""
    return even_poa(SIDE_M) if rng.random() < 0.5 else uneven_poa(SIDE_M, rng)


def even_poa(side_m: float) -> SearchGrid:
    """Return an even POA over a square from the origin."""
    return grid_over([WeightedArea(box(0.0, 0.0, side_m, side_m))], CELL_M)


def uneven_poa(side_m: float, rng: np.random.Generator, *, is_turned: bool = False) -> SearchGrid:
    """Return three strips of a square with 70, 20 and 10 % in any order, from west or south on."""
    third, areas = side_m / 3.0, []
    for k, weight in enumerate(rng.permutation(WEIGHTS)):
        strip = box(k * third, 0.0, (k + 1) * third, side_m)
        turned = tuple((north, east) for east, north in strip)
        areas.append(WeightedArea(turned if is_turned else strip, weight))
    return grid_over(areas, CELL_M)


def fly(number: int, seed: int) -> list[Trial]:
    """Fly once over an emitter, and over as many other cells."""
    rng = np.random.default_rng([seed, number])
    world, model = draw_world(rng)
    grid, track = search_areas(rng), draw_track(rng, SIDE_M)
    area = SearchedArea(grid, model)
    for east, north, up in track:
        area.listen((east, north, up), INTERVAL_S)
    area.finish()
    state = state_of(area)
    first, others = (
        rng.choice(len(grid.poa), 1, p=grid.poa),
        rng.choice(len(grid.poa), EMITTERS - 1),
    )
    cells = np.concatenate((first, others))
    positions = grid.centres_enu_m[cells] + rng.uniform(-0.5, 0.5, (EMITTERS, 2)) * grid.cell_m
    heard = [bool(row.any()) for row in are_heard(world, positions, track, rng)]
    return [
        Trial(number, world.kind, float(state.pod[cell]), state.pos, index == 0, is_heard)
        for index, (cell, is_heard) in enumerate(zip(cells, heard, strict=True))
    ]


@dataclass(frozen=True, slots=True)
class Bin:
    """Cells whose stated POD lies in one tenth."""

    kind: str
    low: float
    stated: float
    heard: float
    sigma: float
    """Standard error of the share heard less the stated one. Cells of one flight share its errors:
    it is that of a ratio of sums over flights."""
    trials: int

    @property
    def error(self) -> float:
        """Observed less stated share."""
        return self.heard - self.stated


def reliability(trials: Sequence[Trial], kind: Kind | None = None) -> list[Bin]:
    """Return the share heard by tenths of the stated POD, of all worlds or of one kind."""
    chosen = [each for each in trials if kind in (None, each.kind)]
    stated = np.array([each.pod for each in chosen])
    heard = np.array([each.is_heard for each in chosen])
    flight = np.array([each.flight for each in chosen])
    tenth = np.minimum((10.0 * stated).astype(int), 9)
    bins = []
    for k in range(10):
        own = tenth == k
        count = int(np.count_nonzero(own))
        if not count:
            continue
        errors = heard[own] - stated[own]
        by_flight = np.bincount(flight[own], errors - errors.mean())
        sigma = float(np.sqrt((by_flight**2).sum())) / count
        means = float(stated[own].mean()), float(heard[own].mean())
        bins.append(Bin(kind or "all", 0.1 * k, *means, sigma, count))
    return bins


def success(trials: Sequence[Trial]) -> tuple[float, float, int]:
    """Return the mean stated POS, the share of emitters heard, and how many there were."""
    first = [each for each in trials if each.is_first]
    stated = float(np.mean([each.pos for each in first]))
    return stated, float(np.mean([each.is_heard for each in first])), len(first)


def csv_of(bins: Iterable[Bin]) -> str:
    """Return the reliability diagram's points as CSV."""
    head = ("world", "pod_from", "stated", "heard", "sigma", "cells")
    rows = (
        (b.kind, f"{b.low:.1f}", f"{b.stated:.4f}", f"{b.heard:.4f}", f"{b.sigma:.4f}", b.trials)
        for b in bins
    )
    return csv_text(head, rows)
