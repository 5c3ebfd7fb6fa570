"""MGRS: the grid text that ground teams read out over the radio."""

from __future__ import annotations

import math

import mgrs

from companion.handoff.record import Degrees

MIN_DIGITS, MAX_DIGITS = 1, 5
"""A digit pair is 10 km, five are 1 m."""


def mgrs_text(place: Degrees, r95_m: float) -> str:
    """A place as MGRS with spaces, no finer than it is known: `32T PT 6894 3510`.

    The square that is named holds the place, and is at most as large as R95 (1 m at least).

    Args:
        place: Latitude and longitude, WGS84; the poles are in UPS squares.
        r95_m: Radius of the uncertainty.
    """
    digits = MAX_DIGITS - math.floor(math.log10(min(max(r95_m, 1.0), 1e4)))
    digits = min(max(digits, MIN_DIGITS), MAX_DIGITS)
    text = mgrs.MGRS().toMGRS(*place, MGRSPrecision=digits).lstrip("0")
    head, east, north = text[: -2 * digits], text[-2 * digits : -digits], text[-digits:]
    return f"{head[:-2]} {head[-2:]} {east} {north}"
