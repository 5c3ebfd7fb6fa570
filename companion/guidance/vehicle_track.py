"""Position and attitude of the vehicle at the time of a measurement, and their accuracy.

Theory of operation of the accuracy. The GNSS receiver reports the accuracy of its fix. PX4's
estimator reports one as well, but relative to the local origin: slow GNSS errors, which move the
origin along with everything else, are not in it. So it can only increase the receiver's sigma and
does not replace it. If the receiver reports no accuracy, has no fix or is silent, the sigma is at
least the assumed default, and the accuracy counts as not reported.

Source: GPS_RAW_INT.h_acc and v_acc, MAVLink common; PX4 1.15, EKF2, where
ESTIMATOR_STATUS.pos_horiz_accuracy comes from the accuracy of the local position.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from dataclasses import replace

from companion.domain import (
    DEFAULT_ACCURACY,
    GNSS_VERTICAL_RATIO,
    MAX_COORDINATE_M,
    Attitude,
    PositionAccuracy,
    PositionEnu,
    VehicleState,
)
from companion.geometry.coordinates import wrap_pi
from companion.geometry.polygons import Point
from companion.guidance import events
from companion.guidance.events import AccuracySource, PositionAccuracyReported

HISTORY_S = 3.0
"""Longest delay of a measurement; older states are dropped."""
MAX_EXTRAPOLATION_S = 0.3
"""Longest extrapolation beyond the newest state."""
MAX_SPEED_MPS = 300.0
MAX_GAP_S = 1.0
"""Longest time between two states that are interpolated."""


class VehicleTrack:
    """The last few seconds of the vehicle's motion."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Drop all states, because the autopilot restarted or moved its frame."""
        self._states: deque[VehicleState] = deque()
        self.latest: VehicleState | None = None
        self._attitudes: deque[tuple[float, Attitude]] = deque()
        self._distrusted_s = (math.inf, -math.inf)

    @property
    def latest_yaw(self) -> tuple[float, float] | None:
        """Time and value of the newest heading; None before the first one."""
        if not self._attitudes:
            return None
        time_s, attitude = self._attitudes[-1]
        return time_s, attitude.yaw_ned_rad

    def shift(self, jump_enu_m: PositionEnu) -> None:
        """Move earlier states along with a position that jumped."""
        de, dn, du = jump_enu_m
        self._states = deque(
            replace(state, position_enu_m=(e + de, n + dn, u + du))
            for state in self._states
            for e, n, u in (state.position_enu_m,)
        )
        self.latest = self._states[-1] if self._states else None

    def turn(self, jump_rad: float) -> None:
        """Turn earlier attitudes along with a heading that jumped, clockwise."""
        self._attitudes = deque(
            (time_s, replace(attitude, yaw_ned_rad=wrap_pi(attitude.yaw_ned_rad + jump_rad)))
            for time_s, attitude in self._attitudes
        )

    def exclude(self, since_s: float, until_s: float) -> None:
        """Exclude positions and headings between these times from measurements."""
        earliest_s, latest_s = self._distrusted_s
        is_apart = latest_s < since_s
        self._distrusted_s = (since_s if is_apart else min(earliest_s, since_s), until_s)

    def is_trusted_at(self, time_s: float) -> bool:
        """Return True if there was no jump around this time."""
        return not self._distrusted_s[0] < time_s < self._distrusted_s[1]

    def add(self, state: VehicleState) -> None:
        """Append a state; one that is not newer than the newest is ignored (reordering)."""
        if self._states and state.time_s <= self._states[-1].time_s:
            return
        self._states.append(state)
        self.latest = state
        while self._states[0].time_s < state.time_s - HISTORY_S:
            self._states.popleft()

    def add_attitude(self, time_s: float, attitude: Attitude) -> None:
        """Append an attitude; one that is not newer than the newest is ignored."""
        if self._attitudes and time_s <= self._attitudes[-1][0]:
            return
        self._attitudes.append((time_s, attitude))
        while self._attitudes[0][0] < time_s - HISTORY_S:
            self._attitudes.popleft()

    def position_at(self, time_s: float) -> PositionEnu | None:
        """Return the position at a time, metres; None outside the history, and around a jump.

        Positions are interpolated linearly, and extrapolated a little by the newest velocity.
        """
        states, (jump_s, settled_s) = self._states, self._distrusted_s
        if not states or time_s < states[0].time_s or jump_s < time_s < settled_s:
            return None
        index = len(states)  # a measurement is about as old as the newest states
        while states[index - 1].time_s > time_s:
            index -= 1
        before = states[index - 1]
        (e, n, u), share = before.position_enu_m, time_s - before.time_s
        if index == len(states):
            if share > MAX_EXTRAPOLATION_S:
                return None
            de, dn, du = before.velocity_enu_mps
        else:
            after = states[index]
            gap_s = after.time_s - before.time_s
            if gap_s > MAX_GAP_S:
                return None
            share /= gap_s
            east_m, north_m, up_m = after.position_enu_m
            de, dn, du = east_m - e, north_m - n, up_m - u
        return (e + share * de, n + share * dn, u + share * du)

    def attitude_at(self, time_s: float) -> Attitude | None:
        """Return the attitude at a time, or None outside the history."""
        attitudes = self._attitudes
        if not attitudes or time_s < attitudes[0][0]:
            return None
        index = bisect.bisect_right(attitudes, time_s, key=lambda a: a[0])
        t0, before = attitudes[index - 1]
        if index == len(attitudes):
            return before if time_s - t0 <= MAX_EXTRAPOLATION_S else None
        t1, after = attitudes[index]
        if t1 - t0 > MAX_GAP_S:
            return None

        def between(one: float, other: float) -> float:
            """Return the angle interpolated linearly between two, rad."""
            return wrap_pi(one + wrap_pi(other - one) * (time_s - t0) / (t1 - t0))

        tilt_rad = None
        if before.tilt_rad is not None and after.tilt_rad is not None:
            (roll0, pitch0), (roll1, pitch1) = before.tilt_rad, after.tilt_rad
            tilt_rad = (between(roll0, roll1), between(pitch0, pitch1))
        return Attitude(between(before.yaw_ned_rad, after.yaw_ned_rad), tilt_rad)


