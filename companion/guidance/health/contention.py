"""Contention: a second source of setpoints, or a pilot who moves the sticks.

Theory of operation. PX4 and ArduPilot both report the target that they follow as
POSITION_TARGET_LOCAL_NED. The reported target is delayed: a setpoint travels to the autopilot, some
are lost, and the echo travels back. So an echo is compared with the path of our recent setpoints,
and the latest time at which that path was there shows how many of our setpoints arrive.

- An echo off the whole path is a foreign setpoint. A single one may come from a frame that just
  moved; several over a while are a second source. The vehicle holds for a second, and if the source
  is still active then, we yield: two streams would pull the vehicle back and forth. Ours follows
  each of its setpoints within a tick, so of a slow source only one in many is ever echoed. An echo
  far off our path is therefore remembered for half a minute; one close to it may be the autopilot's
  rounding, and is soon forgotten. While we pause, as on a clock that slipped, the autopilot echoes
  the position where it stays by itself, which is not a foreign setpoint.
- An echo on the path, but where it was seconds ago, means that our setpoints no longer arrive. So
  does a missing echo where there was one.

POSITION_TARGET_GLOBAL_INT is not used: PX4 fills it from its mission's triplet, which offboard
setpoints do not touch.

PX4 ignores the sticks in offboard unless COM_RC_OVERRIDE says otherwise, and ArduPilot does in
GUIDED, so a pilot's stick input has no effect until the mode is switched. We treat it as a request
for control: hold at once, and yield if the sticks stay moved. A stick is moved if it is neither in
the middle nor where it was when control began: a throttle without a spring rests at any position,
and releasing the other sticks after the mode switch is not a movement. Pulses are the pilot's only
while the autopilot reports its RC input as healthy: a receiver that lost its transmitter goes to a
failsafe position, and when it is heard again the sticks rest where they are then.

Source: MAVLink common, RC_CHANNELS; PX4 COM_RC_STICK_OV (30 %).
"""

from __future__ import annotations

import math
from collections import deque

from companion.domain import PositionEnu
from companion.guidance import events
from companion.guidance.commands import StickReaction
from companion.guidance.control_authority import Finding, Reason, Verdict, Watch

TOLERANCE_M = 1.5
"""Largest distance from our path at which an echo is ours: PX4 smooths, and floats are rounded."""
MEMORY_S = 30.0
"""Memory of our path; ArduPilot echoes a target indefinitely, also one that is older."""
GRACE_S = 2.0
"""Time after the start of control, or a pause, during which an echo may be of earlier targets."""
PAUSE_S = 0.5
"""Pause of our setpoints after which the autopilot echoes its own position."""
MAX_LAG_S = 2.0
"""Longest age of the newest setpoint that is known to have arrived."""
FOREIGN_ECHOES = 3
FOREIGN_SPAN_S = 0.6
"""Number of foreign echoes, over no less than the span, that are a second source."""
NEAR_S = 4.0
FAR_S = 30.0
FAR_M = 10.0
"""Memory of an echo close to our path, of one far from it, and the distance that counts as far."""
HOLD_S = 1.0
"""Duration of the hold before we yield."""
PERSISTS_S = 0.4
"""Time within the hold after which a source that is still active causes a yield."""


