"""Accuracy of the vehicle position on the Earth: reported, or assumed.

Theory of operation. The GNSS receiver reports the accuracy of its fix. PX4's estimator reports one
as well, but about the local origin: slow GNSS errors, which move the origin along with everything
else, are not in it. So it can only increase the receiver's sigma and does not replace it. If the
receiver reports no accuracy, has no fix or is silent, the sigma is at least the assumed default,
and the accuracy counts as not reported.

Source: GPS_RAW_INT.h_acc and v_acc, MAVLink common; PX4 1.15, EKF2, where
ESTIMATOR_STATUS.pos_horiz_accuracy comes from the accuracy of the local position.
"""

from __future__ import annotations

from companion.domain import DEFAULT_ACCURACY, GNSS_VERTICAL_RATIO, PositionAccuracy
from companion.guidance import events
from companion.guidance.events import AccuracySource, PositionAccuracyReported

MAX_AGE_S = 5.0
"""Age after which a report is ignored, and longest wait for the first one of a receiver."""


class PositionAccuracyWatch:
    """Keeps the latest reported accuracy of each source."""

    def __init__(self) -> None:
        self._receiver: PositionAccuracyReported | None = None
        """Latest report of the receiver, with or without an accuracy."""
        self._horizontal_m: dict[AccuracySource, float] = {}
        """Latest accuracy of each source; it does not improve when a source stops reporting one."""
        self._vertical_m: dict[AccuracySource, float] = {}
        self._begun_s: float | None = None
        """Time of the first vehicle position."""

    def handle(self, event: events.Event) -> None:
        """Apply an event about position accuracy; ignore others."""
        match event:
            case PositionAccuracyReported():
                if event.source is AccuracySource.RECEIVER:
                    self._receiver = event
                if event.horizontal_m is not None:
                    self._horizontal_m[event.source] = event.horizontal_m
                if event.vertical_m is not None:
                    self._vertical_m[event.source] = event.vertical_m
            case events.VehicleMoved() if self._begun_s is None:
                self._begun_s = event.time_s

    def accuracy(self, now_s: float) -> PositionAccuracy | None:
        """Return the accuracy in use; None: the first report of the receiver may still arrive."""
        receiver, begun_s = self._receiver, self._begun_s
        if receiver is None and (begun_s is None or now_s - begun_s <= MAX_AGE_S):
            return None
        is_fresh = receiver is not None and now_s - receiver.time_s <= MAX_AGE_S
        is_reported = is_fresh and receiver is not None and receiver.horizontal_m is not None
        least_m = 0.0 if is_reported else DEFAULT_ACCURACY.horizontal_m
        horizontal_m = max(least_m, *self._horizontal_m.values(), 0.0)
        has_height = is_reported and receiver is not None and receiver.vertical_m is not None
        least_m = 0.0 if has_height else GNSS_VERTICAL_RATIO * horizontal_m
        return PositionAccuracy(
            horizontal_m, max(least_m, *self._vertical_m.values(), 0.0), is_reported
        )
