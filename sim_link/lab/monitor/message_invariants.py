"""I2, I5, I6 and I9 to I12: motion of setpoints, frames on the wire, consistent estimates."""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Callable, Mapping

from companion.domain import TargetEstimate
from companion.mav.dialect import mavlink
from sim_link.lab.monitor.independent_checks import Point
from sim_link.lab.monitor.scene import FRAME_STEP_M, TICK_S, Invariant, ObservedScene, SentSetpoint
from sim_link.lab.observer import Frame

STREAM_BREAK_S = 0.35
"""Pause after which a new stream begins, starting at the vehicle's position."""
SHARE = 1.05
TOLERANCE_M = 0.02
"""Rounding on the wire, and ticks that are not exactly a period apart."""
LATE_TICK_S = 0.2
"""Longest time between ticks for which the setpoint may move in proportion."""
HERE_M = 1.5
"""Largest distance of "here" from the newest vehicle position, besides its motion since then."""
STILL_M = 0.02


class WithinEnvelope(Invariant):
    """Setpoints keep to the limits of speed, climb and acceleration, and start at the vehicle."""

    name = "I2"
    title = "setpoints move within speed, climb, acceleration and lead, and begin at the vehicle"

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self._last: SentSetpoint | None = None
        self._origin_enu_m = scene.observed.origin_enu_m
        self._velocity: Point | None = None
        """Velocity of the setpoint, once there were two."""
        self._vehicle: Point | None = None
        """Reported vehicle position when the previous setpoint was sent."""

    def started(self) -> None:
        """Begin a new stream at the start of a process."""
        self._last = None

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Judge a setpoint by the one before."""
        last, self._last = self._last, setpoint
        vehicle, observed = self._vehicle, self.scene.observed.position_enu_m
        self._vehicle = None if observed is None else observed[:2]
        origin_enu_m = self.scene.observed.origin_enu_m
        is_new = last is None or setpoint.time_s - last.time_s > STREAM_BREAK_S
        crept_m = math.dist(origin_enu_m, self._origin_enu_m)
        # A frame that moved takes the setpoint along, or begins a new stream at the vehicle.
        has_moved, self._origin_enu_m = crept_m > FRAME_STEP_M, origin_enu_m
        is_new |= has_moved and last is not None and not self._goes_on(setpoint, last)
        crept_m = 0.0 if has_moved else crept_m
        # One that was sent before it could answer a foreign mode belongs to the stream before.
        left_s = self.scene.observed.left_s + self.scene.rules.answer_s
        is_ours = self.scene.observed.is_ours or setpoint.time_s <= left_s
        if last is None or is_new or not is_ours:
            self._velocity = None
            if not self._is_here(setpoint):
                away = (
                    math.inf
                    if observed is None
                    else math.dist(setpoint.position_enu_m[:2], observed[:2])
                )
                self.report("the first setpoint is not where the vehicle is", away_m=away)
            return
        dt_s = setpoint.time_s - last.time_s
        moved = math.dist(setpoint.position_enu_m[:2], last.position_enu_m[:2])
        rules = self.scene.rules
        if moved > SHARE * rules.speed_mps * dt_s + TOLERANCE_M + crept_m:
            self._velocity = None
            if not self._is_here(setpoint):
                self.report("setpoint too fast", step_m=moved, dt_s=dt_s)
            return
        climbed = abs(setpoint.position_enu_m[2] - last.position_enu_m[2])
        most_m = SHARE * rules.climb_mps * dt_s + TOLERANCE_M + crept_m
        if climbed > most_m and not self._is_here(setpoint):
            self.report("setpoint climbs or sinks too fast", step_m=climbed, dt_s=dt_s)
        if crept_m > 0.0 or has_moved:
            self._velocity = None
            return
        vehicle_m = math.dist(vehicle, self._vehicle) if vehicle and self._vehicle else 0.0
        is_slow_enough = moved <= vehicle_m + TOLERANCE_M
        is_start = self._is_at(self._vehicle, setpoint) and not self._is_at(vehicle, last)
        self._judge_change(
            setpoint, last, dt_s, may_be_moved_along=is_slow_enough, is_start=is_start
        )

    def _goes_on(self, setpoint: SentSetpoint, last: SentSetpoint) -> bool:
        """Return True if a setpoint is as near to the one before as speed and climb allow."""
        rules, dt_s = self.scene.rules, setpoint.time_s - last.time_s
        position, before = setpoint.position_enu_m, last.position_enu_m
        is_near = (
            math.dist(position[:2], before[:2]) <= SHARE * rules.speed_mps * dt_s + TOLERANCE_M
        )
        most_m = SHARE * rules.climb_mps * dt_s + TOLERANCE_M
        return is_near and abs(position[2] - before[2]) <= most_m

    def _judge_change(
        self,
        setpoint: SentSetpoint,
        last: SentSetpoint,
        dt_s: float,
        *,
        may_be_moved_along: bool,
        is_start: bool,
    ) -> None:
        """Judge the change of speed against the acceleration; stopping at once is allowed.

        So is a new beginning at the very position of the vehicle, and moving along with one at a
        border, no farther than that did: the position nearest to it that is allowed.
        """
        if dt_s <= 0.0:
            return
        position, before = setpoint.position_enu_m, last.position_enu_m
        moved_s = min(dt_s, LATE_TICK_S)
        velocity = ((position[0] - before[0]) / moved_s, (position[1] - before[1]) / moved_s)
        last_velocity, self._velocity = self._velocity, velocity
        if last_velocity is None:
            return
        change = math.dist(velocity, last_velocity)
        most = SHARE * self.scene.rules.acceleration_mps2 * max(dt_s, TICK_S)
        most += 2.0 * TOLERANCE_M / dt_s
        is_slower = math.hypot(*velocity) <= math.hypot(*last_velocity)
        if change <= most or is_slower:
            return
        if may_be_moved_along and self.scene.is_moved_inwards(setpoint.position_enu_m[:2]):
            return
        if is_start:  # at rest
            self._velocity = (0.0, 0.0)
            return
        if dt_s > LATE_TICK_S and self._is_here(setpoint):  # so late that it restarted from here
            self._velocity = None
        else:
            self.report("setpoint accelerates too fast", change_mps=change, dt_s=dt_s)

    def _is_here(self, setpoint: SentSetpoint) -> bool:
        """Return True at the vehicle's position, or, at a border, where it may be moved to."""
        if self.scene.is_lied_to:
            return True
        rules, position = self.scene.rules, setpoint.position_enu_m[:2]
        speed_mps = math.hypot(*self.scene.observed.velocity_enu_mps[:2])
        for seen_enu_m, seen_s in self.scene.seen_at:
            age_s = self.scene.now_s - seen_s
            near_m = HERE_M + rules.clearance_m + speed_mps * (age_s + rules.latency_s)
            if math.dist(position, seen_enu_m[:2]) <= near_m:
                return True
        return self.scene.is_moved_inwards(setpoint.position_enu_m[:2])

    def _is_at(self, vehicle: Point | None, setpoint: SentSetpoint) -> bool:
        return vehicle is not None and math.dist(setpoint.position_enu_m[:2], vehicle) <= STILL_M


