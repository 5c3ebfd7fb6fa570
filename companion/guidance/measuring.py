"""The measurement side of a session: from ranging to the estimate and the plan that follows it."""

from __future__ import annotations

from collections.abc import Callable

from companion.domain import RangingMeasurement
from companion.estimation.tracker import FusionReport
from companion.guidance.commands import Severity
from companion.guidance.inputs import InputWatch
from companion.guidance.listener import RangingListener
from companion.guidance.motion_news import MotionNews
from companion.guidance.records import estimate_record, waiting_record
from companion.guidance.refusal_news import RefusalNews
from companion.guidance.situation import Situation
from companion.guidance.states import FLYING, Phase
from companion.guidance.turns import Turns


class Measuring:
    """Feeds the filters, and tells of what they make of it.

    Args:
        situation: Of the session.
        inputs: Is told what the current emitter's filter accepts.
        turns: Decides which emitter that is.
    """

    def __init__(self, situation: Situation, inputs: InputWatch, turns: Turns) -> None:
        self._situation = situation
        self._inputs = inputs
        self._turns = turns
        self._news = RefusalNews()
        self._motion_news = MotionNews()
        self._listener = RangingListener(situation.emitters, situation.vehicle.track)

    def receive(self, measurement: RangingMeasurement, now_s: float) -> None:
        """Take in a measurement."""
        if self._situation.phase is Phase.FINISHED:
            return  # parked on the estimate there is nothing to learn, only to unlearn
        self._contained(lambda: self._fused(self._listener.receive(measurement), now_s), now_s)
        self.fuse_due(now_s)

    def fuse_due(self, now_s: float) -> None:
        """Fuse what waited for an own position."""
        self._contained(lambda: self._fused(self._listener.fuse_due(now_s), now_s), now_s)

    def _contained(self, work: Callable[[], None], now_s: float) -> None:
        if not self._situation.containment.run("estimator", now_s, work):
            self._inputs.rejected()

    def _fused(self, reports: list[FusionReport], now_s: float) -> None:
        situation = self._situation
        if reports:
            self._turns.choose(now_s)
        for report in reports:
            if report.refusal is not None:
                situation.commands += self._news.refused(report.refusal, now_s)
                continue
            measured = report.measurement
            if measured is not None and not situation.emitters.is_current(measured.emitter_id):
                self._note_waiting(measured.emitter_id, now_s)
                continue
            if report.restarted:
                self._inputs.rejected()
                text = "the filter contradicted its measurements and was started anew"
                situation.announce(Severity.WARNING, text)
                situation.flight_plan.forget()
            elif report.agrees:
                self._inputs.accepted()
            self._tell_motion()
            self._replan(report, now_s)

    def _tell_motion(self) -> None:
        situation, tracker = self._situation, self._situation.tracker
        if tracker.emitter_id is not None:
            for news in self._motion_news.told(tracker.emitter_id, tracker.watch.motion):
                situation.announce(news.severity, news.text)

    def _note_waiting(self, emitter_id: int, now_s: float) -> None:
        """Something was learnt of an emitter whose turn it is not."""
        estimate = self._situation.emitters.tracker_of(emitter_id).estimate(now_s)
        if estimate is not None:
            self._situation.commands.append(waiting_record(emitter_id, estimate))

    def _replan(self, report: FusionReport, now_s: float) -> None:
        situation = self._situation
        estimate = situation.tracker.estimate(now_s)
        if estimate is None:
            return
        if situation.estimate is None or estimate.state is not situation.estimate.state:
            text = f"{estimate.state.value}: R95 {estimate.r95_m:.1f} m"
            situation.announce(Severity.INFO, text)
        situation.estimate = estimate
        situation.commands.append(estimate_record(report, estimate))
        if situation.phase in FLYING:
            situation.plan_now(now_s)
