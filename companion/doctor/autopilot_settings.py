"""Checks of the autopilot's fence, limits and parameters for a flight under a companion.

The autopilot's fence is checked by the code of the flight: a fence that would keep the companion
from taking control is a failure here. A circle around home and a ceiling inside the limits of the
companion's guard would end a search in the autopilot's failsafe. Home is assumed to be the zero of
the local frame.

Sources: the parameter references of PX4 1.15 (Commander, Geofence, Multicopter Position Control;
GF_MAX_*: 0 is no limit), ArduCopter 4.5 (FS_*, GUID_*, FENCE_*; FENCE_TYPE is a mask: 1 ceiling,
2 circle), their successors (MAN_OVERRIDE_SPD, MAV_GCS_SYSID, WP_SPD), and the behaviour of both in
SITL: PX4 with COM_OBL_RC_ACT = 0 and no RC sinks at 0.6 to 0.9 m/s and drifts when setpoints stop;
a position target of ArduPilot never times out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from companion.config.schema import CompanionConfig
from companion.doctor.findings import AutopilotFacts, CheckResult, fail, ok, warn
from companion.domain import Autopilot
from companion.guard.gate import Guard
from companion.guidance.fencing import FencePolicy, Fencing

SAME = "upload the same fence to the autopilot, or set limits.autopilot_fence; docs/flying.md"

LONGEST_GAP_S = 0.5
"""Longest gap between two setpoints by lost packets alone, at 50 % loss."""
PATIENT_S = 3.0
_MODES = ("Position mode", "Altitude mode", "Manual mode", "Return", "Land", "Hold")
OFFBOARD_LOSS = dict(enumerate((*_MODES, "Terminate", "Disarm")))
NEEDS_PILOT, FATAL = (0, 1, 2), (6, 7)
RC_OVERRIDE_OFFBOARD = 2
PX4_WARNS_ONLY = 1
"""GF_ACTION up to this keeps the mode."""
CEILING, CIRCLE = 1, 2
RENAMED = {
    "COM_RC_OVERRIDE": "MAN_OVERRIDE_SPD",
    "SYSID_MYGCS": "MAV_GCS_SYSID",
    "WPNAV_SPEED": "WP_SPD",
}
"""Parameters up to PX4 1.17 and ArduCopter 4.6, and their successors: one of both is reported."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Inputs of a rule."""

    values: Mapping[str, float]
    facts: AutopilotFacts
    config: CompanionConfig

    def __getitem__(self, name: str) -> float:
        return self.values[name]


SettingRule = Callable[[Settings], Iterator[CheckResult]]


def check_fence(facts: AutopilotFacts, config: CompanionConfig) -> Iterator[CheckResult]:
    """Compare the fences as configured by `limits.autopilot_fence`."""
    fencing = _fencing_in_flight(facts, config)
    if fencing.refusal is not None:
        yield fail("fence", fencing.refusal, SAME)
    elif fencing.missing:
        text = f"not compared: {' and '.join(fencing.missing)} is not known yet"
        yield warn("fence", text, "wait for a position fix and run the doctor again")
    elif fencing.note is not None:
        yield warn("fence", fencing.note, SAME)
    else:
        policy = fencing.plan.policy
        how = "the autopilot's is the same"
        if policy in (FencePolicy.IGNORE, FencePolicy.USE):
            is_ours = policy is FencePolicy.IGNORE
            how = "the autopilot's is not checked" if is_ours else "the autopilot's own"
        yield ok("fence", f"{fencing.description}; {how}")


def _fencing_in_flight(facts: AutopilotFacts, config: CompanionConfig) -> Fencing:
    """Return the fencing as in flight, with the autopilot's origin and fence."""
    fencing = Fencing(Guard(config.limits.guard_limits()), config.limits.fence_plan())
    if facts.origin is not None:
        fencing.set_origin(facts.origin)
    if facts.fence is not None:
        fencing.take(facts.fence)
    return fencing


def _check_radius(name: str, settings: Settings) -> Iterator[CheckResult]:
    limits = settings.config.limits
    fencing = _fencing_in_flight(settings.facts, settings.config)
    fence = fencing.guard.limits.fence or limits.guard_limits().fence
    reaches_m = [] if limits.distance_home_m is None else [limits.distance_home_m]
    if fence is not None:
        corner_m = max(math.hypot(*corner) for corner in fence.polygon_enu_m)
        reaches_m.append(corner_m - fence.margin_m)
    reach_m = min(reaches_m, default=None)
    if reach_m is not None:
        ours = f"the companion may fly {reach_m:.0f} m away"
        how = ("around home", ours, "make the companion's fence smaller")
        yield _compare_limit(name, settings[name], reach_m, how)