class EchoWatch(Watch):
    """Compares echoed targets with the setpoints sent."""

    def __init__(self) -> None:
        self._path: deque[tuple[float, float, PositionEnu]] = deque()
        self._sent_s = self._resumed_s = -math.inf
        """Time of the latest setpoint, and of the first one after a pause."""
        self.end()

    def end(self) -> None:
        """Note the end of control."""
        self._control_s: float | None = None
        self._forget_echoes()

    def _forget_echoes(self) -> None:
        self._echo_s: float | None = None
        self._contended_since_s: float | None = None
        self._lag_s = 0.0
        self._is_far = False
        """True if the last echo was far off our path."""
        self._foreign_s: list[tuple[float, float]] = []
        """Arrival of each foreign echo, and the time until which it is remembered."""

    def begin(self, now_s: float) -> None:
        """Note the start of control; earlier echoes do not count."""
        self._control_s = now_s
        self._forget_echoes()

    def frame_moved(self, now_s: float) -> None:
        """Drop the path, because every local position changes its meaning."""
        self._path.clear()
        if self._control_s is not None:
            self.begin(now_s)

    def note_setpoint(self, setpoint_enu_m: PositionEnu, now_s: float) -> None:
        """Record a setpoint that was sent."""
        if now_s - self._sent_s > PAUSE_S:
            self._resumed_s = now_s
            self._forget_echoes()
        self._sent_s = now_s
        if self._path and self._path[-1][2] == setpoint_enu_m:
            from_s, _, _ = self._path.pop()
            self._path.append((from_s, now_s, setpoint_enu_m))
        else:
            self._path.append((now_s, now_s, setpoint_enu_m))
        while self._path[0][1] < now_s - MEMORY_S:
            self._path.popleft()

    def handle(self, event: events.Event) -> None:
        """Apply an echo; a restart of the autopilot moves the local frame."""
        match event:
            case events.SetpointEchoed():
                self._note_echo(event)
            case events.AutopilotRestarted():
                self.frame_moved(event.time_s)

    def _note_echo(self, event: events.SetpointEchoed) -> None:
        now_s = event.time_s
        if self._control_s is None or not self._path:
            return
        if now_s - max(self._control_s, self._resumed_s) < GRACE_S:
            return
        self._echo_s = now_s
        if now_s - self._sent_s > PAUSE_S:
            return
        on_path_s, off_m = self._last_on_path_s(event.position_enu_m)
        is_single = self._contended_since_s is None  # a second source has its own text
        self._is_far = is_single and on_path_s is None and off_m >= FAR_M
        if on_path_s is None:
            share = min(1.0, max(0.0, (off_m - TOLERANCE_M) / (FAR_M - TOLERANCE_M)))
            self._foreign_s.append((now_s, now_s + NEAR_S + share * (FAR_S - NEAR_S)))
        else:
            self._lag_s = now_s - on_path_s

    def take_far_echo(self) -> bool:
        """Return True if an echo was far off our path since the last call."""
        is_far, self._is_far = self._is_far, False
        return is_far

    def step(self, now_s: float) -> Finding | None:
        """Drop old foreign echoes; return a finding on a second source or lost echoes, or None."""
        if self._foreign_s:
            self._foreign_s = [echo for echo in self._foreign_s if echo[1] >= now_s]
        if len(self._foreign_s) < FOREIGN_ECHOES or not self._is_contended(now_s):
            self._contended_since_s = None
        elif self._contended_since_s is None:
            self._contended_since_s = now_s
        if self._contended_since_s is not None:
            went_on = self._foreign_s[-1][0] - self._contended_since_s >= PERSISTS_S
            is_over = now_s - self._contended_since_s >= HOLD_S
            verdict = Verdict.YIELD if went_on and is_over else Verdict.HOLD
            first_s = self._foreign_s[0][0]
            text = "second source of setpoints"
            return Finding(verdict, Reason.SECOND_SOURCE, text, since_s=first_s)
        if self._echo_s is None:
            return None
        if now_s - self._echo_s > MAX_LAG_S:
            text = f"no setpoint echo for {MAX_LAG_S:g} s"
            return Finding(Verdict.HOLD, Reason.NO_ECHO, text)
        if self._lag_s > MAX_LAG_S:
            text = f"setpoints not received for {MAX_LAG_S:g} s"
            return Finding(Verdict.HOLD, Reason.SETPOINTS_LOST, text)
        return None

    def _is_contended(self, now_s: float) -> bool:
        """Return True while a second source is active, or not silent for long."""
        span_s = self._foreign_s[-1][0] - self._foreign_s[0][0]
        silent_s = now_s - self._foreign_s[-1][0]
        return span_s >= FOREIGN_SPAN_S and silent_s <= max(NEAR_S, span_s)

    def _last_on_path_s(self, position_enu_m: PositionEnu | None) -> tuple[float | None, float]:
        """Return when our path was last at a position, None if never, and the distance to it."""
        if position_enu_m is None:
            return None, 0.0
        following: PositionEnu | None = None
        least_m = math.inf
        for _, until_s, start in reversed(self._path):
            end = start if following is None else following
            distance_m = _distance_m(position_enu_m, start, end)
            if distance_m <= TOLERANCE_M:
                return until_s, distance_m
            least_m = min(least_m, distance_m)
            following = start
        return None, least_m


