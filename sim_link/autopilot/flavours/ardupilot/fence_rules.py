"""ArduCopter's fence: which of its parts are on, and how near a breach is.

Source: ArduPilot documentation, "Simple GeoFence"; FENCE_TYPE, FENCE_RADIUS, FENCE_ALT_MAX.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.protocols.parameter_store import ParameterStore

ALTITUDE_MAX, CIRCLE, POLYGON, ALTITUDE_MIN = 1, 2, 4, 8
"""Bits of FENCE_TYPE."""


def margin_m(place: PositionEnu, aircraft: Aircraft, parameters: ParameterStore) -> float:
    """Distance to the nearest breach, negative in one; infinite while the fence is off."""
    if not parameters["FENCE_ENABLE"]:
        return math.inf
    parts = int(parameters["FENCE_TYPE"])
    home = aircraft.home_enu_m
    margin = math.inf
    if parts & ALTITUDE_MAX:
        margin = min(margin, parameters["FENCE_ALT_MAX"] - (place[2] - home[2]))
    if parts & CIRCLE:
        margin = min(margin, parameters["FENCE_RADIUS"] - math.dist(place[:2], home[:2]))
    if parts & POLYGON:
        margin = min(margin, aircraft.fence.margin_m(place))
    return margin
