"""Jumps of the vehicle's own navigation: hold, and shift the estimates with them.

Theory of operation. An estimator that resets moves the reported position, or the heading, at once,
while the vehicle stays where it is. MAVLink's local position has no counter for that, so each
report is compared with the one before and the velocities of both. Measurements of the target are
relative to the vehicle, so a jump shifts the target, and every position that it was measured from,
by as much: then the old measurements agree with the new ones. Either position may be the right one:
the relative radius does not depend on it, the absolute one contains both. The vehicle holds until
its navigation was steady for a while, and measurements until then are not fused. Navigation that
keeps jumping leads to a hand-back.

A local frame that gets another origin is such a step of known size: the origin gives it, so there
is no doubt, and the setpoint moves along as well. Its first positions may arrive before it; the
part of the shift that they contain is not applied twice.

For fence and ground it does matter which position was right. Until it is steady the setpoint stays,
wherever the vehicle seems to be. If it then seems to be so far outside that the way back could lead
out on the other side, or so much higher that the ground may be where the floor seems to be, the
vehicle is handed back. The smaller one of the jump and the way back inside may be flown if the
margin covers it.

Source: PX4 user guide, "ECL/EKF", resets; `ardupilot/libraries/AP_NavEKF3`, reset of the position.
"""

from __future__ import annotations

import math
from dataclasses import replace

from companion.domain import PositionEnu, VehicleState
from companion.geometry.coordinates import wrap_pi
from companion.guard.gate import GuardLimits, Motion
from companion.guidance.context import SessionContext
from companion.guidance.control_authority import Finding, Reason, Verdict, Watch
from companion.guidance.events import OriginSet, VehicleMoved, YawMeasured
from companion.guidance.fencing import MAX_STEP_M
from companion.guidance.phases import HAS_VEHICLE, IN_CONTROL, Trigger
from companion.guidance.vehicle import ORIGIN_STEP_M
from companion.guidance.vehicle_track import is_plausible

MIN_STEP_M = 0.5
"""Smallest step that stands out from noise."""
NOISE_SIGMAS = 7.0
"""Multiple of the reports' noise, not exceeded once a day at 20 reports a second."""
NOISE_SHARE = 0.02
"""Weight of the newest report in the mean square of that noise."""
MAX_ACCELERATION_MPS2 = 10.0
"""Largest acceleration; two states differ by a quarter of it times the time squared."""
MIN_TURN_RAD = math.radians(15.0)
MAX_TURN_RADPS = math.radians(120.0)
"""Fastest change of a heading, beyond the smallest turn."""
MAX_GAP_S = 1.0
"""Longest time between two reports that are compared."""
STEADY_S = 2.0
"""Time without a jump after which navigation is stable."""
HAND_BACK_AFTER_S = 5.0
"""Longest time for which jumps may continue before the vehicle is handed back."""


NO_STEP: PositionEnu = (0.0, 0.0, 0.0)


def _minus(a: PositionEnu, b: PositionEnu) -> PositionEnu:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _unexplained_m(before: VehicleState, after: VehicleState, dt_s: float) -> PositionEnu | None:
    """Return the step between two reports less their velocities; None: too far apart in time."""
    if not 0.0 < dt_s <= MAX_GAP_S:
        return None
    half_s = 0.5 * dt_s
    (ae, an, au), (be, bn, bu) = after.position_enu_m, before.position_enu_m
    (ave, avn, avu), (bve, bvn, bvu) = after.velocity_enu_mps, before.velocity_enu_mps
    return (
        (ae - half_s * ave) - (be + half_s * bve),
        (an - half_s * avn) - (bn + half_s * bvn),
        (au - half_s * avu) - (bu + half_s * bvu),
    )


def position_jump_m(
    before: VehicleState, after: VehicleState, noise_m: float = 0.0, dt_s: float | None = None
) -> PositionEnu | None:
    """Return a report's distance from a reachable position, ENU metres; None: no jump.

    `noise_m` is the usual step per axis, one sigma; `dt_s` is by default that of the stamps.
    """
    dt_s = after.time_s - before.time_s if dt_s is None else dt_s
    jump = _unexplained_m(before, after, dt_s)
    if jump is None:
        return None
    least_m = max(MIN_STEP_M, NOISE_SIGMAS * noise_m)
    most_m = least_m + 0.25 * MAX_ACCELERATION_MPS2 * dt_s * dt_s
    return jump if math.hypot(*jump) > most_m else None


class PositionNoise:
    """Noise of reported positions, by the steps that their velocities do not explain."""

    def __init__(self) -> None:
        self._mean_square_m2 = 0.0
        self._count = 0

    @property
    def sigma_m(self) -> float:
        """Sigma per axis of the difference of two reports; 0 before the first."""
        return math.sqrt(self._mean_square_m2)

    def add(self, before: VehicleState, after: VehicleState) -> None:
        """Learn from two reports without a jump between them."""
        rest = _unexplained_m(before, after, after.time_s - before.time_s)
        if rest is None:
            return
        self._count += 1
        share = max(NOISE_SHARE, 1.0 / self._count)
        e, n, u = rest
        square_m2 = (e * e + n * n + u * u) / 3.0
        self._mean_square_m2 += share * (square_m2 - self._mean_square_m2)


