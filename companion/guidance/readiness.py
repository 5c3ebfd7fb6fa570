"""Readiness for control: its inputs, what blocks it, the launch permit, and an earlier session.

The inputs are one row each, for readiness, its texts and the doctor's verdict; docs/flying.md has
the same rows, and a test compares them.

A vehicle seen armed or flying before an automatic launch loses the launch permission for the life
of this process, and the operator engages as with `engage: operator`. If the autopilot does not
report its landed state, the launch waits.

Theory of operation of the recovery. A session can return the state that a later one needs at any
time: its phase, its reports, its estimates of the target, and the frames of its positions and its
fence. If there was an earlier session, a later one never launches by itself. It then restores the
state in two steps. The phase at once: a session that had yielded stays silent until a grant, one
that was in control until another mode was chosen, because PX4 may return to OFFBOARD by itself, and
one that had reported does not search again. The estimate only when the autopilot's origin confirms
that local coordinates still mean the same positions, because an estimate in another frame is wrong
without looking wrong. The autopilot's fences of a flight are restored in the air even if the
mission is another one. No step takes control: the operator hands it over, as always.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.domain import Autopilot, LandedState, VehicleClass
from companion.estimation.belief import Belief
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.context import SessionContext
from companion.guidance.control_authority import Authority
from companion.guidance.events import SessionMemory
from companion.guidance.fencing import Fencing
from companion.guidance.messages import radii_of, radius_fields
from companion.guidance.phases import HAS_VEHICLE, Phase, Trigger
from companion.guidance.vehicle import (
    LANDED_TIMEOUT_S,
    LINK_LOST_S,
    MODE_UNKNOWN_AFTER_S,
    ORIGIN_STEP_M,
    STALE_STATE_S,
    VehicleView,
)

FENCE_MESSAGE = "MISSION_ITEM_INT"


@dataclass(frozen=True, slots=True)
class Requirement:
    """One input without which control cannot begin."""

    text: str
    """Name of the input in the operator's texts."""
    message: str
    """MAVLink message that provides it."""
    is_met: Callable[[VehicleView, Fencing, float], bool]
    timeout_s: float = math.inf
    """Seconds after its last message until it is missing; inf: once known, it stays known."""
    only_for: Autopilot | None = None
    """The only kind of autopilot that has to provide it; None: all kinds."""

    def is_needed(self, autopilot: Autopilot) -> bool:
        """Return True if this kind of autopilot has to provide it."""
        return self.only_for in (None, autopilot)


REQUIREMENTS = (
    Requirement(
        "the autopilot",
        "HEARTBEAT",
        lambda vehicle, _, now_s: vehicle.heartbeat is not None and not vehicle.is_link_lost(now_s),
        LINK_LOST_S,
    ),
    Requirement(
        "the flight mode",
        "HEARTBEAT",
        lambda vehicle, _, now_s: vehicle.heartbeat is None or vehicle.mode_watch.is_known(now_s),
        MODE_UNKNOWN_AFTER_S,
    ),
    Requirement(
        "a local position",
        "LOCAL_POSITION_NED",
        lambda vehicle, _, now_s: vehicle.is_position_fresh(now_s),
        STALE_STATE_S,
    ),
    Requirement(
        "a home position",
        "HOME_POSITION",
        lambda vehicle, _, __: vehicle.home_enu_m is not None,
    ),
    Requirement(
        "the origin",
        "GPS_GLOBAL_ORIGIN",
        lambda vehicle, fencing, _: vehicle.has_origin and "the origin" not in fencing.missing,
    ),
    Requirement(
        "the landed state",
        "EXTENDED_SYS_STATE",
        lambda vehicle, _, now_s: (
            vehicle.landed is not LandedState.UNKNOWN and vehicle.is_landed_fresh(now_s)
        ),
        LANDED_TIMEOUT_S,
        only_for=Autopilot.ARDUPILOT,  # it ignores setpoints on the ground
    ),
    Requirement(
        "the autopilot's fence",
        FENCE_MESSAGE,
        lambda _, fencing, __: "the autopilot's fence" not in fencing.missing,
    ),
)


