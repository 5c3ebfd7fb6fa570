"""Detection model: the probability that an answer of the emitter is received.

Theory of operation. An answer is received while its margin is positive (log-distance path loss with
log-normal shadowing: T. S. Rappaport, Wireless Communications, 2nd ed., section 4.9):

    margin = 10 n log10(reach / d) + r + s + u + f - walls

r is the error of the stated reach, the same wherever the vehicle and the emitter are; s the
shadowing about the emitter, the same from everywhere; u the shadowing of the path, which changes
with the vehicle's position over `correlation_m`; f Rice fading about its median, new with every
answer. s and u have one half
of the shadowing's variance each: two receivers that hear one transmitter have a correlation of 0.5
(3GPP TR 36.814, table A.2.1.1-2). r + s is one offset of a cell in all that was flown, and u one of
a cell and a square of that side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.domain import NonNegative, Params, Point, PositionEnu, Positive
from companion.geometry.polygons import edges, polygon_problem
from companion.search.search_grid import Floats, are_inside

SHARED_VARIANCE = 0.5
"""Share of the variance of shadowing that is common to all cells, about the emitter; see above."""
MAX_WALL_EDGES = 200


class Wall(Params, frozen=True):
    """A building, or another obstacle, that attenuates a signal at each wall it passes."""

    corners_enu_m: tuple[Point, ...]
    height_m: Positive = 6.0
    """Height above home; the roof counts like a side."""
    loss_db: NonNegative = 10.0
    """Loss at each wall; brick and light concrete at 1 to 6 GHz have 5 to 15 dB (ITU-R P.2040)."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for an outline that encloses nothing."""
        problem = polygon_problem(self.corners_enu_m, 1.0)
        if problem is not None:
            raise ValueError(f"corners_enu_m {problem}")


class Propagation(NamedTuple):
    """Path loss and fading of an environment."""

    exponent: float
    """Exponent of the log-distance path loss: 2 in the open, 3 to 4 through rubble."""
    shadowing_db: float
    """Standard deviation of shadowing: 3 to 4 dB in the open, 6 to 8 dB over rubble."""
    correlation_m: float
    """Distance over which shadowing changes: 10 to 30 m over rubble, 50 to 100 m in the open."""
    rice_k_db: float
    """Power of the direct path over reflections: 6 to 9 dB in the open, else about 0."""


Environment = Literal["unknown", "open", "rubble", "buildings"]
PROPAGATION: Mapping[Environment, Propagation] = {
    "unknown": Propagation(2.5, 6.0, 20.0, 0.0),
    "open": Propagation(2.2, 4.0, 75.0, 6.0),
    "rubble": Propagation(3.0, 7.0, 20.0, 0.0),
    "buildings": Propagation(2.5, 4.0, 30.0, 3.0),
}


ReachSigmaDb = Annotated[float, msgspec.Meta(ge=0.5, le=20.0)]
CONFIGURED_SIGMA_DB = 4.0
"""Uncertainty of a reach that was measured with a similar emitter."""
PRESET_SIGMA_DB = 6.0
"""Uncertainty of a preset's reach, the spread of heard emitters about the path, one sigma per axis:
half the radius of a disc, 6 dB below the reach at an exponent of 2; where reception falls off over
7 dB of shadowing and fading, 1.7 times the reach, 6 dB above it at an exponent of 2.5."""


class DetectionParams(Params, frozen=True):
    """Radio link of the search, as configured."""

    reach_m: Positive | None = None
    """Slant range at which half of the answers are received, without shadowing; null: that of the
    radio's preset (`estimation.filter.reach_m`)."""
    reach_sigma_db: ReachSigmaDb | None = None
    """Standard deviation of that reach, as power, 4 dB are a factor of 1.4 in range at exponent
    2.5; null: 4 dB, of a preset's 6 dB."""
    environment: Environment = "unknown"
    """Surroundings of emitter and search, for path loss and shadowing; see `PROPAGATION`."""
    interval_s: Annotated[float, msgspec.Meta(ge=0.01, le=3600.0)] = 1.0
    """Time between two answers, or between two requests that may be answered."""
    duty_cycle: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 1.0
    """Share of the intervals in which the emitter is awake and answers."""
    walls: tuple[Wall, ...] = ()
    """Known obstacles; those that are not known are in the shadowing."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for more walls than an update has time for."""
        if sum(len(wall.corners_enu_m) for wall in self.walls) > MAX_WALL_EDGES:
            raise ValueError(f"walls have more than {MAX_WALL_EDGES} corners in all")

    def model(self, preset_m: float | None) -> DetectionModel | None:
        """Return the link with its reach, or with the preset's; None if neither is known."""
        reach_m, sigma_db = self.reach_m, CONFIGURED_SIGMA_DB
        if reach_m is None:
            reach_m, sigma_db = preset_m, PRESET_SIGMA_DB
        if reach_m is None:
            return None
        return DetectionModel(
            reach_m=reach_m,
            reach_sigma_db=sigma_db if self.reach_sigma_db is None else self.reach_sigma_db,
            environment=self.environment,
            interval_s=self.interval_s,
            duty_cycle=self.duty_cycle,
            walls=self.walls,
        )


