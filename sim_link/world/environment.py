"""Emitter, obstacles, and errors of radio paths in the open and in their shadow.

Theory of operation. In the open one draw decides for a whole measurement whether the path is
obstructed, as the paper has it: then the range has an exponential excess and the bearing a normal
bend. In the shadow of an obstacle every path is obstructed, and both have two parts:

    excess = detour_share * (shortest detour - straight path) + extra,  extra exponential
    bend   = pull_share * (direction of the detour - direction of the emitter) + bias,  bias normal

The first follows from the position (`line_of_sight`). The second is a first-order Gauss-Markov
process over the distance that the sensor moves between shadowed measurements, correlation
exp(-distance / L) (M. Gudmundson, Electronics Letters 27, 1991). An exponential variable is half
the squared length of a pair of standard normals, which the uniform and the exponential number of a
draw are in polar coordinates (G. E. P. Box, M. E. Muller, 1958): that pair is the process, with
twice the correlation length, because squaring halves it. With L = 0 the extra is the drawn one.

Obstacles block the radio only: the flight has to avoid them by other means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from companion.domain import NonNegative, Params, PositionEnu, Positive
from companion.geometry.polygons import polygon_problem
from companion.kernel import kernel
from sim_link.world import line_of_sight
from sim_link.world.line_of_sight import Surroundings, detour, is_blocked_in_space
from sim_link.world.point_mass import Share

Drawn = tuple[float, float, float]
"""Random draws of one path: uniform in [0, 1), exponential of mean 1, standard normal."""


class ChannelParams(Params, frozen=True):
    """Offsets, obstruction and noise of the radio. Paper: "Simulation Setup"."""

    range_offset_m: float = 1.5
    bearing_offset_deg: float = -3.0
    """Bearing offset, counter-clockwise positive, as the paper's angles are."""
    p_nlos: Share = 0.9
    """Probability of an obstructed path in the open, outside of every obstacle's shadow."""
    range_bias_mean_m: NonNegative = 8.0
    bearing_bias_sigma_deg: NonNegative = 5.0
    range_sigma_m: NonNegative = 1.5
    bearing_sigma_deg: NonNegative = 2.0


Permittivity = Annotated[float, msgspec.Meta(ge=1.0, le=100.0)]


class LossParams(Params, frozen=True):
    """Probability that a packet is received; theory in `field_radio`."""

    half_range_m: Positive = 150.0
    """Range at which half of the packets are lost, in sight and abreast of the antenna."""
    exponent: Positive = 2.0
    """Exponent of the log-distance path loss: 2 in the open, 3 to 4 through rubble."""
    wall_db: NonNegative = 10.0
    """Loss at each wall of the obstacles on the straight path."""
    shadow_sigma_db: NonNegative = 4.0
    """Spatially correlated shadowing, over the channel's `correlation_m`."""
    fading_sigma_db: NonNegative = 3.0
    """Fading from packet to packet."""
    null_depth_db: NonNegative = 0.0
    """Null of a dipole along the vehicle's vertical, straight below and above; 0: none."""
    obstruction_db: NonNegative = 0.0
    """Mean loss of an obstructed path, in proportion to the excess of its range."""
    sensitivity_dbm: Annotated[float, msgspec.Meta(ge=-174.0, le=0.0)] | None = None
    """Received power at which half of the packets are lost; None if the radio reports no power."""
    power_step_db: Positive = 1.0
    """Step of the reported power."""

    def reported_dbm(self, margin_db: float) -> float | None:
        """Return the power that a radio reports of a packet with this margin; None: none."""
        if self.sensitivity_dbm is None:
            return None
        return self.power_step_db * round((self.sensitivity_dbm + margin_db) / self.power_step_db)


class FieldChannelParams(ChannelParams, frozen=True):
    """Parameters of a radio in the field, beyond the paper's model; the defaults add nothing."""

    correlation_m: NonNegative = 0.0
    """Distance over which the open path's obstruction decorrelates to 1/e; 0: independent draws."""
    range_step_m: NonNegative = 0.0
    """Quantisation step of ranges; 0: none."""
    range_sigma_growth: NonNegative = 0.0
    """Share of the slant range that noise has on top of `range_sigma_m`, in quadrature."""
    burial_m: NonNegative = 0.0
    """Thickness of the level slab that the emitter lies under."""
    permittivity: Permittivity = 7.0
    """Relative permittivity of the slab: concrete 6 to 8, dry rubble 2 to 4."""
    p_gross: Share = 0.0
    """Share of gross errors among the directions, uniform over all angles."""
    gross_correlation_m: NonNegative = 5.0
    """Distance over which these last; 0: every draw is new."""
    loss: LossParams | None = None
    """Model of packet loss; None: no loss."""

    @property
    def is_as_in_the_paper(self) -> bool:
        """True if the channel adds nothing to the paper's model."""
        added = (self.correlation_m, self.range_step_m, self.range_sigma_growth, self.burial_m)
        return not any((*added, self.p_gross)) and self.loss is None


