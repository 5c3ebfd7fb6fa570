"""Streams, their rates, and what telemetry says."""

from __future__ import annotations

import math
from collections import Counter

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.mavlink_oracle import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    CHANGES,
    FLIES,
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    Violation,
    require,
)
from sim_link.lab.conformance.station import brief
from sim_link.lab.conformance.vehicle_probe import ACCEPTED, ARM, PREARM, VehicleProbe

stream_book = RuleBook(Role.VEHICLE, "streams")
DATA_STREAM = f"MAVLink common, REQUEST_DATA_STREAM; {OBSERVED_ARDUPILOT}"
INTERVALS = "MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL"
NEEDED_HZ = {
    "HEARTBEAT": 1.0,
    "SYS_STATUS": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "SYSTEM_TIME": 1.0,
    "ATTITUDE": 10.0,
    "ATTITUDE_QUATERNION": 5.0,
    "LOCAL_POSITION_NED": 10.0,
    "GLOBAL_POSITION_INT": 10.0,
    "GPS_RAW_INT": 1.0,
    "VFR_HUD": 1.0,
    "BATTERY_STATUS": 0.5,
    "HOME_POSITION": 0.5,
    "MISSION_CURRENT": 1.0,
}
"""What clients stand on, at least this often."""
UNASKED_ON_ARDUPILOT = {"HEARTBEAT", "TIMESYNC", "STATUSTEXT", "COMMAND_ACK"}
LISTEN_S = 10.0
RATE_TOLERANCE = 0.05
Attitude = mavlink.MAVLink_attitude_message
Local = mavlink.MAVLink_local_position_ned_message
EXTRA_MESSAGES: tuple[type[Message], ...] = (
    mavlink.MAVLink_altitude_message,
    mavlink.MAVLink_odometry_message,
    mavlink.MAVLink_estimator_status_message,
)


def rates_hz(probe: VehicleProbe, duration_s: float = LISTEN_S) -> Counter[str]:
    """Messages of the vehicle per name over a while."""
    mark = probe.mark
    probe.run(duration_s)
    return Counter(e.message.get_type() for e in probe.inbox[mark:] if e.source == probe.target)


def require_rate(counts: Counter[str], wanted_hz: float, slack_hz: float, *names: str) -> None:
    """Every one of the messages must have come at a rate."""
    for name in names:
        rate_hz = counts[name] / LISTEN_S
        require(abs(rate_hz - wanted_hz) <= slack_hz, f"{name}: {rate_hz:.2f} Hz")


@stream_book.rule("PX4 1.15, observed in SITL; MAVSDK telemetry_impl.cpp", flavours=PX4_ONLY)
def default_streams_flow(probe: VehicleProbe) -> None:
    """Unasked, what clients stand on flows at its least rate."""
    probe.await_prearm()
    counts = rates_hz(probe)
    for name, rate_hz in NEEDED_HZ.items():
        least = rate_hz * LISTEN_S * (1.0 - RATE_TOLERANCE) - 1.0
        require(counts[name] >= least, f"{name}: {counts[name] / LISTEN_S:.1f} Hz")


@stream_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def nothing_flows_until_asked(probe: VehicleProbe) -> None:
    """By default HEARTBEAT and TIMESYNC flow, and nothing else until it is asked for."""
    probe.run(2.0)
    for number in {e.message.get_msgId() for e in probe.inbox if e.source == probe.target}:
        probe.set_interval(number, 0.0)  # what an earlier client asked for goes back to default
    counts = rates_hz(probe)
    extra = set(counts) - UNASKED_ON_ARDUPILOT
    if extra and max(counts[name] for name in extra) > 3:
        raise Violation(f"unasked: {', '.join(sorted(extra))}")


@stream_book.rule(DATA_STREAM, flavours=ARDUPILOT_ONLY)
def data_streams_can_be_asked_for(probe: VehicleProbe) -> None:
    """REQUEST_DATA_STREAM (0, 4 Hz) starts all groups, and 0 stops them."""
    probe.get_ready()
    send_data_stream(probe, 0, 4)
    probe.run(1.0)
    counts = rates_hz(probe)
    require_rate(counts, 4.0, 0.25, "ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT")
    send_data_stream(probe, 0, 0)
    probe.run(1.0)
    counts = rates_hz(probe, 3.0)
    require(counts["ATTITUDE"] == 0, "ATTITUDE still flows")


