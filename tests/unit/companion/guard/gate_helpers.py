"""Helpers of the guard's tests: limits, and a vehicle that flies its setpoints."""

from __future__ import annotations

import math

from companion.guard.gate import Guard, Guarded, GuardLimits, Motion, Position
from companion.guard.limits import Envelope, Fence, Stopping

SQUARE = Fence(((-100.0, -100.0), (100.0, -100.0), (100.0, 100.0), (-100.0, 100.0)), 5.0)
ENVELOPE = Envelope(
    altitude_min_m=5.0,
    altitude_max_m=60.0,
    speed_mps=5.0,
    climb_mps=2.0,
    acceleration_mps2=2.0,
    step_m=8.0,
)
STOPPING = Stopping(latency_s=0.5, deceleration_mps2=2.0, navigation_sigma_m=1.0)
LIMITS = GuardLimits(SQUARE, ENVELOPE, STOPPING)
GUARD = Guard(LIMITS)
HOME = (0.0, 0.0, 10.0)
LOW_M, HIGH_M = 18.0, 67.0
"""The band above home, 3 sigma from both of its ends."""
START = (0.0, 0.0, 30.0)


def motion(
    position: Position, velocity: Position = (0.0, 0.0, 0.0), battery_pct: float | None = None
) -> Motion:
    return Motion(position, velocity, HOME, battery_pct)


def flown(
    goal: Position,
    *,
    start: Position = START,
    ticks: int = 1000,
    dt_s: float = 0.1,
    guard: Guard = GUARD,
    battery_pct: float | None = None,
    cap_mps: float = math.inf,
) -> list[Guarded]:
    """A vehicle that is always where its setpoint is, and moves like it."""
    steps = [Guarded(start)]
    for _ in range(ticks):
        last = steps[-1]
        now = Motion(last.position_enu_m, last.velocity_enu_mps, HOME, battery_pct)
        steps.append(guard.towards(goal, last, now, dt_s, cap_mps))
    return steps
