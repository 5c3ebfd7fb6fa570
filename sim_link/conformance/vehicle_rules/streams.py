"""Streams and messages that the vehicle must have, their rates and what they say."""

from __future__ import annotations

from collections import Counter

from companion.mav.dialect import Message, mavlink
from sim_link.conformance.rules import (
    ARDUPILOT_ONLY,
    PX4_ONLY,
    Role,
    RuleBook,
    Violation,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT, OBSERVED_PX4
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_station import ACCEPTED

book = RuleBook(Role.VEHICLE, "streams")
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
    return Counter(
        entry.message.get_type() for entry in probe.inbox[mark:] if entry.source == probe.target
    )


@book.rule("PX4 1.15, observed in SITL; MAVSDK telemetry_impl.cpp", flavours=PX4_ONLY)
def default_streams_flow(probe: VehicleProbe) -> None:
    """Unasked, what clients stand on flows at its least rate."""
    probe.await_prearm()
    counts = rates_hz(probe)
    for name, rate_hz in NEEDED_HZ.items():
        least = rate_hz * LISTEN_S * (1.0 - RATE_TOLERANCE) - 1.0
        require(counts[name] >= least, f"{name}: {counts[name] / LISTEN_S:.1f} Hz")


@book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def nothing_flows_until_asked(probe: VehicleProbe) -> None:
    """By default HEARTBEAT and TIMESYNC flow, and nothing else until it is asked for."""
    probe.run(2.0)
    for number in {e.message.get_msgId() for e in probe.inbox if e.source == probe.target}:
        probe.set_interval(number, 0.0)  # what an earlier client asked for goes back to default
    counts = rates_hz(probe)
    extra = set(counts) - UNASKED_ON_ARDUPILOT
    if extra and max(counts[name] for name in extra) > 3:
        raise Violation(f"unasked: {', '.join(sorted(extra))}")


@book.rule("MAVLink common, REQUEST_DATA_STREAM; " + OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def data_streams_can_be_asked_for(probe: VehicleProbe) -> None:
    """REQUEST_DATA_STREAM (0, 4 Hz) starts all groups, and 0 stops them."""
    probe.get_ready()
    send_data_stream(probe, 0, 4, start=True)
    probe.run(1.0)
    counts = rates_hz(probe)
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT"):
        rate_hz = counts[name] / LISTEN_S
        require(abs(rate_hz - 4.0) <= 0.25, f"{name}: {rate_hz:.2f} Hz")
    send_data_stream(probe, 0, 0, start=False)
    probe.run(1.0)
    counts = rates_hz(probe, 3.0)
    require(counts["ATTITUDE"] == 0, "ATTITUDE still flows")


@book.rule("MAVLink common, REQUEST_DATA_STREAM; " + OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def position_group_is_its_own(probe: VehicleProbe) -> None:
    """REQUEST_DATA_STREAM (6, 10 Hz) starts the positions at 10 Hz."""
    probe.get_ready()
    probe.set_interval(int(Local.id), 0.0)
    send_data_stream(probe, mavlink.MAV_DATA_STREAM_POSITION, 10, start=True)
    probe.run(1.0)
    counts = rates_hz(probe)
    send_data_stream(probe, mavlink.MAV_DATA_STREAM_POSITION, 0, start=False)
    for name in ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"):
        rate_hz = counts[name] / LISTEN_S
        require(abs(rate_hz - 10.0) <= 0.5, f"{name}: {rate_hz:.2f} Hz")


def send_data_stream(probe: VehicleProbe, group: int, rate_hz: int, *, start: bool) -> None:
    """REQUEST_DATA_STREAM of a group."""
    probe.send(
        mavlink.MAVLink_request_data_stream_message(*probe.target, group, rate_hz, int(start))
    )


@book.rule(INTERVALS)
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


@book.rule(INTERVALS)
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


@book.rule(
    "MAVLink common, ALTITUDE, ODOMETRY, ESTIMATOR_STATUS; " + OBSERVED_PX4, flavours=PX4_ONLY
)
def further_messages_come_on_request(probe: VehicleProbe) -> None:
    """ALTITUDE, ODOMETRY and ESTIMATOR_STATUS come when they are asked for."""
    probe.get_ready()
    for kind in EXTRA_MESSAGES:
        probe.request(kind)


@book.rule("ArduPilot EKF_STATUS_REPORT; MAVLink ardupilotmega", flavours=ARDUPILOT_ONLY)
def ekf_status_comes_on_request(probe: VehicleProbe) -> None:
    """EKF_STATUS_REPORT (193) comes when it is asked for."""
    probe.get_ready()
    mark = len(probe.datagrams)
    result = probe.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 193.0)
    require(result == ACCEPTED, f"result {result}")
    probe.run(0.5)
    ids = {data[7] | data[8] << 8 | data[9] << 16 for data in probe.frames_since(mark)}
    require(193 in ids, "it did not come")