class DetectionModel(DetectionParams, frozen=True):
    """Radio link of the search, as assumed."""

    reach_m: Positive
    reach_sigma_db: ReachSigmaDb = CONFIGURED_SIGMA_DB

    @property
    def propagation(self) -> Propagation:
        """Path loss and fading of the environment."""
        return PROPAGATION[self.environment]

    @property
    def cell_sigma_db(self) -> float:
        """Standard deviation of a cell's constant errors: reach and shared shadowing, dB."""
        return math.hypot(
            self.reach_sigma_db, math.sqrt(SHARED_VARIANCE) * self.propagation.shadowing_db
        )

    @property
    def path_sigma_db(self) -> float:
        """Standard deviation of the part that is independent for every position of the sensor."""
        return math.sqrt(1.0 - SHARED_VARIANCE) * self.propagation.shadowing_db

    def margin_db(self, centres_enu_m: Floats, sensor_m: PositionEnu) -> Floats:
        """Return the margins without offset, (cells,), dB; the sensor's up is above the ground."""
        east, north, up = sensor_m
        squared = (centres_enu_m[:, 0] - east) ** 2 + (centres_enu_m[:, 1] - north) ** 2 + up * up
        margin = (
            -5.0 * self.propagation.exponent * np.log10(np.maximum(squared, 1.0) / self.reach_m**2)
        )
        for wall in self.walls:
            margin -= wall.loss_db * _ways_through(wall, centres_enu_m, sensor_m)
        return margin


def _ways_through(wall: Wall, centres_enu_m: Floats, sensor_m: PositionEnu) -> NDArray[np.int64]:
    """Return the number of walls and roofs on the straight path of each cell, (cells,)."""
    share = 1.0 if sensor_m[2] <= wall.height_m else wall.height_m / sensor_m[2]
    ends = centres_enu_m + share * (np.array(sensor_m[:2]) - centres_enu_m)
    count = np.zeros(len(centres_enu_m), dtype=np.int64)
    for start, end in edges(wall.corners_enu_m):
        count += _cross(centres_enu_m, ends, np.array(start), np.array(end))
    if share < 1.0:  # it leaves the height of the walls there
        count += are_inside(wall.corners_enu_m, ends)
    return count


