"""Whether the mode that was shown last is of the present: is it known who flies.

Theory of operation. A HEARTBEAT carries no time, and what a link or a socket held back comes oldest
first. After a stall of the control tick, or a long silence, the mode is in doubt: perhaps a pilot
has the vehicle. The doubt ends with a HEARTBEAT that the autopilot sent after a message whose stamp
is of the present, a position or an attitude. Until then no setpoint leaves, no mode counts as
given, and nothing is asked of the autopilot; but a vehicle that shows for seconds that it still
flies by our setpoints, while nothing stamped comes, may be asked to fly by itself.
"""

from __future__ import annotations

import math
from collections import deque

from companion.domain import FlightMode
from companion.guidance.events import HeartbeatReceived

MODE_UNKNOWN_AFTER_S = 10.0
"""Without a HEARTBEAT for this long anyone may fly: stop sending, let its own failsafe act."""
PAST_S = 1.0
"""A mode that was shown earlier than this is of the past."""
ASKED_ANYWAY_S = 5.0
"""So long after the doubt began a vehicle that still shows our mode may be asked for another."""
MOST_STAMPED = 256
"""Two seconds of a busy link."""
LATE_S = 3.0
"""A HEARTBEAT that comes every second and was not heard for so long is missing."""


class ModeWatch:
    """Follows the modes that are shown, and how old they may be."""

    def __init__(self) -> None:
        self.is_in_doubt = False
        self._since_s = -math.inf
        """When the doubt began."""
        self._shown: HeartbeatReceived | None = None
        self._stamped: deque[tuple[float, int | None]] = deque(maxlen=MOST_STAMPED)
        """Time, and place in the order of sending, of the last stamped messages."""

    def stamped(self, measured_at_s: float, order: int | None) -> None:
        """A message came that tells when it was sent."""
        self._stamped.append((measured_at_s, order))

    def shown(self, heartbeat: HeartbeatReceived) -> None:
        """A HEARTBEAT came."""
        self._shown = heartbeat
        self.is_in_doubt = self.is_in_doubt and not self._is_recent(heartbeat)

    def tick(self, now_s: float) -> None:
        """Time passes."""
        if self._is_silent(now_s) and not self.is_in_doubt:
            self.distrust(now_s)

    def distrust(self, now_s: float) -> None:
        """What was heard so far is of the past."""
        self.is_in_doubt, self._since_s = True, now_s

    def forget(self) -> None:
        """The autopilot restarted: nothing was shown yet."""
        self._shown = None
        self._stamped.clear()

    def is_known(self, now_s: float) -> bool:
        """Whether the mode shown last still says who flies."""
        return self._shown is not None and not (self._is_silent(now_s) or self.is_in_doubt)

    def may_be_asked(self, now_s: float) -> bool:
        """Whether a request for a mode takes the vehicle from nobody, as far as one can know."""
        if self.is_known(now_s):
            return True
        shown = self._shown
        if shown is None or not (shown.is_armed and shown.mode is FlightMode.OFFBOARD):
            return False
        is_heard = shown.time_s > self._since_s and now_s - shown.time_s <= LATE_S
        return is_heard and now_s - self._since_s >= ASKED_ANYWAY_S

    def _is_silent(self, now_s: float) -> bool:
        return self._shown is not None and now_s - self._shown.time_s > MODE_UNKNOWN_AFTER_S

    def _is_recent(self, heartbeat: HeartbeatReceived) -> bool:
        """Whether one that was sent before it is: what overtook it on the way says nothing."""
        order = heartbeat.order
        return any(
            heartbeat.time_s - stamped_s <= PAST_S
            and (order is None or place is None or place <= order)
            for stamped_s, place in reversed(self._stamped)  # the newest says it soonest
        )
