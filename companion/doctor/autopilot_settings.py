"""What the autopilot's own fence, limits and parameters mean for a flight under a companion.

Whether the autopilot's own fence is the one that the companion will keep.

The same judgement as in flight, by the same code: what would keep the companion from engaging is a
failure here.

How far and how high the autopilot itself lets the vehicle go, beside fences that were uploaded.

A circle around home and a ceiling that lie within what the companion's guard allows would end a
search in the autopilot's failsafe. Home is taken to be where the local frame has its zero.

Sources: the parameter references of PX4 1.15 (Geofence: GF_ACTION, GF_MAX_*; 0 is no limit) and
ArduCopter 4.5 (FENCE_*; FENCE_TYPE is a mask: 1 ceiling, 2 circle).

What the autopilot's parameters mean for a flight under a companion.

Sources: the parameter references of PX4 1.15 (Commander, Geofence, Multicopter Position Control)
and ArduCopter 4.5 (FS_*, FENCE_*, GUID_*), and what both were seen to do in SITL: PX4 with
COM_OBL_RC_ACT = 0 and no RC sinks at 0.6 to 0.9 m/s and drifts when setpoints stop; a position
target of ArduPilot never times out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

from companion.config.schema import CompanionConfig
from companion.doctor.findings import AutopilotFacts, Finding, fail, ok, warn
from companion.domain import Autopilot
from companion.guard.gate import Guard
from companion.guidance.flight.fencing import FencePolicy, Fencing

SUBJECT = "fence"
SAME = "upload the same fence to the autopilot, or set limits.autopilot_fence; docs/flying.md"


def check_fence(facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    """Compare the fences as `limits.autopilot_fence` says."""
    fencing = Fencing(Guard(config.limits.guard_limits()), config.limits.fence_plan())
    if facts.origin is not None:
        fencing.set_origin(facts.origin)
    if facts.fence is not None:
        fencing.take(facts.fence)
    if fencing.refusal is not None:
        yield fail(SUBJECT, fencing.refusal, SAME)
    elif fencing.missing:
        text = f"not compared: {' and '.join(fencing.missing)} is not known yet"
        yield warn(SUBJECT, text, "wait for a position fix, and look again")
    elif fencing.note is not None:
        yield warn(SUBJECT, fencing.note, SAME)
    else:
        is_read = fencing.plan.policy is not FencePolicy.IGNORE
        how = "the autopilot's is the same" if is_read else "the autopilot's is not looked at"
        how = "the autopilot's own" if fencing.plan.policy is FencePolicy.USE else how
        yield ok(SUBJECT, f"{fencing.words}; {how}")


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
    yield _compare_limit(name, radius_m, reach_m, "around home", ours, "make our fence smaller")


def _ceiling(name: str, height_m: float, config: CompanionConfig) -> Iterator[Finding]:
    wanted_m = config.limits.altitude_max_m
    ours = f"limits.altitude_max_m is {wanted_m:g}"
    yield _compare_limit(
        name, height_m, wanted_m, "above home", ours, "lower limits.altitude_max_m"
    )


def _compare_limit(
    name: str, limit_m: float, wanted_m: float, where: str, ours: str, instead: str
) -> Finding:
    """A limit of the autopilot's beside how far the companion may go."""
    if limit_m >= wanted_m:
        return ok(name, f"{limit_m:g} m {where}, {ours}")
    fix = f"set {name} to {math.ceil(wanted_m)} or more, or {instead}"
    text = f"{limit_m:g} m {where}, but {ours}: that ends in the autopilot's failsafe"
    return warn(name, text, fix)


Rule = Callable[[Values, AutopilotFacts, CompanionConfig], Iterator[Finding]]

