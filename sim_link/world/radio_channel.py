"""The true radio channel: what a range or bearing suffers between emitter and vehicle.

Paper, eq. (1): y = h(x; s) + delta + b + eps. One draw decides for a whole measurement whether the
path is obstructed (NLOS): then it is longer, never shorter (exponential), and bent to either side
(normal). Thermal noise comes on top; the offsets delta are constant. For shadows see `environment`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from sim_link.world.environment import (
    NO_MEMORY,
    ChannelParams,
    Drawn,
    Emitter,
    Environment,
    OpenPath,
    ShadowMemory,
    obstruction,
    open_obstruction,
)
from sim_link.world.line_of_sight import Surroundings

MIN_RANGE_M = 0.01
"""Measured ranges stay positive, as the paper has it."""


@dataclass(frozen=True, slots=True)
class ChannelDraw:
    """Errors of one measurement, from noise and obstacles."""

    range_bias_m: float
    """Excess of an obstructed path; never negative."""
    bearing_bias_rad: float
    range_noise_m: float
    bearing_noise_rad: float


class _Character(NamedTuple):
    """The parameters of a channel as it calculates with them."""

    range_offset_m: float
    bearing_offset_rad: float
    open_path: OpenPath
    range_sigma_m: float
    bearing_sigma_rad: float


@lru_cache(maxsize=64)
def _character_of(params: ChannelParams) -> _Character:
    bend_sigma_rad = math.radians(params.bearing_bias_sigma_deg)
    return _Character(
        params.range_offset_m,
        math.radians(params.bearing_offset_deg),
        OpenPath(params.p_nlos, params.range_bias_mean_m, bend_sigma_rad),
        params.range_sigma_m,
        math.radians(params.bearing_sigma_deg),
    )


class RadioChannel:
    """Measures an emitter through the true channel: its own, or else that of `params`."""

    def __init__(
        self,
        params: ChannelParams,
        rng: np.random.Generator,
        environment: Environment | None = None,
    ) -> None:
        self._rng = rng
        self._environment = environment
        self._surroundings: dict[PositionEnu, Surroundings] = {}
        self._memories: dict[PositionEnu, ShadowMemory] = {}
        self._params = params

    def prepare(self, emitter: Emitter) -> None:
        """Find the ways to `emitter`, and compile what is compiled, before time counts."""
        self._obstruction((0.5, 1.0, 0.0), emitter, emitter.position_enu_m)

    def draw(self, emitter: Emitter, sensor_enu_m: PositionEnu) -> ChannelDraw:
        """Return the next random part; always consumes the same amount of randomness."""
        uniform = float(self._rng.random())
        exponential = float(self._rng.standard_exponential())
        bend, range_noise, bearing_noise = self._rng.standard_normal(3).tolist()
        range_bias_m, bearing_bias_rad, memory = self._obstruction(
            (uniform, exponential, bend), emitter, sensor_enu_m
        )
        self._memories[emitter.position_enu_m] = memory
        character = self._character(emitter)
        return ChannelDraw(
            range_bias_m=float(range_bias_m),
            bearing_bias_rad=float(bearing_bias_rad),
            range_noise_m=character.range_sigma_m * range_noise,
            bearing_noise_rad=character.bearing_sigma_rad * bearing_noise,
        )

    def measure(
        self, emitter: Emitter, sensor_enu_m: PositionEnu, time_s: float
    ) -> RangingMeasurement:
        """Measure `emitter`; the result does not show if the path was obstructed."""
        draw, character = self.draw(emitter, sensor_enu_m), self._character(emitter)
        range_m = (
            emitter.slant_range_m(sensor_enu_m)
            + character.range_offset_m
            + draw.range_bias_m
            + draw.range_noise_m
        )
        bearing_rad = (
            emitter.bearing_enu_rad(sensor_enu_m)
            + character.bearing_offset_rad
            + draw.bearing_bias_rad
            + draw.bearing_noise_rad
        )
        return RangingMeasurement(
            emitter_id=emitter.emitter_id,
            measured_at_s=time_s,
            range_m=max(MIN_RANGE_M, range_m),
            range_sigma_m=character.range_sigma_m,
            bearing_enu_rad=wrap_pi(bearing_rad),
            bearing_sigma_rad=character.bearing_sigma_rad,
            quality=emitter.quality,
        )

    def _params_of(self, emitter: Emitter) -> ChannelParams:
        return self._params if emitter.channel is None else emitter.channel

    def _character(self, emitter: Emitter) -> _Character:
        return _character_of(self._params_of(emitter))

    def _around(self, emitter: Emitter, environment: Environment) -> Surroundings:
        place = emitter.position_enu_m
        if place not in self._surroundings:
            self._surroundings[place] = environment.around(place)
        return self._surroundings[place]

    def _obstruction(
        self, drawn: Drawn, emitter: Emitter, sensor_enu_m: PositionEnu
    ) -> tuple[float, float, ShadowMemory]:
        """Return range excess, bearing bias, and what to remember of the shadow."""
        place, open_path = emitter.position_enu_m, self._character(emitter).open_path
        memory = self._memories.get(place, NO_MEMORY)
        if self._environment is None:
            return *open_obstruction(*drawn, open_path), memory
        shadow, surroundings = self._environment.shadow, self._around(emitter, self._environment)
        return obstruction(drawn, sensor_enu_m, open_path, shadow, surroundings, memory)
