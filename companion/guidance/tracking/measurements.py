"""The measurement side of a session: from ranging to the estimate and the plan that follows it.

A measurement goes to its filter with the vehicle's own place at its time. Among several emitters
the scheduler makes everything about the one whose turn it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from companion.domain import OwnAccuracy, RangingMeasurement
from companion.estimation.antenna import ABOUT_VERTICAL, seen_in_enu
from companion.estimation.screening.measurement_screen import RejectReason, identity_of
from companion.estimation.stepwise import Steps, Stepwise
from companion.estimation.tracker import FusionReport
from companion.guidance.authority.state_machine import FLYING, IN_CONTROL, Phase
from companion.guidance.commands import Severity
from companion.guidance.context import SessionContext
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
from companion.guidance.tracking.emitters import EmitterQueue
from companion.guidance.tracking.fusion_queue import FusionQueue, Queued
from companion.guidance.tracking.vehicle_track import VehicleTrack

MAX_WAITING = 64
"""Measurements that may wait for an own position at their time; the oldest gives way."""
PATIENCE_S = 0.25


class RangingListener:
    """Feeds the filters.

    A measurement that is newer than the newest own position waits until a position on its other
    side arrives, so that its place is interpolated, and what an antenna array printed for an
    attitude, because a vehicle leans fast; one that waits in vain is refused, and so is one from a
    time that will not come.
    """

    def __init__(self, emitters: EmitterQueue, track: VehicleTrack) -> None:
        self._emitters = emitters
        self._antenna = emitters.antenna
        self._is_array = self._antenna.kind not in ABOUT_VERTICAL
        self._takes_tilt = self._antenna.kind != "azimuth"
        self._lag_s = emitters.stamp_lag_s
        self._track = track
        self.waiting: list[RangingMeasurement] = []
        """What is not fused yet."""

    def receive(self, measurement: RangingMeasurement) -> list[FusionReport]:
        """Take in a measurement; it is fused at the next `fuse_due`.

        Of too many that wait the oldest goes; a copy of one that waits does not wait, too.
        """
        if self._lag_s:
            measured_at_s = measurement.measured_at_s - self._lag_s
            measurement = replace(measurement, measured_at_s=measured_at_s)
        identity = identity_of(measurement)
        if any(identity_of(waiting) == identity for waiting in self.waiting):
            return [self._emitters.current.reject(RejectReason.DUPLICATE)]
        self.waiting.append(measurement)
        if len(self.waiting) <= MAX_WAITING:
            return []
        oldest = min(range(len(self.waiting)), key=lambda i: self.waiting[i].measured_at_s)
        del self.waiting[oldest]
        return [self._emitters.current.reject(RejectReason.TOO_MANY)]

    def fuse_due(self, now_s: float, own: OwnAccuracy | None = None) -> list[FusionReport]:
        """Fuse at once what is due.

        `own` is how well the vehicle's place is known on the Earth; None says nothing about it.
        """
        return [self.fuse(Queued(each, now_s, own)) for each in self.take_due(now_s)]

    def take_due(self, now_s: float) -> list[RangingMeasurement]:
        """Take every measurement whose place is known, or will not become known any more."""
        latest = self._track.latest
        due: list[RangingMeasurement] = []
        waiting: list[RangingMeasurement] = []
        for measurement in self.waiting:
            is_covered = latest is not None and measurement.measured_at_s <= latest.time_s
            if is_covered and self._takes_tilt and measurement.bearing_body_rad is not None:
                is_covered = self._has_attitude(measurement)
            is_recent = abs(now_s - measurement.measured_at_s) <= PATIENCE_S
            (waiting if is_recent and not is_covered else due).append(measurement)
        self.waiting = waiting
        return due

    def _has_attitude(self, measurement: RangingMeasurement) -> bool:
        """Whether an angle in the body's frame lies between attitudes, or none will be told."""
        newest = self._track.latest_yaw
        if newest is None:
            return not self._is_array
        return measurement.measured_at_s <= newest[0]

    @Stepwise
    def fuse(self, queued: Queued) -> Steps[FusionReport]:
        """Fuse a measurement, seen from the vehicle's place at its time."""
        measurement, now_s, own = queued
        if not self._track.is_trusted_at(measurement.measured_at_s):
            return self._emitters.current.reject(RejectReason.OWN_JUMP)
        sensor_enu_m = self._track.position_at(measurement.measured_at_s)
        is_turned = measurement.bearing_body_rad is not None
        if is_turned or self._is_array:
            attitude = self._track.attitude_at(measurement.measured_at_s) if is_turned else None
            measurement = seen_in_enu(measurement, attitude, self._antenna)
        report = yield from self._emitters.fuse.steps(measurement, sensor_enu_m, now_s, own)
        return replace(report, measurement=measurement, sensor_enu_m=sensor_enu_m)


