"""Queries of the companion to the autopilot, outside of any mission.

Each query receives the autopilot's messages and returns a request when one is due: for its fence,
for streams, for a parameter, for modes, for its hardware id, for the time. Together all but the
last send one request per control tick, so that a slow line is not flooded: for the fence first,
because engagement waits for it, for the hardware id last, because nothing does.

Streams are requested because ArduPilot sends nothing but heartbeats by itself, and PX4's rates
differ by link. Each kind of message is monitored on its own, by arrival here and progress there:
one with a time stamp counts as new only if that has advanced. A stream without arrivals for a while
is stale, one far below the requested rate is slow; both are requested again. Whether the link is
alive is decided by `AutopilotBinding`, because one HEARTBEAT a second is not a detector where
frames get lost.

Source: MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL and REQUEST_MESSAGE.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import Autopilot
from companion.guidance.commands import Announce, Severity
from companion.guidance.fencing import Fencing
from companion.guidance.vehicle import LANDED_TIMEOUT_S
from companion.link.autopilot_fence import (
    FENCE_IDS,
    FenceDownload,
    FenceParameters,
    Px4FailsafeCheck,
    hears_transmitter,
)
from companion.link.binding import AutopilotBinding
from companion.link.conversion.clock_sync import MAX_PACE, ClockSync
from companion.link.inbound import OfferedModes
from companion.link.intake import RateLimit
from companion.link.outbound import Ids, VehicleCommand
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink

SMOOTHING = 0.2
"""Weight of a new gap in the exponential mean."""

STALE_AFTER_S: dict[int, tuple[str, float]] = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("position", 0.5),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: ("attitude", 1.0),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: ("heartbeat", 3.5),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: ("landed state", LANDED_TIMEOUT_S),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: ("status", 5.0),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: ("home", 15.0),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: ("GNSS status", 5.0),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: ("estimator status", 5.0),
    MAVLink_ekf_status_report_message.id: ("estimator status", 5.0),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: ("battery", 10.0),
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: ("transmitter", 5.0),
}
"""Streams that control depends on, their names for the operator, and the seconds after which they
are stale: within ticks for those that move the vehicle, within a few periods for those that can
only end control."""
STAMPED_ONCE = (mavlink.MAVLINK_MSG_ID_HOME_POSITION,)
"""Stamped with the time at which home was set, not sent: every arrival is progress."""


@dataclass(slots=True)
class Stream:
    """Arrival times of one kind of message."""

    heard_s: float | None = None
    gap_s: float | None = None
    """Mean interval between messages."""
    stamp: int | None = None

    def take(self, stamp: int | None, now_s: float) -> bool:
        """Note a message; return True if it is new."""
        if stamp is not None and stamp == self.stamp:
            return False
        if self.heard_s is not None:
            gap_s = now_s - self.heard_s
            before_s = gap_s if self.gap_s is None else self.gap_s
            self.gap_s = before_s + SMOOTHING * (gap_s - before_s)
        self.heard_s, self.stamp = now_s, stamp
        return True


class StreamFreshness:
    """Arrival times of all kinds of messages from the autopilot."""

    def __init__(self) -> None:
        self._streams: dict[int, Stream] = {}

    def receive(self, message: Message, now_s: float) -> bool:
        """Process a message of the autopilot; return True if its stream made progress."""
        number = message.get_msgId()
        stream = self._streams.get(number)
        if stream is None:
            stream = self._streams[number] = Stream()
        stamp = getattr(message, "time_boot_ms", None) or getattr(message, "time_usec", None)
        if not stamp or number in STAMPED_ONCE:  # 0 stands for unknown
            return stream.take(None, now_s)
        return stream.take(int(stamp), now_s)

    def stream(self, message_id: int) -> Stream:
        """Return the arrival times of a kind of message."""
        return self._streams.get(message_id) or Stream()

    def age_s(self, message_id: int, now_s: float) -> float | None:
        """Return the seconds since a kind of message made progress; None if it never did."""
        stream = self._streams.get(message_id)
        return None if stream is None or stream.heard_s is None else now_s - stream.heard_s

    def stale(self, now_s: float) -> tuple[str, ...]:
        """Return the names of stale streams, without those that never arrived."""
        return tuple(
            name
            for message_id, (name, stale_after_s) in STALE_AFTER_S.items()
            if (self.age_s(message_id, now_s) or 0.0) > stale_after_s
        )

    def restart(self) -> None:
        """Start again after a restart of the autopilot."""
        self._streams.clear()


ECHO_S = 0.07
"""Interval that is not a multiple of usual setpoint intervals: an echo in step with our own
setpoints would never show those of another sender."""
STREAM_INTERVAL_S: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0.05,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0.1,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 0.5,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 0.5,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: ECHO_S,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 0.2,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 0.2,
    MAVLink_ekf_status_report_message.id: 0.2,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 0.2,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 2.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 0.5,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 0.5,
}
"""Streams that guidance uses; GLOBAL_POSITION_INT is for the flight log, because ground stations
replay a track only from it."""
ONLY_FROM = {
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Autopilot.PX4,
    MAVLink_ekf_status_report_message.id: Autopilot.ARDUPILOT,
}
"""Streams of one autopilot only: the other one rejects the request every time."""
ONLY_IF_THERE = (mavlink.MAVLINK_MSG_ID_RC_CHANNELS, mavlink.MAVLINK_MSG_ID_GPS2_RAW)
"""Streams that do not exist without a transmitter or a second GNSS receiver: requested a few times,
and again when a transmitter appears."""
MAX_REQUESTS = 5
"""Requests for such a stream."""
ONE_SHOT = (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
"""Messages sent only on change: requested by REQUEST_MESSAGE until they arrive."""

FIRST_RETRY_S = 1.0
"""First and last interval between requests for one stream, doubled each time."""
LAST_RETRY_S = 16.0
CHECK_PERIOD_S = 0.2
"""Interval of checks while nothing is missing."""
MISSED_PERIODS = 3.0
"""Silent periods after which a stream has stopped, and mean interval that makes it slow."""
HEARTBEAT_LATE_S = 3.0
"""Age above which a HEARTBEAT is requested: its period is one second on most autopilots."""
HEARTBEAT_AGAIN_S = 0.25
"""Interval of those requests: where every other frame is lost, one in four is answered, and ten
seconds after the last heartbeat control is in doubt."""
HEARTBEAT_GIVEN_UP_S, HEARTBEAT_SELDOM_S = 12.0, 5.0
"""Silence after which the request is probably not supported, and its interval from then on."""


@dataclass(slots=True)
class _Want:
    message_id: int
    interval_s: float | None
    """Requested interval of the stream; None: one message, not a stream."""
    retry_s: float = FIRST_RETRY_S
    asked_s: float | None = None
    asks: int = 0
    """Requests since its last arrival."""

    @property
    def is_given_up(self) -> bool:
        """True if it was requested often enough, and does not exist."""
        return self.message_id in ONLY_IF_THERE and self.asks >= MAX_REQUESTS

    def is_met(self, stream: Stream, now_s: float) -> bool:
        """Return True if it arrives as often as requested."""
        if stream.heard_s is None:
            return False
        if self.interval_s is None:
            return True
        if now_s - stream.heard_s > max(MISSED_PERIODS * self.interval_s, FIRST_RETRY_S):
            return False
        return stream.gap_s is None or stream.gap_s <= MISSED_PERIODS * self.interval_s

    def check(self, stream: Stream, now_s: float) -> bool:
        """Check its stream; return True if a request is due: the first one, or if it is not met."""
        if self.asked_s is None:
            self.asked_s, self.asks = now_s, 1
            return True
        if self.is_met(stream, now_s):
            self.retry_s, self.asks = FIRST_RETRY_S, 0
            return False
        if self.is_given_up or now_s - self.asked_s < self.retry_s:
            return False
        self.retry_s = min(2.0 * self.retry_s, LAST_RETRY_S)
        self.asked_s = now_s
        self.asks += 1
        return True


class StreamRequester:
    """Requester that keeps streams flowing; at most one request per tick, with back-off."""

    def __init__(self, freshness: StreamFreshness) -> None:
        self._freshness = freshness
        self._heartbeat_asked_s = -math.inf
        self.restart()

    def restart(self) -> None:
        """Request everything again after a restart of the autopilot."""
        self._wants = [_Want(number, every_s) for number, every_s in STREAM_INTERVAL_S.items()]
        self._wants += [_Want(number, None) for number in ONE_SHOT]
        self.next_check_s = -math.inf
        """Time of the next check, if a request is not overdue."""
        self._had_rc = False

    def note_rc(self, has_rc: bool) -> None:
        """Note whether the autopilot receives a transmitter."""
        if has_rc and not self._had_rc:
            for want in self._wants:
                if want.is_given_up:
                    want.asks, want.retry_s = 0, FIRST_RETRY_S
        self._had_rc = has_rc

    def due(
        self,
        now_s: float,
        target: Ids,
        autopilot: Autopilot = Autopilot.OTHER,
        *,
        is_mode_wanted: bool = False,
    ) -> Message | None:
        """Return the next request, if any; for a HEARTBEAT first, if the mode is in doubt."""
        if now_s < self.next_check_s and not is_mode_wanted:
            return None
        if self._is_heartbeat_due(now_s, is_wanted=is_mode_wanted):
            self._heartbeat_asked_s = now_s
            return request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, target)
        for want in self._wants:
            if ONLY_FROM.get(want.message_id, autopilot) is not autopilot:
                continue
            if want.check(self._freshness.stream(want.message_id), now_s):
                if want.interval_s is None:
                    return request_message(want.message_id, target)
                return _set_interval(want.message_id, 1e6 * want.interval_s, target)
        self.next_check_s = now_s + CHECK_PERIOD_S
        return None

    def _is_heartbeat_due(self, now_s: float, *, is_wanted: bool) -> bool:
        age_s = self._freshness.age_s(mavlink.MAVLINK_MSG_ID_HEARTBEAT, now_s)
        if age_s is None or (age_s < HEARTBEAT_LATE_S and not is_wanted):
            return False
        is_given_up = age_s > HEARTBEAT_GIVEN_UP_S and not is_wanted
        again_s = HEARTBEAT_SELDOM_S if is_given_up else HEARTBEAT_AGAIN_S
        return now_s - self._heartbeat_asked_s >= again_s


def request_message(message_id: int, target: Ids) -> Message:
    """Return a REQUEST_MESSAGE for one message, now."""
    command = VehicleCommand(mavlink.MAV_CMD_REQUEST_MESSAGE, (float(message_id),))
    return command.message(target)


def _set_interval(message_id: int, interval_us: float, target: Ids) -> Message:
    params = (float(message_id), interval_us)
    return VehicleCommand(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, params).message(target)


STOP_AGAIN_S, STILL_ARRIVES_S = 2.0, 1.0
"""Interval between two requests if the stream continues: messages in flight are no refusal."""
STREAM_OFF_US = -1.0
"""Interval that stops a stream."""


class StreamStopper:
    """Requester that stops streams which are not read; a few times each."""

    def __init__(self) -> None:
        self._heard_s: dict[int, float] = {}
        self._asked: dict[int, tuple[int, float]] = {}
        """Number and time of the requests."""

    def hear(self, message_id: int, now_s: float) -> None:
        """Note a message that is not read."""
        self._heard_s[message_id] = now_s

    def due(self, now_s: float, target: Ids) -> Message | None:
        """Return the next request to send, if any."""
        for message_id, heard_s in self._heard_s.items():
            asks, asked_s = self._asked.get(message_id, (0, -math.inf))
            still_arrives = now_s - heard_s <= STILL_ARRIVES_S and now_s - asked_s >= STOP_AGAIN_S
            if asks < MAX_REQUESTS and still_arrives:
                self._asked[message_id] = (asks + 1, now_s)
                return _set_interval(message_id, STREAM_OFF_US, target)
        return None

    def restart(self) -> None:
        """Request again after a restart of the autopilot."""
        self._heard_s.clear()
        self._asked.clear()


PACE_AGAIN_S = 60.0
"""Interval between two texts about a clock at another speed."""
MIN_STALE_AFTER_S = min(stale_after_s for _, stale_after_s in STALE_AFTER_S.values())
TEXTS_PER_S = 0.2


class AutopilotQueries:
    """All queries to the autopilot; `fencing` decides whether to read its fence."""

    def __init__(
        self, binding: AutopilotBinding, fencing: Fencing, *, stops_unread: bool = False
    ) -> None:
        self.clock = ClockSync()
        self.freshness = StreamFreshness()
        self._binding = binding
        self._fencing = fencing
        self.fence = FenceDownload()
        self.fence_parameters = FenceParameters()
        self._streams = StreamRequester(self.freshness)
        self.stopper = StreamStopper() if stops_unread else None
        self._px4_check = Px4FailsafeCheck()
        self.modes = OfferedModes()
        self._asks_mode = False
        self.next_s = -math.inf
        """Time of the next call of `due` that may return a request: after one, the next tick."""
        self._stale: tuple[str, ...] = ()
        self._text_limit = RateLimit(TEXTS_PER_S)
        self._next_pace_text_s = -math.inf

    def receive(self, message: Message, now_s: float) -> list[Announce]:
        """Process a message of the autopilot; return texts for the operator."""
        if message.get_msgId() in FENCE_IDS:
            self.next_s = now_s  # the next item is due
        self.freshness.receive(message, now_s)
        self.clock.receive(message, now_s)
        self.modes.receive(message)
        if isinstance(message, mavlink.MAVLink_sys_status_message):
            self._streams.note_rc(hears_transmitter(message))
        warning = self._px4_check.receive(message)
        return [] if warning is None else [Announce(Severity.WARNING, warning)]

    def due(self, now_s: float, *, is_mode_wanted: bool = False) -> list[Message]:
        """Return the requests to send now; `is_mode_wanted` adds one for a HEARTBEAT."""
        binding, fencing = self._binding, self._fencing
        if binding.bound is None:
            return []
        ids, autopilot = binding.bound.ids, binding.bound.autopilot
        if fencing.is_urgent:
            self.fence.skip_pause()
        request = self.fence.due(
            now_s, ids, is_wanted=fencing.wants_reading, is_followed=fencing.is_followed
        )
        if request is None and fencing.is_followed:
            request = self.fence_parameters.due(now_s, autopilot, ids)
        request = request or self._streams.due(now_s, ids, autopilot, is_mode_wanted=is_mode_wanted)
        if request is None and self.stopper is not None:
            request = self.stopper.due(now_s, ids)
        request = request or self._px4_check.due(now_s, autopilot, ids)
        request = request or self.modes.due(now_s, autopilot, ids)
        if request is None and binding.hardware.is_due(now_s):
            request = request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, ids)
        mode = request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, ids) if self._asks_mode else None
        self._asks_mode = False
        time = self.clock.due(now_s, *ids)
        quiet_until_s = min(self.clock.next_s, self._streams.next_check_s)
        self.next_s = quiet_until_s if request is None else now_s
        return [due for due in (mode, request, time) if due is not None]

    def ask_mode(self) -> None:
        """Request a HEARTBEAT, once, instead of waiting for the next one."""
        self._asks_mode, self.next_s = True, -math.inf

    def new_texts(self, now_s: float) -> list[Announce]:
        """Return texts that are due now on the autopilot's clock and its streams."""
        return self._pace_texts(now_s) + self._stream_texts(now_s)

    def _pace_texts(self, now_s: float) -> list[Announce]:
        pace = self.clock.pace.wrong(now_s)
        if pace is None or now_s < self._next_pace_text_s:
            return []
        self._next_pace_text_s = now_s + PACE_AGAIN_S
        off_pct = 100.0 * abs(pace - 1.0)
        if abs(pace - 1.0) > MAX_PACE:
            text = (
                f"autopilot's clock runs at {pace:.2g} times real time: start the companion with "
                f"--speed {pace:.2g}, or the autopilot in real time"
            )
        elif pace < 1.0:
            text = f"autopilot's clock runs {off_pct:.0f} % slow: its computer is too busy"
        else:
            text = f"autopilot's clock runs {off_pct:.0f} % fast: check its simulator"
        return [Announce(Severity.WARNING, text)]

    def _stream_texts(self, now_s: float) -> list[Announce]:
        """Return a warning about streams that stopped while others still flow."""
        stale = self.freshness.stale(now_s)
        stopped = [name for name in stale if name not in self._stale]
        heard_s = self._binding.heard_s
        is_silent = heard_s is None or now_s - heard_s > MIN_STALE_AFTER_S
        if is_silent or not stopped:
            self._stale = tuple(name for name in self._stale if name in stale)
            return []
        if not self._text_limit.acquire(now_s):
            return []
        self._stale = stale
        text = f"no {' and '.join(stopped)} received any more: requesting again"
        return [Announce(Severity.WARNING, text)]

    def restart(self) -> None:
        """Start again after a restart of the autopilot, which forgets requests."""
        self.next_s = -math.inf
        self.freshness.restart()
        self.clock.restart()
        self._streams.restart()
        self.modes.restart()
        if self.stopper is not None:
            self.stopper.restart()
        self.fence.restart()
        self.fence_parameters.restart()