def in_the_field(params: ChannelParams) -> FieldChannelParams:
    """Return the same channel, as a record of the field."""
    if isinstance(params, FieldChannelParams):
        return params
    return FieldChannelParams(**msgspec.structs.asdict(params))


EmitterId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
Coordinate = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
"""Local coordinate in metres; beyond 100 km a flat local frame is not valid."""


class EmitterParams(Params, frozen=True):
    """The emitter's identity and position, local east-north-up metres from the origin."""

    emitter_id: EmitterId = 1
    position_enu_m: tuple[Coordinate, Coordinate] = (50.0, 50.0)
    height_m: Coordinate = 0.0
    channel: FieldChannelParams | None = None
    """Channel of this emitter, whose missing keys are canonical; None: the scenario's `channel`."""
    quality: Share | None = None
    """Signal quality that the radio reports; None: none."""


class Emitter:
    """Stationary radio."""

    def __init__(self, params: EmitterParams) -> None:
        self.emitter_id = params.emitter_id
        self.channel = params.channel
        self.quality = params.quality
        self.position_enu_m: PositionEnu = (*params.position_enu_m, params.height_m)

    def slant_range_m(self, sensor_enu_m: PositionEnu) -> float:
        """Return the true distance from the sensor, metres. Paper: h of eq. (1) for ranges."""
        return math.dist(self.position_enu_m, sensor_enu_m)

    def bearing_enu_rad(self, sensor_enu_m: PositionEnu) -> float:
        """Return the true azimuth, counter-clockwise from east. Paper: h for bearings."""
        return math.atan2(
            self.position_enu_m[1] - sensor_enu_m[1], self.position_enu_m[0] - sensor_enu_m[0]
        )


MIN_OBSTACLE_M2 = 1e-3
"""Minimum area of an obstacle: a mast is one, too."""

Corners = Annotated[tuple[tuple[Coordinate, Coordinate], ...], msgspec.Meta(min_length=3)]


class ObstacleParams(Params, frozen=True):
    """Solid obstacle on the ground: an upright prism."""

    corners_enu_m: Corners
    """A simple polygon, in either direction; not closed."""
    name: str = "obstacle"
    height_m: Positive | None = None
    """Height above which a path is free; None: higher than anything flies."""

    def __post_init__(self) -> None:
        """Refuse a polygon that encloses nothing or crosses itself."""
        problem = polygon_problem(self.corners_enu_m, MIN_OBSTACLE_M2)
        if problem is not None:
            raise ValueError(f"`{self.name}` {problem}")


class ShadowParams(Params, frozen=True):
    """Effects of an obstacle on a path that it blocks."""

    detour_share: Share = 1.0
    """Share of the shortest detour's excess that the range shows; 0: none of it."""
    pull_share: Share = 1.0
    """Share of the turn towards the detour's first corner that the bearing shows."""
    extra_bias_mean_m: NonNegative = 5.0
    """Mean of the exponential excess beyond the detour."""
    bearing_bias_sigma_deg: NonNegative = 5.0
    """Sigma of the normal error beyond the pull."""
    correlation_m: NonNegative = 10.0
    """Distance over which the correlation of both errors falls to 1/e; 0: every draw is new."""


class OpenPath(NamedTuple):
    """Parameters of an unblocked path, as the kernels take them."""

    p_nlos: float
    bias_mean_m: float
    bend_sigma_rad: float


class Shadow(NamedTuple):
    """Parameters of a blocked path, as the kernels take them."""

    detour_share: float
    pull_share: float
    extra_mean_m: float
    bend_sigma_rad: float
    correlation_m: float


class ShadowMemory(NamedTuple):
    """The correlated part of the last shadowed measurement, in standard units, and its position."""

    first: float
    """First of the pair whose half squared length is the excess."""
    second: float
    bend: float
    east_m: float
    north_m: float
    up_m: float


