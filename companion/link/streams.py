"""Asking the autopilot for every stream we need, and again when one stops.

ArduPilot sends nothing but heartbeats unasked, and PX4's rates differ by link, so the companion
asks for all of it. Source: MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL and REQUEST_MESSAGE.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import Autopilot
from companion.link.freshness import Stream, StreamFreshness
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink

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
}
"""What is flown on; GLOBAL_POSITION_INT is for the flight log, because ground stations replay a
track only from it."""
ONLY_FROM = {
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Autopilot.PX4,
    MAVLink_ekf_status_report_message.id: Autopilot.ARDUPILOT,
}
"""Who else is asked refuses, for ever."""
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

    def is_met(self, stream: Stream, now_s: float) -> bool:
        """Whether it comes, as often as it should."""
        if stream.heard_s is None:
            return False
        if self.interval_s is None:
            return True
        if now_s - stream.heard_s > max(MISSED_PERIODS * self.interval_s, FIRST_RETRY_S):
            return False
        return stream.gap_s is None or stream.gap_s <= MISSED_PERIODS * self.interval_s

    def is_due(self, stream: Stream, now_s: float) -> bool:
        """Whether to ask: never asked, or not met in spite of it."""
        if self.asked_s is None:
            return True
        if self.is_met(stream, now_s):
            self.retry_s = FIRST_RETRY_S
            return False
        return now_s - self.asked_s >= self.retry_s


class StreamRequester:
    """Keeps the streams flowing; at most one request per tick, with back-off per stream.

    Args:
        freshness: Of the autopilot's streams.
    """

    def __init__(self, freshness: StreamFreshness) -> None:
        self._freshness = freshness
        self._wants = [
            _Want(number, interval_s) for number, interval_s in STREAM_INTERVAL_S.items()
        ]
        self._wants += [_Want(number, None) for number in ONE_SHOT]
        self._heartbeat_asked_s = -math.inf
        self._next_look_s = -math.inf

    def restart(self) -> None:
        """Ask for everything again, because the autopilot forgot."""
        for want in self._wants:
            want.asked_s = None
            want.retry_s = FIRST_RETRY_S
        self._next_look_s = -math.inf

    def due(
        self,
        now_s: float,
        system_id: int,
        component_id: int,
        autopilot: Autopilot = Autopilot.OTHER,
        *,
        is_mode_wanted: bool = False,
    ) -> Message | None:
        """The next request to send, if any; one for a HEARTBEAT first, if the mode is in doubt."""
        if now_s < self._next_look_s and not is_mode_wanted:
            return None
        if self._is_heartbeat_due(now_s, is_wanted=is_mode_wanted):
            self._heartbeat_asked_s = now_s
            return request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, system_id, component_id)
        for want in self._wants:
            if ONLY_FROM.get(want.message_id, autopilot) is not autopilot:
                continue
            if want.is_due(self._freshness.stream(want.message_id), now_s):
                if want.asked_s is not None:
                    want.retry_s = min(2.0 * want.retry_s, LAST_RETRY_S)
                want.asked_s = now_s
                return _request(want, system_id, component_id)
        self._next_look_s = now_s + LOOK_PERIOD_S
        return None

    def _is_heartbeat_due(self, now_s: float, *, is_wanted: bool) -> bool:
        age_s = self._freshness.age_s(mavlink.MAVLINK_MSG_ID_HEARTBEAT, now_s)
        if age_s is None or (age_s < HEARTBEAT_LATE_S and not is_wanted):
            return False
        is_given_up = age_s > HEARTBEAT_GIVEN_UP_S and not is_wanted
        again_s = HEARTBEAT_SELDOM_S if is_given_up else HEARTBEAT_AGAIN_S
        return now_s - self._heartbeat_asked_s >= again_s


def request_message(message_id: int, system_id: int, component_id: int) -> Message:
    """REQUEST_MESSAGE: one message, now."""
    number = mavlink.MAV_CMD_REQUEST_MESSAGE
    return _command(number, message_id, 0.0, system_id, component_id)


def _request(want: _Want, system_id: int, component_id: int) -> Message:
    if want.interval_s is None:
        return request_message(want.message_id, system_id, component_id)
    number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    return _command(number, want.message_id, 1e6 * want.interval_s, system_id, component_id)


def _command(number: int, message_id: int, p2: float, system_id: int, component_id: int) -> Message:
    params = (float(message_id), p2, 0.0, 0.0, 0.0, 0.0, 0.0)
    return mavlink.MAVLink_command_long_message(system_id, component_id, number, 0, *params)
