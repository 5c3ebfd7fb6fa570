"""The vehicle's state as MAVLink messages, by message id."""

from __future__ import annotations

from collections.abc import Callable

from companion.mav.dialect import Message, mavlink
from companion.mav.ekf_status_report import MAVLink_ekf_status_report_message
from sim_link.autopilot import motion_messages as motion
from sim_link.autopilot import sensor_messages as sensors
from sim_link.autopilot import status_messages as status
from sim_link.autopilot.vehicle import SimVehicle

Builder = Callable[[SimVehicle], Message | None]

BUILDERS: dict[int, Builder] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: status.heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: status.sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: status.system_time,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: status.extended_sys_state,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: motion.local_position_ned,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: motion.attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: motion.attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: motion.odometry,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: motion.global_position_int,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: motion.altitude,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: motion.vfr_hud,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: motion.nav_controller_output,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: motion.position_target_local_ned,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: motion.position_target_global_int,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: sensors.attitude_target,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: sensors.highres_imu,
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: sensors.servo_output_raw,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: sensors.raw_imu,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: sensors.scaled_pressure,
    mavlink.MAVLINK_MSG_ID_POWER_STATUS: sensors.power_status,
    mavlink.MAVLINK_MSG_ID_VIBRATION: sensors.vibration,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: sensors.distance_sensor,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: motion.gps_raw_int,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: status.battery_status,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: status.home_position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: status.gps_global_origin,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: status.autopilot_version,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: status.current_mission,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: status.estimator_status,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: status.rc_channels,
    MAVLink_ekf_status_report_message.id: status.ekf_status_report,
}
"""What can be told; a flavour's rates say which of these it has."""


class Telemetry:
    """Builds messages of one vehicle.

    Args:
        vehicle: Whose state to show.
    """

    def __init__(self, vehicle: SimVehicle) -> None:
        self._vehicle = vehicle

    def build(self, number: int) -> Message | None:
        """The message with id `number`, or None if it is unknown or has nothing to say now."""
        builder = BUILDERS.get(number)
        if builder is None or number not in self._vehicle.flavour.rules.streams.default_rates_hz:
            return None
        return builder(self._vehicle)