def is_plausible(state: VehicleState) -> bool:
    """Return True if every component of a state is finite and valid in a flat local frame."""
    (e, n, u), (ve, vn, vu) = state.position_enu_m, state.velocity_enu_mps
    return (
        abs(e) <= MAX_COORDINATE_M
        and abs(n) <= MAX_COORDINATE_M
        and abs(u) <= MAX_COORDINATE_M
        and abs(ve) <= MAX_SPEED_MPS
        and abs(vn) <= MAX_SPEED_MPS
        and abs(vu) <= MAX_SPEED_MPS
    )


MAX_AGE_S = 5.0
"""Age after which a report is ignored, and longest wait for the first one of a receiver."""


class PositionAccuracyWatch:
    """Keeps the latest reported accuracy of each source, and the jumps that none explains."""

    def __init__(self) -> None:
        self._receiver: PositionAccuracyReported | None = None
        """Latest report of the receiver, with or without an accuracy."""
        self._horizontal_m: dict[AccuracySource, float] = {}
        """Latest accuracy of each source; it does not improve when a source stops reporting one."""
        self._vertical_m: dict[AccuracySource, float] = {}
        self._begun_s: float | None = None
        """Time of the first vehicle position."""
        self._is_armed = False
        self.jumped_en_m: Point = (0.0, 0.0)
        """Sum of the horizontal jumps of the reported position since the vehicle was armed."""

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
            case events.HeartbeatReceived():
                if event.is_armed and not self._is_armed:
                    self.jumped_en_m = (0.0, 0.0)  # on the ground the position converges
                self._is_armed = event.is_armed

    def accuracy(self, now_s: float) -> PositionAccuracy | None:
        """Return the accuracy in use; None if the first report of the receiver may still arrive."""
        receiver, begun_s = self._receiver, self._begun_s
        if receiver is None and (begun_s is None or now_s - begun_s <= MAX_AGE_S):
            return None
        is_fresh = receiver is not None and now_s - receiver.time_s <= MAX_AGE_S
        is_reported = is_fresh and receiver is not None and receiver.horizontal_m is not None
        least_m = 0.0 if is_reported else DEFAULT_ACCURACY.horizontal_m
        horizontal_m = max(least_m, *self._horizontal_m.values(), 0.0)
        has_height = is_reported and receiver is not None and receiver.vertical_m is not None
        least_m = 0.0 if has_height else GNSS_VERTICAL_RATIO * horizontal_m
        vertical_m = max(least_m, *self._vertical_m.values(), 0.0)
        return PositionAccuracy(horizontal_m, vertical_m, is_reported, self.jumped_en_m)
