"""Streams, their rates and their contents."""

from __future__ import annotations

import math
from collections import Counter

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.rules import ARDUPILOT, CHANGES, FLIES, PX4, RuleBook, assume, require
from sim_link.lab.conformance.station import brief
from sim_link.lab.conformance.vehicle_probe import VehicleProbe

DATA_STREAM = f"MAVLink common, REQUEST_DATA_STREAM; {mav.OBSERVED_ARDUPILOT}"
INTERVALS = "MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL"
COMMON = "MAVLink common"
UNASKED_ON_ARDUPILOT = {"HEARTBEAT", "TIMESYNC", "STATUSTEXT", "COMMAND_ACK"}
CAPABILITIES = {
    "MISSION_INT": 4,
    "COMMAND_INT": 8,
    "LOCAL_NED": 128,
    "GLOBAL_INT": 256,
    "MAVLINK2": 8192,
    "MISSION_FENCE": 16384,
}
LISTEN_S = 10.0
RATE_TOLERANCE = 0.05


class StreamRules(VehicleProbe):
    """Streams of a vehicle, and their rates."""

    book = RuleBook("streams")

    def _rates(self, duration_s: float = LISTEN_S) -> Counter[str]:
        heard = self.listen(duration_s)
        return Counter(e.message.get_type() for e in heard if e.source == self.target)

    def _attitude_hz(self, duration_s: float) -> float:
        return self._rates(duration_s)["ATTITUDE"] / duration_s

    def _request_data_stream(self, group: int, rate_hz: int) -> None:
        """REQUEST_DATA_STREAM of a group; 0 Hz stops it."""
        request = mavlink.MAVLink_request_data_stream_message
        self.send(request(*self.target, group, rate_hz, int(rate_hz > 0)))

    def _require_rates(self, wanted_hz: float, slack_hz: float, *names: str) -> None:
        """Require that each of the messages soon arrives at a rate."""
        self.run(1.0)
        counts = self._rates()
        for name in names:
            rate_hz = counts[name] / LISTEN_S
            require(abs(rate_hz - wanted_hz) <= slack_hz, f"{name}: {rate_hz:.2f} Hz")

    @book.rule("PX4 1.15, observed in SITL; MAVSDK telemetry_impl.cpp", flavours=PX4)
    def default_streams_flow(self) -> None:
        """Streams that clients rely on arrive unrequested, at their minimum rate or faster."""
        self.await_prearm()
        counts = self._rates()
        for name, rate_hz in self.notes.rates_hz.items():
            least = rate_hz * LISTEN_S * (1.0 - RATE_TOLERANCE) - 1.0
            require(counts[name] >= least, f"{name}: {counts[name] / LISTEN_S:.1f} Hz")

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def nothing_flows_until_asked(self) -> None:
        """By default only HEARTBEAT and TIMESYNC are streamed, others once requested."""
        self.run(2.0)
        for number in {e.message.get_msgId() for e in self.inbox if e.source == self.target}:
            self.set_interval(number, 0.0)  # restores what an earlier client requested
        counts = self._rates()
        extra = set(counts) - UNASKED_ON_ARDUPILOT
        most = max((counts[name] for name in extra), default=0)
        require(most <= 3, f"unasked: {', '.join(sorted(extra))}")

    @book.rule(DATA_STREAM, flavours=ARDUPILOT)
    def data_streams_can_be_asked_for(self) -> None:
        """REQUEST_DATA_STREAM (0, 4 Hz) starts all groups, and 0 stops them."""
        self.get_ready()
        self._request_data_stream(0, 4)
        names = ("ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT")
        self._require_rates(4.0, 0.25, *names)
        self._request_data_stream(0, 0)
        self.run(1.0)
        require(self._attitude_hz(3.0) == 0.0, "ATTITUDE still flows")

    @book.rule(DATA_STREAM, flavours=ARDUPILOT)
    def position_group_is_its_own(self) -> None:
        """REQUEST_DATA_STREAM (6, 10 Hz) starts the positions at 10 Hz."""
        self.get_ready()
        self.set_interval(mav.LocalPosition, 0.0)
        self._request_data_stream(6, 10)
        self._require_rates(10.0, 0.5, "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")
        self._request_data_stream(6, 0)

    @book.rule(INTERVALS)
    def asked_rate_is_kept(self) -> None:
        """ATTITUDE at 50, 20, 10, 4 and 1 Hz keeps its rate within 5 %."""
        for rate_hz in (50.0, 20.0, 10.0, 4.0, 1.0):
            result = self.set_interval(mav.Attitude, 1.0 / rate_hz)
            require(result == mav.ACCEPTED, f"{rate_hz:g} Hz: result {result}")
            self.run(0.5)
            measured_hz = self._attitude_hz(LISTEN_S)
            slack_hz = RATE_TOLERANCE * rate_hz + 1.0 / LISTEN_S
            require(abs(measured_hz - rate_hz) <= slack_hz, f"{rate_hz:g} Hz: {measured_hz:.1f} Hz")

    @book.rule(INTERVALS)
    def stream_can_be_stopped_and_restored(self) -> None:
        """Interval -1 stops a stream and 0 restores its default."""
        self.set_interval(mav.Attitude, 0.0)  # a start script may have set another rate
        default_hz = self._attitude_hz(5.0)
        self.set_interval(mav.Attitude, 0.1)
        require(self._attitude_hz(2.0) > 5.0, "it does not flow")
        self.set_interval(mav.Attitude, -1.0)
        require(self._attitude_hz(2.0) == 0.0, "it flows after -1")
        self.set_interval(mav.Attitude, 0.0)
        restored_hz = self._attitude_hz(5.0)
        slack_hz = 0.1 * default_hz + 0.3
        require(abs(restored_hz - default_hz) <= slack_hz, f"{restored_hz:.1f} Hz after 0")

    @book.rule(f"{COMMON}, ALTITUDE, ODOMETRY, ESTIMATOR_STATUS; {mav.OBSERVED_PX4}", flavours=PX4)
    def further_messages_come_on_request(self) -> None:
        """ALTITUDE, ODOMETRY and ESTIMATOR_STATUS are sent on request."""
        self.get_ready()
        self.request(mavlink.MAVLink_altitude_message)
        self.request(mavlink.MAVLink_odometry_message)
        self.request(mavlink.MAVLink_estimator_status_message)

    @book.rule("ArduPilot EKF_STATUS_REPORT; MAVLink ardupilotmega", flavours=ARDUPILOT)
    def ekf_status_comes_on_request(self) -> None:
        """EKF_STATUS_REPORT (193) is sent on request."""
        self.get_ready()
        mark = len(self.datagrams)
        self.require_result(mav.ACCEPTED, mav.REQUEST, 193.0)
        self.run(0.5)
        ids = {data[7] | data[8] << 8 | data[9] << 16 for data in self.frames_since(mark)}
        require(193 in ids, "it did not come")