def _cross(starts: Floats, ends: Floats, a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Return (n,) True where the path from start to end crosses the edge from a to b."""

    def sides(points: Floats) -> Floats:
        """Return a number for each point, (n,), positive to the left of the edge."""
        beside: Floats = (b[0] - a[0]) * (points[:, 1] - a[1]) - (b[1] - a[1]) * (
            points[:, 0] - a[0]
        )
        return beside

    along = ends - starts

    def turns(corner: Floats) -> Floats:
        """Return a number for each ray, (n,), positive if the corner is to its left."""
        to = corner - starts
        turn: Floats = along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]
        return turn

    return (sides(starts) * sides(ends) < 0.0) & (turns(a) * turns(b) < 0.0)


NODE_SIGMAS = 0.25
"""Step of the quadrature over a cell's offset, in its own standard deviations."""
MAX_SIGMAS = 3.0


def _normal_weights(sigmas: Floats) -> Floats:
    density = np.exp(-0.5 * sigmas**2)
    weights: Floats = density / density.sum()
    return weights


_HALF = round(MAX_SIGMAS / NODE_SIGMAS)
NODES: Floats = NODE_SIGMAS * np.arange(-_HALF, _HALF + 1, dtype=float)
"""Offsets of a cell, in its own standard deviations; the same for all models."""
NODE_WEIGHTS = _normal_weights(NODES)
MARGIN_STEPS = 16
"""Steps of the table's margin to a step of the quadrature."""
FADING_DB = 25.0
"""Largest modelled fading: hardly any answer exceeds its median by half as much, and 0.2 % of
Rayleigh fading lies so far below it."""
MIN_LOG = -60.0
"""Log probability of a miss below which detection is certain."""


class MissTable:
    """Log probability that one answer is missed, by margin and by offset of cell and path.

    Offsets are on one grid: those of a cell, by `NODE_WEIGHTS`, and those of the path, whose
    `path_weights` lie about each of them.
    """

    def __init__(self, model: DetectionModel) -> None:
        self.step_db = NODE_SIGMAS * model.cell_sigma_db
        half = _HALF
        path_half = math.ceil(MAX_SIGMAS * model.path_sigma_db / self.step_db)
        path_db: Floats = self.step_db * np.arange(-path_half, path_half + 1, dtype=float)
        self.path_weights = _normal_weights(path_db / max(model.path_sigma_db, self.step_db))
        self._half = half + path_half
        offsets = 2 * self._half + 1
        farthest_db = self._half * self.step_db + FADING_DB
        count = 2 * math.ceil(farthest_db / self.step_db) * MARGIN_STEPS
        self._least_db = -farthest_db
        self._fine_db = self.step_db / MARGIN_STEPS
        fine = np.arange(count + MARGIN_STEPS * (offsets - 1)) - MARGIN_STEPS * self._half
        margins_db = np.clip(self._least_db + self._fine_db * fine, -farthest_db, farthest_db)
        missed = 1.0 - model.duty_cycle * received_share(margins_db, model.propagation.rice_k_db)
        log_missed = np.log(np.maximum(missed, math.exp(MIN_LOG)))
        windows = np.arange(count)[:, None] + MARGIN_STEPS * np.arange(offsets)
        self.rows = log_missed[windows].astype(np.float32)
        """Table by margin and offset, (margins, offsets)."""

    def index_of(self, margin_db: Floats) -> NDArray[np.int64]:
        """Return the table rows of margins, (cells,), clipped to the table."""
        index = np.rint((margin_db - self._least_db) / self._fine_db).astype(np.int64)
        return np.clip(index, 0, len(self.rows) - 1)

    def spread_matrix(self) -> NDArray[np.float32]:
        """(offsets, nodes): weights of the path's offsets about every node of the cell's."""
        matrix = np.zeros((2 * self._half + 1, len(NODE_WEIGHTS)), dtype=np.float32)
        for node in range(len(NODE_WEIGHTS)):
            matrix[node : node + len(self.path_weights), node] = self.path_weights
        return matrix


POISSON_TERMS = 120
"""Terms of Rice's series: up to 15 dB, a mean of 32, the rest is below 1e-12."""


def received_share(margins_db: Floats, rice_k_db: float) -> Floats:
    """Return the share of fading amplitudes that keep a margin, above the median power.

    The power is non-central chi-square with two degrees of freedom: a Poisson mixture, of mean K,
    of Erlang distributions.
    """
    k = 10.0 ** (0.1 * rice_k_db)

    def above(power: Floats) -> Floats:
        """Return the probability that each multiple of the scattered power is exceeded."""
        term = math.exp(-k)
        total: Floats = np.zeros(len(power))
        inner: Floats = np.exp(-power)
        erlang = inner.copy()
        for i in range(POISSON_TERMS):
            total += term * erlang
            term *= k / (i + 1)
            inner = inner * power / (i + 1)
            erlang += inner
        return total

    low, high = 0.0, 2.0 + 2.0 * k
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if above(np.array([middle]))[0] > 0.5 else (low, middle)
    return above(low * 10.0 ** (-0.1 * margins_db))


def look_spacing_m(model: DetectionModel) -> float:
    """Return the side of the squares in which looks are taken as from one point, m.

    An eighth of the reach is half a decibel at the reach, to either side; less than a metre is
    within the vehicle's own uncertainty.
    """
    return max(1.0, min(model.propagation.correlation_m, model.reach_m / 8.0))
