"""Conversion of the autopilot's messages to events: NED to ENU, stamps to local time.

Theory of operation of modes beyond a firmware's table. All ArduPilot vehicles reserve number 30,
OFFBOARD, for an external controller's mode. None has it by itself; a script may register it, and
the vehicle then lists it in AVAILABLE_MODES and flies it as GUIDED. So the list is requested when
an autopilot is bound, again when AVAILABLE_MODES_MONITOR announces a change, and when a mode
appears that the list did not have. A vehicle that is found in mode 30 has to leave it once:
otherwise the answer alone would be taken as a mode switch.

Source: MAVLink common, messages 0, 1, 30, 32, 33, 49, 85, 242, 245, AVAILABLE_MODES and "Standard
Flight Modes" protocol; ArduPilot #28939, #28110; ArduCopter 4.5 answers FAILED.
"""

from __future__ import annotations

import math
from dataclasses import replace

from companion.domain import Autopilot, FlightMode, LandedState, VehicleState
from companion.geometry.coordinates import LocalOrigin, enu_from_ned
from companion.guidance.events import (
    AutopilotClockSlipped,
    AutopilotRestarted,
    Event,
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    OriginSet,
    VehicleMoved,
    YawMeasured,
)
from companion.guidance.vehicle import ORIGIN_STEP_M
from companion.link.conversion.clock_sync import ClockSync
from companion.link.conversion.geodesy_fit import GeodesyFit
from companion.link.conversion.health_reports import HealthReports
from companion.link.conversion.sender_clock import ClockStep, VehicleClock
from companion.link.outbound import Ids, VehicleCommand
from companion.mav.codec import HEADER_LENGTH
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import (
    OFFBOARD_NUMBER,
    autopilot_of,
    class_of,
    mode_of,
    other_mode_name,
)

FIRST_RETRY_S = 1.0
MAX_REQUESTS = 4
"""Requests with growing intervals; an autopilot without the message rejects each."""
ALL_MODES = 0.0
"""Second parameter of the request."""


class OfferedModes:
    """Query for the modes that one autopilot offers."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Start again, because the autopilot restarted or was replaced."""
        self.understands_offboard = False
        """True if mode 30 obeys setpoints, and was offered before it was selected."""
        self._is_offered = False
        self._list_number: int | None = None
        self._ask_again()

    def _ask_again(self) -> None:
        self._heard: set[int] = set()
        self._is_complete = False
        self._asks, self._next_s = 0, -math.inf

    def due(self, now_s: float, autopilot: Autopilot, target: Ids) -> Message | None:
        """Return the request to send now, if any; an incomplete list is requested again."""
        is_over = self._is_complete or self._asks >= MAX_REQUESTS
        if autopilot is not Autopilot.ARDUPILOT or is_over or now_s < self._next_s:
            return None
        self._next_s = now_s + FIRST_RETRY_S * 2**self._asks
        self._asks += 1
        params = (float(mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES), ALL_MODES)
        return VehicleCommand(mavlink.MAV_CMD_REQUEST_MESSAGE, params).message(target)

    def receive(self, message: Message) -> None:
        """Process a message of the autopilot."""
        match message:
            case mavlink.MAVLink_heartbeat_message():
                if message.custom_mode != OFFBOARD_NUMBER:
                    self.understands_offboard = self._is_offered
                elif not self._is_offered and self._is_complete:
                    self._ask_again()
            case mavlink.MAVLink_available_modes_message():
                self._heard.add(message.mode_index)
                self._is_complete = len(self._heard) >= message.number_modes
                self._is_offered |= message.custom_mode == OFFBOARD_NUMBER
            case mavlink.MAVLink_available_modes_monitor_message():
                if message.seq != self._list_number:
                    self._list_number = message.seq
                    self._is_offered = False
                    self._ask_again()


