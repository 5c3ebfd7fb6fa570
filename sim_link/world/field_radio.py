"""A radio in the field: an antenna, spatially correlated errors, burial, lost packets.

Theory of operation. `RadioChannel` is the paper's channel; every part that is added here is off by
default, and draws from a generator of its own.

Errors are spatially correlated. Whether an open path is obstructed, its excess and its bend, the
direction of a gross error and the shadowing of the signal are first-order Gauss-Markov over the
path of the sensor (M. Gudmundson, Electronics Letters 27, 1991), as in the shadows of
`environment`: the excess as the squared length of a pair, obstruction and gross errors as a
standard normal that lies below the quantile of their share.

A bend is an angle in space, so that it grows in azimuth as noise does; an obstacle's pull turns the
azimuth by itself. A level slab of thickness w and permittivity e delays by

    excess = w (sqrt(e - sin^2 t) - cos t),    t from the vertical

w (sqrt(e) - 1) straight above and w sqrt(e - 1) at most (plane wave, Snell's law). A packet is
heard while a margin is positive: 10 n log10(half range / slant range), less what walls and the
dipole's null take (its gain is the squared sine of the angle to its axis), and what shadowing and
fading add. A radio that reports received power reports its sensitivity plus that margin, in steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from sim_link.world.environment import (
    NO_MEMORY,
    ChannelParams,
    Drawn,
    Emitter,
    Environment,
    FieldChannelParams,
    LossParams,
    ShadowMemory,
    in_the_field,
    remembered,
)
from sim_link.world.line_of_sight import detour, is_blocked_in_space, walls_between
from sim_link.world.point_mass import LEVEL, Components, EulerAngles, seen_from
from sim_link.world.radio_channel import (
    MIN_RANGE_M,
    AntennaModelParams,
    ChannelDraw,
    Printed,
    RadioChannel,
    bent,
    direction_enu,
    printed,
    seen_by_antenna,
    turned_about_vertical,
)

Measures = Literal["both", "range", "bearing", "power"]
IDEAL = AntennaModelParams()
PATH_NORMALS, GROSS_NORMALS, FREE_NORMALS = 3, 4, 5
"""Random draws of each measurement: path, gross errors and white noise."""


def burial_excess_m(thickness_m: float, permittivity: float, up: float) -> float:
    """Return the excess range of a level slab in m; `up` is the cosine from the vertical."""
    sine2 = 1.0 - up * up
    return thickness_m * max(0.0, math.sqrt(permittivity - sine2) - abs(up))


def link_margin_db(params: LossParams, slant_m: float, walls: int, body_down: float) -> float:
    """Return a packet's margin above the threshold, before shadowing and fading.

    Args:
        body_down: Component of the direction along the vehicle's vertical.
    """
    ratio = params.half_range_m / max(slant_m, MIN_RANGE_M)
    margin_db = 10.0 * params.exponent * math.log10(ratio) - params.wall_db * walls
    sine2 = max(1.0 - body_down * body_down, 10.0 ** (-0.1 * params.null_depth_db))
    return margin_db + 10.0 * math.log10(sine2)


def is_within(share: float, normal: float) -> bool:
    """Return True if a standard normal lies in the lower `share` of its distribution."""
    return 0.5 * math.erfc(-normal / math.sqrt(2.0)) < share


class CorrelatedNormals:
    """Standard normals that are spatially correlated."""

    def __init__(self) -> None:
        self._values: list[float] = []
        self._position: PositionEnu = (0.0, 0.0, 0.0)

    def move(self, fresh: list[float], position: PositionEnu, correlation_m: float) -> list[float]:
        """Return the draws at a later position; a correlation of 0 forgets at once."""
        kept = 0.0
        if self._values and correlation_m > 0.0:
            kept = math.exp(-math.dist(position, self._position) / correlation_m)
        old = self._values or fresh
        new = math.sqrt(1.0 - kept * kept)
        self._values = [kept * was + new * now for was, now in zip(old, fresh, strict=True)]
        self._position = position
        return self._values


@dataclass(slots=True)
class _Path:
    """Spatially correlated state of the path to one emitter."""

    path: CorrelatedNormals = field(default_factory=CorrelatedNormals)
    gross: CorrelatedNormals = field(default_factory=CorrelatedNormals)
    excess: ShadowMemory = NO_MEMORY


class _Moment(NamedTuple):
    """One measurement with its random draws."""

    emitter: Emitter
    position: PositionEnu
    attitude: EulerAngles
    params: FieldChannelParams
    draw: ChannelDraw
    bend_up: float
    """Standard normal, as the following."""
    shadow: float
    gross: list[float]
    """Normal that decides whether it is a gross error, and east, north and up of its direction."""
    free: list[float]
    """Components of the direction, range, fading."""

    @property
    def direction(self) -> Components:
        """East, north, up."""
        return direction_enu(self.position, self.emitter.position_enu_m)

    @property
    def gross_direction(self) -> Components | None:
        """Unit vector (east, north, up) to the source of a gross error; None: no gross error."""
        if not is_within(self.params.p_gross, self.gross[0]):
            return None
        return direction_enu((0.0, 0.0, 0.0), (self.gross[1], self.gross[2], self.gross[3]))


class FieldRadio(RadioChannel):
    """Measures emitters as a radio on a moving, leaning vehicle does; draws as `RadioChannel`."""

    def __init__(
        self,
        params: ChannelParams,
        rng: np.random.Generator,
        environment: Environment | None = None,
        antenna: AntennaModelParams = IDEAL,
        measures: Measures = "both",
    ) -> None:
        super().__init__(in_the_field(params), rng, environment)
        (self._field_rng,) = rng.spawn(1)
        self._antenna = antenna
        self._measures = measures
        self._paths: dict[PositionEnu, _Path] = {}
        self._blocking_normal = 0.0
        """Normal of the path that is being drawn."""

    def prepare(self, emitter: Emitter) -> None:
        """Prepare as any channel, and forget earlier trials."""
        super().prepare(emitter)
        self._paths.clear()

    def hear(
        self, emitter: Emitter, position: PositionEnu, time_s: float, attitude: EulerAngles = LEVEL
    ) -> RangingMeasurement | None:
        """Return a measurement of `emitter` from a position, local east, north, up; None: lost."""
        params = in_the_field(self._params_of(emitter))
        is_plain = self._antenna.kind == "ideal" and self._measures == "both"
        if is_plain and params.is_as_in_the_paper:
            return self.measure(emitter, position, time_s)
        moment = self._moment(emitter, position, attitude, params)
        margin_db = self._margin_db(moment)
        if margin_db <= 0.0:
            return None
        bearing = self._bearing(moment) if self._measures in ("both", "bearing") else None
        range_m = self._range_m(moment) if self._measures in ("both", "range") else None
        power_dbm = None if params.loss is None else params.loss.reported_dbm(margin_db)
        if bearing is None and range_m is None and power_dbm is None:
            return None
        measurement = self._measurement(moment, time_s, range_m, bearing)
        return measurement if power_dbm is None else replace(measurement, power_dbm=power_dbm)

    def _moment(
        self,
        emitter: Emitter,
        position: PositionEnu,
        attitude: EulerAngles,
        params: FieldChannelParams,
    ) -> _Moment:
        """Draw a moment; always consumes the same amount of randomness."""
        fresh = self._field_rng.standard_normal(PATH_NORMALS + GROSS_NORMALS + FREE_NORMALS)
        path_fresh, gross_fresh, free = (
            part.tolist() for part in np.split(fresh, (PATH_NORMALS, PATH_NORMALS + GROSS_NORMALS))
        )
        path, correlation_m = self._path(emitter), params.correlation_m
        if self._environment is not None and self._is_shaded(emitter, position):
            correlation_m = max(correlation_m, self._environment.shadow.correlation_m)
        blocking, bend_up, shadow = path.path.move(path_fresh, position, correlation_m)
        gross = path.gross.move(gross_fresh, position, params.gross_correlation_m)
        self._blocking_normal = blocking
        draw = self.draw(emitter, position)
        return _Moment(emitter, position, attitude, params, draw, bend_up, shadow, gross, free)

    def _path(self, emitter: Emitter) -> _Path:
        return self._paths.setdefault(emitter.position_enu_m, _Path())

    def _obstruction(
        self, drawn: Drawn, emitter: Emitter, sensor_enu_m: PositionEnu
    ) -> tuple[float, float, ShadowMemory]:
        """Return the obstruction, spatially correlated in the open."""
        correlation_m = in_the_field(self._params_of(emitter)).correlation_m
        if correlation_m == 0.0 or self._is_shaded(emitter, sensor_enu_m):
            return super()._obstruction(drawn, emitter, sensor_enu_m)
        memory = self._memories.get(emitter.position_enu_m, NO_MEMORY)
        path, open_path = self._path(emitter), self._character(emitter).open_path
        path.excess = kept = remembered(drawn, sensor_enu_m, correlation_m, path.excess)
        if not is_within(open_path.p_nlos, self._blocking_normal):
            return 0.0, 0.0, memory
        pair = 0.5 * (kept.first * kept.first + kept.second * kept.second)
        return open_path.bias_mean_m * pair, open_path.bend_sigma_rad * kept.bend, memory

    def _is_shaded(self, emitter: Emitter, position: PositionEnu) -> bool:
        if self._environment is None:
            return False
        edges = self._around(emitter, self._environment).edges
        return bool(is_blocked_in_space(*emitter.position_enu_m, *position, edges))

    def _margin_db(self, moment: _Moment) -> float:
        """Return a packet's margin above the threshold; positive: it is heard."""
        loss = moment.params.loss
        if loss is None:
            return math.inf
        walls = 0
        if self._environment is not None:
            edges = self._environment.edges
            walls = walls_between(*moment.emitter.position_enu_m, *moment.position, edges)
        east, north, up = moment.direction
        body = seen_from(moment.attitude, (north, east, -up))
        slant_m = moment.emitter.slant_range_m(moment.position)
        margin_db = link_margin_db(loss, slant_m, walls, body[2])
        margin_db += loss.shadow_sigma_db * moment.shadow + loss.fading_sigma_db * moment.free[4]
        if loss.obstruction_db > 0.0 and moment.params.range_bias_mean_m > 0.0:
            excess = moment.draw.range_bias_m / moment.params.range_bias_mean_m
            margin_db -= loss.obstruction_db * excess
        return margin_db

    def _range_m(self, moment: _Moment) -> float:
        params, slant_m = moment.params, moment.emitter.slant_range_m(moment.position)
        range_m = (
            slant_m
            + params.range_offset_m
            + moment.draw.range_bias_m
            + moment.draw.range_noise_m
            + params.range_sigma_growth * slant_m * moment.free[3]
        )
        if params.burial_m > 0.0:
            up = moment.direction[2]
            range_m += burial_excess_m(params.burial_m, params.permittivity, up)
        if params.range_step_m > 0.0:
            range_m = params.range_step_m * round(range_m / params.range_step_m)
        return max(MIN_RANGE_M, range_m)

    def _bearing(self, moment: _Moment) -> Printed | None:
        """Measure the bearing, None: none; an ideal antenna counts counter-clockwise from east."""
        draw, gross = moment.draw, moment.gross_direction
        offset_rad = self._character(moment.emitter).bearing_offset_rad
        if self._antenna.kind == "ideal":
            bearing_rad = moment.emitter.bearing_enu_rad(moment.position) + draw.bearing_bias_rad
            if gross is not None:
                bearing_rad = math.atan2(gross[1], gross[0])
            bearing_rad += offset_rad + draw.bearing_noise_rad
            return Printed(wrap_pi(bearing_rad), None, is_array_angle=False)
        direction = self._obstructed_direction(moment) if gross is None else gross
        u = seen_by_antenna(direction, moment.attitude, self._antenna, offset_rad)
        noise = (moment.free[0], moment.free[1], moment.free[2])
        return printed(u, self._antenna, self._sigma_rad(moment.emitter), noise)

    def _obstructed_direction(self, moment: _Moment) -> Components:
        """Return the arriving signal's unit vector (east, north, up), deflected by obstacles."""
        draw, direction = moment.draw, moment.direction
        if draw.range_bias_m == 0.0 and draw.bearing_bias_rad == 0.0:
            return direction
        aside_rad = draw.bearing_bias_rad
        up_sigma_rad = self._character(moment.emitter).open_path.bend_sigma_rad
        if self._environment is not None and self._is_shaded(moment.emitter, moment.position):
            shadow = self._environment.shadow
            around = self._around(moment.emitter, self._environment)
            pull_rad = shadow.pull_share * detour(*moment.position, around)[1]
            direction = turned_about_vertical(direction, pull_rad)
            aside_rad -= pull_rad
            up_sigma_rad = shadow.bend_sigma_rad
        return bent(direction, aside_rad, up_sigma_rad * moment.bend_up)

    def _sigma_rad(self, emitter: Emitter) -> float:
        sigma_deg = self._antenna.sigma_deg
        if self._antenna.kind == "ideal" or sigma_deg is None:
            return self._character(emitter).bearing_sigma_rad
        return math.radians(sigma_deg)

    def _measurement(
        self, moment: _Moment, time_s: float, range_m: float | None, bearing: Printed | None
    ) -> RangingMeasurement:
        """Return the measurement with the data sheet's standard deviations."""
        measurement = RangingMeasurement(
            emitter_id=moment.emitter.emitter_id,
            measured_at_s=time_s,
            range_m=range_m,
            range_sigma_m=None if range_m is None else moment.params.range_sigma_m,
            quality=moment.emitter.quality,
        )
        if bearing is None:
            return measurement
        is_ideal, sigma_rad = self._antenna.kind == "ideal", self._sigma_rad(moment.emitter)
        return replace(
            measurement,
            bearing_enu_rad=bearing.bearing_rad if is_ideal else None,
            bearing_body_rad=None if is_ideal else bearing.bearing_rad,
            bearing_sigma_rad=sigma_rad,
            elevation_rad=bearing.elevation_rad,
            elevation_sigma_rad=None if bearing.elevation_rad is None else sigma_rad,
            is_array_angle=bearing.is_array_angle,
        )