def missing_inputs(vehicle: VehicleView, fencing: Fencing, now_s: float) -> list[str]:
    """Return the names of missing inputs; a position delayed by a slow link is named as such."""
    texts = [
        row.text
        for row in REQUIREMENTS
        if row.is_needed(vehicle.autopilot) and not row.is_met(vehicle, fencing, now_s)
    ]
    return [
        vehicle.missing_position_text(now_s) if text == "a local position" else text
        for text in texts
    ]


ANNOUNCE_MISSING_S = 10.0
"""Inputs missing for less than this may still be starting up."""


class WaitingReason:
    """Reports why engagement is blocked."""

    def __init__(self, vehicle: VehicleView, authority: Authority, fencing: Fencing) -> None:
        self._vehicle = vehicle
        self._authority = authority
        self._fencing = fencing
        self._missing_since_s: float | None = None
        self._announced: str | None = None

    def due_text(self, now_s: float) -> str | None:
        """Return the reason if it differs from the one announced last, else None."""
        text = self._text(now_s)
        if text is None or text == self._announced:
            return None
        self._announced = text
        return text

    def _text(self, now_s: float) -> str | None:
        if self._vehicle.objection is not None:
            return f"no control: {self._vehicle.objection}"
        if self._authority.has_id_conflict(now_s):
            return "id conflict: another system uses our ids; stop one"
        missing = missing_inputs(self._vehicle, self._fencing, now_s)
        if self._vehicle.heartbeat is None or not missing:
            self._missing_since_s = None
        if not missing:
            if not self._authority.needs_another_mode:
                return None
            mode = self._vehicle.name_of(self._vehicle.mode)
            return f"no control: found in {mode}; leave it first"
        if self._vehicle.heartbeat is None:
            return None
        if self._missing_since_s is None:
            self._missing_since_s = now_s
        if now_s - self._missing_since_s < ANNOUNCE_MISSING_S:
            return None
        return f"waiting for {' and '.join(missing)}"


AIRBORNE = frozenset({LandedState.IN_AIR, LandedState.TAKEOFF, LandedState.LANDING})
WARN_UNLANDED_S = 10.0
"""Longest time without a reported landed state before the operator is warned."""


