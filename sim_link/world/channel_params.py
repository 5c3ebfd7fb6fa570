"""What a radio channel is made of, as a scenario gives it."""

from __future__ import annotations

from typing import Annotated

import msgspec

from companion.params import NonNegative, Params

Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


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
