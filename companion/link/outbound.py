"""Commands to messages: ENU to NED, metres to AMSL and degE7, texts to chunks.

Source: MAVLink common; PX4 user guide, offboard mode.
"""

from __future__ import annotations

import math

from companion.domain import Autopilot, FlightMode, PositionSetpoint
from companion.errors import LocalProtocolError
from companion.geometry.frames import LocalOrigin, ned_from_enu
from companion.link.requests import CommandMessage
from companion.mav import type_mask
from companion.mav.dialect import Message, mavlink
from companion.mav.modes import set_mode_params

TEXT_LENGTH = 50
"""Bytes of one STATUSTEXT."""
MAX_CHUNKS = 4
"""A longer text is cut."""
UINT32 = 0xFFFFFFFF


def time_boot_ms(now_s: float) -> int:
    """Our clock as a 32-bit stamp, which wraps after 49.7 days."""
    return int(now_s * 1000.0) & UINT32


def heartbeat() -> Message:
    """HEARTBEAT of an onboard controller (component 191, no autopilot)."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_AUTOPILOT_INVALID,
        0,
        0,
        mavlink.MAV_STATE_ACTIVE,
        3,
    )


def local_setpoint(
    setpoint: PositionSetpoint, now_s: float, system_id: int, component_id: int
) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED in frame LOCAL_NED, position with or without yaw.

    Raises:
        LocalProtocolError: A coordinate is not finite.
    """
    _check_finite(setpoint)
    north_m, east_m, down_m = ned_from_enu(setpoint.position_enu_m)
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms(now_s),
        system_id,
        component_id,
        mavlink.MAV_FRAME_LOCAL_NED,
        _mask(setpoint),
        north_m,
        east_m,
        down_m,
        *(0.0,) * 6,
        setpoint.yaw_ned_rad or 0.0,
        0.0,
    )


def global_setpoint(
    setpoint: PositionSetpoint,
    origin: LocalOrigin,
    now_s: float,
    system_id: int,
    component_id: int,
) -> Message:
    """SET_POSITION_TARGET_GLOBAL_INT in frame GLOBAL_INT (5, AMSL).

    Not frame 6: PX4 1.15 misplaces relative altitudes by twice the distance of origin and home.

    Raises:
        LocalProtocolError: A coordinate is not finite.
    """
    _check_finite(setpoint)
    latitude_deg, longitude_deg, altitude_m = origin.geodetic_from_enu(setpoint.position_enu_m)
    return mavlink.MAVLink_set_position_target_global_int_message(
        time_boot_ms(now_s),
        system_id,
        component_id,
        mavlink.MAV_FRAME_GLOBAL_INT,
        _mask(setpoint),
        round(latitude_deg * 1e7),
        round(longitude_deg * 1e7),
        altitude_m,
        *(0.0,) * 6,
        setpoint.yaw_ned_rad or 0.0,
        0.0,
    )


def arm(system_id: int, component_id: int, confirmation: int) -> CommandMessage:
    """COMMAND_LONG to arm, without force."""
    return _command(
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM, system_id, component_id, confirmation, 1.0
    )


def set_mode(
    mode: FlightMode,
    autopilot: Autopilot,
    is_armed: bool,
    system_id: int,
    component_id: int,
    confirmation: int,
) -> CommandMessage:
    """COMMAND_LONG DO_SET_MODE."""
    params = set_mode_params(mode, autopilot, is_armed=is_armed)
    return _command(mavlink.MAV_CMD_DO_SET_MODE, system_id, component_id, confirmation, *params)


def take_off(
    altitude_m: float,
    home_up_m: float,
    origin: LocalOrigin | None,
    autopilot: Autopilot,
    system_id: int,
    component_id: int,
    confirmation: int,
) -> CommandMessage:
    """COMMAND_LONG NAV_TAKEOFF to a height above home.

    PX4 reads parameter 7 as AMSL, and NaN as "here" or its own default; ArduPilot reads it above
    home and must not see a NaN.
    """
    if autopilot is Autopilot.ARDUPILOT:
        params = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, altitude_m)
    else:
        amsl_m = math.nan if origin is None else origin.altitude_m + home_up_m + altitude_m
        params = (math.nan,) * 6 + (amsl_m,)
    return _command(mavlink.MAV_CMD_NAV_TAKEOFF, system_id, component_id, confirmation, *params)


def autopilot_version(param_capability: int) -> Message:
    """AUTOPILOT_VERSION of the companion, which is none, for what it can do.

    Args:
        param_capability: MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE or _C_CAST.
    """
    return mavlink.MAVLink_autopilot_version_message(
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | param_capability,
        *(0,) * 4,
        *(bytes(8),) * 3,
        *(0,) * 3,
    )


def command_ack(command: int, result: int, to: Message) -> Message:
    """COMMAND_ACK to the sender of a command."""
    return mavlink.MAVLink_command_ack_message(
        command, result, 0, 0, to.get_srcSystem(), to.get_srcComponent()
    )


def status_text(severity: int, text: str, text_id: int) -> list[Message]:
    """STATUSTEXT, in chunks where it does not fit into one.

    Args:
        severity: MAV_SEVERITY.
        text: What to say; longer than four chunks it is cut.
        text_id: Non-zero number that joins the chunks of one text.
    """
    chunks = _chunks(text)
    if len(chunks) == 1:
        return [mavlink.MAVLink_statustext_message(severity, chunks[0], 0, 0)]
    return [
        mavlink.MAVLink_statustext_message(severity, chunk, text_id, number)
        for number, chunk in enumerate(chunks)
    ]


def _chunks(text: str) -> list[bytes]:
    """UTF-8 in pieces of a STATUSTEXT each, no character cut in two.

    Source: MAVLink common, STATUSTEXT: a text of several chunks ends with the first NUL.
    """
    chunks = [b""]
    for character in text.encode("utf-8", errors="replace").decode("utf-8"):
        data = character.encode("utf-8")
        if len(chunks[-1]) + len(data) > TEXT_LENGTH:
            if len(chunks) == MAX_CHUNKS:
                break
            chunks.append(b"")
        chunks[-1] += data
    if len(chunks) > 1 and len(chunks[-1]) == TEXT_LENGTH:
        if len(chunks) == MAX_CHUNKS:
            chunks[-1] = chunks[-1].decode("utf-8")[:-1].encode("utf-8")
        else:
            chunks.append(b"")
    return chunks


def _command(
    command: int, system_id: int, component_id: int, confirmation: int, *params: float
) -> CommandMessage:
    padded = (*params, *(0.0,) * (7 - len(params)))
    return CommandMessage(system_id, component_id, command, confirmation, *padded)


def _mask(setpoint: PositionSetpoint) -> int:
    has_yaw = setpoint.yaw_ned_rad is not None
    return type_mask.POSITION_AND_YAW if has_yaw else type_mask.POSITION_ONLY


def _check_finite(setpoint: PositionSetpoint) -> None:
    values = (*setpoint.position_enu_m, setpoint.yaw_ned_rad or 0.0)
    if not all(math.isfinite(value) for value in values):
        raise LocalProtocolError(f"setpoint {setpoint.position_enu_m} is not finite")
