"""Random faults, each with figures in a range that a vehicle may meet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import msgspec
import numpy as np

from companion.domain import FlightMode
from sim_link.faults import kinds
from sim_link.faults.content_kinds import RangingField
from sim_link.faults.kinds import Fault
from sim_link.faults.link_kinds import Direction

T = TypeVar("T")
MODES = (FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND)
UNIT_FACTORS = (0.001, 0.01, 180.0 / math.pi, 100.0, 1000.0)
MUTED = ("LOCAL_POSITION_NED", "HEARTBEAT", "ATTITUDE", "HOME_POSITION", "EXTENDED_SYS_STATE")
DIRECTIONS: tuple[Direction, ...] = ("both", "to_companion", "to_vehicle")
FIELDS: tuple[RangingField, ...] = ("both", "range", "bearing")
JUMP_M = 7.0
EARLIEST_S, LATEST_S = 2.0, 30.0
SHORTEST_S, LONGEST_S = 0.3, 15.0


class Dice:
    """Draws figures.

    Args:
        rng: Of one trial.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def number(self, low: float, high: float) -> float:
        """A number, evenly."""
        return round(float(self._rng.uniform(low, high)), 3)

    def spread(self, low: float, high: float) -> float:
        """A number, evenly by its logarithm."""
        return round(math.exp(float(self._rng.uniform(math.log(low), math.log(high)))), 3)

    def one(self, choices: Sequence[T]) -> T:
        """One of these."""
        return choices[int(self._rng.integers(len(choices)))]

    def happens(self, share: float) -> bool:
        """True so often."""
        return float(self._rng.random()) < share


def _jump(dice: Dice) -> Fault:
    heading = dice.number(-math.pi, math.pi)
    size_m = dice.one((1.0, JUMP_M))
    return kinds.EkfJump(
        east_m=round(size_m * math.cos(heading), 3),
        north_m=round(size_m * math.sin(heading), 3),
        yaw_deg=dice.one((0.0, 0.0, 30.0)),
    )


def _wind(dice: Dice) -> Fault:
    heading = dice.number(-math.pi, math.pi)
    return kinds.Wind(
        east_mps=round(12.0 * math.cos(heading), 3), north_mps=round(12.0 * math.sin(heading), 3)
    )


DRAWS: tuple[Callable[[Dice], Fault], ...] = (
    lambda d: kinds.LinkLoss(share=d.number(0.05, 0.6), direction=d.one(DIRECTIONS)),
    lambda d: kinds.LinkBursts(
        mean_good_s=d.number(0.3, 3.0), mean_bad_s=d.number(0.05, 1.0), direction=d.one(DIRECTIONS)
    ),
    lambda d: kinds.LinkBlackout(direction=d.one(DIRECTIONS)),
    lambda d: kinds.LinkDelay(delay_s=d.number(0.02, 0.25), direction=d.one(DIRECTIONS)),
    lambda d: kinds.LinkJitter(jitter_s=d.number(0.05, 0.3), direction=d.one(DIRECTIONS)),
    lambda d: kinds.LinkDuplicates(share=d.number(0.05, 0.5), copies=d.one((1, 2, 5))),
    lambda d: kinds.LinkBitFlips(share=d.number(0.01, 0.3), bits=d.one((1, 2, 8))),
    lambda d: kinds.LinkTruncation(share=d.number(0.01, 0.3)),
    lambda d: kinds.LinkGarbage(share=d.number(0.05, 0.5)),
    lambda d: kinds.LinkRateCap(bits_per_s=d.one((9600.0, 57_600.0, 115_200.0))),
    lambda d: kinds.LinkHold(direction=d.one(DIRECTIONS)),
    lambda d: kinds.StreamMute(message=d.one(MUTED)),
    lambda d: kinds.TelemetryNonsense(share=d.number(0.05, 0.5)),
    lambda d: kinds.RangingDropout(missing=d.one(FIELDS)),
    lambda _: kinds.RangingFreeze(),
    lambda d: kinds.RangingWrongUnit(of=d.one(FIELDS), factor=d.one(UNIT_FACTORS)),
    lambda d: kinds.RangingOutliers(share=d.number(0.05, 0.4), excess_m=d.number(10.0, 80.0)),
    lambda d: kinds.RangingStale(age_s=d.number(0.3, 3.0)),
    lambda d: kinds.RangingOutOfOrder(window_s=d.number(0.2, 1.0)),
    lambda d: kinds.RangingSecondEmitter(
        east_m=d.number(-20.0, 110.0),
        north_m=d.number(-20.0, 110.0),
        emitter_id=d.one((None, 0, 9)),
    ),
    lambda d: kinds.RangingNan(share=d.number(0.1, 1.0)),
    lambda d: kinds.VehicleReboot(down_s=d.number(0.2, 3.0)),
    _jump,
    lambda d: kinds.EkfPoor(ratio=d.number(1.1, 3.0)),
    lambda _: kinds.GpsLoss(),
    _wind,
    lambda d: kinds.Battery(share=d.one((None, 0.14, 0.1, 0.06, 0.02))),
    lambda d: kinds.OriginShift(east_m=d.number(-12.0, 12.0), north_m=d.number(-12.0, 12.0)),
    lambda d: kinds.PilotMode(mode=d.one(MODES)),
    lambda d: kinds.PilotSticks(forward=d.number(-1.0, 1.0), right=d.number(-1.0, 1.0)),
    lambda d: kinds.ModeFlap(mode=d.one(MODES), period_s=d.number(0.3, 3.0)),
    lambda d: kinds.Failsafe(mode=d.one((FlightMode.RETURN, FlightMode.LAND))),
    lambda _: kinds.Disarm(),
    lambda d: kinds.SecondSender(
        rate_hz=d.number(2.0, 30.0), east_m=d.number(0.0, 40.0), north_m=d.number(0.0, 40.0)
    ),
    lambda d: kinds.CompanionKilled(down_s=d.spread(0.2, 10.0)),
    lambda _: kinds.CompanionStalled(),
    lambda _: kinds.CompanionTerminated(),
    lambda d: kinds.ForgedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: kinds.ReplayedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: kinds.UnsignedFrames(rate_hz=d.spread(10.0, 500.0)),
    lambda d: kinds.ForeignFrames(rate_hz=d.spread(10.0, 500.0)),
)
"""One per kind of fault, in the order of `kinds.Fault`."""


def random_fault(rng: np.random.Generator) -> Fault:
    """Any fault, at any time of a flight."""
    dice = Dice(rng)
    fault = dice.one(DRAWS)(dice)
    times = {
        "start_s": dice.number(EARLIEST_S, LATEST_S),
        "duration_s": dice.spread(SHORTEST_S, LONGEST_S),
    }
    return msgspec.structs.replace(fault, **times)
