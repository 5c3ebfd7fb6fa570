"""Whether somebody else flies: a second source of setpoints, or a pilot who moves the sticks.

Theory of operation. PX4 and ArduPilot both tell the target that they follow as
POSITION_TARGET_LOCAL_NED. What is told now was sent a while ago: a setpoint travels to the
autopilot, some are lost, and the echo travels back. So an echo is compared with the way that our
setpoints took lately, and the newest moment at which it was on that way says how much of what we
send arrives.

- An echo beside the whole way is somebody else's setpoint. One alone may be a frame that just
  moved; several over a while are a second source. We stay in place for a second, and if it goes
  on meanwhile, we give way: two streams would tear the vehicle to and fro. Ours follows each of its
  setpoints within a tick, so of a slow source only one in many is ever echoed. What is far beside
  our way is therefore remembered for half a minute; what is just beside it may be the autopilot's
  rounding, and is soon forgotten. While we pause, as on a clock that slipped, the autopilot echoes
  where it stays by itself: that is nobody's setpoint.
- An echo that is on the way, but where it was seconds ago, means that nothing of ours arrives any
  more, and so may no echo at all where there was one.

POSITION_TARGET_GLOBAL_INT is not looked at: PX4 fills it from its mission's triplet, which
offboard setpoints do not touch.

PX4 ignores the sticks in offboard unless COM_RC_OVERRIDE says otherwise, and ArduPilot does in
GUIDED, so a pilot who grabs them flies nothing until somebody switches the mode. We take it as a
wish: stay at once, and give way if the sticks stay moved. A stick is moved if it is neither in the
middle nor where it was when control began: a throttle without a spring rests anywhere, and whoever
let go of the others after the mode switch did not move them. Pulses are the pilot's only while the
autopilot calls its RC input healthy: a receiver that lost its transmitter goes to a failsafe
position, and when it is heard again the sticks rest where they are then.

Source: MAVLink common, RC_CHANNELS; PX4 COM_RC_STICK_OV (30 %).
"""

from __future__ import annotations

import math
from collections import deque

from companion.domain import PositionEnu
from companion.guidance import events
from companion.guidance.health.findings import Finding, Reason, Verdict, Watch
from companion.guidance.session_params import StickReaction

TOLERANCE_M = 1.5
"""An echo nearer to our way than this is ours: PX4 smooths, and floats round."""
MEMORY_S = 30.0
"""A position target of ArduPilot is echoed for ever; one of ours that is older is not known."""
GRACE_S = 2.0
"""After control began, or a pause, the echo may still tell of what was flown before."""
PAUSE_S = 0.5
"""Who sends nothing for longer is not echoed: the autopilot follows a place of its own then."""
MAX_LAG_S = 2.0
"""How old the newest setpoint may be that is known to have arrived."""
FOREIGN_ECHOES = 3
FOREIGN_SPAN_S = 0.6
"""So many foreign echoes, over no less than the span, are a second source."""
NEAR_S = 4.0
FAR_S = 30.0
FAR_M = 10.0
"""How long one is remembered that is just beside our way, and one that is so far from it."""
HOLD_S = 1.0
"""How long it is held before giving way ..."""
GOES_ON_S = 0.4
"""... to a source that was still there after this much of it."""