PREARM_BIT = mavlink.MAV_SYS_STATUS_PREARM_CHECK
FENCE_BIT = mavlink.MAV_SYS_STATUS_GEOFENCE
"""Enabled and not healthy: a breach, a failsafe that ArduPilot's HEARTBEAT does not show."""
FAILSAFE_STATES = (
    mavlink.MAV_STATE_CRITICAL,
    mavlink.MAV_STATE_EMERGENCY,
    mavlink.MAV_STATE_FLIGHT_TERMINATION,
)
ENDED_STATES = (mavlink.MAV_STATE_FLIGHT_TERMINATION, mavlink.MAV_STATE_POWEROFF)
STAMPED = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_COMMAND_ACK,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT,
    }
)
"""Kinds that are not ordered by their sequence numbers: stamped ones, and those without order."""
TIMESYNC, NO_TIME = mavlink.MAVLINK_MSG_ID_TIMESYNC, bytes(8)
UP_STATES = (mavlink.MAV_STATE_STANDBY, mavlink.MAV_STATE_ACTIVE)
MAX_HOME_DISTANCE_M = 1e5
"""Largest plausible distance of home from the origin."""
MAX_ALTITUDE_MM = 100_000_000
"""Largest plausible altitude of an origin above sea level; INT32_MAX is a placeholder."""
FRAME_SETTLES_S = 1.0
"""Time after which no position of the previous frame is in flight."""
MAX_YAW_RAD = 2.0 * math.pi
"""Largest accepted yaw: a whole turn, twice that of the definition of ATTITUDE."""


UNREAD = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_ACTUATOR_CONTROL_TARGET,
        mavlink.MAVLINK_MSG_ID_ALTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
        mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR,
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_ODOMETRY,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
        mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
        mavlink.MAVLINK_MSG_ID_VIBRATION,
    }
)
"""Streams that autopilots send by themselves and that are not used, two thirds of PX4's onboard
link: they are logged and show that the autopilot is alive, but are not decoded."""


