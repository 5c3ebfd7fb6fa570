"""A target that walks although it is believed to lie still, through nine reflections in ten."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.domain import Point
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.ranging import message_from_ranging
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.world.radio_channel import ChannelParams, RadioChannel
from sim_link.world.target import Emitter, EmitterParams
from tests.loop.loop_helpers import Loop

HEARD_FROM_M = 3.0
Walk = Callable[[float], Point]


def circle(speed_mps: float, radius_m: float = 30.0) -> Walk:
    """Round and round from (50, 50)."""

    def place(time_s: float) -> Point:
        turn = speed_mps * time_s / radius_m
        return (50.0 + radius_m * math.sin(turn), 50.0 + radius_m * (1.0 - math.cos(turn)))

    return place


class WalkingRadio:
    """The canonical channel to an emitter that walks.

    Args:
        walk: Where it is at which time.
        seed: Of the channel.
    """

    def __init__(self, walk: Walk, seed: int) -> None:
        self._walk = walk
        self._channel = RadioChannel(ChannelParams(), np.random.default_rng(seed))
        self._codec = MavCodec(1, mavlink.MAV_COMP_ID_PERIPHERAL)

    def __call__(self, sim: SimEndpoint, now_s: float) -> bytes | None:
        body = sim.vehicle.body
        if body.height_m < HEARD_FROM_M:
            return None
        emitter = Emitter(EmitterParams(position_enu_m=self._walk(now_s)))
        measured = self._channel.measure(emitter, body.position_enu_m, now_s)
        return self._codec.encode(message_from_ranging(measured, round(1e6 * now_s)))


@pytest.mark.parametrize("speed_mps", [0.3, 3.0])
def test_the_operator_is_told_of_a_target_that_walks(speed_mps: float) -> None:
    walk = circle(speed_mps)
    loop = Loop(seed=4, payload_source=WalkingRadio(walk, seed=4))
    loop.run(80.0)
    assert loop.notes.said("the target seems to walk")


def test_a_target_that_lies_still_is_found_and_nothing_is_told_of_a_walk() -> None:
    loop = Loop(seed=3, payload_source=WalkingRadio(lambda _: (50.0, 50.0), seed=3))
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.error_m <= 1.5
    assert not loop.notes.said("the target seems to walk")
