"""Where random missions are flown: fences of several shapes, with keep-outs and emitters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Corners = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Place:
    """A fence, what must not be entered, and where people stand."""

    name: str
    fence_enu_m: Corners
    keep_out_enu_m: tuple[Corners, ...]
    start_enu_m: tuple[float, float]
    emitter_box_m: tuple[float, float, float, float]
    """West, south, east, north of where the emitter may be; may reach over the fence."""


def box(west: float, south: float, east: float, north: float) -> Corners:
    """A rectangle's corners."""
    return ((west, south), (east, south), (east, north), (west, north))


PLACES = (
    Place("field", box(-40, -40, 110, 110), (), (10, 10), (-45, -45, 115, 115)),
    Place("close", box(-15, -15, 60, 60), (), (10, 10), (-10, -10, 70, 70)),
    Place(
        "notch",
        ((-20, -20), (100, -20), (100, 30), (45, 30), (45, 100), (-20, 100)),
        (),
        (10, 10),
        (-15, -15, 95, 95),
    ),
    Place(
        "masts",
        box(-30, -30, 110, 110),
        (box(38, 20, 46, 34), ((60, 60), (75, 62), (66, 78)), box(20, 70, 24, 74)),
        (10, 10),
        (0, 0, 100, 100),
    ),
    Place(
        "wedge",
        ((-25, -25), (120, -10), (40, 50), (-10, 120)),
        (),
        (5, 5),
        (-20, -20, 110, 110),
    ),
    Place("strip", box(-20, -20, 140, 25), (), (0, 0), (10, -25, 150, 30)),
)


def emitter_of(place: Place, rng: np.random.Generator) -> tuple[float, float]:
    """Somewhere in its box; not where the vehicle stands."""
    west, south, east, north = place.emitter_box_m
    while True:
        e, n = float(rng.uniform(west, east)), float(rng.uniform(south, north))
        away = ((e - place.start_enu_m[0]) ** 2 + (n - place.start_enu_m[1]) ** 2) ** 0.5
        if away > 8.0:
            return e, n