@stream_book.rule(DATA_STREAM, flavours=ARDUPILOT_ONLY)
def position_group_is_its_own(probe: VehicleProbe) -> None:
    """REQUEST_DATA_STREAM (6, 10 Hz) starts the positions at 10 Hz."""
    probe.get_ready()
    probe.set_interval(int(Local.id), 0.0)
    send_data_stream(probe, 6, 10)
    probe.run(1.0)
    counts = rates_hz(probe)
    send_data_stream(probe, 6, 0)
    require_rate(counts, 10.0, 0.5, "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")


def send_data_stream(probe: VehicleProbe, group: int, rate_hz: int) -> None:
    """REQUEST_DATA_STREAM of a group; 0 Hz stops it."""
    start = int(rate_hz > 0)
    probe.send(mavlink.MAVLink_request_data_stream_message(*probe.target, group, rate_hz, start))


@stream_book.rule(INTERVALS)
def asked_rate_is_kept(probe: VehicleProbe) -> None:
    """ATTITUDE at 50, 20, 10, 4 and 1 Hz keeps its rate within 5 %."""
    for rate_hz in (50.0, 20.0, 10.0, 4.0, 1.0):
        result = probe.set_interval(int(Attitude.id), 1.0 / rate_hz)
        require(result == ACCEPTED, f"{rate_hz:g} Hz: result {result}")
        probe.run(0.5)
        measured_hz = rates_hz(probe)["ATTITUDE"] / LISTEN_S
        slack_hz = RATE_TOLERANCE * rate_hz + 1.0 / LISTEN_S
        require(abs(measured_hz - rate_hz) <= slack_hz, f"{rate_hz:g} Hz: {measured_hz:.1f} Hz")
    probe.set_interval(int(Attitude.id), 0.0)


@stream_book.rule(INTERVALS)
def stream_can_be_stopped_and_restored(probe: VehicleProbe) -> None:
    """Interval -1 stops a stream and 0 restores its default."""
    default_hz = rates_hz(probe, 5.0)["ATTITUDE"] / 5.0
    probe.set_interval(int(Attitude.id), 0.1)
    require(rates_hz(probe, 2.0)["ATTITUDE"] > 10, "it does not flow")
    probe.set_interval(int(Attitude.id), -1.0)
    require(rates_hz(probe, 2.0)["ATTITUDE"] == 0, "it flows after -1")
    probe.set_interval(int(Attitude.id), 0.0)
    restored_hz = rates_hz(probe, 5.0)["ATTITUDE"] / 5.0
    slack_hz = 0.1 * default_hz + 0.3
    require(abs(restored_hz - default_hz) <= slack_hz, f"{restored_hz:.1f} Hz after 0")


@stream_book.rule(
    "MAVLink common, ALTITUDE, ODOMETRY, ESTIMATOR_STATUS; " + OBSERVED_PX4, flavours=PX4_ONLY
)
def further_messages_come_on_request(probe: VehicleProbe) -> None:
    """ALTITUDE, ODOMETRY and ESTIMATOR_STATUS come when they are asked for."""
    probe.get_ready()
    for kind in EXTRA_MESSAGES:
        probe.request(kind)


@stream_book.rule("ArduPilot EKF_STATUS_REPORT; MAVLink ardupilotmega", flavours=ARDUPILOT_ONLY)
def ekf_status_comes_on_request(probe: VehicleProbe) -> None:
    """EKF_STATUS_REPORT (193) comes when it is asked for."""
    probe.get_ready()
    mark = len(probe.datagrams)
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_REQUEST_MESSAGE, 193.0)
    probe.run(0.5)
    ids = {data[7] | data[8] << 8 | data[9] << 16 for data in probe.frames_since(mark)}
    require(193 in ids, "it did not come")


telemetry_book = RuleBook(Role.VEHICLE, "telemetry")
COMMON = "MAVLink common"
SetOrigin = mavlink.MAVLink_set_gps_global_origin_message
Home = mavlink.MAVLink_home_position_message
Global = mavlink.MAVLink_global_position_int_message