NO_MEMORY = ShadowMemory(0.0, 0.0, 0.0, math.nan, math.nan, math.nan)


@kernel
def open_obstruction(
    uniform: float, exponential: float, normal: float, open_path: OpenPath
) -> tuple[float, float]:
    """Return range excess, metres, and bearing bias, radians, outside of all shadows.

    The uniform draw is in [0, 1), the exponential of mean 1. Paper: b of eq. (1).
    """
    if uniform < open_path.p_nlos:
        return open_path.bias_mean_m * exponential, open_path.bend_sigma_rad * normal
    return 0.0, 0.0


@kernel
def remembered(
    drawn: Drawn, position: PositionEnu, correlation_m: float, memory: ShadowMemory
) -> ShadowMemory:
    """Return the part, correlated over a length in m (0: none), at the next measurement."""
    (uniform, exponential, normal), (e, n, up) = drawn, position
    kept = 0.0
    if correlation_m > 0.0 and not math.isnan(memory.east_m):
        moved_m = math.hypot(math.hypot(e - memory.east_m, n - memory.north_m), up - memory.up_m)
        kept = math.exp(-moved_m / correlation_m)
    length = math.sqrt(2.0 * exponential * (1.0 - kept))
    angle = 2.0 * math.pi * uniform
    return ShadowMemory(
        math.sqrt(kept) * memory.first + length * math.cos(angle),
        math.sqrt(kept) * memory.second + length * math.sin(angle),
        kept * memory.bend + math.sqrt(1.0 - kept * kept) * normal,
        e,
        n,
        up,
    )


@kernel
def obstruction(
    drawn: Drawn,
    position: PositionEnu,
    open_path: OpenPath,
    shadow: Shadow,
    surroundings: Surroundings,
    memory: ShadowMemory,
) -> tuple[float, float, ShadowMemory]:
    """Return range excess, metres, never negative; bearing bias, radians; the memory.

    The position is the sensor's (height 0 in the plane); the memory of the measurement before is
    `NO_MEMORY` at first. Paper: b of eq. (1).
    """
    e, n, up = position
    around = surroundings
    if not is_blocked_in_space(around.east_m, around.north_m, around.up_m, e, n, up, around.edges):
        excess_m, bend_rad = open_obstruction(drawn[0], drawn[1], drawn[2], open_path)
        return excess_m, bend_rad, memory
    memory = remembered(drawn, position, shadow.correlation_m, memory)
    pair = 0.5 * (memory.first * memory.first + memory.second * memory.second)
    excess_m = shadow.extra_mean_m * pair
    bend_rad = shadow.bend_sigma_rad * memory.bend
    if shadow.detour_share > 0.0 or shadow.pull_share > 0.0:
        detour_m, pull_rad = detour(e, n, up, surroundings)
        excess_m += shadow.detour_share * detour_m
        bend_rad += shadow.pull_share * pull_rad
    return excess_m, bend_rad, memory


def shadow_of(params: ShadowParams) -> Shadow:
    """Return the parameters as the kernels take them."""
    return Shadow(
        params.detour_share,
        params.pull_share,
        params.extra_bias_mean_m,
        math.radians(params.bearing_bias_sigma_deg),
        params.correlation_m,
    )


class Environment:
    """The obstacles of a scene."""

    def __init__(
        self, obstacles: Sequence[ObstacleParams] = (), shadow: ShadowParams | None = None
    ) -> None:
        self.shadow = shadow_of(shadow or ShadowParams())
        rows: list[tuple[float, ...]] = []
        corners: list[tuple[float, float]] = []
        for owner, obstacle in enumerate(obstacles):
            top_m = math.inf if obstacle.height_m is None else obstacle.height_m
            rows += line_of_sight.walls(obstacle.corners_enu_m, top_m, owner)
            corners += line_of_sight.turning_corners(obstacle.corners_enu_m)
        self.edges = np.array(rows, dtype=np.float64).reshape(-1, line_of_sight.COLUMNS)
        self._corners = np.array(corners, dtype=np.float64).reshape(-1, 2)

    def around(self, emitter_enu_m: PositionEnu) -> Surroundings:
        """Return an emitter in it, with the paths from all corners: keep the result."""
        return line_of_sight.surroundings_of(emitter_enu_m, self.edges, self._corners)
