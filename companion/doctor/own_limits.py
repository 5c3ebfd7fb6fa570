"""How far and how high the autopilot itself lets the vehicle go, beside fences that were uploaded.

A circle around home and a ceiling that lie within what the companion's guard allows would end a
search in the autopilot's failsafe. Home is taken to be where the local frame has its zero.

Sources: the parameter references of PX4 1.15 (Geofence: GF_ACTION, GF_MAX_*; 0 is no limit) and
ArduCopter 4.5 (FENCE_*; FENCE_TYPE is a mask: 1 ceiling, 2 circle).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from companion.config.schema import CompanionConfig
from companion.doctor.facts import AutopilotFacts
from companion.doctor.verdicts import Finding, ok, warn
from companion.guard.gate import Guard
from companion.guidance.fencing import Fencing

Values = Mapping[str, float]

PX4_LIMITS = ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")
PX4_WARNS_ONLY = 1
"""GF_ACTION up to this keeps the mode."""
ARDUPILOT_LIMITS = ("FENCE_RADIUS", "FENCE_ALT_MAX")
CEILING, CIRCLE = 1, 2


def px4_limits(values: Values, facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    """GF_MAX_HOR_DIST and GF_MAX_VER_DIST against the guard's limits."""
    radius, ceiling = PX4_LIMITS
    acts = values["GF_ACTION"] > PX4_WARNS_ONLY
    if acts and values[radius] > 0.0:
        yield from _radius(radius, values[radius], facts, config)
    if acts and values[ceiling] > 0.0:
        yield from _ceiling(ceiling, values[ceiling], config)


def ardupilot_limits(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    """FENCE_RADIUS and FENCE_ALT_MAX against the guard's limits."""
    radius, ceiling = ARDUPILOT_LIMITS
    acts = values["FENCE_ENABLE"] != 0 and values["FENCE_ACTION"] != 0
    kinds = int(values["FENCE_TYPE"])
    if acts and kinds & CIRCLE:
        yield from _radius(radius, values[radius], facts, config)
    if acts and kinds & CEILING:
        yield from _ceiling(ceiling, values[ceiling], config)


def farthest_m(facts: AutopilotFacts, config: CompanionConfig) -> float | None:
    """How far from home the guard lets the vehicle go; None: its fence is not known."""
    fencing = Fencing(Guard(config.limits.guard_limits()), config.limits.fence_plan())
    if facts.origin is not None:
        fencing.set_origin(facts.origin)
    if facts.fence is not None:
        fencing.take(facts.fence)
    fence = fencing.guard.limits.fence or config.limits.guard_limits().fence
    reaches_m = []
    if fence is not None:
        corner_m = max(math.hypot(*corner) for corner in fence.polygon_enu_m)
        reaches_m.append(corner_m - fence.margin_m)
    if config.limits.distance_home_m is not None:
        reaches_m.append(config.limits.distance_home_m)
    return min(reaches_m, default=None)


def _radius(
    name: str, radius_m: float, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    reach_m = farthest_m(facts, config)
    if reach_m is None:
        return
    ours = f"the companion may fly {reach_m:.0f} m away"
    yield _compared(name, radius_m, reach_m, "around home", ours, "make our fence smaller")


def _ceiling(name: str, height_m: float, config: CompanionConfig) -> Iterator[Finding]:
    wanted_m = config.limits.altitude_max_m
    ours = f"limits.altitude_max_m is {wanted_m:g}"
    yield _compared(name, height_m, wanted_m, "above home", ours, "lower limits.altitude_max_m")


def _compared(
    name: str, limit_m: float, wanted_m: float, where: str, ours: str, instead: str
) -> Finding:
    """A limit of the autopilot's beside how far the companion may go."""
    if limit_m >= wanted_m:
        return ok(name, f"{limit_m:g} m {where}, {ours}")
    fix = f"set {name} to {math.ceil(wanted_m)} or more, or {instead}"
    text = f"{limit_m:g} m {where}, but {ours}: that ends in the autopilot's failsafe"
    return warn(name, text, fix)