def _distance_m(point: PositionEnu, start: PositionEnu, end: PositionEnu) -> float:
    (e, n, u), (to_e, to_n, to_u), (at_e, at_n, at_u) = start, end, point
    de, dn, du = to_e - e, to_n - n, to_u - u
    length2 = de * de + dn * dn + du * du
    if length2 == 0.0:
        return math.dist(point, start)
    offset = (at_e - e, at_n - n, at_u - u)
    along = de * offset[0] + dn * offset[1] + du * offset[2]
    share = min(1.0, max(0.0, along / length2))
    return math.dist(offset, (share * de, share * dn, share * du))


MOVED = 0.3
"""Deflection from rest that counts as the pilot's request for control."""
LASTING_S = 0.5
"""Time in s after which moved sticks are a lasting request."""
RELEASED_S = 2.0
"""Time in s after which released sticks no longer hold the vehicle."""
THROTTLE = 2
"""Channel of the throttle, counted from 0; ArduPilot RCMAP_THROTTLE 3."""
STALE_S = 1.0
"""Longest age of a report; without newer ones there is no transmitter."""
RATING_S = 3.0
"""Longest wait of a move for the autopilot's report on its RC input, sent once a second."""


class StickWatch(Watch):
    """Watches the pilot's sticks."""

    def __init__(self, reaction: StickReaction) -> None:
        self._reaction = reaction
        self._latest: events.SticksReported | None = None
        self._rest: tuple[float, ...] | None = None
        self._moved_s: float | None = None
        self._seen_moved_s: float | None = None
        self._rated: events.RcStatusReported | None = None
        self._rest_is_next = False
        """True once the transmitter is heard again: the next report shows where its sticks rest."""
        self.is_idle = True

    def begin(self, now_s: float) -> None:
        """Note the start of control: the sticks rest where they are."""
        latest = self._latest
        is_fresh = latest is not None and now_s - latest.time_s <= STALE_S
        self._rest = latest.deflections if latest is not None and is_fresh else None
        self._moved_s = self._seen_moved_s = None
        self.is_idle = True

    def handle(self, event: events.Event) -> None:
        """Apply the stick positions, and the health of the RC input."""
        if isinstance(event, events.RcStatusReported):
            was_lost, self._rated = self._is_lost, event
            if self._is_lost:
                self._latest = self._moved_s = self._seen_moved_s = None
                self.is_idle = True
            elif was_lost:  # it may rest elsewhere now
                self._rest = None
                self._rest_is_next = True
        if not isinstance(event, events.SticksReported) or self._is_lost:
            return
        self._latest = event
        if self._rest_is_next:
            self._rest, self._rest_is_next = event.deflections, False
        if self._rest is None:
            throttle = event.deflections[THROTTLE]
            self._rest = tuple(
                throttle if n == THROTTLE else 0.0 for n in range(len(event.deflections))
            )
        pairs = zip(event.deflections, self._rest, strict=True)
        if not any(abs(now) > MOVED and abs(now - before) > MOVED for now, before in pairs):
            self._moved_s = None
            return
        if self._moved_s is None:
            self._moved_s = event.time_s
        self._seen_moved_s, self.is_idle = event.time_s, False

    def step(self, now_s: float) -> Finding | None:
        """Return the finding of moved sticks, or None; those no longer reported are at rest."""
        seen_s, latest = self._seen_moved_s, self._latest
        if latest is not None and now_s - latest.time_s > STALE_S:
            self._moved_s = None
        if self._reaction == "ignore" or seen_s is None or latest is None:
            return None
        moved_s = self._moved_s
        if moved_s is None:
            is_held = now_s - seen_s < RELEASED_S
            return _finding(Verdict.HOLD) if is_held else None
        is_request = self._reaction == "yield" and seen_s - moved_s >= LASTING_S
        is_request = is_request and self._is_pilots(moved_s, now_s)
        return _finding(Verdict.YIELD if is_request else Verdict.HOLD)

    @property
    def _is_lost(self) -> bool:
        return self._rated is not None and not self._rated.is_healthy

    def _is_pilots(self, moved_s: float, now_s: float) -> bool:
        """Return True once a report after the move calls the RC input healthy, or none comes."""
        rated = self._rated
        return rated is None or rated.time_s > moved_s or now_s - moved_s > RATING_S


def _finding(verdict: Verdict) -> Finding:
    return Finding(verdict, Reason.STICKS, "pilot moves the sticks")
