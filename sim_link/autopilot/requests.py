"""Requests for messages and streams: what is sent once, and how often.

Source: MAVLink common, MAV_CMD_REQUEST_MESSAGE, MAV_CMD_SET_MESSAGE_INTERVAL, REQUEST_DATA_STREAM;
PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

from companion.mav.dialect import Message, mavlink
from companion.mav.ekf_status_report import MAVLink_ekf_status_report_message
from sim_link.autopilot.commands import ACCEPTED, DENIED, FAILED, Command, whole
from sim_link.autopilot.streams import StreamTable
from sim_link.autopilot.telemetry import Telemetry

MAX_INTERVAL_US = 3600e6
DATA_STREAMS: dict[int, tuple[int, ...]] = {
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_MISSION_CURRENT,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
    ),
    mavlink.MAV_DATA_STREAM_RC_CHANNELS: (mavlink.MAVLINK_MSG_ID_RC_CHANNELS,),
    mavlink.MAV_DATA_STREAM_POSITION: (
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    ),
    mavlink.MAV_DATA_STREAM_EXTRA1: (mavlink.MAVLINK_MSG_ID_ATTITUDE,),
    mavlink.MAV_DATA_STREAM_EXTRA2: (mavlink.MAVLINK_MSG_ID_VFR_HUD,),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_BATTERY_STATUS,
        MAVLink_ekf_status_report_message.id,
    ),
}
"""Messages of each MAV_DATA_STREAM; ALL is every one of them."""
Answer = tuple[int, list[Message]]
"""MAV_RESULT, and messages to send before the COMMAND_ACK."""


class MessageRequests:
    """Obeys requests for messages and streams.

    Args:
        telemetry: Builds requested messages.
        is_ardupilot: Which of the two answers to give where they differ.
    """

    def __init__(self, telemetry: Telemetry, *, is_ardupilot: bool) -> None:
        self._telemetry = telemetry
        self._is_ardupilot = is_ardupilot

    def handle(self, command: Command, streams: StreamTable, now_s: float) -> Answer | None:
        """Obey a command that is about messages; None if it is about something else.

        Args:
            command: The command.
            streams: Of the link that it came by.
            now_s: Seconds since boot.
        """
        match command.number:
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request_message(command, streams)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return self._send_once(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return self._send_once(mavlink.MAVLINK_MSG_ID_HOME_POSITION)
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                return self._interval(command.params[0], streams)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(command, streams, now_s), []
        return None

    def request_data_stream(
        self, stream: int, rate_hz: int, is_start: bool, streams: StreamTable, now_s: float
    ) -> None:
        """REQUEST_DATA_STREAM, which has no answer."""
        numbers = DATA_STREAMS.get(stream, ())
        if stream == mavlink.MAV_DATA_STREAM_ALL:
            numbers = tuple(number for group in DATA_STREAMS.values() for number in group)
        interval_us = 1e6 / rate_hz if is_start and rate_hz > 0 else -1.0
        for number in numbers:
            streams.set_interval_us(number, interval_us, now_s)

    def _send_once(self, number: int | None) -> Answer:
        message = None if number is None else self._telemetry.build(number)
        if message is None:
            return (FAILED if self._is_ardupilot else DENIED), []
        return ACCEPTED, [message]

    def _request_message(self, command: Command, streams: StreamTable) -> Answer:
        number = whole(command.params[0])
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._interval(command.params[1], streams)
        return self._send_once(number)

    def _interval(self, wanted: float, streams: StreamTable) -> Answer:
        number = whole(wanted)
        if number is None or not 0 <= number <= 0xFFFF:
            return DENIED, []
        interval_us = streams.interval_us(number)
        result = FAILED if self._is_ardupilot and interval_us == 0 else ACCEPTED
        return result, [mavlink.MAVLink_message_interval_message(number, interval_us)]

    def _set_interval(self, command: Command, streams: StreamTable, now_s: float) -> int:
        number, interval_us = whole(command.params[0]), command.params[1]
        is_sensible = interval_us in (-1.0, 0.0) or 0.0 < interval_us <= MAX_INTERVAL_US
        if number is None or not is_sensible:
            return DENIED
        if streams.set_interval_us(number, interval_us, now_s):
            return ACCEPTED
        return DENIED if self._is_ardupilot else FAILED
