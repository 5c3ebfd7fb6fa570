"""The autopilot's fence in flight: hold while it is unconfirmed, hand back if that lasts.

`Fencing` decides which fence the guard keeps meanwhile.
"""

from __future__ import annotations

from companion.guidance import events
from companion.guidance.context import SessionContext
from companion.guidance.findings import Finding, Reason, Verdict, Watch
from companion.guidance.messages import RateLimited
from companion.guidance.phases import IN_CONTROL

UNREAD_PATIENCE_S = 20.0
"""Time for two rounds of unanswered requests and the pause between them, see `fence_download`: 8
tries of 0.4 s each, and 10 s."""
REPEAT_AFTER_S = 30.0


class FenceWatch(Watch):
    """Updates the fence with the state of the flight, and holds while it is unconfirmed."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._wrong_since_s: float | None = None
        self._texts = RateLimited(REPEAT_AFTER_S)

    def handle(self, event: events.Event) -> None:
        """Doubt a fence that the autopilot changed, until it is downloaded."""
        fencing = self._context.fencing
        if not isinstance(event, events.AutopilotFenceChanged) or not fencing.is_followed:
            return
        fencing.doubt()
        if self._texts.is_due("changed", event.time_s):
            self._context.warn("the autopilot's fence changed: reading it again")

    def step(self, now_s: float) -> Finding | None:
        """Update the fence with home and control; hold while it is unknown or cannot be kept.

        Hand back when that lasts.
        """
        context, vehicle, fencing = self._context, self._context.vehicle, self._context.fencing
        if vehicle.reported_home_enu_m is not None:
            before = fencing.note
            fencing.set_home(vehicle.reported_home_enu_m[:2])
            if fencing.note is not None and fencing.note != before:
                context.warn(fencing.note)
        if vehicle.heartbeat is not None:  # after a restart of the autopilot it may still fly
            is_in_control = context.phase in IN_CONTROL
            fencing.follow(is_airborne=context.is_airborne, is_in_control=is_in_control)
        if fencing.refusal is None and not fencing.is_doubted:
            self._wrong_since_s = None
            return None
        if self._wrong_since_s is None:
            self._wrong_since_s = now_s
        refusal = fencing.refusal
        text = "the autopilot's fence is not read yet" if refusal is None else refusal
        has_lasted = now_s - self._wrong_since_s > UNREAD_PATIENCE_S
        return Finding(Verdict.HAND_BACK if has_lasted else Verdict.HOLD, Reason.FENCE, text)