class FreshState(Invariant):
    """No setpoint moves on a position older than half a second."""

    name = "I5"
    title = "nothing moves on a stale position"
    _last: SentSetpoint | None = None

    def started(self) -> None:
        """Begin a new stream at the start of a process."""
        self._last = None

    def setpoint(self, setpoint: SentSetpoint) -> None:
        """Check whether the setpoint moved, and the age of its position."""
        last, self._last = self._last, setpoint
        observed = self.scene.observed
        age_s = math.inf if observed.position_s is None else self.scene.now_s - observed.position_s
        if age_s <= self.scene.rules.state_age_s + TICK_S or last is None:
            return
        moved = math.dist(setpoint.position_enu_m, last.position_enu_m)
        if moved > STILL_M:
            self.report("a setpoint moved on a stale position", age_s=age_s, moved_m=moved)


_MAY_BE_SENT = (
    "HEARTBEAT SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT COMMAND_LONG "
    "COMMAND_ACK STATUSTEXT TIMESYNC PARAM_REQUEST_READ REQUEST_DATA_STREAM MISSION_REQUEST_LIST "
    "MISSION_REQUEST_INT MISSION_ACK NAMED_VALUE_FLOAT PARAM_VALUE PARAM_ERROR AUTOPILOT_VERSION "
    "TARGET_ESTIMATE TUNNEL"
)
ALLOWED = frozenset(_MAY_BE_SENT.split())
"""Messages that a companion may send to a vehicle, and through it to others."""
COMMANDS = frozenset(
    {
        mavlink.MAV_CMD_DO_SET_MODE,
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
        mavlink.MAV_CMD_REQUEST_MESSAGE,
    }
)
FORCE = 21196.0
"""Parameter 2 of an arming command that overrides every check."""
FRAME_OF = {
    "SET_POSITION_TARGET_LOCAL_NED": mavlink.MAV_FRAME_LOCAL_NED,
    "SET_POSITION_TARGET_GLOBAL_INT": mavlink.MAV_FRAME_GLOBAL_INT,
}
FARTHEST_M = 1e6
WINDOW_S = 1.0
RECORD_WINDOW_S = 10.0