class VehicleInbound:
    """Converter of the bound autopilot's messages; `sync` has its clock, `modes` its modes."""

    def __init__(self, sync: ClockSync | None = None, modes: OfferedModes | None = None) -> None:
        self.clock = VehicleClock(sync or ClockSync())
        self._modes = modes or OfferedModes()
        self.overtaken = 0
        """Messages that arrived after a newer one of their kind."""
        self._autopilot = Autopilot.OTHER
        self._restart(0.0)

    def begin_again(self, now_s: float) -> AutopilotRestarted:
        """Forget the previous autopilot, because another one was bound."""
        self.clock.restart()
        return replace(self._restart(now_s), is_other=True)

    def _restart(self, now_s: float) -> AutopilotRestarted:
        self._origin: LocalOrigin | None = None
        self._geodesy: GeodesyFit | None = None
        self._home: mavlink.MAVLink_home_position_message | None = None
        self._is_prearm_good = True
        self._is_fence_breached = False
        self._newest: dict[int, int] = {}
        """Sending order of the newest message of each kind."""
        self._frame: LocalOrigin | None = None
        """Origin of the current frame, shifted with every local position."""
        self._frame_begun: tuple[int, float] | None = None
        """Sending order and time of the report with which that frame began."""
        self._health = HealthReports()
        return AutopilotRestarted(now_s)

    def events(self, message: Message, now_s: float, number: int = 0) -> list[Event]:
        """Return the events of a message; none if a newer one of its kind has arrived.

        Positions and attitudes are ordered by their stamps in their buffers; but a position that
        was sent before the origin moved is in another frame. `number` is a message's position in
        the order of sending, from the sequence numbers.
        """
        if self._note_order(message, number, now_s):
            self.overtaken += 1
            return []
        match message:
            case mavlink.MAVLink_heartbeat_message():
                return self._heartbeat(message, now_s, number)
            case mavlink.MAVLink_local_position_ned_message() | mavlink.MAVLink_attitude_message():
                return self._stamped(message, now_s, number)
            case mavlink.MAVLink_extended_sys_state_message():
                return [
                    LandedStateChanged(now_s, _landed_state(message.landed_state), order=number)
                ]
            case mavlink.MAVLink_sys_status_message():
                present = message.onboard_control_sensors_present & PREARM_BIT
                health = message.onboard_control_sensors_health & PREARM_BIT
                self._is_prearm_good = not present or bool(health)
                enabled = message.onboard_control_sensors_enabled & FENCE_BIT
                self._is_fence_breached = bool(enabled & ~message.onboard_control_sensors_health)
            case mavlink.MAVLink_global_position_int_message():
                return self._compare_positions(message, now_s)
            case mavlink.MAVLink_gps_global_origin_message():
                return self._take_origin(message, now_s, number)
            case mavlink.MAVLink_home_position_message():
                self._home = message
                return self._home_events(now_s)
            case mavlink.MAVLink_timesync_message() if self.clock.sync.take_restart():
                self.clock.restart()
                return [self._restart(now_s)]
        return list(self._health.events(message, now_s))

    def _note_order(self, message: Message, number: int, now_s: float) -> bool:
        """Note a message's position in the order; return True if it is too old to be used.

        After a long delay a sequence number may be ambiguous. So a HEARTBEAT is withheld only if it
        shows what could give us control, never if it takes control away.
        """
        kind = message.get_msgId()
        begun = self._frame_begun
        if kind == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED and begun is not None:
            return number < begun[0] and now_s - begun[1] <= FRAME_SETTLES_S
        if kind in STAMPED:
            return False
        if number >= self._newest.get(kind, number):
            self._newest[kind] = number
            return False
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            autopilot = autopilot_of(message)
            is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            is_offboard = (
                autopilot is not None and self._mode_of(message, autopilot) is FlightMode.OFFBOARD
            )
            return is_armed and is_offboard
        return True

    def _stamped(
        self,
        message: mavlink.MAVLink_local_position_ned_message | mavlink.MAVLink_attitude_message,
        now_s: float,
        number: int,
    ) -> list[Event]:
        """Return a position or an attitude at its own time; a stamp can also reveal a restart."""
        event: Event
        fitted: list[Event] = []
        if isinstance(message, mavlink.MAVLink_attitude_message):
            if not abs(message.yaw) <= MAX_YAW_RAD:
                return []
            reading = self.clock.read(message.time_boot_ms / 1000.0, now_s)
            tilt = (message.roll, message.pitch)
            has_tilt = abs(message.roll) <= MAX_YAW_RAD and abs(message.pitch) <= MAX_YAW_RAD
            event = YawMeasured(
                now_s, reading.time_s, message.yaw, tilt if has_tilt else None, order=number
            )
        else:
            reading = self.clock.read(message.time_boot_ms / 1000.0, now_s)
            position_enu_m = enu_from_ned((message.x, message.y, message.z))
            velocity_enu_mps = enu_from_ned((message.vx, message.vy, message.vz))
            state = VehicleState(reading.time_s, position_enu_m, velocity_enu_mps)
            event = VehicleMoved(now_s, state, order=number)
            fitted = self._compare_positions(message, now_s)
        if self.clock.is_too_fast:
            return fitted
        if reading.step is ClockStep.RESTART:
            return [self._restart(now_s), event]
        if reading.step is ClockStep.SLIP:
            return [AutopilotClockSlipped(now_s), event, *fitted]
        return [event, *fitted]

    def _mode_of(
        self, heartbeat: mavlink.MAVLink_heartbeat_message, autopilot: Autopilot
    ) -> FlightMode:
        return mode_of(heartbeat, autopilot, offers_offboard=self._modes.understands_offboard)

    def _heartbeat(
        self, message: mavlink.MAVLink_heartbeat_message, now_s: float, order: int | None
    ) -> list[Event]:
        autopilot = autopilot_of(message)
        if autopilot is None:
            return []
        self._autopilot = autopilot
        status = message.system_status
        is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        is_up = status in UP_STATES
        mode = self._mode_of(message, autopilot)
        is_other = mode is FlightMode.UNKNOWN or message.custom_mode == OFFBOARD_NUMBER
        event = HeartbeatReceived(
            time_s=now_s,
            autopilot=autopilot,
            mode=mode,
            is_armed=is_armed,
            is_ready=is_armed or (is_up and self._is_prearm_good),
            is_failsafe=status in FAILSAFE_STATES or self._is_fence_breached,
            is_terminated=status in ENDED_STATES,
            other_mode=other_mode_name(message, autopilot) if is_other else "",
            order=order,
            vehicle_class=class_of(message),
        )
        return [event]

    def _take_origin(
        self, message: mavlink.MAVLink_gps_global_origin_message, now_s: float, number: int
    ) -> list[Event]:
        origin = origin_of(message, self._autopilot)
        if origin is None:
            return []
        # an origin that drifts does not move the frame
        frame = self._frame or origin
        if math.hypot(*frame.zero_of(origin)) > ORIGIN_STEP_M:
            frame, self._frame_begun = origin, (number, now_s)
        self._frame = frame
        if self._geodesy is None or self._geodesy.reported != origin:
            self._geodesy = GeodesyFit(origin)
        return self._origin_events(self._geodesy, now_s)

    def _origin_events(self, geodesy: GeodesyFit, now_s: float) -> list[Event]:
        self._origin = geodesy.origin
        is_fitted = self._origin != geodesy.reported
        off_m = geodesy.off_m if is_fitted else 0.0
        return [OriginSet(now_s, self._origin, off_m), *self._home_events(now_s)]

    def _compare_positions(
        self,
        message: mavlink.MAVLink_local_position_ned_message
        | mavlink.MAVLink_global_position_int_message,
        now_s: float,
    ) -> list[Event]:
        """Compare local and global positions; return another origin if they disagree."""
        geodesy, stamp_s = self._geodesy, message.time_boot_ms / 1000.0
        if geodesy is None:
            return []
        if isinstance(message, mavlink.MAVLink_local_position_ned_message):
            is_new = geodesy.note_local(stamp_s, enu_from_ned((message.x, message.y, message.z)))
        elif _is_on_earth(message.lat, message.lon):
            geodetic = (message.lat / 1e7, message.lon / 1e7, message.alt / 1000.0)
            is_new = geodesy.note_global(stamp_s, geodetic)
        else:
            return []
        return self._origin_events(geodesy, now_s) if is_new else []

    def _home_events(self, now_s: float) -> list[Event]:
        """Return home in the local frame: x, y, z until the origin is known, then latitude."""
        home = self._home
        if home is None:
            return []
        if self._origin is None:
            local = enu_from_ned((home.x, home.y, home.z))
        elif _is_on_earth(home.latitude, home.longitude):
            local = self._origin.enu_from_geodetic(
                home.latitude / 1e7, home.longitude / 1e7, home.altitude / 1000.0
            )
        else:
            return []
        is_near = all(abs(v) <= MAX_HOME_DISTANCE_M for v in local)
        return [HomeSet(now_s, local)] if is_near else []


def origin_of(
    message: mavlink.MAVLink_gps_global_origin_message, autopilot: Autopilot
) -> LocalOrigin | None:
    """Return the origin of an autopilot's local frame; None if the sender does not know it."""
    is_somewhere = _is_on_earth(message.latitude, message.longitude)
    if not is_somewhere or abs(message.altitude) > MAX_ALTITUDE_MM:
        return None
    geodetic = (message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0)
    return LocalOrigin(*geodetic, autopilot.projection)


def _is_on_earth(latitude_e7: int, longitude_e7: int) -> bool:
    """Return True if 1e-7 degrees are a position; 0/0 and INT32_MAX mean unknown."""
    is_set = latitude_e7 != 0 or longitude_e7 != 0
    return is_set and abs(latitude_e7) <= 900_000_000 and abs(longitude_e7) <= 1_800_000_000


def _landed_state(value: int) -> LandedState:
    try:
        return LandedState(value)
    except ValueError:
        return LandedState.UNKNOWN


def is_time_request(frame: bytes) -> bool:
    """Return True if a TIMESYNC asks for the time (PX4: ten times a second): its `tc1` is 0."""
    at = HEADER_LENGTH[frame[0]]
    return frame[at : at + 8] == NO_TIME
