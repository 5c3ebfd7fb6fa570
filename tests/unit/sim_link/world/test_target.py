"""The emitter's true geometry."""

from __future__ import annotations

import math

import pytest

from sim_link.world.environment import Emitter, EmitterParams


def test_range_is_slant_and_bearing_counts_from_east() -> None:
    emitter = Emitter(EmitterParams(position_enu_m=(3.0, 4.0), height_m=-2.0))
    assert emitter.slant_range_m((0.0, 0.0, 10.0)) == pytest.approx(13.0)
    assert emitter.bearing_enu_rad((0.0, 4.0, 10.0)) == pytest.approx(0.0)
    assert emitter.bearing_enu_rad((3.0, 0.0, 10.0)) == pytest.approx(math.pi / 2.0)
