"""What an observer would have seen of a flight, kept to be shown later, in the order of time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from companion.mav.dialect import mavlink
from sim_link.lockstep.observer import Frame, Observer

TELLING = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
    }
)
"""Messages to the companion that an invariant looks at; a real vehicle sends hundreds of others."""


class Recording(Observer):
    """Keeps frames, journal and the fate of the companion's process."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, Callable[[Observer], None]]] = []

    def play(self, observer: Observer) -> None:
        """Show everything; what happened at the same time in the order of its coming."""
        for _, show in sorted(self._seen, key=lambda seen: seen[0]):
            show(observer)

    def sent(self, frame: Frame) -> None:
        """The companion sent this."""
        self._seen.append((frame.time_s, lambda o: o.sent(frame)))

    def heard(self, frame: Frame) -> None:
        """This reaches the companion."""
        if frame.number in TELLING:
            self._seen.append((frame.time_s, lambda o: o.heard(frame)))

    def vehicle_sent(self, frame: Frame) -> None:
        """The vehicle sent this."""
        if frame.number in TELLING:
            self._seen.append((frame.time_s, lambda o: o.vehicle_sent(frame)))

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """The companion wrote into its journal."""
        self._seen.append((now_s, lambda o: o.noted(kind, fields, now_s)))

    def companion_started(self, now_s: float) -> None:
        """The companion process began anew."""
        self._seen.append((now_s, lambda o: o.companion_started(now_s)))

    def companion_suspended(self, now_s: float, until_s: float) -> None:
        """The companion process gets no time."""
        self._seen.append((now_s, lambda o: o.companion_suspended(now_s, until_s)))

    def companion_ended(self, now_s: float) -> None:
        """The companion process ended."""
        self._seen.append((now_s, lambda o: o.companion_ended(now_s)))
