"""The vehicle's state as MAVLink messages.

Degrees, millimetres, NED and boot milliseconds begin here. Source: MAVLink common; bits and modes
as PX4 1.15 sends them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.domain import FlightMode
from companion.geometry.frames import ned_from_enu
from companion.mav import type_mask
from companion.mav.dialect import Message, mavlink
from companion.mav.modes import CUSTOM_MODE_ENABLED, px4_custom_mode
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.point_mass import GRAVITY_MPS2

MAVLINK_VERSION = 3
PX4_VERSION = 0x010F_02FF
"""1.15.2, official release: the one whose behaviour is simulated."""
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
)
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
AUTO_FLAGS = (
    mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    | mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
)
STICK_FLAGS = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
BASE_MODE_FLAGS: dict[FlightMode, int] = {
    FlightMode.POSITION: STICK_FLAGS,
    FlightMode.ALTITUDE: STICK_FLAGS,
    FlightMode.STABILIZED: STICK_FLAGS,
    FlightMode.MANUAL: mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
    FlightMode.ACRO: mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
}
"""What a mode adds to CUSTOM_MODE_ENABLED; modes not listed are automatic (OFFBOARD apart)."""

ENDURANCE_S = 1200.0
FULL_CELL_MV, EMPTY_CELL_MV, CELLS = 4200, 3500, 4
HOVER_CURRENT_CA = 1800
UINT16_MAX = 0xFFFF
INT16_MAX = 0x7FFF


def _int16(value: float) -> int:
    return round(min(INT16_MAX, max(-INT16_MAX, value)))


def _int32(value: float) -> int:
    return round(min(2**31 - 1, max(-(2**31 - 1), value)))


class Telemetry:
    """Builds messages of one vehicle.

    Args:
        vehicle: Whose state to show.
    """

    def __init__(self, vehicle: SimVehicle) -> None:
        self._vehicle = vehicle
        lat, lon, alt = vehicle.origin.geodetic_from_enu(vehicle.home_enu_m)
        self._home = (_int32(lat * 1e7), _int32(lon * 1e7), _int32(alt * 1e3))
        self._geodetic_at_s = -1.0
        self._geodetic = (0, 0, 0)
        self._builders: dict[int, Callable[[], Message | None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self.heartbeat,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self.sys_status,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: self.system_time,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self.extended_sys_state,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self.local_position_ned,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self.attitude,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self.global_position_int,
            mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: self.position_target_local_ned,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: self.gps_raw_int,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self.battery_status,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: self.home_position,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self.gps_global_origin,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self.autopilot_version,
        }

    def build(self, number: int) -> Message | None:
        """The message with id `number`, or None if it is unknown or has nothing to say now."""
        builder = self._builders.get(number)
        return None if builder is None else builder()

    @property
    def _boot_ms(self) -> int:
        return round(1e3 * self._vehicle.time_s) & 0xFFFF_FFFF

    @property
    def _boot_us(self) -> int:
        return round(1e6 * self._vehicle.time_s)

    def heartbeat(self) -> Message:
        """HEARTBEAT of the autopilot."""
        modes = self._vehicle.modes
        situation = self._vehicle.situation(self._vehicle.time_s)
        base_mode = CUSTOM_MODE_ENABLED
        if modes.mode is FlightMode.OFFBOARD:
            if situation.is_stream_alive or modes.is_armed:
                base_mode |= mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        else:
            base_mode |= BASE_MODE_FLAGS.get(modes.mode, AUTO_FLAGS)
        if modes.is_armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            status = mavlink.MAV_STATE_CRITICAL if modes.is_failsafe else mavlink.MAV_STATE_ACTIVE
        else:
            can_arm = modes.can_arm(situation)
            status = mavlink.MAV_STATE_STANDBY if can_arm else mavlink.MAV_STATE_UNINIT
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4,
            base_mode,
            px4_custom_mode(modes.mode),
            status,
            MAVLINK_VERSION,
        )

    def sys_status(self) -> Message:
        """SYS_STATUS; the prearm bit is healthy while arming would be accepted."""
        modes = self._vehicle.modes
        health = SENSORS
        if modes.is_armed or modes.can_arm(self._vehicle.situation(self._vehicle.time_s)):
            health |= PREARM
        return mavlink.MAVLink_sys_status_message(
            SENSORS | PREARM,
            SENSORS | PREARM,
            health,
            load=250,
            voltage_battery=CELLS * self._cell_mv,
            current_battery=self._current_ca,
            battery_remaining=self._remaining_percent,
            drop_rate_comm=0,
            errors_comm=0,
            errors_count1=0,
            errors_count2=0,
            errors_count3=0,
            errors_count4=0,
        )

    def system_time(self) -> Message:
        """SYSTEM_TIME; the Unix time stays 0 (unknown), so that a run depends on its seed only."""
        return mavlink.MAVLink_system_time_message(0, self._boot_ms)

    def extended_sys_state(self) -> Message:
        """EXTENDED_SYS_STATE."""
        return mavlink.MAVLink_extended_sys_state_message(
            mavlink.MAV_VTOL_STATE_UNDEFINED, self._vehicle.landed_state.value
        )

    def local_position_ned(self) -> Message:
        """LOCAL_POSITION_NED about the EKF origin."""
        north, east, down = ned_from_enu(self._vehicle.reported_enu_m)
        v_north, v_east, v_down = ned_from_enu(self._vehicle.body.velocity_enu_mps)
        return mavlink.MAVLink_local_position_ned_message(
            self._boot_ms, north, east, down, v_north, v_east, v_down
        )

    def attitude(self) -> Message:
        """ATTITUDE: the tilt that the present acceleration needs."""
        body = self._vehicle.body
        east, north, _ = body.acceleration_enu_mps2
        cos_yaw, sin_yaw = math.cos(body.yaw_ned_rad), math.sin(body.yaw_ned_rad)
        forward = north * cos_yaw + east * sin_yaw
        right = east * cos_yaw - north * sin_yaw
        return mavlink.MAVLink_attitude_message(
            self._boot_ms,
            math.atan2(right, GRAVITY_MPS2),
            -math.atan2(forward, GRAVITY_MPS2),
            body.yaw_ned_rad,
            0.0,
            0.0,
            0.0,
        )

    def global_position_int(self) -> Message:
        """GLOBAL_POSITION_INT."""
        lat, lon, alt = self._place()
        v_north, v_east, v_down = ned_from_enu(self._vehicle.body.velocity_enu_mps)
        return mavlink.MAVLink_global_position_int_message(
            self._boot_ms,
            lat,
            lon,
            alt,
            _int32(alt - 1e3 * self._vehicle.home_altitude_m),
            _int16(1e2 * v_north),
            _int16(1e2 * v_east),
            _int16(1e2 * v_down),
            round(math.degrees(self._vehicle.body.yaw_ned_rad) * 1e2) % 36000,
        )

    def gps_raw_int(self) -> Message:
        """GPS_RAW_INT with a good 3-D fix."""
        lat, lon, alt = self._place()
        v_east, v_north, _ = self._vehicle.body.velocity_enu_mps
        course_cdeg = round(math.degrees(math.atan2(v_east, v_north)) * 1e2) % 36000
        return mavlink.MAVLink_gps_raw_int_message(
            self._boot_us,
            mavlink.GPS_FIX_TYPE_3D_FIX,
            lat,
            lon,
            alt,
            eph=90,
            epv=120,
            vel=_int16(1e2 * math.hypot(v_east, v_north)),
            cog=course_cdeg,
            satellites_visible=14,
        )

    def battery_status(self) -> Message:
        """BATTERY_STATUS: a four-cell pack that only flying empties."""
        voltages = [self._cell_mv] * CELLS + [UINT16_MAX] * (10 - CELLS)
        return mavlink.MAVLink_battery_status_message(
            0,
            mavlink.MAV_BATTERY_FUNCTION_ALL,
            mavlink.MAV_BATTERY_TYPE_LIPO,
            INT16_MAX,
            voltages,
            self._current_ca,
            -1,
            -1,
            self._remaining_percent,
        )

    def home_position(self) -> Message:
        """HOME_POSITION."""
        north, east, down = ned_from_enu(self._vehicle.home_enu_m)
        lat, lon, alt = self._home
        return mavlink.MAVLink_home_position_message(
            lat,
            lon,
            alt,
            north,
            east,
            down,
            [1.0, 0.0, 0.0, 0.0],
            0.0,
            0.0,
            0.0,
            self._boot_us,
        )

    def gps_global_origin(self) -> Message:
        """GPS_GLOBAL_ORIGIN: the zero of LOCAL_POSITION_NED."""
        origin = self._vehicle.origin
        return mavlink.MAVLink_gps_global_origin_message(
            _int32(origin.latitude_deg * 1e7),
            _int32(origin.longitude_deg * 1e7),
            _int32(origin.altitude_m * 1e3),
            self._boot_us,
        )

    def position_target_local_ned(self) -> Message | None:
        """POSITION_TARGET_LOCAL_NED: the setpoint that is flown, in OFFBOARD only."""
        if self._vehicle.modes.mode is not FlightMode.OFFBOARD:
            return None
        setpoint = self._vehicle.offboard.setpoint
        mask = type_mask.ACCELERATION_IGNORE
        mask |= 0 if setpoint.position_en_m else type_mask.X_IGNORE | type_mask.Y_IGNORE
        mask |= 0 if setpoint.up_m is not None else type_mask.Z_IGNORE
        mask |= 0 if setpoint.velocity_en_mps else type_mask.VX_IGNORE | type_mask.VY_IGNORE
        mask |= 0 if setpoint.climb_mps is not None else type_mask.VZ_IGNORE
        mask |= 0 if setpoint.yaw_ned_rad is not None else type_mask.YAW_IGNORE
        mask |= 0 if setpoint.yaw_rate_ned_radps is not None else type_mask.YAW_RATE_IGNORE
        east, north = setpoint.position_en_m or (0.0, 0.0)
        v_east, v_north = setpoint.velocity_en_mps or (0.0, 0.0)
        return mavlink.MAVLink_position_target_local_ned_message(
            self._boot_ms,
            mavlink.MAV_FRAME_LOCAL_NED,
            mask,
            north,
            east,
            -(setpoint.up_m or 0.0),
            v_north,
            v_east,
            -(setpoint.climb_mps or 0.0),
            0.0,
            0.0,
            0.0,
            setpoint.yaw_ned_rad or 0.0,
            setpoint.yaw_rate_ned_radps or 0.0,
        )

    def autopilot_version(self) -> Message:
        """AUTOPILOT_VERSION."""
        return mavlink.MAVLink_autopilot_version_message(
            CAPABILITIES,
            PX4_VERSION,
            PX4_VERSION,
            0,
            0,
            [0] * 8,
            [0] * 8,
            [0] * 8,
            0,
            0,
            self._vehicle.scenario.system_id,
        )

    def _place(self) -> tuple[int, int, int]:
        """Latitude and longitude in 1e-7 degrees and altitude in millimetres, once per step."""
        if self._geodetic_at_s != self._vehicle.time_s:
            lat, lon, alt = self._vehicle.origin.geodetic_from_enu(self._vehicle.reported_enu_m)
            self._geodetic = (_int32(lat * 1e7), _int32(lon * 1e7), _int32(alt * 1e3))
            self._geodetic_at_s = self._vehicle.time_s
        return self._geodetic

    @property
    def _remaining_percent(self) -> int:
        return max(0, round(100.0 * (1.0 - self._vehicle.flight_time_s / ENDURANCE_S)))

    @property
    def _cell_mv(self) -> int:
        share = self._remaining_percent / 100.0
        return round(EMPTY_CELL_MV + share * (FULL_CELL_MV - EMPTY_CELL_MV))

    @property
    def _current_ca(self) -> int:
        return 50 if self._vehicle.body.is_on_ground else HOVER_CURRENT_CA
