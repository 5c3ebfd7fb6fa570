"""What the companion asks the autopilot by itself, outside of any mission.

Each query receives the autopilot's messages and says when a question is due: for its fence, for
streams, for a parameter, for modes, for its hardware id, for the time. All but that leave one
per control tick, so that a slow line is not flooded; that for the fence first: nothing engages
before it is answered; that for the hardware id last: nothing waits for it.

Streams are asked for because ArduPilot sends nothing but heartbeats unasked, and PX4's rates differ
by link. Each kind of message is watched on its own, by arrival here and progress there: one with a
time stamp counts as new only if that moved. What has not come for a while is stale; what comes far
less often than asked for is slow; both are asked for again. Whether the link is alive is for
`AutopilotBinding` to say, because one HEARTBEAT a second is no detector where frames get lost.

With COM_OBL_RC_ACT = 0, the default, PX4 falls back to Position mode when setpoints stop; without
an RC that sinks at 0.6 to 0.9 m/s and drifts (PX4 1.15, observed in SITL). That is warned of.

Source: MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL and REQUEST_MESSAGE; PX4 parameter reference,
COM_OBL_RC_ACT; MAVLink guide, "Parameter Protocol", for integers sent bytewise in a float.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from companion.domain import Autopilot
from companion.guidance.commands import Announce, Severity
from companion.guidance.flight.fencing import Fencing
from companion.guidance.flight.vehicle import LANDED_PATIENCE_S
from companion.link.binding import AutopilotBinding
from companion.link.conversion.clock_sync import MAX_PACE, ClockSync
from companion.link.conversion.offered_modes import OfferedModes
from companion.link.fence_download import FenceDownload
from companion.link.fence_parameters import FenceParameters
from companion.link.intake import RateLimit
from companion.link.outbound import Ids, VehicleCommand
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from companion.mav.param_encoding import name_of

SMOOTHING = 0.2
"""How much one more gap changes the mean."""

PATIENCE_S: dict[int, tuple[str, float]] = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("position", 0.5),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: ("attitude", 1.0),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: ("heartbeat", 3.5),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: ("landed state", LANDED_PATIENCE_S),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: ("status", 5.0),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: ("home", 15.0),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: ("GNSS status", 5.0),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: ("estimator status", 5.0),
    MAVLink_ekf_status_report_message.id: ("estimator status", 5.0),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: ("battery", 10.0),
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: ("transmitter", 5.0),
}
"""Streams that control leans on, the word for each, and after how many seconds it is missed: what
moves the vehicle within ticks, what can only end control within a few of its periods."""
STAMPED_ONCE = (mavlink.MAVLINK_MSG_ID_HOME_POSITION,)
"""Stamped with when home was set, not with the time of sending: every arrival is progress."""


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

    def receive(self, message: Message, now_s: float) -> bool:
        """Take in a message of the autopilot; whether its stream made progress."""
        number = message.get_msgId()
        stream = self._streams.get(number)
        if stream is None:
            stream = self._streams[number] = Stream()
        stamp = getattr(message, "time_boot_ms", None) or getattr(message, "time_usec", None)
        if not stamp or number in STAMPED_ONCE:  # 0 stands for unknown
            return stream.take(None, now_s)
        return stream.take(int(stamp), now_s)

    def stream(self, message_id: int) -> Stream:
        """What is known of a kind of message."""
        return self._streams.get(message_id, Stream())

    def age_s(self, message_id: int, now_s: float) -> float | None:
        """How long ago a kind of message made progress; None if it never did."""
        stream = self._streams.get(message_id)
        return None if stream is None or stream.heard_s is None else now_s - stream.heard_s

    def stale(self, now_s: float) -> tuple[str, ...]:
        """What is flown on and did not come for too long, by name; what never came is not told."""
        return tuple(
            name
            for message_id, (name, patience_s) in PATIENCE_S.items()
            if (self.age_s(message_id, now_s) or 0.0) > patience_s
        )

    def restart(self) -> None:
        """Begin anew, because the autopilot did."""
        self._streams.clear()


ECHO_S = 0.07
"""No multiple of a rate that anybody sends setpoints at: in step with our own, which follows soon
after, an echo would never show those of another sender."""
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
"""What is flown on; GLOBAL_POSITION_INT is for the flight log, because ground stations replay a
track only from it."""
ONLY_FROM = {
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Autopilot.PX4,
    MAVLink_ekf_status_report_message.id: Autopilot.ARDUPILOT,
}
"""Who else is asked refuses, for ever."""
ONLY_IF_THERE = (mavlink.MAVLINK_MSG_ID_RC_CHANNELS, mavlink.MAVLINK_MSG_ID_GPS2_RAW)
"""Never sent without a transmitter or a second receiver: asked for a few times, and again when a
transmitter is heard."""
MOST_ASKS = 5
ONE_SHOT = (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
"""Asked for by REQUEST_MESSAGE until they arrive: what is only sent when it changes."""

FIRST_RETRY_S = 1.0
LAST_RETRY_S = 16.0
LOOK_PERIOD_S = 0.2
"""While nothing is missing it is looked for less often than at every tick."""
MISSED_PERIODS = 3.0
"""A stream that is silent for so many of its periods has stopped, and one that takes so many for
each message is slow."""
HEARTBEAT_LATE_S = 3.0
"""Its period is a second in every autopilot, and most do not change it: a late one is asked for by
itself."""
HEARTBEAT_AGAIN_S = 0.25
"""So often: where every other frame is lost, one in four questions is answered, and ten seconds
after the last heartbeat nobody knows who flies."""
HEARTBEAT_GIVEN_UP_S, HEARTBEAT_SELDOM_S = 12.0, 5.0
"""Who did not answer for so long does not know the question, and is asked seldom."""


@dataclass(slots=True)
class _Want:
    message_id: int
    interval_s: float | None
    """None: one message, not a stream."""
    retry_s: float = FIRST_RETRY_S
    asked_s: float | None = None
    asks: int = 0
    """Since it came last."""

    @property
    def is_given_up(self) -> bool:
        """Whether it was asked for often enough, and is not there."""
        return self.message_id in ONLY_IF_THERE and self.asks >= MOST_ASKS

    def is_met(self, stream: Stream, now_s: float) -> bool:
        """Whether it comes, as often as it should."""
        if stream.heard_s is None:
            return False
        if self.interval_s is None:
            return True
        if now_s - stream.heard_s > max(MISSED_PERIODS * self.interval_s, FIRST_RETRY_S):
            return False
        return stream.gap_s is None or stream.gap_s <= MISSED_PERIODS * self.interval_s

    def look(self, stream: Stream, now_s: float) -> bool:
        """Look at its stream; whether to ask: never asked, or not met in spite of it."""
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
    """Keeps the streams flowing; at most one request per tick, with back-off per stream."""

    def __init__(self, freshness: StreamFreshness) -> None:
        self._freshness = freshness
        self._heartbeat_asked_s = -math.inf
        self.restart()

    def restart(self) -> None:
        """Ask for everything again, because the autopilot forgot."""
        self._wants = [_Want(number, every_s) for number, every_s in STREAM_INTERVAL_S.items()]
        self._wants += [_Want(number, None) for number in ONE_SHOT]
        self._next_look_s = -math.inf
        self._had_rc = False

    def note_rc(self, has_rc: bool) -> None:
        """The autopilot says whether it hears a transmitter."""
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
        """The next request to send, if any; one for a HEARTBEAT first, if the mode is in doubt."""
        if now_s < self._next_look_s and not is_mode_wanted:
            return None
        if self._is_heartbeat_due(now_s, is_wanted=is_mode_wanted):
            self._heartbeat_asked_s = now_s
            return request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, target)
        for want in self._wants:
            if ONLY_FROM.get(want.message_id, autopilot) is not autopilot:
                continue
            if want.look(self._freshness.stream(want.message_id), now_s):
                return _request(want, target)
        self._next_look_s = now_s + LOOK_PERIOD_S
        return None

    def _is_heartbeat_due(self, now_s: float, *, is_wanted: bool) -> bool:
        age_s = self._freshness.age_s(mavlink.MAVLINK_MSG_ID_HEARTBEAT, now_s)
        if age_s is None or (age_s < HEARTBEAT_LATE_S and not is_wanted):
            return False
        is_given_up = age_s > HEARTBEAT_GIVEN_UP_S and not is_wanted
        again_s = HEARTBEAT_SELDOM_S if is_given_up else HEARTBEAT_AGAIN_S
        return now_s - self._heartbeat_asked_s >= again_s


def request_message(message_id: int, target: Ids) -> Message:
    """REQUEST_MESSAGE: one message, now."""
    command = VehicleCommand(mavlink.MAV_CMD_REQUEST_MESSAGE, (float(message_id),))
    return command.message(target)


def _request(want: _Want, target: Ids) -> Message:
    if want.interval_s is None:
        return request_message(want.message_id, target)
    return _set_interval(want.message_id, 1e6 * want.interval_s, target)


def _set_interval(message_id: int, interval_us: float, target: Ids) -> Message:
    params = (float(message_id), interval_us)
    return VehicleCommand(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, params).message(target)


RC_BIT = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER


def hears_transmitter(status: mavlink.MAVLink_sys_status_message) -> bool:
    """Whether an autopilot says that a pilot's transmitter is there, and good."""
    present = status.onboard_control_sensors_present & RC_BIT
    return bool(present and status.onboard_control_sensors_health & RC_BIT)


