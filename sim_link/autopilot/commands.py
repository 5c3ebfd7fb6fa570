"""MAVLink commands: who is addressed, whether the numbers make sense, and what is answered.

Parameters may be NaN where a command does not use them; where it does, anything but a sensible
number is DENIED. Source: MAVLink developer guide, "Command Protocol"; PX4 1.15 as observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import FlightMode
from companion.mav.dialect import Message, mavlink
from companion.mav.modes import CUSTOM_MODE_ENABLED, px4_mode
from sim_link.autopilot.modes import ACCEPTED, DENIED
from sim_link.autopilot.streams import StreamTable
from sim_link.autopilot.telemetry import Telemetry
from sim_link.autopilot.vehicle import SimVehicle

UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
FAILED = mavlink.MAV_RESULT_FAILED
UNSUPPORTED_MAV_FRAME = 9
"""MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME, which the dialect does not have yet."""

FORCE_DISARM = 21196
"""Magic number of MAV_CMD_COMPONENT_ARM_DISARM's second parameter."""
AMSL_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
RELATIVE_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)
MAX_TAKEOFF_HEIGHT_M = 1000.0
MAX_INTERVAL_US = 3600e6


@dataclass(frozen=True, slots=True)
class Command:
    """A command, whichever message carried it."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT; None for COMMAND_LONG, whose altitudes are above sea level."""


def command_from_long(message: mavlink.MAVLink_command_long_message) -> Command:
    """The command of a COMMAND_LONG."""
    return Command(
        message.command,
        (
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            message.param5,
            message.param6,
            message.param7,
        ),
    )


def command_from_int(message: mavlink.MAVLink_command_int_message) -> Command:
    """The command of a COMMAND_INT; its x and y stay in 1e-7 degrees."""
    return Command(
        message.command,
        (
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            float(message.x),
            float(message.y),
            message.z,
        ),
        message.frame,
    )


def command_from_set_mode(message: mavlink.MAVLink_set_mode_message) -> Command:
    """DO_SET_MODE in place of the SET_MODE message, as PX4 answers it."""
    main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
    nan = math.nan
    return Command(
        mavlink.MAV_CMD_DO_SET_MODE,
        (float(message.base_mode), float(main), float(sub), nan, nan, nan, nan),
    )


def whole(value: float) -> int | None:
    """The integer that a float parameter holds, or None (NaN, infinite, 0.4)."""
    return int(value) if math.isfinite(value) and value == int(value) else None


class CommandHandler:
    """Obeys commands.

    Args:
        vehicle: Whom they are for.
        telemetry: Builds requested messages.
        streams: Whose rates may be changed.
    """

    def __init__(self, vehicle: SimVehicle, telemetry: Telemetry, streams: StreamTable) -> None:
        self._vehicle = vehicle
        self._telemetry = telemetry
        self._streams = streams

    def handle(self, command: Command, now_s: float) -> tuple[int, list[Message]]:
        """Obey `command` at `now_s` seconds since boot.

        Returns:
            Its MAV_RESULT, and messages to send before the COMMAND_ACK.
        """
        match command.number:
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request_message(command)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return ACCEPTED, [self._telemetry.autopilot_version()]
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return ACCEPTED, [self._telemetry.home_position()]
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                return self._message_interval(command.params[0])
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_message_interval(command, now_s), []
        result = self._fly(command, now_s)
        self._vehicle.note_changes(now_s, "commanded")
        return result, []

    def _fly(self, command: Command, now_s: float) -> int:
        modes, situation = self._vehicle.modes, self._vehicle.situation(now_s)
        match command.number:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                return self._arm_disarm(command, now_s)
            case mavlink.MAV_CMD_DO_SET_MODE:
                return self._set_mode(command, now_s)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return self._take_off(command, now_s)
            case mavlink.MAV_CMD_NAV_LAND:
                return modes.choose(FlightMode.LAND, situation)
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return modes.choose(FlightMode.RETURN, situation)
        return UNSUPPORTED

    def _arm_disarm(self, command: Command, now_s: float) -> int:
        wanted, force = command.params[:2]
        if wanted not in (0.0, 1.0) or not (math.isnan(force) or force in (0.0, FORCE_DISARM)):
            return DENIED
        situation = self._vehicle.situation(now_s)
        if wanted == 1.0:
            return self._vehicle.modes.arm(situation)
        return self._vehicle.modes.disarm(situation, is_forced=force == FORCE_DISARM)

    def _set_mode(self, command: Command, now_s: float) -> int:
        base, main = whole(command.params[0]), whole(command.params[1])
        sub = 0 if math.isnan(command.params[2]) else whole(command.params[2])
        if base is None or main is None or sub is None or not base & CUSTOM_MODE_ENABLED:
            return DENIED
        mode = px4_mode(main, sub)
        if mode is FlightMode.TAKEOFF:
            self._vehicle.pilot.takeoff_up_m = self._default_takeoff_up_m
        return self._vehicle.modes.choose(mode, self._vehicle.situation(now_s))

    def _take_off(self, command: Command, now_s: float) -> int:
        altitude_m = command.params[6]
        home_up_m = self._vehicle.home_enu_m[2]
        if command.frame is not None and command.frame not in AMSL_FRAMES + RELATIVE_FRAMES:
            return UNSUPPORTED_MAV_FRAME
        if math.isnan(altitude_m):
            up_m = self._default_takeoff_up_m
        elif command.frame in RELATIVE_FRAMES:
            up_m = home_up_m + altitude_m
        else:
            up_m = home_up_m + altitude_m - self._vehicle.home_altitude_m
        if not 0.0 < up_m - home_up_m <= MAX_TAKEOFF_HEIGHT_M:
            return DENIED
        self._vehicle.pilot.takeoff_up_m = up_m
        return self._vehicle.modes.choose(FlightMode.TAKEOFF, self._vehicle.situation(now_s))

    @property
    def _default_takeoff_up_m(self) -> float:
        return self._vehicle.home_enu_m[2] + self._vehicle.scenario.autopilot.takeoff_altitude_m

    def _request_message(self, command: Command) -> tuple[int, list[Message]]:
        number = whole(command.params[0])
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._message_interval(command.params[1])
        message = None if number is None else self._telemetry.build(number)
        return (DENIED, []) if message is None else (ACCEPTED, [message])

    def _message_interval(self, wanted: float) -> tuple[int, list[Message]]:
        number = whole(wanted)
        if number is None or not 0 <= number <= 0xFFFF:
            return DENIED, []
        interval_us = self._streams.interval_us(number)
        return ACCEPTED, [mavlink.MAVLink_message_interval_message(number, interval_us)]

    def _set_message_interval(self, command: Command, now_s: float) -> int:
        number, interval_us = whole(command.params[0]), command.params[1]
        is_sensible = interval_us in (-1.0, 0.0) or 0.0 < interval_us <= MAX_INTERVAL_US
        if number is None or not is_sensible:
            return DENIED
        return ACCEPTED if self._streams.set_interval_us(number, interval_us, now_s) else FAILED
