"""A target that walks, or leaves the fence, although it is believed to be stationary within it.

Nine ranges of ten are reflected.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.geometry.polygons import Point
from companion.guidance.commands import SessionParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink, message_from_ranging
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.monitor import Monitor
from sim_link.world.environment import ChannelParams, Emitter, EmitterParams
from sim_link.world.radio_channel import RadioChannel
from tests.loop.loop_helpers import Loop

pytestmark = pytest.mark.slow

HEARD_FROM_M = 3.0
Walk = Callable[[float], Point]


def circle(speed_mps: float, radius_m: float = 30.0) -> Walk:
    """Round and round from (50, 50)."""

    def position(time_s: float) -> Point:
        turn = speed_mps * time_s / radius_m
        return (50.0 + radius_m * math.sin(turn), 50.0 + radius_m * (1.0 - math.cos(turn)))

    return position


class WalkingRadio:
    """The canonical channel to an emitter that walks.

    Args:
        walk: Position of the emitter over time.
        seed: Seed of the channel.
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


def test_a_target_that_walks_slowly_is_reported_as_moving() -> None:
    loop = Loop(seed=4, payload_source=WalkingRadio(circle(0.3), seed=4))
    loop.run(80.0)
    assert loop.said("target seems to move")


@pytest.mark.parametrize(
    "seed", [3, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (4, 5, 6))]
)
@pytest.mark.parametrize("speed_mps", [1.0, 3.0])
def test_no_position_is_reported_of_a_target_that_walks_fast(speed_mps: float, seed: int) -> None:
    """Its motion is often not recognised: no velocity that lasts explains a circle."""
    loop = Loop(seed=seed, payload_source=WalkingRadio(circle(speed_mps), seed=seed))
    loop.run(80.0)
    assert loop.notes.results == []


def test_a_target_that_lies_still_is_found_and_nothing_is_announced_a_walk() -> None:
    loop = Loop(seed=3, payload_source=WalkingRadio(lambda _: (50.0, 50.0), seed=3))
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.error_m <= 1.5
    assert not loop.said("target seems to move")


def away(time_s: float) -> Point:
    """Out of the fence to the east at a walker's pace, and on."""
    return (45.0 + 1.5 * time_s, 40.0)


def along_the_border(time_s: float) -> Point:
    """Return the position on a way back and forth across the fence's north-east corner."""
    return (60.0 + 25.0 * math.sin(0.05 * time_s), 60.0 + 25.0 * math.cos(0.05 * time_s))


def elsewhere(time_s: float) -> Point:
    """Inside for half a minute, far outside for the next."""
    return (40.0, 40.0) if time_s % 60.0 < 30.0 else (160.0, -90.0)


@pytest.mark.parametrize(
    ("walk", "flight_s"), [(away, 80.0), (along_the_border, 100.0), (elsewhere, 100.0)]
)
def test_a_target_that_leaves_the_fence_is_announced_and_never_followed(
    walk: Walk, flight_s: float
) -> None:
    half_m = 65.0
    fence = ((-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m))
    limits = LimitsConfig(fence_enu_m=fence)
    mission = SessionParams(engage="auto", stop_confirm_s=1e6)
    config = CompanionConfig(mission=mission, limits=limits)
    loop = Loop(config, seed=5, payload_source=WalkingRadio(walk, seed=5))
    monitor = Monitor(rules_of(config), loop.flight.sim.vehicle)
    loop.flight.observers.append(monitor)
    loop.run(flight_s)
    assert loop.said("outside the fence")
    assert monitor.violations == []
    assert 0.0 < monitor.fence.closest_m < 50.0


def test_an_estimate_that_nothing_agrees_with_any_more_is_given_up_within_seconds() -> None:
    mission = SessionParams(engage="auto", stop_confirm_s=1e6)
    radio = WalkingRadio(elsewhere, seed=5)
    loop = Loop(CompanionConfig(mission=mission), seed=5, payload_source=radio)
    # 1.3 m at 30 s; 0.3 m without the 0.15 s that count for stamps where no antenna is configured
    for end_s, most_m in ((30.0, 1.5), (40.0, 60.0)):
        loop.run(end_s - loop.now_s)
        estimate = loop.companion.session.estimate
        assert estimate is not None
        assert estimate.r95_m <= most_m
        assert math.dist(estimate.position_enu_m, elsewhere(end_s - 0.1)) <= estimate.r95_m
    assert loop.said("measurements do not agree")