def _check_ceiling(name: str, settings: Settings) -> Iterator[CheckResult]:
    wanted_m = settings.config.limits.altitude_max_m
    ours = f"limits.altitude_max_m is {wanted_m:g}"
    how = ("above home", ours, "lower limits.altitude_max_m")
    yield _compare_limit(name, settings[name], wanted_m, how)


def _compare_limit(
    name: str, limit_m: float, wanted_m: float, how: tuple[str, str, str]
) -> CheckResult:
    """Compare a limit with our reach; `how`: its reference, our limit as text, another remedy."""
    where, ours, instead = how
    if limit_m >= wanted_m:
        return ok(name, f"{limit_m:g} m {where}, {ours}")
    fix = f"set {name} to {math.ceil(wanted_m)} or more, or {instead}"
    text = f"{limit_m:g} m {where}, but {ours}: that ends in the autopilot's failsafe"
    return warn(name, text, fix)


def _check_speed(name: str, per_mps: float, settings: Settings) -> Iterator[CheckResult]:
    speed_mps, wanted_mps = settings[name] / per_mps, settings.config.limits.speed_mps
    if speed_mps < wanted_mps:
        text = f"{speed_mps:g} m/s: slower than limits.speed_mps ({wanted_mps:g})"
        yield warn(name, text, f"lower limits.speed_mps, or raise {name}")
    else:
        yield ok(name, f"{speed_mps:g} m/s, limits.speed_mps is {wanted_mps:g}")


def _px4_limits(settings: Settings) -> Iterator[CheckResult]:
    acts = settings["GF_ACTION"] > PX4_WARNS_ONLY
    if acts and settings["GF_MAX_HOR_DIST"] > 0.0:
        yield from _check_radius("GF_MAX_HOR_DIST", settings)
    if acts and settings["GF_MAX_VER_DIST"] > 0.0:
        yield from _check_ceiling("GF_MAX_VER_DIST", settings)


def _px4_loss_timeout(settings: Settings) -> Iterator[CheckResult]:
    name, timeout_s = "COM_OF_LOSS_T", settings["COM_OF_LOSS_T"]
    fix = "set COM_OF_LOSS_T to 1.0"
    if timeout_s < LONGEST_GAP_S:
        yield fail(name, f"{timeout_s:g} s: a few lost packets end OFFBOARD", fix)
    elif timeout_s > PATIENT_S:
        text = f"{timeout_s:g} s: PX4 keeps flying for that long after the companion is gone"
        yield warn(name, text, fix)
    else:
        yield ok(name, f"{timeout_s:g} s without setpoints end OFFBOARD")


def _px4_loss_action(settings: Settings) -> Iterator[CheckResult]:
    name, action = "COM_OBL_RC_ACT", int(settings["COM_OBL_RC_ACT"])
    what = f"{action} ({OFFBOARD_LOSS.get(action, 'unknown')}) when setpoints stop"
    fix = "set COM_OBL_RC_ACT to 5 (Hold) or 3 (Return)"
    if action in FATAL or action not in OFFBOARD_LOSS:
        yield fail(name, what, fix)
    elif action in NEEDS_PILOT and settings.facts.has_rc is not True:
        yield warn(name, f"{what}, and there is no RC: it then sinks and drifts", fix)
    elif action in NEEDS_PILOT:
        yield warn(name, f"{what}: the pilot must take over at once", fix)
    else:
        yield ok(name, what)


def _px4_sticks(settings: Settings) -> Iterator[CheckResult]:
    value = settings["COM_RC_OVERRIDE"]
    takes = bool(int(value) & RC_OVERRIDE_OFFBOARD)
    how = "sticks take over in OFFBOARD" if takes else "the mode switch takes over, sticks do not"
    yield ok("COM_RC_OVERRIDE", f"{value:g}: {how}")


def _px4_stick_speed(settings: Settings) -> Iterator[CheckResult]:
    value = settings["MAN_OVERRIDE_SPD"]
    how = "sticks that move faster take over in OFFBOARD"
    yield ok("MAN_OVERRIDE_SPD", f"{value:g} 1/s: {how if value >= 0.0 else 'sticks do not'}")


def _px4_fence(settings: Settings) -> Iterator[CheckResult]:
    action = settings["GF_ACTION"]
    if action == 0:
        text = "0: PX4's own geofence is off, the companion's is the only one"
        yield warn("GF_ACTION", text, "set GF_ACTION to 2 (Hold) or 3 (Return)")
    else:
        yield ok("GF_ACTION", f"{action:g}: PX4's own geofence acts")


def _ardupilot_limits(settings: Settings) -> Iterator[CheckResult]:
    acts = settings["FENCE_ENABLE"] != 0 and settings["FENCE_ACTION"] != 0
    kinds = int(settings["FENCE_TYPE"])
    if acts and kinds & CIRCLE:
        yield from _check_radius("FENCE_RADIUS", settings)
    if acts and kinds & CEILING:
        yield from _check_ceiling("FENCE_ALT_MAX", settings)