class EchoWatch(Watch):
    """Compares what is echoed with what was sent."""

    def __init__(self) -> None:
        self._way: deque[tuple[float, float, PositionEnu]] = deque()
        self._sent_s = self._resumed_s = -math.inf
        """When we sent last, and when we began to after a pause."""
        self.end()

    def end(self) -> None:
        """Control ends."""
        self._control_s: float | None = None
        self._forget_echoes()

    def _forget_echoes(self) -> None:
        self._echo_s: float | None = None
        self._disputed_s: float | None = None
        self._lag_s = 0.0
        self._is_far = False
        """Whether the last echo was far beside our way."""
        self._foreign_s: list[tuple[float, float]] = []
        """When a foreign one came, and until when it is remembered."""

    def begin(self, now_s: float) -> None:
        """Control begins: what was echoed before says nothing."""
        self._control_s = now_s
        self._forget_echoes()

    def frame_moved(self, now_s: float) -> None:
        """Every local position means another place from now on."""
        self._way.clear()
        if self._control_s is not None:
            self.begin(now_s)

    def note_setpoint(self, place_enu_m: PositionEnu, now_s: float) -> None:
        """We sent a setpoint."""
        if now_s - self._sent_s > PAUSE_S:
            self._resumed_s = now_s
            self._forget_echoes()
        self._sent_s = now_s
        if self._way and self._way[-1][2] == place_enu_m:
            from_s, _, _ = self._way.pop()
            self._way.append((from_s, now_s, place_enu_m))
        else:
            self._way.append((now_s, now_s, place_enu_m))
        while self._way[0][1] < now_s - MEMORY_S:
            self._way.popleft()

    def handle(self, event: events.Event) -> None:
        """Take in what the autopilot follows; after a restart of it every place is another one."""
        match event:
            case events.SetpointEchoed():
                self._note_echo(event)
            case events.AutopilotRestarted():
                self.frame_moved(event.time_s)

    def _note_echo(self, event: events.SetpointEchoed) -> None:
        now_s = event.time_s
        if self._control_s is None or not self._way:
            return
        if now_s - max(self._control_s, self._resumed_s) < GRACE_S:
            return
        self._echo_s = now_s
        if now_s - self._sent_s > PAUSE_S:
            return
        on_way_s, off_m = self._last_on_way_s(event.position_enu_m)
        self._is_far = on_way_s is None and off_m >= FAR_M
        if on_way_s is None:
            share = min(1.0, max(0.0, (off_m - TOLERANCE_M) / (FAR_M - TOLERANCE_M)))
            self._foreign_s.append((now_s, now_s + NEAR_S + share * (FAR_S - NEAR_S)))
        else:
            self._lag_s = now_s - on_way_s

    def take_far(self) -> bool:
        """Whether an echo was far beside our way, since this was asked last."""
        is_far, self._is_far = self._is_far, False
        return is_far

    def tick(self, now_s: float) -> None:
        """Forget foreign echoes of long ago, and note since when there is a second source."""
        self._foreign_s = [echo for echo in self._foreign_s if echo[1] >= now_s]
        if not self._is_disputed(now_s):
            self._disputed_s = None
        elif self._disputed_s is None:
            self._disputed_s = now_s

    def finding(self, now_s: float) -> Finding | None:
        """What the echoes say at a tick in control."""
        if self._disputed_s is not None:
            went_on = self._foreign_s[-1][0] - self._disputed_s >= GOES_ON_S
            is_over = now_s - self._disputed_s >= HOLD_S
            verdict = Verdict.GIVE_WAY if went_on and is_over else Verdict.HOLD
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

    def _is_disputed(self, now_s: float) -> bool:
        """Whether there is a second source, silent for no longer than it took to be noticed."""
        if len(self._foreign_s) < FOREIGN_ECHOES:
            return False
        span_s = self._foreign_s[-1][0] - self._foreign_s[0][0]
        silent_s = now_s - self._foreign_s[-1][0]
        return span_s >= FOREIGN_SPAN_S and silent_s <= max(NEAR_S, span_s)

    def _last_on_way_s(self, place_enu_m: PositionEnu | None) -> tuple[float | None, float]:
        """When our way was last at a place, None if it never was; and how far it stayed away."""
        if place_enu_m is None:
            return None, 0.0
        following: PositionEnu | None = None
        least_m = math.inf
        for _, until_s, place in reversed(self._way):
            end = place if following is None else following
            distance_m = _distance_m(place_enu_m, place, end)
            if distance_m <= TOLERANCE_M:
                return until_s, distance_m
            least_m = min(least_m, distance_m)
            following = place
        return None, least_m


