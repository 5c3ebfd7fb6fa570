"""Recovery of the state that an earlier process of ours kept.

Theory of operation. A session can return the state that a later one needs at any time: its phase,
its reports, its estimates of the target, and the frames of its positions and its fence. If there
was an earlier session, a later one never launches by itself. It then restores the state in two
steps. The phase at once: a session that had yielded stays silent until a grant, one that was in
control until another mode was chosen, because PX4 may return to OFFBOARD by itself, and one that
had reported does not search again. The estimate only when the autopilot's origin confirms that
local coordinates still mean the same places, because an estimate in another frame is wrong without
looking wrong. The autopilot's fences of a flight are restored in the air even if the mission is
another one. No step takes control: the operator hands it over, as always.
"""

from __future__ import annotations

from companion.estimation.belief import Belief
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.context import SessionContext
from companion.guidance.events import SessionMemory
from companion.guidance.flight.vehicle import ORIGIN_STEP_M
from companion.guidance.messages import radii_of, radius_fields
from companion.guidance.phases import HAS_VEHICLE, Phase, Trigger

ORIGIN_PATIENCE_S = 15.0
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
        """Kept estimates of all emitters that wait for their frame, the one searched for last at
        the end."""
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
        elif now_s - self._recalled_s > ORIGIN_PATIENCE_S:
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
                context.warn(f"estimate reset: it held {problem}")
            else:
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