def _ardupilot_target_timeout(settings: Settings) -> Iterator[CheckResult]:
    name, timeout_s = "GUID_TIMEOUT", settings["GUID_TIMEOUT"]
    if timeout_s < LONGEST_GAP_S:
        text = f"{timeout_s:g} s: a few lost packets stop a vehicle under velocity setpoints"
        yield warn(name, text, "set GUID_TIMEOUT to 3.0")
    else:
        text = "for velocities only: without a companion it stays at its last position"
        yield ok(name, f"{timeout_s:g} s, {text}")


def _ardupilot_station(name: str, settings: Settings) -> Iterator[CheckResult]:
    if settings[name] == settings.facts.system_id:
        text = f"{settings.facts.system_id}: this companion would count as the ground station"
        yield fail(name, text, f"set {name} to your station's id, 255")
    if settings["FS_GCS_ENABLE"] == 0:
        text = "0: no reaction to a lost ground station"
        yield warn("FS_GCS_ENABLE", text, f"set FS_GCS_ENABLE to 1 (RTL) and {name} to yours")
    else:
        text = f"{settings['FS_GCS_ENABLE']:g}, after {settings['FS_GCS_TIMEOUT']:g} s"
        yield ok("FS_GCS_ENABLE", text)


def _ardupilot_throttle(settings: Settings) -> Iterator[CheckResult]:
    if settings["FS_THR_ENABLE"] == 0 and settings.facts.has_rc is not False:
        text = "0: no reaction to a lost transmitter"
        yield warn("FS_THR_ENABLE", text, "set FS_THR_ENABLE to 1 (RTL)")


def _ardupilot_fence(settings: Settings) -> Iterator[CheckResult]:
    if settings["FENCE_ENABLE"] == 0:
        text = "0: ArduPilot's own fence is off, the companion's is the only one"
        fix = "set FENCE_ENABLE to 1 and FENCE_ACTION to 1 (RTL) or 4 (BRAKE)"
        yield warn("FENCE_ENABLE", text, fix)
    elif settings["FENCE_ACTION"] == 0:
        yield warn("FENCE_ACTION", "0: the fence only reports", "set FENCE_ACTION to 1 (RTL)")
    else:
        yield ok("FENCE_ENABLE", f"on, action {settings['FENCE_ACTION']:g}")


RULES: Mapping[Autopilot, tuple[tuple[tuple[str, ...], SettingRule], ...]] = {
    Autopilot.PX4: (
        (("COM_OF_LOSS_T",), _px4_loss_timeout),
        (("COM_OBL_RC_ACT",), _px4_loss_action),
        (("COM_RC_OVERRIDE",), _px4_sticks),
        (("MAN_OVERRIDE_SPD",), _px4_stick_speed),
        (("GF_ACTION",), _px4_fence),
        (("GF_ACTION", "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"), _px4_limits),
        (("MPC_XY_VEL_MAX",), partial(_check_speed, "MPC_XY_VEL_MAX", 1.0)),
    ),
    Autopilot.ARDUPILOT: (
        (("GUID_TIMEOUT",), _ardupilot_target_timeout),
        *(
            ((name, "FS_GCS_ENABLE", "FS_GCS_TIMEOUT"), partial(_ardupilot_station, name))
            for name in ("SYSID_MYGCS", "MAV_GCS_SYSID")
        ),
        (("FS_THR_ENABLE",), _ardupilot_throttle),
        (("FENCE_ENABLE", "FENCE_ACTION"), _ardupilot_fence),
        (
            ("FENCE_ENABLE", "FENCE_ACTION", "FENCE_TYPE", "FENCE_RADIUS", "FENCE_ALT_MAX"),
            _ardupilot_limits,
        ),
        (("WPNAV_SPEED",), partial(_check_speed, "WPNAV_SPEED", 100.0)),
        (("WP_SPD",), partial(_check_speed, "WP_SPD", 1.0)),
    ),
}


def needed_parameters(autopilot: Autopilot) -> tuple[str, ...]:
    """Return the parameters to request from this kind of autopilot."""
    names = (name for names, _ in RULES.get(autopilot, ()) for name in names)
    return tuple(dict.fromkeys(names))


def check_parameters(facts: AutopilotFacts, config: CompanionConfig) -> Iterator[CheckResult]:
    """Check the parameters; one that the autopilot does not report is a finding, too."""
    known = {name: value for name, value in facts.parameters.items() if value is not None}
    for name in needed_parameters(facts.autopilot):
        if name not in known and name not in RENAMED.values() and RENAMED.get(name) not in known:
            yield warn(
                name, "the autopilot does not report it", f"look {name} up with a ground station"
            )
    for names, rule in RULES.get(facts.autopilot, ()):
        if all(name in known for name in names):
            yield from rule(Settings(known, facts, config))
