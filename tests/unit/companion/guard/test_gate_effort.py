"""A tick looks at every edge a few times, wherever the vehicle is and whatever the fence is like.

What counts is how often an edge is looked at: the time that takes is the computer's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.geometry import obstacles, polygons
from companion.geometry.polygons import Corners, Point
from companion.guard.gate import Guard, Guarded, GuardReason, Motion
from companion.guard.limits import Fence
from tests.unit.companion.guard.gate_helpers import LIMITS

LOOKS_PER_EDGE = 30
FIELD = ((0.0, 0.0), (300.0, 0.0), (300.0, 300.0), (0.0, 300.0))
NAMES = ("nearest_on_segment", "segments_cross", "share_in_capsule", "moved_left")


def comb() -> Corners:
    """A field with 49 gaps that are too narrow to be in, 199 corners."""
    teeth = [
        (400.0 - 8.0 * tooth - aside, north)
        for tooth in range(49)
        for aside, north in ((1.0, 0.0), (2.5, 300.0), (4.0, 300.0), (5.0, 0.0))
    ]
    return ((0.0, -100.0), (400.0, -100.0), *teeth, (0.0, 0.0))


def disc(east: float, north: float, radius_m: float) -> Corners:
    turns = [math.tau * corner / 36 for corner in range(36)]
    return tuple((east + radius_m * math.cos(t), north + radius_m * math.sin(t)) for t in turns)


def discs() -> tuple[Corners, ...]:
    """Five round exclusions that overlap."""
    positions = ((100.0, 100.0), (190.0, 100.0), (100.0, 190.0), (190.0, 190.0))
    return (*(disc(*position, 50.0) for position in positions), disc(145.0, 145.0, 30.0))


def counted(original: Callable[..., object], seen: list[str]) -> Callable[..., object]:
    def called(*args: object) -> object:
        seen.append(original.__name__)
        return original(*args)

    return called


def looks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the functions that are called for an edge, from now on."""
    seen: list[str] = []
    for module in (obstacles, polygons):
        for name in NAMES:
            if hasattr(module, name):
                monkeypatch.setattr(module, name, counted(getattr(module, name), seen))
    return seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("polygon", "keep_outs", "position"),
    [
        (comb(), (), (200.0, 299.0)),
        (comb(), (), (203.5, 200.0)),
        (comb(), (), (500.0, 500.0)),
        (comb(), (), (200.0, -50.0)),
        (FIELD, discs(), (145.0, 145.0)),
        (FIELD, discs(), (120.0, 140.0)),
        (FIELD, discs(), (-50.0, -50.0)),
        (FIELD, discs(), (20.0, 20.0)),
    ],
)
def test_the_way_back_does_not_take_longer_the_more_corners_meet(
    polygon: Corners,
    keep_outs: tuple[Corners, ...],
    position: Point,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    guard = Guard(replace(LIMITS, fence=Fence(polygon, 3.0, keep_outs)))
    edges = len(polygon) + sum(map(len, keep_outs))
    vehicle = Motion((*position, 20.0), (0.5, 0.5, 0.0), (0.0, 0.0, 0.0))
    seen = looks(monkeypatch)
    tick = guard.towards((390.0, 290.0, 20.0), Guarded((*position, 20.0)), vehicle, 0.05)
    count = len(seen)
    is_out = not Fence(polygon, 3.0, keep_outs).allows(position)
    assert count <= LOOKS_PER_EDGE * edges
    assert count or not is_out  # in free space perhaps none is near
    assert (GuardReason.OUTSIDE in tick.reasons) is is_out