STOP_AGAIN_S, STILL_COMES_S = 2.0, 1.0
"""It is asked again after so long, if it came within the last second: what was on its way is no
refusal."""
OFF_US = -1.0
"""The interval that stops a stream."""


class StreamStopper:
    """Asks for streams to stop that came although nobody reads them; a few times, then no more."""

    def __init__(self) -> None:
        self._heard_s: dict[int, float] = {}
        self._asked: dict[int, tuple[int, float]] = {}
        """How often, and when last."""

    def hear(self, message_id: int, now_s: float) -> None:
        """One that nobody reads came."""
        self._heard_s[message_id] = now_s

    def due(self, now_s: float, target: Ids) -> Message | None:
        """The next request to send, if any."""
        for message_id, heard_s in self._heard_s.items():
            asks, asked_s = self._asked.get(message_id, (0, -math.inf))
            still_comes = now_s - heard_s <= STILL_COMES_S and now_s - asked_s >= STOP_AGAIN_S
            if asks < MOST_ASKS and still_comes:
                self._asked[message_id] = (asks + 1, now_s)
                return _set_interval(message_id, OFF_US, target)
        return None

    def restart(self) -> None:
        """Ask again, because the autopilot forgot."""
        self._heard_s.clear()
        self._asked.clear()


PARAMETER = "COM_OBL_RC_ACT"
ASK_PERIOD_S = 3.0
ASKS = 3
WARNING = (
    "COM_OBL_RC_ACT is 0 and there is no RC: if setpoints stop, PX4 sinks and drifts. "
    "Set it to 5 (hold) or 3 (return)"
)