class KnownFrames(Invariant):
    """Only finite values, in allowed messages, frames and commands."""

    name = "I6"
    title = "only allowed messages, frames and commands, and only finite values"

    def sent(self, frame: Frame) -> None:
        """Judge a frame."""
        message = frame.message
        if message is None:
            self.report("a frame that cannot be read", number=float(frame.number))
            return
        if message.get_type() not in ALLOWED:
            self.report("a message that a companion may not send", number=float(frame.number))
            return
        if message.get_type() in FRAME_OF:
            used = getattr(message, "coordinate_frame", -1)
            if used != FRAME_OF[message.get_type()]:
                self.report("a setpoint in a frame that is not allowed", frame=float(used))
            for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
                value = getattr(message, name)
                if kind == "float" and not math.isfinite(value):
                    self.report(f"a setpoint with a {name} that is not a number")
                elif kind == "float" and abs(value) > FARTHEST_M:
                    self.report(f"a setpoint with an absurd {name}", value=value)
        if isinstance(message, mavlink.MAVLink_command_long_message):
            self._judge_command(message)

    def _judge_command(self, message: mavlink.MAVLink_command_long_message) -> None:
        if message.command not in COMMANDS:
            self.report("a command that a companion may not send", command=float(message.command))
        is_arming = message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM
        if is_arming and (message.param1 != 1.0 or message.param2 == FORCE):
            self.report("disarmed or forced to arm", param1=message.param1)
        params = [getattr(message, f"param{i}") for i in range(1, 8)]
        if any(math.isinf(value) for value in params):
            self.report("a command with an infinite parameter", command=float(message.command))


class Bounded(Invariant):
    """Bounds on the amount sent and written."""

    name = "I11"
    title = "frames, log lines and queues stay within bounds"

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self._sent: deque[tuple[float, int]] = deque()
        self._sent_bytes = 0
        self._records: deque[float] = deque()

    def sent(self, frame: Frame) -> None:
        """Count frames and bytes of the last second."""
        self._sent.append((frame.time_s, len(frame.data)))
        self._sent_bytes += len(frame.data)
        while self._sent[0][0] < frame.time_s - WINDOW_S:
            self._sent_bytes -= self._sent.popleft()[1]
        rules = self.scene.rules
        if len(self._sent) > rules.sent_frames_per_s * WINDOW_S:
            self.report("too many frames in a second", frames=float(len(self._sent)))
        elif self._sent_bytes > rules.sent_bytes_per_s * WINDOW_S:
            self.report("too many bytes in a second", sent_bytes=float(self._sent_bytes))
        else:
            return
        self._sent.clear()
        self._sent_bytes = 0

    def noted(self, kind: str, fields: Mapping[str, object]) -> None:  # noqa: ARG002
        """Count lines of the journal."""
        now_s = self.scene.now_s
        self._records.append(now_s)
        while self._records[0] < now_s - RECORD_WINDOW_S:
            self._records.popleft()
        if len(self._records) > self.scene.rules.records_per_s * RECORD_WINDOW_S:
            self.report("too many lines in the journal", lines=float(len(self._records)))
            self._records.clear()