class LaunchPermit:
    """Decides whether an automatic launch is permitted."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._silent_since_s: float | None = None
        self._is_silence_announced = False

    @property
    def is_given(self) -> bool:
        """True if the launch may begin now."""
        vehicle = self._context.vehicle
        is_down = vehicle.landed is LandedState.ON_GROUND and not vehicle.is_armed
        return self._context.is_launch_wanted and is_down

    def tick(self, now_s: float) -> None:
        """Check the vehicle, while waiting and in standby."""
        context, vehicle = self._context, self._context.vehicle
        if not context.is_launch_wanted or vehicle.objection is not None:
            return
        if vehicle.vehicle_class is VehicleClass.HELICOPTER:
            context.forbid_launch()
            text = "no automatic takeoff: the pilot must spin up a helicopter's rotor"
            context.warn(f"{text}; switch to {vehicle.guided_name}")
        elif vehicle.is_armed or vehicle.landed in AIRBORNE:
            context.forbid_launch()
            found = "armed" if vehicle.is_armed else "in the air"
            text = f"no automatic takeoff: vehicle was found {found}"
            context.warn(f"{text}; switch to {vehicle.guided_name}")
        elif vehicle.landed is LandedState.UNKNOWN and vehicle.is_usable(now_s):
            if self._silent_since_s is None:
                self._silent_since_s = now_s
            if now_s - self._silent_since_s < WARN_UNLANDED_S or self._is_silence_announced:
                return
            self._is_silence_announced = True
            text = "no automatic takeoff: autopilot reports no landed state"
            self._context.warn(text)
        else:
            self._silent_since_s = None


ORIGIN_TIMEOUT_S = 15.0
"""Longest wait of a kept estimate for the origin of its frame."""


def memory_of(context: SessionContext) -> SessionMemory:
    """Return the state that a later session needs."""
    current = context.tracker
    others = (each.belief for each in context.emitters.trackers if each is not current)
    return SessionMemory(
        phase=context.authority.phase,
        origin=context.vehicle.origin,
        belief=current.belief,
        report=context.result,
        fence_anchor=context.fencing.anchor,
        flown_fences=context.fencing.flown,
        fence_limits=context.fencing.fence_limits,
        others=tuple(belief for belief in others if belief is not None),
        earlier=tuple(context.reports.values())[:-1],
    )


class Recollection:
    """Restores the state of an earlier session."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self.waiting: tuple[Belief, ...] = ()
        """Kept estimates that wait for their frame, the one searched for last at the end."""
        self._origin: LocalOrigin | None = None
        self._kept_at_s = 0.0
        """Time of the kept estimates, on this session's clock."""
        self._recalled_s = 0.0

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """Restore phase, reports and fence; estimates follow when their frame is confirmed."""
        context = self._context
        context.forbid_launch()
        if memory.fence_anchor is not None:
            context.fencing.recall(memory.fence_anchor)
        if context.is_airborne and context.fencing.is_followed:
            context.fencing.recall_flown(memory.flown_fences, memory.fence_limits)
        if memory.phase is None:
            return
        was = f"resumed after {age_s:.0f} s in {memory.phase.value}"
        context.announce(Severity.NOTICE, f"{was}: reselect the mode to fly")
        if memory.phase in HAS_VEHICLE:
            context.authority.require_another_mode()
        if memory.phase is Phase.YIELD:
            context.enter(Trigger.YIELD_RECALLED, now_s)
        if memory.report is not None:
            self._recall_reports((*memory.earlier, memory.report))
            if context.emitters.is_single or memory.phase is Phase.FINISHED:
                context.enter(Trigger.REPORT_RECALLED, now_s)
        beliefs = memory.others if memory.belief is None else (*memory.others, memory.belief)
        if beliefs:
            self.waiting, self._origin = beliefs, memory.origin
            self._kept_at_s, self._recalled_s = now_s - age_s, now_s
        self.advance(now_s)

    def advance(self, now_s: float) -> None:
        """Restore the kept estimates once their frame is confirmed."""
        if not self.waiting:
            return
        origin, context = self._context.vehicle.origin, self._context
        if self._origin is None:
            self._reset_estimates("its local frame was not known")
        elif origin is not None:
            step_m = context.vehicle.origin_step_m(self._origin)
            if step_m > ORIGIN_STEP_M:
                self._reset_estimates(f"the local frame moved by {step_m:.0f} m")
            else:
                self._resume(now_s)
        elif now_s - self._recalled_s > ORIGIN_TIMEOUT_S:
            self._reset_estimates("the autopilot does not report its origin")

    def forget(self) -> None:
        """Drop the kept estimates, because the autopilot restarted in a new frame."""
        self.waiting = ()

    def _recall_reports(self, reports: tuple[ReportResult, ...]) -> None:
        context = self._context
        for report in reports:
            context.report(report)
        ids = [report.emitter_id for report in reports if report.emitter_id is not None]
        context.emitters.mark_reported(ids)
        one, radii = context.emitters.is_single, radii_of(reports[-1].estimate)
        who = "the target was" if one else f"emitters {', '.join(map(str, ids))} were"
        context.announce(Severity.NOTICE, f"{who} reported already, {radii}")

    def _resume(self, now_s: float) -> None:
        beliefs, self.waiting = self.waiting, ()
        context = self._context
        for belief in beliefs:
            problem = context.emitters.resume(belief, now_s - self._kept_at_s, now_s)
            if problem is not None:
                context.warn(f"estimate reset: checkpoint has {problem}")
                continue
            if belief.own is not None:
                context.vehicle.position_accuracy.jumped_en_m = belief.own.jumped_en_m
            self._announce_resumed(belief, now_s)

    def _announce_resumed(self, belief: Belief, now_s: float) -> None:
        context, estimate = self._context, self._context.tracker.estimate(now_s)
        context.set_estimate(estimate)
        context.states.begin(estimate)
        if estimate is None:
            return
        context.record(
            "resumed",
            state=estimate.state.value,
            position_enu_m=estimate.position_enu_m,
            **radius_fields(estimate),
            measurements=belief.measurements,
        )
        text = f"estimate resumed: {estimate.state.value}, {radii_of(estimate)}"
        context.announce(Severity.NOTICE, text)

    def _reset_estimates(self, reason: str) -> None:
        self.waiting = ()
        self._context.warn(f"estimate reset: {reason}")