class Px4FailsafeCheck:
    """Asks for the parameter a few times and judges the answer once."""

    def __init__(self) -> None:
        self._asks = 0
        self._next_s = 0.0
        self._action: int | None = None
        self._has_rc: bool | None = None
        self._is_done = False

    def due(
        self, now_s: float, autopilot: Autopilot, system_id: int, component_id: int
    ) -> Message | None:
        """The request to send now, if any; silence is no error and is not asked about for ever."""
        is_needed = autopilot is Autopilot.PX4 and self._action is None and self._asks < ASKS
        if not is_needed or now_s < self._next_s:
            return None
        self._asks += 1
        self._next_s = now_s + ASK_PERIOD_S
        name = PARAMETER.encode("ascii")
        return mavlink.MAVLink_param_request_read_message(system_id, component_id, name, -1)

    def receive(self, message: Message) -> str | None:
        """Take in a message of the autopilot; the warning, once, if it is deserved."""
        if isinstance(message, mavlink.MAVLink_param_value_message):
            self._take_parameter(message)
        elif isinstance(message, mavlink.MAVLink_sys_status_message):
            self._has_rc = hears_transmitter(message)
        if self._is_done or self._action is None or self._has_rc is None:
            return None
        self._is_done = True
        return WARNING if self._action == 0 and not self._has_rc else None

    def _take_parameter(self, message: mavlink.MAVLink_param_value_message) -> None:
        if name_of(message) == PARAMETER:
            self._action = struct.unpack("<i", struct.pack("<f", message.param_value))[0]