def _distance_m(point: PositionEnu, start: PositionEnu, end: PositionEnu) -> float:
    along = [b - a for a, b in zip(start, end, strict=True)]
    length2 = sum(d * d for d in along)
    if length2 == 0.0:
        return math.dist(point, start)
    offset = [p - a for a, p in zip(start, point, strict=True)]
    share = min(1.0, max(0.0, sum(d * o for d, o in zip(along, offset, strict=True)) / length2))
    return math.dist(offset, [share * d for d in along])


MOVED = 0.3
"""Deflection from rest that means a wish to fly."""
GIVE_WAY_S = 0.5
"""Moved for longer than this, they are not let go again."""
RELEASED_S = 2.0
"""Let go for less than this, they may be taken again."""
THROTTLE = 2
"""Its channel, counted from 0; ArduPilot RCMAP_THROTTLE 3."""
STALE_S = 1.0
"""An older report says nothing: there is no transmitter."""
RATING_S = 3.0
"""So long a move waits for the autopilot's word on its RC input, which comes once a second."""


class StickWatch(Watch):
    """Watches the sticks."""

    def __init__(self, reaction: StickReaction) -> None:
        self._reaction = reaction
        self._latest: events.SticksReported | None = None
        self._rest: tuple[float, ...] | None = None
        self._moved_s: float | None = None
        self._seen_moved_s: float | None = None
        self._rated: events.TransmitterRated | None = None
        self._rest_is_next = False
        """The transmitter is heard again: the next report shows where its sticks rest."""

    def begin(self, now_s: float) -> None:
        """Control begins: the sticks rest where they are."""
        latest = self._latest
        is_fresh = latest is not None and now_s - latest.time_s <= STALE_S
        self._rest = latest.deflections if latest is not None and is_fresh else None
        self._moved_s = self._seen_moved_s = None

    def handle(self, event: events.Event) -> None:
        """Take in where they are, and if the autopilot hears the transmitter."""
        if isinstance(event, events.TransmitterRated):
            self._note_rating(event)
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
        if not self._are_moved(event, self._rest):
            self._moved_s = None
            return
        if self._moved_s is None:
            self._moved_s = event.time_s
        self._seen_moved_s = event.time_s

    def tick(self, now_s: float) -> None:
        """Sticks that are not reported any more are not moved."""
        if self._latest is not None and now_s - self._latest.time_s > STALE_S:
            self._moved_s = None

    def finding(self, now_s: float) -> Finding | None:
        """What the sticks mean at a tick in control."""
        seen_s, latest = self._seen_moved_s, self._latest
        if self._reaction == "ignore" or seen_s is None or latest is None:
            return None
        moved_s = self._moved_s
        if moved_s is None:
            is_held = now_s - seen_s < RELEASED_S
            return _finding(Verdict.HOLD) if is_held else None
        is_wish = self._reaction == "yield" and seen_s - moved_s >= GIVE_WAY_S
        is_wish = is_wish and self._is_pilots(moved_s, now_s)
        return _finding(Verdict.GIVE_WAY if is_wish else Verdict.HOLD)

    @property
    def _is_lost(self) -> bool:
        return self._rated is not None and not self._rated.is_healthy

    def _note_rating(self, event: events.TransmitterRated) -> None:
        """Forget what pulses of a lost transmitter showed; back again, it rests anywhere."""
        was_lost, self._rated = self._is_lost, event
        if self._is_lost:
            self._latest = self._moved_s = self._seen_moved_s = None
        elif was_lost:
            self._rest = None
            self._rest_is_next = True

    def _is_pilots(self, moved_s: float, now_s: float) -> bool:
        """Return True once a rating after the move calls the RC input healthy, or none comes."""
        rated = self._rated
        return rated is None or rated.time_s > moved_s or now_s - moved_s > RATING_S

    @staticmethod
    def _are_moved(event: events.SticksReported, rest: tuple[float, ...]) -> bool:
        pairs = zip(event.deflections, rest, strict=True)
        return any(abs(now) > MOVED and abs(now - before) > MOVED for now, before in pairs)


def _finding(verdict: Verdict) -> Finding:
    return Finding(verdict, Reason.STICKS, "pilot moves the sticks")
