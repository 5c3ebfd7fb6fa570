"""Independent MAVLink implementation: frames, results, modes and setpoints, valid and invalid.

It is an oracle for frame readers: only the CRC_EXTRA of each message is shared with the codec under
test, and modes have a table apart from the simulator's, so that a wrong number is not used on both
sides. Results are numbers because the dialect does not have all of them.

Source: MAVLink guide, "Packet Serialization" and "Message Signing"; MAVLink common, MAV_RESULT and
MAV_MISSION_RESULT; PX4 `px4_custom_mode.h`; ArduPilot `ArduCopter/mode.h`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.rules import Flavour, autopilot_notes

OBSERVED_PX4 = "PX4 1.15, observed in SITL"
OBSERVED_ARDUPILOT = "ArduCopter 4.5, observed in SITL"
OBSERVED_BOTH = f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}"

# Messages and numbers of the dialect, by the names that rules call them

Ack = mavlink.MAVLink_command_ack_message
Attitude = mavlink.MAVLink_attitude_message
Battery = mavlink.MAVLink_battery_status_message
Clear = mavlink.MAVLink_mission_clear_all_message
CommandInt = mavlink.MAVLink_command_int_message
CommandLong = mavlink.MAVLink_command_long_message
Count = mavlink.MAVLink_mission_count_message
Current = mavlink.MAVLink_mission_current_message
GlobalPosition = mavlink.MAVLink_global_position_int_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message
Heartbeat = mavlink.MAVLink_heartbeat_message
HomePosition = mavlink.MAVLink_home_position_message
Item = mavlink.MAVLink_mission_item_int_message
ItemIntRequest = mavlink.MAVLink_mission_request_int_message
ItemRequest = mavlink.MAVLink_mission_request_message
LocalPosition = mavlink.MAVLink_local_position_ned_message
LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
Origin = mavlink.MAVLink_gps_global_origin_message
ParamError = mavlink.MAVLink_param_error_message
ParamRead = mavlink.MAVLink_param_request_read_message
ParamSet = mavlink.MAVLink_param_set_message
ParamValue = mavlink.MAVLink_param_value_message
Ping = mavlink.MAVLink_ping_message
PlanAck = mavlink.MAVLink_mission_ack_message
PlanRequest = mavlink.MAVLink_mission_request_list_message
Reached = mavlink.MAVLink_mission_item_reached_message
SetOrigin = mavlink.MAVLink_set_gps_global_origin_message
StatusText = mavlink.MAVLink_statustext_message
SysState = mavlink.MAVLink_extended_sys_state_message
SysStatus = mavlink.MAVLink_sys_status_message
SystemTime = mavlink.MAVLink_system_time_message
Timesync = mavlink.MAVLink_timesync_message
Version = mavlink.MAVLink_autopilot_version_message

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
FORCE_DISARM = 21196.0
"""Parameter 2 of ARM: disarm even in flight."""
REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE
TAKE_OFF = mavlink.MAV_CMD_NAV_TAKEOFF
REBOOT = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
ACTIVE, CRITICAL = mavlink.MAV_STATE_ACTIVE, mavlink.MAV_STATE_CRITICAL
MISSION = mavlink.MAV_MISSION_TYPE_MISSION
FENCE = mavlink.MAV_MISSION_TYPE_FENCE
RALLY = mavlink.MAV_MISSION_TYPE_RALLY
ALL = mavlink.MAV_MISSION_TYPE_ALL
INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
NAN = math.nan

# Results: MAV_RESULT, then MAV_MISSION_RESULT

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
IN_PROGRESS, CANCELLED = 5, 6
COMMAND_LONG_ONLY, COMMAND_INT_ONLY, UNSUPPORTED_FRAME = 7, 8, 9
REFUSALS = (TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, 7, 8, 9, 10)

PLAN_ERROR, PLAN_UNSUPPORTED_FRAME, PLAN_UNSUPPORTED = 1, 2, 3
PLAN_NO_SPACE, PLAN_INVALID = 4, 5
PLAN_INVALID_X, PLAN_INVALID_Z = 10, 12
PLAN_INVALID_SEQUENCE, PLAN_CANCELLED = 13, 15


MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
HEADER_LENGTH = {MAGIC_V1: 6, MAGIC_V2: 10}
CRC_LENGTH = 2
SIGNED = 0x01
SIGNATURE_LENGTH = 13
SIGNING_UNITS_PER_S = 100_000
"""Signing counts units of 10 microseconds since 2015."""


@dataclass(frozen=True, slots=True)
class FrameSpec:
    """Deviations of a frame from an ordinary one."""

    system_id: int = 255
    component_id: int = 190
    sequence: int = 0
    version: int = 2
    incompat: int = 0
    compat: int = 0
    trim: bool = True
    """True if trailing zeros of the payload are cut (MAVLink 2 only)."""
    crc_change: int = 0
    """Mask that spoils the CRC, by exclusive or."""


def crc_x25(data: bytes) -> int:
    """Return CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        step = (byte ^ crc) & 0xFF
        step = (step ^ (step << 4)) & 0xFF
        crc = (crc >> 8) ^ (step << 8) ^ (step << 3) ^ (step >> 4)
    return crc & 0xFFFF