@telemetry_book.rule(f"{COMMON}, MAV_SYS_STATUS_SENSOR; MAVSDK health")
def sensor_bits_are_told(probe: VehicleProbe) -> None:
    """SYS_STATUS shows gyro, accelerometer, magnetometer, barometer, GPS and battery as healthy."""
    probe.get_ready()
    status = probe.latest(mavlink.MAVLink_sys_status_message)
    needed = 1 | 2 | 4 | 8 | 32 | 0x2000000 | PREARM
    for name in ("present", "health"):
        bits = getattr(status, f"onboard_control_sensors_{name}")
        require(bits & needed == needed, f"{name} {bits:#x} lacks {needed & ~bits:#x}")


@telemetry_book.rule(f"{COMMON}, SYS_STATUS, BATTERY_STATUS")
def battery_makes_sense(probe: VehicleProbe) -> None:
    """The battery has a voltage of some cells and 0 to 100 % left, or says that it is unknown."""
    status = probe.request(mavlink.MAVLink_sys_status_message)
    millivolts, percent = status.voltage_battery, status.battery_remaining
    require(millivolts == 65_535 or 2_500 < millivolts < 60_000, f"{millivolts} mV")
    require(-1 <= percent <= 100, f"{percent} %")


@telemetry_book.rule(f"{COMMON}, MAV_LANDED_STATE")
def landed_state_on_the_ground(probe: VehicleProbe) -> None:
    """On the ground EXTENDED_SYS_STATE says ON_GROUND."""
    probe.require_disarmed()
    probe.get_ready()
    state = probe.request(mavlink.MAVLink_extended_sys_state_message)
    require(state.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND, brief(state))


@telemetry_book.rule(f"{COMMON}, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, GPS_GLOBAL_ORIGIN")
def local_and_global_position_agree(probe: VehicleProbe) -> None:
    """LOCAL_POSITION_NED about GPS_GLOBAL_ORIGIN is GLOBAL_POSITION_INT."""
    probe.get_ready()
    origin = probe.origin()
    probe.watch(Global, 0.1)
    report = probe.latest(Global)
    near = probe.expect(Local)
    north_m = (report.lat - origin.latitude) * 0.0111320
    east_m = (report.lon - origin.longitude) * 0.0111320
    east_m *= math.cos(math.radians(report.lat / 1e7))
    down_m = (origin.altitude - report.alt) / 1e3
    off_m = math.dist((north_m, east_m, down_m), (near.x, near.y, near.z))
    require(off_m < 2.0, f"{off_m:.1f} m apart")


@telemetry_book.rule(f"{COMMON}, GLOBAL_POSITION_INT, HOME_POSITION")
def relative_altitude_is_above_home(probe: VehicleProbe) -> None:
    """relative_alt is the altitude above home's."""
    probe.get_ready()
    home = probe.home()
    report = probe.request(Global)
    off_mm = report.relative_alt - (report.alt - home.altitude)
    require(abs(off_mm) < 1_500, f"off by {off_mm} mm")


@telemetry_book.rule(f"{COMMON}, GLOBAL_POSITION_INT (65535: unknown)")
def heading_is_in_range(probe: VehicleProbe) -> None:
    """The field hdg is 0 to 35999 or unknown, and agrees with ATTITUDE.yaw."""
    probe.get_ready()
    report = probe.request(Global)
    attitude = probe.request(Attitude)
    require(report.hdg <= 35_999 or report.hdg == 65_535, f"hdg {report.hdg}")
    if report.hdg != 65_535:
        off = math.remainder(math.radians(report.hdg / 100.0) - attitude.yaw, math.tau)
        require(abs(off) < 0.1, f"hdg {report.hdg / 100:.1f}, yaw {attitude.yaw:.2f} rad")


@telemetry_book.rule(f"{COMMON}, ATTITUDE, ATTITUDE_QUATERNION")
def quaternion_and_angles_agree(probe: VehicleProbe) -> None:
    """ATTITUDE_QUATERNION has length 1 and ATTITUDE's yaw."""
    probe.get_ready()
    q = probe.request(mavlink.MAVLink_attitude_quaternion_message)
    attitude = probe.request(Attitude)
    length = math.hypot(q.q1, q.q2, q.q3, q.q4)
    require(abs(length - 1.0) < 0.01, f"length {length:.3f}")
    yaw = math.atan2(2.0 * (q.q1 * q.q4 + q.q2 * q.q3), 1.0 - 2.0 * (q.q3**2 + q.q4**2))
    off = math.remainder(yaw - attitude.yaw, math.tau)
    require(abs(off) < 0.1, f"yaw {yaw:.2f}, not {attitude.yaw:.2f} rad")


