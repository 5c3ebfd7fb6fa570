"""The measurement side of a session: from ranging to the estimate and the plan that follows it.

A measurement goes to its filter with the vehicle position at its time. Among several emitters the
scheduler keeps estimate, plan and watches on the current one.

Theory of operation. Estimation may not delay a setpoint. So measurements queue up by emitter, each
is fused in steps (`companion.estimation.stepwise`), and between two wake-ups only a limited number
of steps is made, counted by the measurements that they process: never by a clock, so that a replay
makes the same steps at the same wake-ups. A measurement is finished before the next one of its
emitter begins, so that estimates are the same, only later; a solution of the window takes some
wake-ups. The current emitter goes first, the others alternate, which puts their solutions out of
phase.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from companion.domain import PositionAccuracy, RangingMeasurement
from companion.estimation.antenna import ABOUT_VERTICAL, seen_in_enu
from companion.estimation.screen import RejectReason, identity_of
from companion.estimation.stepwise import Steps, finish
from companion.estimation.tracker import FusionReport
from companion.guidance.commands import Severity
from companion.guidance.context import SessionContext
from companion.guidance.emitters import EmitterQueue
from companion.guidance.health.watches import InputWatch
from companion.guidance.messages import (
    AntennaMessages,
    MotionMessages,
    OffsetMessages,
    RejectMessages,
    estimate_record,
    radii_of,
    waiting_record,
)
from companion.guidance.phases import FLYING, IN_CONTROL, Phase
from companion.guidance.vehicle_track import VehicleTrack

MAX_WAITING = 64
"""Measurements that may wait for a vehicle position at their time; the oldest is dropped."""
POSITION_WAIT_S = 0.25
WAKE_ROWS = 20_000
"""Measurements that the steps of one wake-up process: a tenth of a control period, 5 ms."""
BEGIN_ROWS = 4_000
"""Cost of a measurement besides solutions, in this unit: 1 ms in plain Python."""
MAX_QUEUED = 256
"""Limit at which the oldest is dropped: 16 emitters at 10 Hz for more than a second."""


class Queued(NamedTuple):
    """Measurement whose vehicle position is known, with the accuracy at that time."""

    measurement: RangingMeasurement
    now_s: float
    own: PositionAccuracy | None


class FusionQueue:
    """Fuses added measurements by `begin`, in the order of each emitter."""

    def __init__(self, begin: Callable[[Queued], Steps[FusionReport]]) -> None:
        self._begin = begin
        self.by_emitter: dict[int, deque[Queued]] = {}
        """Queues by emitter, none of them empty, the next in turn first."""
        self._begun: dict[int, Steps[FusionReport]] = {}
        """Remaining steps for the first measurement of a queue."""
        self.left = WAKE_ROWS
        """Measurements that the steps of this wake-up may still process."""

    def __len__(self) -> int:
        """Return the number of measurements that are not fused yet."""
        return sum(len(queue) for queue in self.by_emitter.values())

    def add(self, queued: Queued) -> bool:
        """Queue a measurement; return True if it took the place of an older one."""
        is_full = sum([len(queue) for queue in self.by_emitter.values()]) >= MAX_QUEUED
        if is_full:
            self._drop_oldest()
        self.by_emitter.setdefault(queued.measurement.emitter_id, deque()).append(queued)
        return is_full

    def _drop_oldest(self) -> None:
        """Drop the oldest measurement of the longest queue that is not begun."""

        def waiting(key: int) -> int:
            return len(self.by_emitter[key]) - (key in self._begun)

        longest = max(self.by_emitter, key=waiting)
        del self.by_emitter[longest][longest in self._begun]
        if not self.by_emitter[longest]:
            del self.by_emitter[longest]

    def advance(self, first_id: int | None) -> list[FusionReport]:
        """Make the steps of this wake-up; return reports of finished measurements, oldest first."""
        reports: list[FusionReport] = []
        while self.left > 0 and self.by_emitter:
            key = first_id if first_id in self.by_emitter else next(iter(self.by_emitter))
            assert key is not None
            steps = self._begun.pop(key, None)
            if steps is None:
                steps = self._begin(self.by_emitter[key][0])
                self.left -= BEGIN_ROWS
            is_over = True
            try:
                self.left -= next(steps)
                self._begun[key] = steps
                is_over = False
            except StopIteration as end:
                reports.append(end.value)
            finally:
                if is_over:  # also if it raised: what makes a filter fail is not repeated
                    queue = self.by_emitter.pop(key)
                    queue.popleft()
                    if queue:
                        self.by_emitter[key] = queue
        return reports


class RangingListener:
    """Passes measurements to the filters.

    A measurement that is newer than the newest vehicle position waits until a later position
    arrives, so that its position can be interpolated; a bearing of an antenna array waits for an
    attitude as well, because a vehicle tilts fast. One that waits too long is rejected, and so is
    one from the future.
    """

    def __init__(self, emitters: EmitterQueue, track: VehicleTrack) -> None:
        self._emitters = emitters
        self._antenna = emitters.antenna
        self._is_array = self._antenna.kind not in ABOUT_VERTICAL
        self._needs_attitude = self._antenna.kind != "azimuth"
        self._lag_s = emitters.stamp_lag_s
        self._track = track
        self.waiting: list[RangingMeasurement] = []

    def receive(self, measurement: RangingMeasurement) -> list[FusionReport]:
        """Queue a measurement without copies; of too many the oldest is dropped."""
        if self._lag_s:
            measured_at_s = measurement.measured_at_s - self._lag_s
            measurement = replace(measurement, measured_at_s=measured_at_s)
        if self.waiting:
            identity = identity_of(measurement)
            if any(identity_of(waiting) == identity for waiting in self.waiting):
                return [self._emitters.current.reject(RejectReason.DUPLICATE)]
        self.waiting.append(measurement)
        if len(self.waiting) <= MAX_WAITING:
            return []
        oldest = min(range(len(self.waiting)), key=lambda i: self.waiting[i].measured_at_s)
        del self.waiting[oldest]
        return [self._emitters.current.reject(RejectReason.TOO_MANY)]

    def fuse_due(self, now_s: float, own: PositionAccuracy | None = None) -> list[FusionReport]:
        """Fuse all due measurements; `own` is the position accuracy, None leaves it unchanged."""
        return [finish(self.fusion(Queued(each, now_s, own))) for each in self.take_due(now_s)]

    def take_due(self, now_s: float) -> list[RangingMeasurement]:
        """Remove and return measurements whose position is known, or will stay unknown."""
        latest = self._track.latest
        due: list[RangingMeasurement] = []
        waiting: list[RangingMeasurement] = []
        for measurement in self.waiting:
            is_covered = latest is not None and measurement.measured_at_s <= latest.time_s
            if is_covered and self._needs_attitude and measurement.bearing_body_rad is not None:
                is_covered = self._has_attitude(measurement)
            is_recent = abs(now_s - measurement.measured_at_s) <= POSITION_WAIT_S
            (waiting if is_recent and not is_covered else due).append(measurement)
        self.waiting = waiting
        return due

    def _has_attitude(self, measurement: RangingMeasurement) -> bool:
        """Return True if an angle in the body frame lies between attitudes, or none is reported."""
        newest = self._track.latest_yaw
        if newest is None:
            return not self._is_array
        return measurement.measured_at_s <= newest[0]

    def fusion(self, queued: Queued) -> Steps[FusionReport]:
        """Fuse a measurement, seen from the vehicle position at its time."""
        (measurement, now_s, own), emitters = queued, self._emitters
        sensor_enu_m = self._track.position_at(measurement.measured_at_s)
        if sensor_enu_m is None and not self._track.is_trusted_at(measurement.measured_at_s):
            return emitters.current.reject(RejectReason.OWN_JUMP)
        is_turned = measurement.bearing_body_rad is not None
        if is_turned or self._is_array:
            attitude = self._track.attitude_at(measurement.measured_at_s) if is_turned else None
            measurement = seen_in_enu(measurement, attitude, self._antenna)
        is_single = emitters.is_single
        tracker = emitters.current if is_single else emitters.addressed(measurement, now_s)
        if isinstance(tracker, RejectReason):
            return emitters.current.reject(tracker).of(measurement, sensor_enu_m)
        if tracker.accepted == 0:  # all that the search has left, until the first is accepted
            tracker.prior = emitters.search_prior()
        report = yield from tracker.fusion(measurement, sensor_enu_m, now_s, own)
        if not is_single and report.reject_reason is None and sensor_enu_m is not None:
            emitters.note_fused(measurement, sensor_enu_m)
        return report.of(measurement, sensor_enu_m)


class EmitterScheduler:
    """Keeps estimate, plan and watches on the current emitter, and announces it."""

    def __init__(self, context: SessionContext, inputs: InputWatch) -> None:
        self._context = context
        self._inputs = inputs
        self._followed = context.tracker
        self._announced: int | None = None

    def choose(self, now_s: float) -> None:
        """Choose the current emitter, and follow."""
        context = self._context
        context.emitters.choose(now_s, is_flying=context.authority.phase in IN_CONTROL)
        self.follow(now_s)

    def follow(self, now_s: float) -> None:
        """Switch estimate, plan and watches to the current emitter if it changed."""
        context = self._context
        tracker = context.tracker
        if tracker is self._followed:
            return
        self._followed = tracker
        context.set_estimate(tracker.estimate(now_s))
        context.states.begin(context.estimate)
        context.flight_plan.change_target()
        self._inputs.note_switch(tracker.integrity.contact.agreeing_since_gap(now_s))
        if context.authority.phase in FLYING:
            context.plan_now(now_s)

    def announce(self) -> None:
        """Announce the current emitter, once for each turn in control."""
        context, emitters = self._context, self._context.emitters
        current = emitters.current.emitter_id
        is_turn = current != self._announced and not emitters.is_single
        if not is_turn or context.authority.phase not in IN_CONTROL:
            return
        self._announced = current
        waiting = emitters.waiting
        context.record("turn", emitter_id=current, waiting=waiting)
        if current is None:
            context.announce(Severity.NOTICE, "searching for further emitters")
            return
        then = f", then {', '.join(str(each) for each in waiting)}" if waiting else ""
        context.announce(Severity.NOTICE, f"searching for emitter {current}{then}")


class Measuring:
    """Feeds the filters, and reports their results; their errors end no other task."""

    def __init__(
        self, context: SessionContext, inputs: InputWatch, scheduler: EmitterScheduler
    ) -> None:
        self._context = context
        self._inputs = inputs
        self._scheduler = scheduler
        self._rejects = RejectMessages()
        self._motions = MotionMessages()
        self._antennas = AntennaMessages()
        self._offsets = OffsetMessages()
        self._listener = RangingListener(context.emitters, context.vehicle.track)
        self._queue = FusionQueue(self._listener.fusion)
        self._ticks_behind = 0
        """Control ticks since `continue_fusing`, with measurements left to be fused."""

    def receive(self, measurement: RangingMeasurement, now_s: float) -> None:
        """Queue a measurement, and fuse within the steps of this wake-up."""
        if self._context.authority.phase is Phase.FINISHED:
            return  # while parked on the estimate, more measurements can only spoil it
        try:
            refused = self._listener.receive(measurement)
            if refused:
                self._follow_reports(refused, now_s)
        except Exception as error:
            self._contain(error, now_s)
        self.fuse_due(now_s)

    @property
    def is_behind(self) -> bool:
        """True while measurements are left to be fused."""
        return bool(self._queue.by_emitter)

    def fuse_due(self, now_s: float, *, has_time: bool = True) -> None:
        """Queue measurements of known position; with `has_time` fuse in this wake-up's steps."""
        due = self._listener.take_due(now_s) if self._listener.waiting else ()
        if due:
            own = self._context.vehicle.position_accuracy.accuracy(now_s)
            for measurement in due:
                if self._queue.add(Queued(measurement, now_s, own)):
                    self._context.emitters.current.reject(RejectReason.TOO_MANY)
        if not (has_time and self._queue.by_emitter):
            return
        try:
            reports = self._queue.advance(self._context.emitters.current.emitter_id)
            if reports:
                self._follow_reports(reports, now_s)
        except Exception as error:
            self._contain(error, now_s)

    def continue_fusing(self, now_s: float) -> None:
        """Fuse within the steps of another wake-up."""
        self._ticks_behind = 0
        self._queue.left = WAKE_ROWS
        self.fuse_due(now_s)

    def tick(self, now_s: float) -> None:
        """Queue due measurements; fuse if there was no spare time between two control ticks."""
        if self._listener.waiting:
            self.fuse_due(now_s, has_time=False)
        if not self._queue.by_emitter:
            self._queue.left = WAKE_ROWS
            return
        self._ticks_behind += 1
        if self._ticks_behind > 1:
            self._queue.left = WAKE_ROWS
            self.fuse_due(now_s)

    def _contain(self, error: Exception, now_s: float) -> None:
        self._context.contain("estimator", error, now_s)
        self._inputs.note_rejected()

    def _follow_reports(self, reports: list[FusionReport], now_s: float) -> None:
        context = self._context
        self._scheduler.choose(now_s)
        for report in reports:
            measured = report.measurement
            if report.reject_reason is not None:
                context.send(*self._rejects.messages_for(report.reject_reason, now_s))
            elif measured is not None and not context.emitters.is_current(measured.emitter_id):
                estimate = context.emitters.tracker_of(measured.emitter_id).estimate(now_s)
                if estimate is not None:
                    context.send(waiting_record(measured.emitter_id, estimate))
            else:
                self._follow_current(report, now_s)

    def _follow_current(self, report: FusionReport, now_s: float) -> None:
        """Update estimate, texts and plan after a measurement of the current emitter."""
        context, tracker = self._context, self._context.tracker
        if report.restarted:
            self._inputs.note_rejected()
            text = "filter diverged from its measurements: restarted"
            context.warn(text)
            context.flight_plan.forget()
        elif report.agrees:
            self._inputs.note_accepted()
        if tracker.emitter_id is not None:
            context.send(*self._motions.messages_for(tracker.emitter_id, tracker.watch.motion))
        context.send(*self._antennas.messages_for(tracker.identified_antenna))
        estimate = tracker.estimate(now_s)
        if estimate is None:
            return
        context.send(
            *self._offsets.messages_for(
                estimate.range_offset_m, tracker.params.filter, tracker.accepted, now_s
            )
        )
        if context.estimate is None:
            context.states.begin(None)
        if context.states.is_due(estimate, now_s, context.params.ranging_timeout_s):
            context.announce(Severity.INFO, f"{estimate.state.value}: {radii_of(estimate)}")
        context.set_estimate(estimate)
        context.send(estimate_record(report, estimate))
        if context.authority.phase in FLYING:
            context.plan_now(now_s)
