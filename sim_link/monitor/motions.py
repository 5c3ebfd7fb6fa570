"""I2 and I5: how setpoints move, and that none moves on an old position."""

from __future__ import annotations

import math

from sim_link.monitor.invariant import Invariant
from sim_link.monitor.predicates import Point, is_moved_inwards
from sim_link.monitor.rules import TICK_S
from sim_link.monitor.scene import FRAME_STEP_M, Scene, Setpoint

STREAM_BREAK_S = 0.35
"""A longer pause begins a new stream, which starts where the vehicle is."""
SHARE = 1.05
TOLERANCE_M = 0.02
"""Rounding on the wire, and ticks that are not exactly a period apart."""
LATE_TICK_S = 0.2
"""A control tick that comes later moves the setpoint no farther than one after this time."""
HERE_M = 1.5
"""How far from the vehicle's newest place "here" may be, beside what it moved meanwhile."""
STILL_M = 0.02


class WithinEnvelope(Invariant):
    """Setpoints keep to speed, climb and acceleration, and begin where the vehicle is."""

    name = "I2"
    title = "setpoints move within speed, climb, acceleration and lead, and begin at the vehicle"

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._last: Setpoint | None = None
        self._origin_enu_m = scene.told.origin_enu_m
        """Another frame begins another stream."""
        self._velocity: Point | None = None
        """Of the setpoint, once there were two."""
        self._vehicle: Point | None = None
        """Where the vehicle was told to be when the setpoint before was sent."""

    def started(self) -> None:
        """A new process begins a new stream."""
        self._last = None

    def setpoint(self, setpoint: Setpoint) -> None:
        """Judge a setpoint by the one before."""
        last, self._last = self._last, setpoint
        vehicle, told = self._vehicle, self.scene.told.position_enu_m
        self._vehicle = None if told is None else told[:2]
        origin_enu_m = self.scene.told.origin_enu_m
        is_new = last is None or setpoint.time_s - last.time_s > STREAM_BREAK_S
        crept_m = math.dist(origin_enu_m, self._origin_enu_m)
        is_new |= crept_m > FRAME_STEP_M
        self._origin_enu_m = origin_enu_m
        if last is None or is_new or not self.scene.told.is_ours:
            self._velocity = None
            self._judge_begin(setpoint)
            return
        dt_s = setpoint.time_s - last.time_s
        moved = math.dist(setpoint.place_enu_m[:2], last.place_enu_m[:2])
        rules = self.scene.rules
        if moved > SHARE * rules.speed_mps * dt_s + TOLERANCE_M + crept_m:
            self._velocity = None
            if not self._is_here(setpoint):
                self.report("setpoint too fast", step_m=moved, dt_s=dt_s)
            return
        climbed = abs(setpoint.place_enu_m[2] - last.place_enu_m[2])
        most_m = SHARE * rules.climb_mps * dt_s + TOLERANCE_M + crept_m
        if climbed > most_m and not self._is_here(setpoint):
            self.report("setpoint climbs or sinks too fast", step_m=climbed, dt_s=dt_s)
        if crept_m > 0.0:
            self._velocity = None
            return
        is_slow_enough = moved <= self._moved_since(vehicle) + TOLERANCE_M
        is_anew = self._is_at(self._vehicle, setpoint) and not self._is_at(vehicle, last)
        self._judge_change(setpoint, last, dt_s, may_be_moved_along=is_slow_enough, is_anew=is_anew)

    def _moved_since(self, vehicle: Point | None) -> float:
        """How far the vehicle was told to have moved since the setpoint before."""
        if vehicle is None or self._vehicle is None:
            return 0.0
        return math.dist(vehicle, self._vehicle)

    def _judge_change(
        self,
        setpoint: Setpoint,
        last: Setpoint,
        dt_s: float,
        *,
        may_be_moved_along: bool,
        is_anew: bool,
    ) -> None:
        """Faster by no more than the acceleration; stopping is allowed at once.

        So is a new beginning at the very place of the vehicle, and moving along with one at a
        border, no farther than that did: the place nearest to it that is allowed.
        """
        if dt_s <= 0.0:
            return
        place, before = setpoint.place_enu_m, last.place_enu_m
        moved_s = min(dt_s, LATE_TICK_S)
        velocity = ((place[0] - before[0]) / moved_s, (place[1] - before[1]) / moved_s)
        last_velocity, self._velocity = self._velocity, velocity
        if last_velocity is None:
            return
        change = math.dist(velocity, last_velocity)
        most = SHARE * self.scene.rules.acceleration_mps2 * max(dt_s, TICK_S)
        most += 2.0 * TOLERANCE_M / dt_s
        is_slower = math.hypot(*velocity) <= math.hypot(*last_velocity)
        if change <= most or is_slower:
            return
        if may_be_moved_along and self._is_moved_inwards(setpoint):
            return
        if is_anew:  # at rest
            self._velocity = (0.0, 0.0)
            return
        if dt_s > LATE_TICK_S and self._is_here(setpoint):  # so late that it began anew
            self._velocity = None
        else:
            self.report("setpoint accelerates too fast", change_mps=change, dt_s=dt_s)

    def _judge_begin(self, setpoint: Setpoint) -> None:
        if not self._is_here(setpoint):
            told = self.scene.told.position_enu_m
            away = math.inf if told is None else math.dist(setpoint.place_enu_m[:2], told[:2])
            self.report("the first setpoint is not where the vehicle is", away_m=away)

    def _is_here(self, setpoint: Setpoint) -> bool:
        """Where the vehicle is, or, for one at a border, what is allowed next to that."""
        if self.scene.is_lied_to:
            return True
        rules, place = self.scene.rules, setpoint.place_enu_m[:2]
        speed_mps = math.hypot(*self.scene.told.velocity_enu_mps[:2])
        for seen_enu_m, seen_s in self.scene.seen_at:
            age_s = self.scene.now_s - seen_s
            near_m = HERE_M + rules.clearance_m + speed_mps * (age_s + rules.latency_s)
            if math.dist(place, seen_enu_m[:2]) <= near_m:
                return True
        return self._is_moved_inwards(setpoint)

    def _is_at(self, vehicle: Point | None, setpoint: Setpoint) -> bool:
        return vehicle is not None and math.dist(setpoint.place_enu_m[:2], vehicle) <= STILL_M

    def _is_moved_inwards(self, setpoint: Setpoint) -> bool:
        told, rules = self.scene.told.position_enu_m, self.scene.rules
        if told is None:
            return False
        place = setpoint.place_enu_m[:2]
        return is_moved_inwards(rules.fence_enu_m, rules.keep_out_enu_m, told[:2], place)


class FreshState(Invariant):
    """No setpoint moves on a position older than half a second."""

    name = "I5"
    title = "nothing moves on a stale position"

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._last: Setpoint | None = None

    def started(self) -> None:
        """A new process begins a new stream."""
        self._last = None

    def setpoint(self, setpoint: Setpoint) -> None:
        """Judge whether it moved, and what it stands on."""
        last, self._last = self._last, setpoint
        told = self.scene.told
        age_s = math.inf if told.position_s is None else self.scene.now_s - told.position_s
        if age_s <= self.scene.rules.state_age_s + TICK_S or last is None:
            return
        moved = math.dist(setpoint.place_enu_m, last.place_enu_m)
        if moved > STILL_M:
            self.report("a setpoint moved on a stale position", age_s=age_s, moved_m=moved)