@telemetry_book.rule(f"{COMMON} (NaN only where a field says so)")
def positions_are_finite(probe: VehicleProbe) -> None:
    """Position, velocity and attitude are finite numbers."""
    probe.get_ready()
    for kind in (Local, Attitude, mavlink.MAVLink_vfr_hud_message):
        message = probe.request(kind)
        for name in message.get_fieldnames():
            value = getattr(message, name)
            require(math.isfinite(value), f"{message.get_type()}.{name} is {value}")


@telemetry_book.rule(f"{COMMON}, LOCAL_POSITION_NED.time_boot_ms")
def boot_time_goes_with_the_clock(probe: VehicleProbe) -> None:
    """time_boot_ms rises with time and is one clock for all messages."""
    probe.get_ready()
    first = probe.request(Attitude).time_boot_ms
    started_s = probe.now_s
    probe.run(3.0)
    elapsed_ms = probe.request(Attitude).time_boot_ms - first
    require(abs(elapsed_ms - 1e3 * (probe.now_s - started_s)) < 300, f"{elapsed_ms} ms in 3 s")
    other = probe.request(Global).time_boot_ms - probe.request(Attitude).time_boot_ms
    require(abs(other) < 500, f"two clocks, {other} ms apart")


@telemetry_book.rule(f"{COMMON}, SYSTEM_TIME")
def system_time_tells_the_boot_time(probe: VehicleProbe) -> None:
    """SYSTEM_TIME.time_boot_ms is the same clock."""
    time_ms = probe.request(mavlink.MAVLink_system_time_message).time_boot_ms
    other_ms = probe.request(Attitude).time_boot_ms
    require(abs(time_ms - other_ms) < 1_200, f"{time_ms} and {other_ms} ms")


@telemetry_book.rule(
    f"{COMMON}, AUTOPILOT_VERSION, MAV_PROTOCOL_CAPABILITY",
    ardupilot="ArduCopter 4.5 sets neither encoding bit",
)
def capabilities_are_told(probe: VehicleProbe) -> None:
    """AUTOPILOT_VERSION tells missions, COMMAND_INT, both setpoints, fences and one encoding."""
    told = probe.request(mavlink.MAVLink_autopilot_version_message).capabilities
    needed = {"MISSION_INT": 4, "COMMAND_INT": 8, "LOCAL_NED": 128, "GLOBAL_INT": 256}
    needed |= {"MAVLINK2": 8192, "MISSION_FENCE": 16384}
    for name, bit in needed.items():
        require(bool(told & bit), f"{name} is missing in {told:#x}")
    bytewise, c_cast = bool(told & 16), bool(told & 131_072)
    if probe.is_px4:
        require(bytewise and not c_cast, f"PX4 encodes bytewise, told {told:#x}")
    else:
        require(not bytewise, f"ArduPilot encodes by C-cast, told {told:#x}")


@telemetry_book.rule(f"{COMMON}, GPS_GLOBAL_ORIGIN, HOME_POSITION")
def origin_and_home_come_on_request(probe: VehicleProbe) -> None:
    """GPS_GLOBAL_ORIGIN and HOME_POSITION come when they are asked for."""
    probe.get_ready()
    for place in (probe.origin(), probe.home()):
        on_earth = 0 < abs(place.latitude) <= 900_000_000
        require(on_earth, brief(place))