def payload_of(message: Message) -> bytes:
    """Return the message's payload in MAVLink 2, with all its trailing zeros."""
    frame = message.pack(mavlink.MAVLink(None, 1, 1))
    cut = frame[10 : 10 + frame[1]]
    full = type(message).unpacker.size
    return bytes(cut) + bytes(full - len(cut))


def base_length(message: Message) -> int:
    """Return the payload length in MAVLink 1: the fields before the extensions."""
    return int(message.pack(mavlink.MAVLink(None, 1, 1), force_mavlink1=True)[1])


def build_frame(message: Message, spec: FrameSpec | None = None) -> bytes:
    """Return the frame of a message, built by `spec`."""
    spec = spec or FrameSpec()
    payload = payload_of(message)
    if spec.version == 1:
        payload = payload[: base_length(message)]
    elif spec.trim:
        payload = payload.rstrip(b"\0") or payload[:1]
    return build_raw(message.get_msgId(), payload, type(message).crc_extra, spec)


def build_raw(message_id: int, payload: bytes, crc_extra: int, spec: FrameSpec) -> bytes:
    """Return a frame of any message id, known or not."""
    head = bytes((spec.sequence, spec.system_id, spec.component_id))
    if spec.version == 1:
        body = bytes((len(payload),)) + head + bytes((message_id,)) + payload
        magic = MAGIC_V1
    else:
        flags = bytes((len(payload), spec.incompat, spec.compat))
        body = flags + head + message_id.to_bytes(3, "little") + payload
        magic = MAGIC_V2
    crc = crc_x25(body + bytes((crc_extra,))) ^ spec.crc_change
    return bytes((magic,)) + body + crc.to_bytes(2, "little")


def sign(frame: bytes, key: bytes, link_id: int, timestamp: int) -> bytes:
    """Return a frame built with `incompat` 1, signed, with timestamps as in signing."""
    tail = bytes((link_id,)) + timestamp.to_bytes(6, "little")
    return frame + tail + hashlib.sha256(key + frame + tail).digest()[:6]


@dataclass(frozen=True, slots=True)
class Signature:
    """The signature block of a signed frame."""

    link_id: int
    timestamp: int
    is_right: bool


def signature_of(frame: bytes, key: bytes) -> Signature | None:
    """Return the signature of a frame; None if it is not signed."""
    if frame[0] != MAGIC_V2 or not frame[2] & SIGNED:
        return None
    body, block = frame[:-SIGNATURE_LENGTH], frame[-SIGNATURE_LENGTH:]
    expected = hashlib.sha256(key + body + block[:7]).digest()[:6]
    return Signature(block[0], int.from_bytes(block[1:7], "little"), block[7:] == expected)


