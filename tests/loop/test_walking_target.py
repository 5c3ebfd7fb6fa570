"""A target that walks although it is believed to lie still, through nine reflections in ten."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.domain import EstimateState, Point
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


def dishonest_s(loop: Loop, walk: Walk, seconds: float) -> float:
    """How long the target was outside of R95 while it was called localised."""
    period_s, told = 0.5, 0.0
    for _ in range(round(seconds / period_s)):
        loop.run(period_s)
        estimate = loop.companion.session.status(loop.now_s).estimate
        if estimate is None or estimate.state is not EstimateState.LOCALISED:
            continue
        away_m = math.dist(estimate.position_enu_m, walk(loop.now_s))
        told += period_s * (away_m > estimate.r95_m)
    return told


@pytest.mark.parametrize("speed_mps", [0.3, 3.0])
def test_a_target_that_walks_is_not_reported(speed_mps: float) -> None:
    walk = circle(speed_mps)
    loop = Loop(seed=4, payload_source=WalkingRadio(walk, seed=4))
    assert dishonest_s(loop, walk, 80.0) <= 3.0
    assert not loop.notes.results
    watch = loop.companion.session.tracker.watch
    assert watch.walks == 1
    assert watch.motion is not None
    assert sum("the target walks" in text for _, text in loop.notes.texts) == 1


def test_a_target_that_lies_still_is_found_and_nothing_is_told_of_a_walk() -> None:
    loop = Loop(seed=3, payload_source=WalkingRadio(lambda _: (50.0, 50.0), seed=3))
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.error_m <= 1.5
    assert loop.companion.session.tracker.watch.walks == 0