LONGEST_GAP_S = 0.5
"""What lost packets alone may cost between two setpoints, at 50 % loss."""
PATIENT_S = 3.0
OFFBOARD_LOSS = {
    0: "Position mode",
    1: "Altitude mode",
    2: "Manual mode",
    3: "Return",
    4: "Land",
    5: "Hold",
    6: "Terminate",
    7: "Disarm",
}
NEEDS_PILOT, FATAL = (0, 1, 2), (6, 7)
RC_OVERRIDE_OFFBOARD = 2
"""Bit of COM_RC_OVERRIDE."""


def _px4_loss_timeout(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del facts, config
    name, timeout_s = "COM_OF_LOSS_T", values["COM_OF_LOSS_T"]
    if timeout_s < LONGEST_GAP_S:
        text = f"{timeout_s:g} s: a few lost packets end OFFBOARD"
        yield fail(name, text, "set COM_OF_LOSS_T to 1.0")
    elif timeout_s > PATIENT_S:
        text = f"{timeout_s:g} s: so long it flies on when the companion is gone"
        yield warn(name, text, "set COM_OF_LOSS_T to 1.0")
    else:
        yield ok(name, f"{timeout_s:g} s without setpoints end OFFBOARD")


def _px4_loss_action(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del config
    name, action = "COM_OBL_RC_ACT", int(values["COM_OBL_RC_ACT"])
    what = f"{action} ({OFFBOARD_LOSS.get(action, 'unknown')}) when setpoints stop"
    fix = "set COM_OBL_RC_ACT to 5 (Hold) or 3 (Return)"
    if action in FATAL or action not in OFFBOARD_LOSS:
        yield fail(name, what, fix)
    elif action in NEEDS_PILOT and facts.has_rc is not True:
        yield warn(name, f"{what}, and there is no RC: it then sinks and drifts", fix)
    elif action in NEEDS_PILOT:
        yield warn(name, f"{what}: the pilot must take over at once", fix)
    else:
        yield ok(name, what)


def _px4_sticks(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del facts, config
    takes = bool(int(values["COM_RC_OVERRIDE"]) & RC_OVERRIDE_OFFBOARD)
    how = "sticks take over in OFFBOARD" if takes else "the mode switch takes over, sticks do not"
    yield ok("COM_RC_OVERRIDE", f"{values['COM_RC_OVERRIDE']:g}: {how}")


def _px4_fence(values: Values, facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    del facts, config
    if values["GF_ACTION"] == 0:
        text = "0: PX4's own geofence does nothing, the companion's is the only one"
        yield warn("GF_ACTION", text, "set GF_ACTION to 2 (Hold) or 3 (Return)")
    else:
        yield ok("GF_ACTION", f"{values['GF_ACTION']:g}: PX4's own geofence acts")


def _px4_speed(values: Values, facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    del facts
    yield from _speed("MPC_XY_VEL_MAX", values["MPC_XY_VEL_MAX"], config)


def _ardupilot_target_timeout(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del facts, config
    name, timeout_s = "GUID_TIMEOUT", values["GUID_TIMEOUT"]
    if timeout_s < LONGEST_GAP_S:
        text = f"{timeout_s:g} s: a few lost packets stop whoever steers by velocities"
        yield warn(name, text, "set GUID_TIMEOUT to 3.0")
    else:
        text = "for velocities only: without a companion it stays at its last position"
        yield ok(name, f"{timeout_s:g} s, {text}")


def _ardupilot_station(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del config
    if values["SYSID_MYGCS"] == facts.system_id:
        text = f"{facts.system_id}: this companion would count as the ground station"
        yield fail("SYSID_MYGCS", text, "set SYSID_MYGCS to your station's id, 255")
    if values["FS_GCS_ENABLE"] == 0:
        text = "0: a lost ground station does nothing"
        yield warn("FS_GCS_ENABLE", text, "set FS_GCS_ENABLE to 1 (RTL) and SYSID_MYGCS to yours")
    else:
        text = f"{values['FS_GCS_ENABLE']:g}, after {values['FS_GCS_TIMEOUT']:g} s"
        yield ok("FS_GCS_ENABLE", text)


def _ardupilot_throttle(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del config
    if values["FS_THR_ENABLE"] == 0 and facts.has_rc is not False:
        text = "0: a lost transmitter does nothing"
        yield warn("FS_THR_ENABLE", text, "set FS_THR_ENABLE to 1 (RTL)")


def _ardupilot_fence(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del facts, config
    name = "FENCE_ENABLE"
    if values["FENCE_ENABLE"] == 0:
        text = "0: ArduPilot's own fence is off, the companion's is the only one"
        yield warn(name, text, "set FENCE_ENABLE to 1 and FENCE_ACTION to 1 (RTL) or 4 (BRAKE)")
    elif values["FENCE_ACTION"] == 0:
        yield warn("FENCE_ACTION", "0: the fence only reports", "set FENCE_ACTION to 1 (RTL)")
    else:
        yield ok(name, f"on, action {values['FENCE_ACTION']:g}")


def _ardupilot_speed(
    values: Values, facts: AutopilotFacts, config: CompanionConfig
) -> Iterator[Finding]:
    del facts
    yield from _speed("WPNAV_SPEED", values["WPNAV_SPEED"] / 100.0, config)


def _speed(name: str, speed_mps: float, config: CompanionConfig) -> Iterator[Finding]:
    wanted_mps = config.limits.speed_mps
    if speed_mps < wanted_mps:
        text = f"{speed_mps:g} m/s: slower than limits.speed_mps ({wanted_mps:g})"
        yield warn(name, text, f"lower limits.speed_mps, or raise {name}")
    else:
        yield ok(name, f"{speed_mps:g} m/s, limits.speed_mps is {wanted_mps:g}")


RULES: Mapping[Autopilot, tuple[tuple[tuple[str, ...], Rule], ...]] = {
    Autopilot.PX4: (
        (("COM_OF_LOSS_T",), _px4_loss_timeout),
        (("COM_OBL_RC_ACT",), _px4_loss_action),
        (("COM_RC_OVERRIDE",), _px4_sticks),
        (("GF_ACTION",), _px4_fence),
        (("GF_ACTION", *PX4_LIMITS), px4_limits),
        (("MPC_XY_VEL_MAX",), _px4_speed),
    ),
    Autopilot.ARDUPILOT: (
        (("GUID_TIMEOUT",), _ardupilot_target_timeout),
        (("SYSID_MYGCS", "FS_GCS_ENABLE", "FS_GCS_TIMEOUT"), _ardupilot_station),
        (("FS_THR_ENABLE",), _ardupilot_throttle),
        (("FENCE_ENABLE", "FENCE_ACTION"), _ardupilot_fence),
        (("FENCE_ENABLE", "FENCE_ACTION", "FENCE_TYPE", *ARDUPILOT_LIMITS), ardupilot_limits),
        (("WPNAV_SPEED",), _ardupilot_speed),
    ),
}
"""Which parameters each rule needs."""


def needed_parameters(autopilot: Autopilot) -> tuple[str, ...]:
    """What to ask an autopilot for."""
    names = (name for names, _ in RULES.get(autopilot, ()) for name in names)
    return tuple(dict.fromkeys(names))


def check_parameters(facts: AutopilotFacts, config: CompanionConfig) -> Iterator[Finding]:
    """What the parameters mean; one that the autopilot does not tell is a finding, too."""
    untold: set[str] = set()
    for names, rule in RULES.get(facts.autopilot, ()):
        values = {name: facts.parameters.get(name) for name in names}
        known = {name: value for name, value in values.items() if value is not None}
        for name in names:
            if name not in known and name not in untold:
                untold.add(name)
                text = "the autopilot does not tell"
                yield warn(name, text, f"look {name} up with a ground station")
        if len(known) == len(names):
            yield from rule(known, facts, config)