class TelemetryRules(VehicleProbe):
    """Content of telemetry."""

    book = RuleBook("telemetry", begin=VehicleProbe.get_ready)

    @book.rule(f"{COMMON}, MAV_SYS_STATUS_SENSOR; MAVSDK health")
    def sensor_bits_are_reported(self) -> None:
        """SYS_STATUS shows gyro, accelerometer, compass, barometer, GPS and battery as healthy."""
        status = self.latest(mav.SysStatus)
        needed = 1 | 2 | 4 | 8 | 32 | 0x2000000 | mav.PREARM
        for name in ("present", "health"):
            bits = getattr(status, f"onboard_control_sensors_{name}")
            require(bits & needed == needed, f"{name} {bits:#x} lacks {needed & ~bits:#x}")

    @book.rule(f"{COMMON}, SYS_STATUS, BATTERY_STATUS")
    def battery_makes_sense(self) -> None:
        """The battery has a voltage of some cells and 0 to 100 % left, or reports it as unknown."""
        self.watch(mav.SysStatus, 0.5)
        status = self.latest(mav.SysStatus)
        millivolts, percent = status.voltage_battery, status.battery_remaining
        require(millivolts == 65_535 or 2_500 < millivolts < 60_000, f"{millivolts} mV")
        require(-1 <= percent <= 100, f"{percent} %")

    @book.rule(f"{COMMON}, MAV_LANDED_STATE")
    def landed_state_on_the_ground(self) -> None:
        """On the ground EXTENDED_SYS_STATE reports ON_GROUND."""
        self.require_disarmed()
        state = self.request(mav.SysState)
        require(state.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND, brief(state))

    @book.rule(f"{COMMON}, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, GPS_GLOBAL_ORIGIN")
    def local_and_global_position_agree(self) -> None:
        """LOCAL_POSITION_NED about GPS_GLOBAL_ORIGIN is GLOBAL_POSITION_INT."""
        origin = self.request(mav.Origin)
        self.watch(mav.GlobalPosition, 0.1)
        report = self.latest(mav.GlobalPosition)
        near = self.expect(mav.LocalPosition)
        north_m = (report.lat - origin.latitude) * mav.METRES_PER_E7
        east_m = (report.lon - origin.longitude) * mav.METRES_PER_E7
        east_m *= math.cos(math.radians(report.lat / 1e7))
        down_m = (origin.altitude - report.alt) / 1e3
        off_m = math.dist((north_m, east_m, down_m), (near.x, near.y, near.z))
        require(off_m < 2.0, f"{off_m:.1f} m apart")

    @book.rule(f"{COMMON}, GLOBAL_POSITION_INT, HOME_POSITION")
    def relative_altitude_is_above_home(self) -> None:
        """relative_alt is the altitude above home's."""
        home = self.home()
        report = self.request(mav.GlobalPosition)
        off_mm = report.relative_alt - (report.alt - home.altitude)
        require(abs(off_mm) < 1_500, f"off by {off_mm} mm")

    @book.rule(f"{COMMON}, GLOBAL_POSITION_INT (65535: unknown)")
    def heading_is_in_range(self) -> None:
        """The field hdg is 0 to 35999 or unknown, and agrees with ATTITUDE.yaw."""
        heading, yaw = self.request(mav.GlobalPosition).hdg, self.request(mav.Attitude).yaw
        require(heading <= 35_999 or heading == 65_535, f"hdg {heading}")
        if heading != 65_535:
            off = math.remainder(math.radians(heading / 100.0) - yaw, math.tau)
            require(abs(off) < 0.1, f"hdg {heading / 100:.1f}, yaw {yaw:.2f} rad")

    @book.rule(f"{COMMON}, ATTITUDE, ATTITUDE_QUATERNION")
    def quaternion_and_angles_agree(self) -> None:
        """ATTITUDE_QUATERNION has length 1 and ATTITUDE's yaw."""
        q = self.request(mavlink.MAVLink_attitude_quaternion_message)
        wanted = self.request(mav.Attitude).yaw
        length = math.hypot(q.q1, q.q2, q.q3, q.q4)
        require(abs(length - 1.0) < 0.01, f"length {length:.3f}")
        yaw = math.atan2(2.0 * (q.q1 * q.q4 + q.q2 * q.q3), 1.0 - 2.0 * (q.q3**2 + q.q4**2))
        off = math.remainder(yaw - wanted, math.tau)
        require(abs(off) < 0.1, f"yaw {yaw:.2f}, not {wanted:.2f} rad")

    @book.rule(f"{COMMON} (NaN only where a field says so)")
    def positions_are_finite(self) -> None:
        """Position, velocity and attitude are finite numbers."""
        for kind in (mav.LocalPosition, mav.Attitude, mavlink.MAVLink_vfr_hud_message):
            message = self.request(kind)
            for name in message.get_fieldnames():
                value = getattr(message, name)
                require(math.isfinite(value), f"{message.get_type()}.{name} is {value}")

    @book.rule(f"{COMMON}, LOCAL_POSITION_NED.time_boot_ms")
    def boot_time_goes_with_the_clock(self) -> None:
        """time_boot_ms rises with time and is one clock for all messages."""
        first = self.request(mav.Attitude).time_boot_ms
        started_s = self.now_s
        self.run(3.0)
        elapsed_ms = self.request(mav.Attitude).time_boot_ms - first
        require(abs(elapsed_ms - 1e3 * (self.now_s - started_s)) < 300, f"{elapsed_ms} ms in 3 s")
        other = (
            self.request(mav.GlobalPosition).time_boot_ms - self.request(mav.Attitude).time_boot_ms
        )
        require(abs(other) < 500, f"two clocks, {other} ms apart")

    @book.rule(f"{COMMON}, SYSTEM_TIME")
    def system_time_reports_the_boot_time(self) -> None:
        """SYSTEM_TIME.time_boot_ms is the same clock."""
        time_ms = self.request(mav.SystemTime).time_boot_ms
        other_ms = self.request(mav.Attitude).time_boot_ms
        require(abs(time_ms - other_ms) < 1_200, f"{time_ms} and {other_ms} ms")

    @book.rule(f"{COMMON}, AUTOPILOT_VERSION, MAV_PROTOCOL_CAPABILITY")
    def capabilities_are_reported(self) -> None:
        """AUTOPILOT_VERSION reports missions, COMMAND_INT, setpoints, fences and one encoding."""
        reported = self.request(mav.Version).capabilities
        for name, bit in CAPABILITIES.items():
            require(bool(reported & bit), f"{name} is missing in {reported:#x}")
        bytewise, c_cast = bool(reported & 16), bool(reported & 131_072)
        if self.is_px4:
            require(bytewise and not c_cast, f"PX4 encodes bytewise, reported {reported:#x}")
        else:
            require(not bytewise, f"ArduPilot encodes by C-cast, reported {reported:#x}")

    @book.rule(f"{COMMON}, GPS_GLOBAL_ORIGIN, HOME_POSITION")
    def origin_and_home_come_on_request(self) -> None:
        """GPS_GLOBAL_ORIGIN and HOME_POSITION are sent on request."""
        for point in (self.request(mav.Origin), self.home()):
            require(0 < abs(point.latitude) <= 900_000_000, brief(point))

    @book.rule(
        f"{COMMON}, SET_GPS_GLOBAL_ORIGIN; MAVSDK waits for exactly these numbers", effect=CHANGES
    )
    def origin_can_be_set(self) -> None:
        """SET_GPS_GLOBAL_ORIGIN is answered by GPS_GLOBAL_ORIGIN with exactly its numbers."""
        before = self.request(mav.Origin)
        kept = (before.latitude, before.longitude, before.altitude)
        wanted = (before.latitude + 17, before.longitude - 13, before.altitude + 11)
        self.send(mav.SetOrigin(self.target[0], *wanted))
        if not self.is_px4:
            self.run(0.5)
            after = self.request(mav.Origin)
            require((after.latitude, after.longitude, after.altitude) == kept, "the origin moved")
            return
        answer = self.expect(mav.Origin, mark=self.asked)
        position = (answer.latitude, answer.longitude, answer.altitude)
        require(position == wanted, f"{position}, not {wanted}")
        self.send(mav.SetOrigin(self.target[0], *kept))
        self.run(0.2)

    @book.rule(f"{COMMON}, HOME_POSITION (sent when it changes)", effect=CHANGES)
    def moved_home_is_sent_unasked(self) -> None:
        """After DO_SET_HOME a HOME_POSITION with the new position is sent without a request."""
        home = self.home()
        self.set_interval(mav.HomePosition, -1.0)
        for latitude in (home.latitude + 450, home.latitude):
            result = self.set_home((latitude, home.longitude, home.altitude / 1e3))
            require(result == mav.ACCEPTED, f"DO_SET_HOME gave result {result}")
            self._expect_home_at(latitude)

    def _expect_home_at(self, latitude: int) -> None:
        self.expect(mav.HomePosition, lambda m: abs(m.latitude - latitude) < 10, mark=self.asked)

    @book.rule("MAVLink guide, Routing", effect=CHANGES)
    def origin_for_another_system_is_ignored(self) -> None:
        """SET_GPS_GLOBAL_ORIGIN for another system changes nothing."""
        before = self.request(mav.Origin)
        self.send(mav.SetOrigin(77, 100_000_000, 0, 0))
        self.run(0.5)
        require(self.request(mav.Origin).latitude == before.latitude, "the origin moved")

    @book.rule(f"{COMMON}, EXTENDED_SYS_STATE", effect=FLIES)
    def landed_state_in_the_air(self) -> None:
        """In the air EXTENDED_SYS_STATE reports IN_AIR."""
        self.take_off(5.0)
        state = self.request(mav.SysState)
        require(state.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR, brief(state))

    @book.rule(f"{COMMON}, SYS_STATUS", effect=FLIES)
    def flying_drains_the_battery(self) -> None:
        """Flying for a while leaves less in the battery."""
        before = self.request(mav.Battery)
        assume(before.battery_remaining >= 0, "the battery is unknown")
        self.take_off(5.0)
        self.run(45.0)
        after = self.request(mav.Battery)
        drawn = before.battery_remaining > after.battery_remaining
        drawn = drawn or after.current_consumed > max(0, before.current_consumed)
        require(drawn, f"{before.battery_remaining} %, then {after.battery_remaining} %")
