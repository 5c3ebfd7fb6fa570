"""The true radio channel: what a range or bearing suffers between emitter and vehicle.

Paper, eq. (1): y = h(x; s) + delta + b + eps. One draw decides for a whole measurement whether the
path is obstructed (NLOS). An obstructed path is longer, never shorter (range bias >= 0,
exponential) and bent to either side (bearing bias, normal); thermal noise comes on top of both,
and the offsets delta are constant. In the shadow of an obstacle every path is obstructed, see
`environment`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.frames import wrap_pi
from companion.params import NonNegative, Params
from sim_link.world.environment import (
    NO_MEMORY,
    Environment,
    OpenPath,
    ShadowMemory,
    obstruction,
    open_obstruction,
)
from sim_link.world.sight import Surroundings
from sim_link.world.target import Emitter

Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

MIN_RANGE_M = 0.01
"""Measured ranges stay positive, as the paper has it."""


class ChannelParams(Params, frozen=True):
    """Offsets, obstruction and noise of the radio. Paper: "Simulation Setup"."""

    range_offset_m: float = 1.5
    bearing_offset_deg: float = -3.0
    """Counter-clockwise positive, as the paper's angles are."""
    p_nlos: Probability = 0.9
    """In the open: outside of every obstacle's shadow."""
    range_bias_mean_m: NonNegative = 8.0
    bearing_bias_sigma_deg: NonNegative = 5.0
    range_sigma_m: NonNegative = 1.5
    bearing_sigma_deg: NonNegative = 2.0


@dataclass(frozen=True, slots=True)
class ChannelDraw:
    """What chance and obstacles add to one measurement."""

    range_bias_m: float
    """Of an obstructed path; never negative."""
    bearing_bias_rad: float
    range_noise_m: float
    bearing_noise_rad: float


class RadioChannel:
    """Measures an emitter through the true channel.

    Args:
        params: Offsets, obstruction and noise.
        rng: The channel's own generator.
        environment: The obstacles; None: there are none.
    """

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
        self._range_offset_m = params.range_offset_m
        self._bearing_offset_rad = math.radians(params.bearing_offset_deg)
        self._open_path = OpenPath(
            params.p_nlos, params.range_bias_mean_m, math.radians(params.bearing_bias_sigma_deg)
        )
        self.bearing_sigma_rad = math.radians(params.bearing_sigma_deg)
        self.range_sigma_m = params.range_sigma_m

    def prepare(self, emitter: Emitter) -> None:
        """Find the ways to `emitter`, and compile what is compiled, before time counts."""
        self._obstruction((0.5, 1.0, 0.0), emitter, emitter.position_enu_m)

    def draw(self, emitter: Emitter, sensor_enu_m: PositionEnu) -> ChannelDraw:
        """The next random part; always consumes the same amount of randomness.

        Args:
            emitter: Whom to measure.
            sensor_enu_m: True position of the sensor.
        """
        uniform = float(self._rng.random())
        exponential = float(self._rng.standard_exponential())
        bend, range_noise, bearing_noise = self._rng.standard_normal(3).tolist()
        range_bias_m, bearing_bias_rad, memory = self._obstruction(
            (uniform, exponential, bend), emitter, sensor_enu_m
        )
        self._memories[emitter.position_enu_m] = memory
        return ChannelDraw(
            range_bias_m=float(range_bias_m),
            bearing_bias_rad=float(bearing_bias_rad),
            range_noise_m=self.range_sigma_m * range_noise,
            bearing_noise_rad=self.bearing_sigma_rad * bearing_noise,
        )

    def measure(
        self, emitter: Emitter, sensor_enu_m: PositionEnu, time_s: float
    ) -> RangingMeasurement:
        """One measurement of `emitter`; it does not tell whether the path was obstructed.

        Args:
            emitter: Whom to measure.
            sensor_enu_m: True position of the sensor.
            time_s: When, on the vehicle's clock.
        """
        draw = self.draw(emitter, sensor_enu_m)
        range_m = (
            emitter.slant_range_m(sensor_enu_m)
            + self._range_offset_m
            + draw.range_bias_m
            + draw.range_noise_m
        )
        bearing_rad = (
            emitter.bearing_enu_rad(sensor_enu_m)
            + self._bearing_offset_rad
            + draw.bearing_bias_rad
            + draw.bearing_noise_rad
        )
        return RangingMeasurement(
            emitter_id=emitter.emitter_id,
            measured_at_s=time_s,
            range_m=max(MIN_RANGE_M, range_m),
            range_sigma_m=self.range_sigma_m,
            bearing_enu_rad=wrap_pi(bearing_rad),
            bearing_sigma_rad=self.bearing_sigma_rad,
        )

    def _obstruction(
        self, drawn: tuple[float, float, float], emitter: Emitter, sensor_enu_m: PositionEnu
    ) -> tuple[float, float, ShadowMemory]:
        """Range excess, bearing bias, and what to remember of the shadow."""
        place = emitter.position_enu_m
        memory = self._memories.get(place, NO_MEMORY)
        if self._environment is None:
            return *open_obstruction(*drawn, self._open_path), memory
        if place not in self._surroundings:
            self._surroundings[place] = self._environment.around(place)
        shadow, surroundings = self._environment.shadow, self._surroundings[place]
        return obstruction(*drawn, *sensor_enu_m, self._open_path, shadow, surroundings, memory)