def yaw_jump_rad(before: tuple[float, float], after: tuple[float, float]) -> float | None:
    """Return the jump of a heading (time, value), clockwise, rad; None: a possible turn."""
    dt_s, turn_rad = after[0] - before[0], wrap_pi(after[1] - before[1])
    if not 0.0 < dt_s <= MAX_GAP_S:
        return None
    return turn_rad if abs(turn_rad) > MIN_TURN_RAD + MAX_TURN_RADPS * dt_s else None


def may_breach(limits: GuardLimits, motion: Motion, jump_enu_m: PositionEnu) -> bool:
    """Return True if the flight could leave the fence or hit the ground if the jump was wrong."""
    if jump_enu_m[2] > limits.envelope.altitude_min_m:
        return True
    fence, position = limits.fence, motion.position_enu_m[:2]
    if fence is not None:
        way_m = math.dist(position, fence.nearest_allowed(position))
        if min(way_m, math.hypot(*jump_enu_m[:2])) > fence.margin_m:
            return True
    height_m = motion.position_enu_m[2] - motion.home_enu_m[2]
    low_m, high_m = limits.altitude_m
    climb_m = max(low_m - height_m, height_m - high_m)
    return min(climb_m, abs(jump_enu_m[2])) > limits.stopping.clearance_m


