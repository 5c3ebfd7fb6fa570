"""The session follows whoever's turn it is among several emitters."""

from __future__ import annotations

from companion.guidance.commands import Severity
from companion.guidance.inputs import InputWatch
from companion.guidance.situation import Situation
from companion.guidance.states import FLYING, IN_CONTROL


class Turns:
    """Makes estimate, plan and watches those of the current emitter, and tells who it is.

    Args:
        situation: Of the session.
        inputs: Judges the current emitter's ranging.
    """

    def __init__(self, situation: Situation, inputs: InputWatch) -> None:
        self._situation = situation
        self._inputs = inputs
        self._followed = situation.tracker
        self._told: int | None = None

    def choose(self, now_s: float) -> None:
        """Decide whose turn it is, and follow."""
        situation = self._situation
        situation.emitters.choose(now_s, is_flying=situation.phase in IN_CONTROL)
        self.follow(now_s)

    def follow(self, now_s: float) -> None:
        """If it is another emitter's turn, everything is about that one from now on."""
        situation = self._situation
        tracker = situation.tracker
        if tracker is self._followed:
            return
        self._followed = tracker
        situation.estimate = tracker.estimate(now_s)
        situation.flight_plan.forget()
        self._inputs.switched(tracker.contact.agreeing_since_gap(now_s))
        if situation.phase in FLYING:
            situation.plan_now(now_s)

    def tell(self) -> None:
        """Say whose turn it is, once for each turn that is flown."""
        situation, emitters = self._situation, self._situation.emitters
        current = emitters.current.emitter_id
        if emitters.is_single or situation.phase not in IN_CONTROL or current == self._told:
            return
        self._told = current
        waiting = emitters.waiting
        situation.record("turn", emitter_id=current, waiting=waiting)
        then = f", then {', '.join(str(each) for each in waiting)}" if waiting else ""
        situation.announce(Severity.NOTICE, f"looking for emitter {current}{then}")
