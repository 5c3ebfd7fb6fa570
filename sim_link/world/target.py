"""The hidden emitter: where it really is, and the true range and bearing to it."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from companion.domain import PositionEnu
from companion.params import Params
from sim_link.world.channel_params import ChannelParams

EmitterId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
Coordinate = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
"""Local metres; beyond 100 km a flat local frame means nothing."""


class EmitterParams(Params, frozen=True):
    """The emitter's identity and place, local east-north-up metres about the origin."""

    emitter_id: EmitterId = 1
    position_enu_m: tuple[Coordinate, Coordinate] = (50.0, 50.0)
    height_m: Coordinate = 0.0
    channel: ChannelParams | None = None
    """How it is heard, what is left out being canonical; None: over the scenario's `channel`."""
    quality: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None = None
    """What the radio says of its signal; None: nothing."""


class Emitter:
    """A radio that does not move.

    Args:
        params: Its identity and place.
    """

    def __init__(self, params: EmitterParams) -> None:
        self.emitter_id = params.emitter_id
        self.channel = params.channel
        self.quality = params.quality
        self.position_enu_m: PositionEnu = (*params.position_enu_m, params.height_m)

    def slant_range_m(self, sensor_enu_m: PositionEnu) -> float:
        """True distance from the sensor, metres. Paper: h of eq. (1) for ranges."""
        return math.dist(self.position_enu_m, sensor_enu_m)

    def bearing_enu_rad(self, sensor_enu_m: PositionEnu) -> float:
        """True azimuth from the sensor, counter-clockwise from east. Paper: h for bearings."""
        return math.atan2(
            self.position_enu_m[1] - sensor_enu_m[1], self.position_enu_m[0] - sensor_enu_m[0]
        )