class JumpWatch(Watch):
    """Watches reported positions and headings for jumps."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._noise = PositionNoise()
        self._first_s = -math.inf
        self._last_s = -math.inf
        self._jumped_m: PositionEnu | None = None
        """Sum of the jumps since the position was steady; None if it is not in doubt."""
        self._newest: tuple[float, PositionEnu] | None = None
        """Time and size of the newest jump."""
        self._arrived_s = -math.inf
        self.is_idle = True

    @property
    def is_in_doubt(self) -> bool:
        """True after a jump, until the position may be used for guidance again."""
        return self._jumped_m is not None

    def step(self, now_s: float) -> Finding | None:
        """Clear the doubt once the position is stable; return a hand-back if unsafe, else None.

        An operator who hands control over after the jumps knows where the vehicle is.
        """
        if self._jumped_m is None or now_s - self._last_s < STEADY_S:
            return None
        phase, motion = self._context.authority.phase, self._context.vehicle.motion
        limits = self._context.guard.limits
        is_unsafe = motion is not None and may_breach(limits, motion, self._jumped_m)
        is_safe = phase in IN_CONTROL and motion is not None and not is_unsafe
        if is_safe or phase not in HAS_VEHICLE:
            self._jumped_m, self.is_idle = None, True
            return None
        if not is_unsafe:
            return None
        text = f"vehicle position jumped by {math.hypot(*self._jumped_m):.0f} m: may breach fence"
        return Finding(Verdict.HAND_BACK, Reason.OWN_JUMP, text)

    def take_position(self, event: VehicleMoved) -> None:
        """Compare a reported position with those before, and pass it to the vehicle."""
        track = self._context.vehicle.track
        before = track.latest
        if is_plausible(event.state):
            self._compare_position(event)
        self._context.vehicle.handle(event)
        if track.latest is not before:
            self._arrived_s = event.time_s

    def take_heading(self, event: YawMeasured) -> None:
        """Compare a reported heading with the one before, and pass it to the vehicle."""
        if math.isfinite(event.yaw_ned_rad):
            self._compare_heading(event)
        self._context.vehicle.handle(event)

    def _compare_position(self, event: VehicleMoved) -> None:
        track = self._context.vehicle.track
        if track.latest is None:
            return
        noise_m = self._noise.sigma_m
        jump_m = position_jump_m(track.latest, event.state, noise_m)
        if jump_m is None:
            self._noise.add(track.latest, event.state)
            return
        passed_s = event.time_s - self._arrived_s
        if 0.0 < passed_s <= MAX_GAP_S and (
            position_jump_m(track.latest, event.state, noise_m, passed_s) is None
        ):
            return  # moved while the frames were in transit, stamped by a clock that slipped
        before_s = track.latest.time_s
        self._context.vehicle.shift(jump_m)
        self._move_targets(jump_m, 0.0, noise_m, jump_m)
        self._newest = (event.time_s, jump_m)
        self._context.steering.forget_setpoint()
        (e, n, u), (de, dn, du) = self._jumped_m or (0.0, 0.0, 0.0), jump_m
        self._jumped_m, self.is_idle = (e + de, n + dn, u + du), False
        text = f"vehicle position jumped by {math.hypot(*jump_m):.1f} m"
        self._hold(text, before_s, event.time_s)

    def _compare_heading(self, event: YawMeasured) -> None:
        track = self._context.vehicle.track
        if track.latest_yaw is None:
            return
        before_s = track.latest_yaw[0]
        jump_rad = yaw_jump_rad(track.latest_yaw, (event.measured_at_s, event.yaw_ned_rad))
        if jump_rad is None:
            return
        track.turn(jump_rad)
        self._move_targets(NO_STEP, -jump_rad, 0.0)
        text = f"vehicle heading jumped by {math.degrees(jump_rad):.0f} deg"
        self._hold(text, before_s, event.time_s)

    def take_origin(self, event: OriginSet) -> bool:
        """Return True if the local frame moved, and positions with it unless it went far away."""
        context, frame = self._context, self._context.vehicle.frame
        step_m = context.vehicle.origin_step_m(event.origin)
        if frame is None or step_m <= ORIGIN_STEP_M:
            return False
        is_near = step_m <= MAX_STEP_M
        if is_near:
            self._shift_frame(event, event.origin.zero_of(frame))
        else:
            context.vehicle.move_frame(event.origin, None)
            context.forget_target()
            context.steering.forget_setpoint()
        finding = Finding(Verdict.HOLD, Reason.FRAME_MOVED, "the local frame moved")
        context.record_finding(finding, event.time_s)
        context.passing.hold(finding, event.time_s + STEADY_S)
        context.enter(Trigger.INPUT_LOST, event.time_s)
        text = f"local origin moved {step_m:.0f} m: fence kept in place"
        context.warn(f"{text}, estimate shifted with it" if is_near else f"{text}, estimate reset")
        return True

    def _shift_frame(self, event: OriginSet, shift_enu_m: PositionEnu) -> None:
        """Shift all positions, less the shift that the first positions already contain."""
        context = self._context
        moved_m = self._moved_by(shift_enu_m, event.time_s)
        rest_m = _minus(shift_enu_m, moved_m)
        is_moved = moved_m != NO_STEP
        context.vehicle.move_frame(event.origin, NO_STEP if is_moved else rest_m)
        self._move_targets(rest_m, 0.0, 0.0, _minus(NO_STEP, moved_m))
        if is_moved and self._jumped_m is not None:
            left_m = _minus(self._jumped_m, moved_m)
            self.is_idle = math.hypot(*left_m) <= MIN_STEP_M
            self._jumped_m = None if self.is_idle else left_m
        elif not is_moved:
            context.steering.shift(rest_m)
        context.flight_plan.forget()
        context.set_estimate(context.tracker.estimate(event.time_s))

    def _moved_by(self, shift_enu_m: PositionEnu, now_s: float) -> PositionEnu:
        """Return the part of a shift that the newest jump contains, if it was just now."""
        if self._newest is None or now_s - self._newest[0] > STEADY_S:
            return NO_STEP
        least_m = max(MIN_STEP_M, NOISE_SIGMAS * self._noise.sigma_m)
        newest_m, self._newest = self._newest[1], None
        return newest_m if math.dist(newest_m, shift_enu_m) <= least_m else NO_STEP

    def _move_targets(
        self,
        shift_enu_m: PositionEnu,
        turn_rad: float,
        sigma_m: float,
        jump_enu_m: PositionEnu = NO_STEP,
    ) -> None:
        """Shift the estimates, and add a jump to the sum of those in flight.

        On the ground the navigation converges. In flight either position may be the right one.
        """
        vehicle, trackers = self._context.vehicle, self._context.emitters.trackers
        accuracy = vehicle.position_accuracy
        if vehicle.is_armed:
            east_m, north_m = accuracy.jumped_en_m
            accuracy.jumped_en_m = (east_m + jump_enu_m[0], north_m + jump_enu_m[1])
        for tracker in trackers:
            tracker.move(shift_enu_m, turn_rad, sigma_m)
            if tracker.own is not None:
                tracker.own = replace(tracker.own, jumped_en_m=accuracy.jumped_en_m)

    def _hold(self, text: str, before_s: float, now_s: float) -> None:
        context = self._context
        is_first = now_s - self._last_s > STEADY_S
        if is_first:
            self._first_s = now_s
        self._last_s = now_s
        context.vehicle.track.exclude(before_s, now_s + STEADY_S)
        context.flight_plan.forget()
        context.set_estimate(context.tracker.estimate(now_s))
        verdict, reason = Verdict.HOLD, Reason.OWN_JUMP
        finding = Finding(verdict, reason, f"{text}: holding until it is stable")
        if now_s - self._first_s > HAND_BACK_AFTER_S:
            finding = Finding(
                Verdict.HAND_BACK, reason, "vehicle position or heading keeps jumping"
            )
        context.record_finding(finding, now_s)
        context.passing.hold(finding, now_s + STEADY_S)
        context.enter(Trigger.INPUT_LOST, now_s)
        context.record("own_jump", text=text)
        if is_first:
            doubt_m = math.hypot(*context.vehicle.position_accuracy.jumped_en_m)
            wider = f", absolute R95 {doubt_m:.0f} m wider" if doubt_m > MIN_STEP_M else ""
            context.warn(f"{text}: estimate shifted with it{wider}")