@telemetry_book.rule(
    f"{COMMON}, SET_GPS_GLOBAL_ORIGIN; MAVSDK waits for exactly these numbers",
    effect=CHANGES,
    ardupilot="ArduCopter keeps its first origin",
)
def origin_can_be_set(probe: VehicleProbe) -> None:
    """SET_GPS_GLOBAL_ORIGIN is answered by GPS_GLOBAL_ORIGIN with exactly its numbers."""
    probe.get_ready()
    before = probe.origin()
    kept = (before.latitude, before.longitude, before.altitude)
    wanted = (before.latitude + 17, before.longitude - 13, before.altitude + 11)
    mark = probe.mark
    probe.send(SetOrigin(probe.target[0], *wanted))
    if not probe.is_px4:
        probe.run(0.5)
        after = probe.origin()
        require((after.latitude, after.longitude, after.altitude) == kept, "the origin moved")
        return
    answer = probe.expect(mavlink.MAVLink_gps_global_origin_message, mark=mark)
    told = (answer.latitude, answer.longitude, answer.altitude)
    require(told == wanted, f"{told}, not {wanted}")
    probe.send(SetOrigin(probe.target[0], *kept))
    probe.run(0.2)


def require_home_told(probe: VehicleProbe, home: Home, latitude: int) -> None:
    """Home moved to a latitude must be told by itself."""
    mark = probe.mark
    result = probe.set_home((latitude, home.longitude, home.altitude / 1e3))
    require(result == ACCEPTED, f"DO_SET_HOME gave result {result}")
    probe.expect(Home, lambda m: abs(m.latitude - latitude) < 10, mark=mark)


@telemetry_book.rule(f"{COMMON}, HOME_POSITION (sent when it changes)", effect=CHANGES)
def moved_home_is_told_unasked(probe: VehicleProbe) -> None:
    """After DO_SET_HOME a HOME_POSITION with the new place comes by itself."""
    probe.get_ready()
    home = probe.home()
    probe.set_interval(mavlink.MAVLINK_MSG_ID_HOME_POSITION, -1.0)
    require_home_told(probe, home, home.latitude + 450)
    require_home_told(probe, home, home.latitude)
    probe.set_interval(mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0.0)


@telemetry_book.rule("MAVLink guide, Routing", effect=CHANGES)
def origin_for_another_system_is_ignored(probe: VehicleProbe) -> None:
    """SET_GPS_GLOBAL_ORIGIN for another system changes nothing."""
    probe.get_ready()
    before = probe.origin()
    probe.send(SetOrigin(77, 100_000_000, 0, 0))
    probe.run(0.5)
    require(probe.origin().latitude == before.latitude, "the origin moved")


@telemetry_book.rule(f"{COMMON}, STATUSTEXT (chunks)", effect=FLIES)
def texts_are_well_formed(probe: VehicleProbe) -> None:
    """A text is one message with id 0, or chunks 0, 1, ... of one id that end short."""
    probe.command(ARM, 1.0, 0.0)
    probe.set_mode("land")
    probe.command(ARM, 1.0, 0.0)
    probe.run(2.0)
    texts = probe.from_vehicle(mavlink.MAVLink_statustext_message)
    if not texts:
        raise NotApplicable("it says nothing")
    expected: dict[int, int] = {}
    for text in texts:
        require(text.severity <= 7, f"severity {text.severity}")
        if text.id == 0:
            require(text.chunk_seq == 0, f"chunk {text.chunk_seq} of a single text")
            continue
        number = expected.get(text.id, 0)
        require(text.chunk_seq == number, f"chunk {text.chunk_seq} where {number} was due")
        expected[text.id] = number + 1


@telemetry_book.rule(f"{COMMON}, EXTENDED_SYS_STATE", effect=FLIES)
def landed_state_in_the_air(probe: VehicleProbe) -> None:
    """In the air EXTENDED_SYS_STATE says IN_AIR."""
    probe.take_off(5.0)
    state = probe.request(mavlink.MAVLink_extended_sys_state_message)
    require(state.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR, brief(state))


@telemetry_book.rule(f"{COMMON}, SYS_STATUS", effect=FLIES)
def flying_drains_the_battery(probe: VehicleProbe) -> None:
    """Flying for a while leaves less in the battery."""
    before = probe.request(mavlink.MAVLink_battery_status_message)
    if before.battery_remaining < 0:
        raise NotApplicable("the battery is unknown")
    probe.take_off(5.0)
    probe.run(45.0)
    after = probe.request(mavlink.MAVLink_battery_status_message)
    drawn = before.battery_remaining > after.battery_remaining
    drawn = drawn or after.current_consumed > max(0, before.current_consumed)
    require(drawn, f"{before.battery_remaining} %, then {after.battery_remaining} %")
