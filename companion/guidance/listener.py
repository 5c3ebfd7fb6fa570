"""From a ranging measurement to its filter, with the vehicle's own place at its time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.refusal import Refusal, identity_of
from companion.estimation.tracker import FusionReport
from companion.geometry.frames import bearing_enu_from_ned
from companion.guidance.track import VehicleTrack

MAX_WAITING = 64
"""Measurements that may wait for an own position at their time; the oldest gives way."""


class Fuser(Protocol):
    """Takes measurements in: the filter of one emitter, or those of several."""

    def fuse(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> FusionReport:
        """Take in one measurement."""

    def refuse(self, reason: Refusal) -> FusionReport:
        """Count a measurement that could not even be offered."""


class RangingListener:
    """Feeds the filters.

    A measurement that is newer than the newest own position waits until a position on its other
    side arrives, so that its place is interpolated; one that waits in vain is refused, and so is
    one from a time that will not come.

    Args:
        fuser: Whom to feed.
        track: The vehicle's own motion.
        patience_s: How long a measurement may wait.
    """

    def __init__(self, fuser: Fuser, track: VehicleTrack, patience_s: float = 0.25) -> None:
        self._fuser = fuser
        self._track = track
        self._patience_s = patience_s
        self._waiting: list[RangingMeasurement] = []

    def receive(self, measurement: RangingMeasurement) -> list[FusionReport]:
        """Take in a measurement; it is fused at the next `fuse_due`.

        Of too many that wait the oldest goes; a copy of one that waits does not wait, too.
        """
        identity = identity_of(measurement)
        if any(identity_of(waiting) == identity for waiting in self._waiting):
            return [self._fuser.refuse(Refusal.DUPLICATE)]
        self._waiting.append(measurement)
        if len(self._waiting) <= MAX_WAITING:
            return []
        oldest = min(range(len(self._waiting)), key=lambda i: self._waiting[i].measured_at_s)
        del self._waiting[oldest]
        return [self._fuser.refuse(Refusal.TOO_MANY)]

    def fuse_due(self, now_s: float) -> list[FusionReport]:
        """Fuse every measurement whose place is known, or will not become known any more."""
        latest = self._track.latest
        due: list[RangingMeasurement] = []
        waiting: list[RangingMeasurement] = []
        for measurement in self._waiting:
            is_covered = latest is not None and measurement.measured_at_s <= latest.time_s
            is_recent = abs(now_s - measurement.measured_at_s) <= self._patience_s
            (waiting if is_recent and not is_covered else due).append(measurement)
        self._waiting = waiting  # first, so that one that makes a filter fail is not tried again
        return [self._fuse(measurement, now_s) for measurement in due]

    def _fuse(self, measurement: RangingMeasurement, now_s: float) -> FusionReport:
        if not self._track.is_trusted_at(measurement.measured_at_s):
            return self._fuser.refuse(Refusal.OWN_JUMP)
        sensor_enu_m = self._track.position_at(measurement.measured_at_s)
        body_rad = measurement.bearing_body_rad
        if body_rad is not None and measurement.bearing_enu_rad is None:
            yaw_ned_rad = self._track.yaw_at(measurement.measured_at_s)
            # The wire may carry infinities; the filter refuses those as they are.
            if yaw_ned_rad is not None and math.isfinite(body_rad):
                bearing_enu_rad = bearing_enu_from_ned(yaw_ned_rad + body_rad)
                measurement = replace(measurement, bearing_enu_rad=bearing_enu_rad)
        report = self._fuser.fuse(measurement, sensor_enu_m, now_s)
        return replace(report, measurement=measurement, sensor_enu_m=sensor_enu_m)