class EmitterScheduler:
    """Makes estimate, plan and watches those of the current emitter, and tells who it is."""

    def __init__(self, context: SessionContext, inputs: InputWatch) -> None:
        self._context = context
        self._inputs = inputs
        self._followed = context.tracker
        self._told: int | None = None

    def choose(self, now_s: float) -> None:
        """Decide whose turn it is, and follow."""
        context = self._context
        context.emitters.choose(now_s, is_flying=context.phase in IN_CONTROL)
        self.follow(now_s)

    def follow(self, now_s: float) -> None:
        """If it is another emitter's turn, everything is about that one from now on."""
        context = self._context
        tracker = context.tracker
        if tracker is self._followed:
            return
        self._followed = tracker
        context.believe(tracker.estimate(now_s))
        context.states.begin(context.estimate)
        context.flight_plan.forget()
        self._inputs.note_switch(tracker.integrity.contact.agreeing_since_gap(now_s))
        if context.phase in FLYING:
            context.plan_now(now_s)

    def tell(self) -> None:
        """Say whose turn it is, once for each turn that is flown."""
        context, emitters = self._context, self._context.emitters
        current = emitters.current.emitter_id
        if emitters.is_single or context.phase not in IN_CONTROL or current == self._told:
            return
        self._told = current
        waiting = emitters.waiting
        context.record("turn", emitter_id=current, waiting=waiting)
        then = f", then {', '.join(str(each) for each in waiting)}" if waiting else ""
        context.announce(Severity.NOTICE, f"searching for emitter {current}{then}")


class Measuring:
    """Feeds the filters, and tells of what they make of it; their errors end nothing else."""

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
        self._queue = FusionQueue(self._listener.fuse.steps)
        self._ticks_behind = 0
        """Control ticks since `go_on`, with measurements left to be fused."""

    def receive(self, measurement: RangingMeasurement, now_s: float) -> None:
        """Take in a measurement."""
        if self._context.authority.phase is Phase.FINISHED:
            return  # parked on the estimate there is nothing to learn, only to unlearn
        with self._contained(now_s):
            refused = self._listener.receive(measurement)
            if refused:
                self._follow_reports(refused, now_s)
        self.fuse_due(now_s)

    @property
    def is_behind(self) -> bool:
        """Whether there are measurements to be gone on with."""
        return len(self._queue) > 0

    def fuse_due(self, now_s: float) -> None:
        """Queue what waited for an own position, and fuse as far as this wake-up goes."""
        self._take_due(now_s)
        self._advance(now_s)

    def go_on(self, now_s: float) -> None:
        """Fuse as far as another wake-up goes."""
        self._ticks_behind = 0
        self._queue.renew()
        self.fuse_due(now_s)

    def tick(self, now_s: float) -> None:
        """Queue what is due; fuse only where nothing came between two control ticks."""
        self._take_due(now_s)
        if self.is_behind:
            self._ticks_behind += 1
            if self._ticks_behind == 1:
                return
        self._queue.renew()
        self._advance(now_s)

    def _take_due(self, now_s: float) -> None:
        if not self._listener.waiting:
            return
        own = self._context.vehicle.own_place.accuracy(now_s)
        for measurement in self._listener.take_due(now_s):
            if self._queue.add(Queued(measurement, now_s, own)):
                self._context.emitters.current.reject(RejectReason.TOO_MANY)

    def _advance(self, now_s: float) -> None:
        if not self.is_behind:
            return
        with self._contained(now_s):
            reports = self._queue.advance(self._context.tracker.emitter_id)
            if reports:
                self._follow_reports(reports, now_s)

    @contextmanager
    def _contained(self, now_s: float) -> Iterator[None]:
        try:
            yield
        except Exception as error:
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
        """What a measurement of the emitter that is looked for changes."""
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
        context.send(*self._antennas.messages_for(tracker.antenna_shown))
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
        context.believe(estimate)
        context.send(estimate_record(report, estimate))
        if context.phase in FLYING:
            context.plan_now(now_s)