PACE_AGAIN_S = 60.0
"""An autopilot that runs at another speed is named this often."""
SHORTEST_PATIENCE_S = min(patience_s for _, patience_s in PATIENCE_S.values())
TEXTS_PER_S = 0.2


class AutopilotQueries:
    """All of them; `fencing` says whether the autopilot's fence is wanted."""

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
        self._stale: tuple[str, ...] = ()
        self._may_tell = RateLimit(TEXTS_PER_S)
        self._next_pace_text_s = -math.inf

    def receive(self, message: Message, now_s: float) -> list[Announce]:
        """Take in a message of the autopilot; what the operator is to be told."""
        self.freshness.receive(message, now_s)
        self.clock.receive(message, now_s)
        self.modes.receive(message)
        if isinstance(message, mavlink.MAVLink_sys_status_message):
            self._streams.note_rc(hears_transmitter(message))
        warning = self._px4_check.receive(message)
        return [] if warning is None else [Announce(Severity.WARNING, warning)]

    def due(self, now_s: float, *, is_mode_wanted: bool = False) -> list[Message]:
        """The questions to ask now; a HEARTBEAT is wanted until one comes that ends a doubt."""
        binding = self._binding
        if binding.system_id is None:
            return []
        ids = (binding.system_id, binding.component_id)
        fencing = self._fencing
        if fencing.is_urgent:
            self.fence.hurry()
        request = self.fence.due(
            now_s, ids, is_wanted=fencing.wants_reading, is_followed=fencing.is_followed
        )
        if request is None and fencing.is_followed:
            request = self.fence_parameters.due(now_s, binding.autopilot, ids)
        request = request or self._streams.due(
            now_s, ids, binding.autopilot, is_mode_wanted=is_mode_wanted
        )
        if request is None and self.stopper is not None:
            request = self.stopper.due(now_s, ids)
        request = request or self._px4_check.due(now_s, binding.autopilot, *ids)
        request = request or self.modes.due(now_s, binding.autopilot, ids)
        if request is None and binding.hardware.is_due(now_s):
            request = request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, ids)
        mode = request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, ids) if self._asks_mode else None
        self._asks_mode = False
        time = self.clock.due(now_s, *ids)
        return [question for question in (mode, request, time) if question is not None]

    def ask_mode(self) -> None:
        """Ask for a HEARTBEAT, once, instead of waiting for the next one."""
        self._asks_mode = True

    def new_texts(self, now_s: float) -> list[Announce]:
        """Texts that are due now on the autopilot's clock and its streams."""
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
        """Streams that stopped while others still flow."""
        stale = self.freshness.stale(now_s)
        stopped = [name for name in stale if name not in self._stale]
        heard_s = self._binding.heard_s
        is_silent = heard_s is None or now_s - heard_s > SHORTEST_PATIENCE_S
        if is_silent or not stopped:
            self._stale = tuple(name for name in self._stale if name in stale)
            return []
        if not self._may_tell.acquire(now_s):
            return []
        self._stale = stale
        return [Announce(Severity.WARNING, f"no {' and '.join(stopped)} any more: asking again")]

    def restart(self) -> None:
        """Begin anew, because the autopilot forgot what it was asked."""
        self.freshness.restart()
        self.clock.restart()
        self._streams.restart()
        self.modes.restart()
        if self.stopper is not None:
            self.stopper.restart()
        self.fence.restart()
        self.fence_parameters.restart()
