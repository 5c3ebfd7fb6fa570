"""Position and attitude of the vehicle at the time of a measurement."""

from __future__ import annotations

import bisect
import math
from collections import deque
from dataclasses import replace

from companion.domain import Attitude, PositionEnu, VehicleState
from companion.geometry.coordinates import wrap_pi

HISTORY_S = 3.0
"""Longest delay of a measurement."""
MAX_EXTRAPOLATION_S = 0.3
"""Longest extrapolation beyond the newest state."""
MAX_COORDINATE_M = 1e5
"""Largest coordinate for which a flat local frame is valid."""
MAX_SPEED_MPS = 300.0
MAX_GAP_S = 1.0
"""Two states farther apart than this are not interpolated between."""


class VehicleTrack:
    """The last few seconds of the vehicle's motion."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Drop all states, because the autopilot restarted or moved its frame."""
        self._states: deque[VehicleState] = deque()
        self.latest: VehicleState | None = None
        """The newest state."""
        self._attitudes: deque[tuple[float, Attitude]] = deque()
        self._distrusted_s = (math.inf, -math.inf)

    @property
    def latest_yaw(self) -> tuple[float, float] | None:
        """Time and value of the newest heading."""
        if not self._attitudes:
            return None
        time_s, attitude = self._attitudes[-1]
        return time_s, attitude.yaw_ned_rad

    def shift(self, jump_enu_m: PositionEnu) -> None:
        """Move earlier states along with a position that jumped."""
        self._states = deque(
            replace(state, position_enu_m=_step(state.position_enu_m, jump_enu_m, 1.0))
            for state in self._states
        )
        self.latest = self._states[-1] if self._states else None

    def turn(self, jump_rad: float) -> None:
        """Turn earlier attitudes along with a heading that jumped, clockwise."""
        self._attitudes = deque(
            (time_s, replace(attitude, yaw_ned_rad=wrap_pi(attitude.yaw_ned_rad + jump_rad)))
            for time_s, attitude in self._attitudes
        )

    def distrust(self, since_s: float, until_s: float) -> None:
        """Exclude positions and headings between these times from measurements."""
        earliest_s, latest_s = self._distrusted_s
        is_apart = latest_s < since_s
        self._distrusted_s = (since_s if is_apart else min(earliest_s, since_s), until_s)

    def is_trusted_at(self, time_s: float) -> bool:
        """Return True if there was no jump about this time."""
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
        """Return the position at a time, east-north-up metres, or None outside the history.

        Positions are interpolated linearly, and extrapolated a little by the newest velocity.
        """
        states = self._states
        if not states or time_s < states[0].time_s:
            return None
        index = len(states)  # a measurement is about as old as the newest states
        while states[index - 1].time_s > time_s:
            index -= 1
        before = states[index - 1]
        if index == len(states):
            ahead_s = time_s - before.time_s
            if ahead_s > MAX_EXTRAPOLATION_S:
                return None
            return _step(before.position_enu_m, before.velocity_enu_mps, ahead_s)
        after = states[index]
        gap_s = after.time_s - before.time_s
        if gap_s > MAX_GAP_S:
            return None
        way_m = _step(after.position_enu_m, before.position_enu_m, -1.0)
        return _step(before.position_enu_m, way_m, (time_s - before.time_s) / gap_s)

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
            return wrap_pi(one + wrap_pi(other - one) * (time_s - t0) / (t1 - t0))

        tilt_rad = None
        if before.tilt_rad is not None and after.tilt_rad is not None:
            (roll0, pitch0), (roll1, pitch1) = before.tilt_rad, after.tilt_rad
            tilt_rad = (between(roll0, roll1), between(pitch0, pitch1))
        return Attitude(between(before.yaw_ned_rad, after.yaw_ned_rad), tilt_rad)


def _step(place: PositionEnu, way: PositionEnu, share: float) -> PositionEnu:
    """Return a position displaced by a share of a vector."""
    (e, n, u), (de, dn, du) = place, way
    return (e + share * de, n + share * dn, u + share * du)


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
