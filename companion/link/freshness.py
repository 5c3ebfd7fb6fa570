"""Which of the autopilot's streams flow: by arrival here, and by progress there.

Theory of operation. The link is alive while any valid frame of the autopilot comes; that is for
`AutopilotBinding` to say, because one HEARTBEAT a second is no detector where frames get lost. Here
each kind of message is watched on its own. One with a time stamp counts as new only if its stamp
moved: a sensor that stands still with a link that works is no stream. What has not come for a
while is stale; what comes, but far less often than asked for, is slow.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink

SMOOTHING = 0.2
"""How much one more gap changes the mean."""

PATIENCE_S: dict[int, tuple[str, float]] = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("position", 0.5),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: ("attitude", 1.0),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: ("heartbeat", 3.5),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: ("landed state", 3.5),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: ("status", 5.0),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: ("home", 15.0),
}
"""What is flown on, what to call it, and when it is stale, seconds."""


@dataclass(slots=True)
class Stream:
    """One kind of message."""

    heard_s: float | None = None
    gap_s: float | None = None
    """Mean time from one to the next."""
    stamp: int | None = None

    def take(self, stamp: int | None, now_s: float) -> bool:
        """Note one; whether it is new."""
        if stamp is not None and stamp == self.stamp:
            return False
        if self.heard_s is not None:
            gap_s = now_s - self.heard_s
            before_s = gap_s if self.gap_s is None else self.gap_s
            self.gap_s = before_s + SMOOTHING * (gap_s - before_s)
        self.heard_s, self.stamp = now_s, stamp
        return True


class StreamFreshness:
    """All kinds of messages that the autopilot sends."""

    def __init__(self) -> None:
        self._streams: dict[int, Stream] = {}

    def heard(self, message: Message, now_s: float) -> bool:
        """Take in a message of the autopilot; whether its stream made progress."""
        number = message.get_msgId()
        stream = self._streams.get(number)
        if stream is None:
            stream = self._streams[number] = Stream()
        return stream.take(_stamp_of(message), now_s)

    def stream(self, message_id: int) -> Stream:
        """What is known of a kind of message."""
        return self._streams.get(message_id, Stream())

    def age_s(self, message_id: int, now_s: float) -> float | None:
        """How long ago a kind of message made progress; None if it never did."""
        stream = self._streams.get(message_id)
        return None if stream is None or stream.heard_s is None else now_s - stream.heard_s

    def stale(self, now_s: float) -> tuple[str, ...]:
        """What is flown on and did not come for too long, by name; what never came is not told."""
        names = []
        for message_id, (name, patience_s) in PATIENCE_S.items():
            age_s = self.age_s(message_id, now_s)
            if age_s is not None and age_s > patience_s:
                names.append(name)
        return tuple(names)

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self._streams.clear()


def _stamp_of(message: Message) -> int | None:
    """The time in a message, in whatever unit; None without one."""
    stamp = getattr(message, "time_boot_ms", None) or getattr(message, "time_usec", None)
    return int(stamp) if stamp else None  # 0 stands for unknown