def cut(data: bytes) -> list[bytes]:
    """Return the frames in bytes, by the lengths in their headers, without the rest."""
    frames = []
    start = 0
    while start + HEADER_LENGTH[MAGIC_V1] <= len(data):
        magic = data[start]
        if magic not in HEADER_LENGTH:
            start += 1
            continue
        end = start + HEADER_LENGTH[magic] + data[start + 1] + CRC_LENGTH
        if magic == MAGIC_V2 and data[start + 2] & SIGNED:
            end += SIGNATURE_LENGTH
        if end <= len(data):
            frames.append(data[start:end])
        start = end
    return frames


AUTOPILOT_OF = {
    Flavour.PX4: mavlink.MAV_AUTOPILOT_PX4,
    Flavour.ARDUPILOT: mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
}
CUSTOM = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def custom_mode(flavour: Flavour, mode: str) -> int:
    """Return HEARTBEAT.custom_mode of a mode; KeyError if the autopilot has no such mode."""
    main, sub = autopilot_notes()[flavour].modes[mode]
    return main if flavour is Flavour.ARDUPILOT else main << 16 | sub << 24


def set_mode_params(flavour: Flavour, mode: str) -> tuple[float, float, float]:
    """Return parameters 1 to 3 of MAV_CMD_DO_SET_MODE."""
    main, sub = autopilot_notes()[flavour].modes[mode]
    return (float(CUSTOM), float(main), float(sub))


POSITION = 0x0DF8
POSITION_YAW = 0x09F8
VELOCITY = 0x0DC7
VELOCITY_YAW_RATE = 0x05C7
POSITION_VELOCITY = 0x0DC0
ACCELERATION = 0x0C3F
NOTHING = 0x0FFF & ~0x0200
FORCE = 0x0200
LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
LOCAL_OFFSET = mavlink.MAV_FRAME_LOCAL_OFFSET_NED
BODY_NED = mavlink.MAV_FRAME_BODY_NED
BODY_OFFSET = mavlink.MAV_FRAME_BODY_OFFSET_NED
METRES_PER_E7 = 0.011132

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class LocalSetpoint:
    """SET_POSITION_TARGET_LOCAL_NED; north, east, down."""

    position_m: Triple = ZERO
    velocity_mps: Triple = ZERO
    acceleration_mps2: Triple = ZERO
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    mask: int = POSITION
    frame: int = LOCAL_NED

    def message(self, target: tuple[int, int]) -> Message:
        """Return the message for an autopilot."""
        motion = (*self.position_m, *self.velocity_mps, *self.acceleration_mps2)
        yaw = (self.yaw_rad, self.yaw_rate_radps)
        return LocalTarget(0, *target, self.frame, self.mask, *motion, *yaw)


@dataclass(frozen=True, slots=True)
class GlobalSetpoint:
    """A SET_POSITION_TARGET_GLOBAL_INT setpoint."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float
    frame: int = mavlink.MAV_FRAME_GLOBAL_INT
    mask: int = POSITION

    def message(self, target: tuple[int, int]) -> Message:
        """Return the message for an autopilot."""
        x, y, z = self.latitude_e7, self.longitude_e7, self.altitude_m
        return GlobalTarget(0, *target, self.frame, self.mask, x, y, z, *[0.0] * 8)


def moved_e7(latitude_e7: int, longitude_e7: int, north_m: float, east_m: float) -> tuple[int, int]:
    """Return a position a few metres away; flat earth."""
    east_scale = METRES_PER_E7 * math.cos(math.radians(latitude_e7 / 1e7))
    return (latitude_e7 + round(north_m / METRES_PER_E7), longitude_e7 + round(east_m / east_scale))


def distance_m(start_e7: tuple[int, int], end_e7: tuple[int, int]) -> float:
    """Return the distance between two positions in m; flat earth."""
    north_m = (end_e7[0] - start_e7[0]) * METRES_PER_E7
    east_m = (end_e7[1] - start_e7[1]) * METRES_PER_E7
    return math.hypot(north_m, east_m * math.cos(math.radians(start_e7[0] / 1e7)))
