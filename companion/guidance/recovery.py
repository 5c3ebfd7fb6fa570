"""How a session takes up again what an earlier process of ours knew.

Theory of operation. A session can say at any time what a later one would need: its phase, what it
reported, what it believes of the target, where the local frame and that of its fence were. Told
that there was an earlier session, a later one never launches by itself. Then it takes up what was
remembered in two steps. The phase at once: a session that had yielded stays silent until control is
granted, one that had the vehicle until another mode was chosen, because PX4 may return to OFFBOARD
by itself, and one that had reported does not search again. The belief only when the autopilot's
origin shows that local coordinates still mean the same places, because a belief in another frame is
wrong without looking wrong. Nothing of this gives control: the operator does, as always.
"""

from __future__ import annotations

from companion.domain import LandedState
from companion.estimation.belief import Belief
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.authority.state_machine import HAS_VEHICLE, Phase, Trigger
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.context import SessionContext
from companion.guidance.events import SessionMemory
from companion.guidance.flight.vehicle import ORIGIN_STEP_M
from companion.guidance.messages import radii_of, radius_fields

ORIGIN_PATIENCE_S = 15.0
"""How long a belief waits for the origin of the frame that it is in."""


def memory_of(context: SessionContext) -> SessionMemory:
    """What a later session would need to know."""
    current = context.tracker
    others = (each.belief for each in context.emitters.trackers if each is not current)
    return SessionMemory(
        phase=context.phase,
        origin=context.vehicle.origin,
        belief=current.belief,
        report=context.result,
        fence_anchor=context.fencing.anchor,
        flown_fences=context.fencing.flown,
        fence_limits=context.fencing.flown_limits,
        others=tuple(belief for belief in others if belief is not None),
        earlier=tuple(context.reports.values())[:-1],
    )


class Recollection:
    """Takes up what an earlier session knew."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._beliefs: tuple[Belief, ...] = ()
        """Of all emitters, that of the one that was looked for last."""
        self._origin: LocalOrigin | None = None
        self._held_at_s = 0.0
        """When the belief was held, on this session's clock."""
        self._recalled_s = 0.0

    @property
    def is_waiting(self) -> bool:
        """Whether a belief waits for its frame."""
        return bool(self._beliefs)

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """Take up a memory."""
        context = self._context
        context.forbid_launch()
        if memory.fence_anchor is not None:
            context.fencing.recall(memory.fence_anchor)
        vehicle = context.vehicle
        if vehicle.is_armed and vehicle.landed is not LandedState.ON_GROUND:
            context.fencing.recall_flown(memory.flown_fences, memory.fence_limits)
        was = f"resumed after {age_s:.0f} s in {memory.phase.value}"
        context.announce(Severity.NOTICE, f"{was}: give the mode again to fly")
        if memory.phase in HAS_VEHICLE:
            context.authority.demand_another_mode()
        if memory.phase is Phase.YIELD:
            context.enter(Trigger.YIELD_RECALLED, now_s)
        if memory.report is not None:
            self._recall_reports((*memory.earlier, memory.report))
            if context.emitters.is_single or memory.phase is Phase.FINISHED:
                context.enter(Trigger.REPORT_RECALLED, now_s)
        beliefs = memory.others if memory.belief is None else (*memory.others, memory.belief)
        if beliefs:
            self._beliefs, self._origin = beliefs, memory.origin
            self._held_at_s, self._recalled_s = now_s - age_s, now_s
        self.advance(now_s)

    def advance(self, now_s: float) -> None:
        """Take up the beliefs once their frame is known to be the present one."""
        if not self._beliefs:
            return
        origin, context = self._context.vehicle.origin, self._context
        if self._origin is None:
            self._begin_anew("its local frame was not known")
        elif origin is not None:
            step_m = context.vehicle.origin_step_m(self._origin)
            if step_m > ORIGIN_STEP_M:
                self._begin_anew(f"the local frame moved by {step_m:.0f} m")
            else:
                self._resume(now_s)
        elif now_s - self._recalled_s > ORIGIN_PATIENCE_S:
            self._begin_anew("the autopilot does not tell its origin")

    def forget(self) -> None:
        """The autopilot restarted: whatever waits is of another frame."""
        self._beliefs = ()

    def _recall_reports(self, reports: tuple[ReportResult, ...]) -> None:
        context = self._context
        for report in reports:
            context.report(report)
        ids = [report.emitter_id for report in reports if report.emitter_id is not None]
        context.emitters.reported.update(ids)
        one, radii = context.emitters.is_single, radii_of(reports[-1].estimate)
        who = "the target was" if one else f"emitters {', '.join(map(str, ids))} were"
        context.announce(Severity.NOTICE, f"{who} reported already, {radii}")

    def _resume(self, now_s: float) -> None:
        beliefs, self._beliefs = self._beliefs, ()
        context = self._context
        for belief in beliefs:
            problem = context.emitters.resume(belief, now_s - self._held_at_s, now_s)
            if problem is not None:
                context.warn(f"estimate reset: it held {problem}")
            else:
                self._tell_resumed(belief, now_s)

    def _tell_resumed(self, belief: Belief, now_s: float) -> None:
        context, estimate = self._context, self._context.tracker.estimate(now_s)
        context.believe(estimate)
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

    def _begin_anew(self, reason: str) -> None:
        self._beliefs = ()
        self._context.warn(f"estimate reset: {reason}")