SYMMETRY = 1e-6
"""Relative difference of the two off-diagonal elements that rounding explains."""
NEGATIVE = 1e-9
"""Share of the larger eigenvalue by which rounding makes the smaller one negative."""

Estimate = Callable[[], TargetEstimate | None]
Snapshot = Callable[[], tuple[str, object]]
"""The phase, and a value that stays equal while the companion's other relevant state is
unchanged."""


class HonestCovariance(Invariant):
    """The covariance is symmetric, positive semidefinite and bounded, and R95 is a number."""

    name = "I9"
    title = "the covariance is symmetric, positive and bounded"

    def __init__(self, scene: ObservedScene, estimate: Estimate) -> None:
        super().__init__(scene)
        self._estimate = estimate
        self._seen: TargetEstimate | None = None

    def ticked(self) -> None:
        """Check a new estimate."""
        estimate = self._estimate()
        if estimate is None or estimate is self._seen:
            return
        self._seen = estimate
        (a, b), (c, d) = estimate.covariance_m2
        values = (a, b, c, d, estimate.r95_m, *estimate.position_enu_m)
        if not all(map(math.isfinite, values)):
            self.report("an estimate that is not a number")
            return
        if abs(b - c) > SYMMETRY * max(abs(b), abs(c), 1e-12):
            self.report("a covariance that is not symmetric", upper=b, lower=c)
        middle, radius = 0.5 * (a + d), math.hypot(0.5 * (a - d), 0.5 * (b + c))
        if middle - radius < -NEGATIVE * (middle + radius) or middle + radius < 0.0:
            self.report("a covariance that is not positive", eigenvalue=middle - radius)
        most = self.scene.rules.position_sigma_most_m
        if middle + radius > most * most:
            self.report("a covariance without bounds", sigma_m=math.sqrt(middle + radius))
        if estimate.r95_m < 0.0:
            self.report("a negative radius", r95_m=estimate.r95_m)


BARRED = ("standby", "waiting")
"""Phases before and after control that was not given yet is barred."""
ENDED = "yield"
"""Phase after control ended."""


class OnlyProvedFrames(Invariant):
    """Damaged, foreign or, with a key, unsigned frames change nothing.

    Without a key a frame with the vehicle's ids and address is none of these, whichever vehicle
    sends it. One with its ids from elsewhere may bar control that was not given yet, and while the
    vehicle is silent end control, as of two vehicles with the same ids none is flown.
    """

    name = "I10"
    title = "no unproved frame changes any state"

    def __init__(self, scene: ObservedScene, snapshot: Snapshot) -> None:
        super().__init__(scene)
        self._snapshot = snapshot
        self._before: tuple[str, object] | None = None
        self.unproved = 0
        """Frames that had to change nothing."""

    def heard(self, frame: Frame) -> None:  # noqa: ARG002
        """Remember the state before a frame that must not change it."""
        self._before = None
        if not self.scene.must_accept and not self.scene.is_indistinct:
            self.unproved += 1
            self._before = self._snapshot()

    def read(self, frame: Frame) -> None:
        """Report a state that an unproved frame changed."""
        before, self._before = self._before, None
        if before is None:
            return
        after = self._snapshot()
        is_rival = not self.scene.is_signed and self.scene.is_of_autopilot(frame)
        is_ended = self.scene.has_silent_vehicle and after[0] == ENDED
        is_step = (before[0], after[0]) == BARRED or is_ended
        is_barred = is_rival and frame.is_readable and is_step
        if after != before and not (is_barred and after[1] == before[1]):
            self.report("an unproved frame changed the state", number=float(frame.number))


class Repeatable(Invariant):
    """Digest of everything sent; the same seed must give the same digest."""

    name = "I12"
    title = "the same seed gives the same bytes"

    def __init__(self, scene: ObservedScene) -> None:
        super().__init__(scene)
        self._hash = hashlib.blake2b(digest_size=16)

    def sent(self, frame: Frame) -> None:
        """Update the digest."""
        self._hash.update(frame.data)

    @property
    def digest(self) -> str:
        """Digest of everything so far."""
        return self._hash.hexdigest()

    def compare(self, other: str) -> None:
        """Compare with the digest of another flight of the same seed."""
        if self.digest != other:
            self.report("two flights of the same seed differ")
