"""Take-off, landing, return and reposition; what a vehicle does by itself in a failsafe."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    ACCEPTED,
    COMMAND_INT_ONLY,
    DENIED,
    FAILED,
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
    REFUSALS,
    UNSUPPORTED,
    UNSUPPORTED_FRAME,
)
from sim_link.lab.conformance.protocol_clients import (
    INT32,
    REAL32,
    float_name,
    parameter_set,
    read,
)
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    ASKS,
    CHANGES,
    FLIES,
    PX4_ONLY,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.vehicle_probe import ARM, NAN, VehicleProbe
from sim_link.lab.conformance.vehicle_rules.setpoint_rules import begin

flight_book = RuleBook(Role.VEHICLE, "flights", FLIES)
SERVICE = "MAVLink guide, Command Protocol"
SysState = mavlink.MAVLink_extended_sys_state_message
Position = mavlink.MAVLink_global_position_int_message
STRICT = "(stricter than the real one, which accepts it)"


@flight_book.rule(
    "MAVLink common, MAV_CMD_NAV_TAKEOFF",
    px4="parameter 7 is above sea level",
    ardupilot="parameter 7 is above home; GUIDED first",
)
def takeoff_climbs_to_its_altitude(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF climbs to the altitude it names and stays there."""
    probe.take_off(12.0)
    probe.run(3.0)
    height_m = -probe.place()[2] + probe.home().z
    require(abs(height_m - 12.0) < 1.0, f"{height_m:.1f} m above home")


@flight_book.rule(f"{SERVICE}; {OBSERVED_PX4}", flavours=PX4_ONLY)
def takeoff_without_altitude_uses_the_parameter(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF with NaN for its altitude climbs to MIS_TAKEOFF_ALT."""
    probe.arm()
    before = probe.place()[2]
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_TAKEOFF)
    probe.await_mode("hold", 30.0)
    probe.run(1.0)
    climbed_m = before - probe.place()[2]
    require(1.5 < climbed_m < 11.0, f"climbed {climbed_m:.1f} m")


@flight_book.rule(f"{OBSERVED_ARDUPILOT} {STRICT}", flavours=ARDUPILOT_ONLY)
def takeoff_without_altitude_is_refused(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF with NaN, zero or a negative altitude is refused: it would climb without end."""
    probe.arm()
    for altitude in (NAN, 0.0, -5.0, math.inf):
        probe.require_result(REFUSALS, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude)


@flight_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def takeoff_needs_guided_and_arming(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF fails while disarmed, and in STABILIZE."""
    probe.get_ready()
    params = (0.0,) * 6 + (10.0,)
    probe.require_result(FAILED, mavlink.MAV_CMD_NAV_TAKEOFF, *params)
    probe.set_mode("stabilized")
    probe.command(ARM, 1.0, 0.0)
    probe.require_result(FAILED, mavlink.MAV_CMD_NAV_TAKEOFF, *params)


@flight_book.rule(f"{SERVICE} (commands are idempotent)", ardupilot="FAILED in the air")
def takeoff_in_the_air_is_answered(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF in the air is ACCEPTED and does not bring the vehicle down."""
    probe.take_off()
    down_m = probe.place()[2]
    if probe.is_px4:
        altitude_m = probe.home().altitude / 1e3 + 10.0
        probe.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_TAKEOFF, *[NAN] * 6, altitude_m)
    else:
        probe.require_result(FAILED, mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 10.0)
    probe.run(3.0)
    require(abs(probe.place()[2] - down_m) < 1.5, "it left its height")


@flight_book.rule(f"{SERVICE} (never guess another frame)")
def takeoff_in_a_foreign_frame_is_refused(probe: VehicleProbe) -> None:
    """NAV_TAKEOFF as COMMAND_INT in a frame that is not known for it is refused."""
    probe.arm()
    for frame in (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_NED, 99):
        params, place = (0.0, 0.0, 0.0, NAN), (0, 0, 10.0)
        result = probe.command_int(mavlink.MAV_CMD_NAV_TAKEOFF, frame, params, place)
        wanted = (UNSUPPORTED_FRAME,) if probe.is_px4 else REFUSALS
        require(result in wanted, f"frame {frame}: result {result}")


@flight_book.rule("MAVLink common, MAV_CMD_NAV_LAND; PX4 COM_DISARM_LAND; ArduPilot DISARM_DELAY")
def land_ends_disarmed_on_the_ground(probe: VehicleProbe) -> None:
    """NAV_LAND comes down, tells ON_GROUND and disarms by itself."""
    probe.take_off(5.0)
    probe.watch(SysState, 0.2)
    state = probe.latest(SysState).landed_state
    require(state == mavlink.MAV_LANDED_STATE_IN_AIR, f"landed_state {state} in the air")
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_LAND)
    probe.await_mode("land")
    probe.await_disarmed(40.0)
    probe.run(0.5)
    state = probe.latest(SysState).landed_state
    require(state == mavlink.MAV_LANDED_STATE_ON_GROUND, f"landed_state {state}")


@flight_book.rule(
    "MAVLink common, MAV_CMD_NAV_RETURN_TO_LAUNCH", ardupilot="climbs to RTL_ALT (15 m) first"
)
def return_comes_home_and_lands(probe: VehicleProbe) -> None:
    """NAV_RETURN_TO_LAUNCH lands at home and disarms."""
    probe.take_off(5.0)
    home = probe.home()
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    probe.await_mode("return")
    probe.await_disarmed(120.0)
    north, east, _ = probe.place()
    distance_m = math.dist((north, east), (home.x, home.y))
    require(distance_m < 2.0, f"{distance_m:.1f} m from home")


@flight_book.rule("MAVLink common, MAV_CMD_DO_REPOSITION; MAVSDK action.goto_location")
def reposition_flies_there(probe: VehicleProbe) -> None:
    """DO_REPOSITION as COMMAND_INT in GLOBAL_INT flies to its latitude, longitude and altitude."""
    probe.take_off()
    probe.watch(Position, 0.1)
    here = probe.latest(Position)
    lat, lon, alt_m = here.lat + 2_000, here.lon + 1_000, here.alt / 1e3 + 3.0
    frame = mavlink.MAV_FRAME_GLOBAL_INT if probe.is_px4 else mavlink.MAV_FRAME_GLOBAL
    result = probe.reposition(frame, (lat, lon, alt_m))
    require(result == ACCEPTED, f"result {result}")
    near = probe.run_until(lambda: distance_e7(probe, lat, lon, alt_m) < 1.0, 40.0)
    require(near, f"{distance_e7(probe, lat, lon, alt_m):.1f} m away after 40 s")


def distance_e7(probe: VehicleProbe, lat_e7: int, lon_e7: int, alt_m: float) -> float:
    """Distance of the newest GLOBAL_POSITION_INT from a place, metres; flat earth."""
    here = probe.expect(Position, within_s=3.0)
    north_m = (here.lat - lat_e7) * 0.011132
    east_m = (here.lon - lon_e7) * 0.011132 * math.cos(math.radians(here.lat / 1e7))
    return math.hypot(north_m, east_m, here.alt / 1e3 - alt_m)


@flight_book.rule(f"{OBSERVED_ARDUPILOT} {STRICT}")
def senseless_reposition_is_refused(probe: VehicleProbe) -> None:
    """DO_REPOSITION to no latitude or in a local frame is refused, and nothing moves."""
    probe.take_off()
    before = probe.place()
    cases = {
        "a latitude of 100 degrees": (mavlink.MAV_FRAME_GLOBAL, (1_000_000_000, 85_000_000, 500.0)),
        "local frame": (mavlink.MAV_FRAME_LOCAL_NED, (10, 10, -10.0)),
        "frame 20": (mavlink.MAV_FRAME_LOCAL_FRD, (10, 10, -10.0)),
    }
    if not probe.is_px4:  # PX4 flies to 0/0 as to anywhere
        cases["latitude and longitude 0"] = (mavlink.MAV_FRAME_GLOBAL, (0, 0, 500.0))
    for name, (frame, place) in cases.items():
        result = probe.reposition(frame, place)
        require(result in REFUSALS, f"{name}: result {result}")
    probe.run(3.0)
    require(math.dist(before, probe.place()) < 1.5, "it moved")


@flight_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def reposition_outside_guided_needs_its_flag(probe: VehicleProbe) -> None:
    """Outside GUIDED, DO_REPOSITION without the change-mode flag is DENIED."""
    probe.take_off()
    here = probe.request(Position)
    probe.set_mode("loiter")
    place = (here.lat, here.lon, here.alt / 1e3)
    result = probe.reposition(mavlink.MAV_FRAME_GLOBAL, place, flags=0.0)
    require(result == DENIED, f"result {result}")


LOCATION = f"{SERVICE} (location commands belong in COMMAND_INT); {OBSERVED_ARDUPILOT}"


@flight_book.rule(LOCATION, flavours=ARDUPILOT_ONLY, effect=ASKS)
def reposition_as_long_is_refused(probe: VehicleProbe) -> None:
    """DO_REPOSITION as COMMAND_LONG is refused."""
    params = (-1.0, 1.0, 0.0, NAN, 47.0, 8.0, 500.0)
    wanted = (UNSUPPORTED, COMMAND_INT_ONLY, DENIED, FAILED)
    probe.require_result(wanted, mavlink.MAV_CMD_DO_REPOSITION, *params)


@flight_book.rule("MAVLink common, MAV_CMD_DO_CHANGE_SPEED")
def speed_change_is_accepted_in_flight(probe: VehicleProbe) -> None:
    """DO_CHANGE_SPEED in flight is ACCEPTED."""
    probe.take_off(5.0)
    probe.require_result(ACCEPTED, mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 4.0, -1.0)


@flight_book.rule("MAVLink common, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN")
def reboot_is_refused_while_armed(probe: VehicleProbe) -> None:
    """PREFLIGHT_REBOOT_SHUTDOWN is refused while armed."""
    probe.arm()
    probe.require_result(REFUSALS, mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0, 0.0, 0.0)
    require(probe.is_alive(), "it rebooted")
    require(probe.is_armed(), "it disarmed")


@flight_book.rule("MAVLink common, MAV_CMD_DO_SET_HOME; HOME_POSITION", effect=CHANGES)
def home_can_be_set(probe: VehicleProbe) -> None:
    """DO_SET_HOME to a place near by moves HOME_POSITION there."""
    probe.get_ready()
    home = probe.home()
    lat, lon, alt_m = home.latitude + 500, home.longitude - 500, home.altitude / 1e3
    result = probe.set_home((lat, lon, alt_m))
    require(result == ACCEPTED, f"result {result}")
    moved = probe.home()
    require(abs(moved.latitude - lat) <= 1, f"latitude {moved.latitude}, not {lat}")
    require(abs(moved.longitude - lon) <= 1, f"longitude {moved.longitude}, not {lon}")


@flight_book.rule(f"MAVLink common, MAV_CMD_DO_SET_HOME {STRICT}", effect=CHANGES)
def senseless_home_is_refused(probe: VehicleProbe) -> None:
    """DO_SET_HOME to no latitude is refused and home stays."""
    probe.get_ready()
    before = probe.home()
    result = probe.set_home((1_000_000_000, 0, 488.0))
    require(result in REFUSALS, f"result {result}")
    require(probe.home().latitude == before.latitude, "home moved")


failsafe_book = RuleBook(Role.VEHICLE, "failsafes", FLIES)
PX4_SAFETY = "PX4 user guide, Safety Configuration"
PX4_OFFBOARD = "PX4 user guide, Offboard Mode, COM_OF_LOSS_T"
HOLD_BEFORE_S = 6.0
"""PX4 holds for COM_FAIL_ACT_T, 5 s by default, before it returns."""
CRITICAL = mavlink.MAV_STATE_CRITICAL
OFFBOARD_NUMBER = 6 << 16


@contextmanager
def silence(probe: VehicleProbe) -> Iterator[None]:
    """Our own heartbeat stops for a while."""
    probe.be_silent()
    try:
        yield
    finally:
        probe.be_heard()


@failsafe_book.rule(f"{OBSERVED_ARDUPILOT}, FS_GCS_ENABLE, SYSID_MYGCS", flavours=ARDUPILOT_ONLY)
def lost_ground_station_returns(probe: VehicleProbe) -> None:
    """With FS_GCS_ENABLE, five seconds without the ground station's heartbeat: RTL, CRITICAL."""
    with parameter_set(probe, "FS_GCS_ENABLE", 1.0):
        probe.take_off()
        mark = probe.mark
        with silence(probe):
            probe.run(3.5)
            require(probe.is_in("offboard"), "RTL before 5 s")
            probe.await_mode("return", 5.0)
            beat = probe.heartbeat()
        require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")
        texts = [m.text for m in probe.heard(mavlink.MAVLink_statustext_message, mark)]
        require(any("GCS" in text for text in texts), f"texts {texts}")


@failsafe_book.rule(OBSERVED_ARDUPILOT, flavours=ARDUPILOT_ONLY)
def lost_ground_station_is_nothing_by_default(probe: VehicleProbe) -> None:
    """Without FS_GCS_ENABLE a silent ground station changes nothing."""
    probe.take_off()
    with silence(probe):
        probe.run(9.0)
        require(probe.is_in("offboard"), "it left GUIDED")


@failsafe_book.rule(f"{PX4_SAFETY}, NAV_DLL_ACT, COM_DL_LOSS_T", flavours=PX4_ONLY)
def lost_data_link_returns(probe: VehicleProbe) -> None:
    """With NAV_DLL_ACT 2, COM_DL_LOSS_T without a ground station: Hold for a while, RETURN."""
    with parameter_set(probe, "NAV_DLL_ACT", 2.0), parameter_set(probe, "COM_DL_LOSS_T", 5.0):
        probe.take_off()
        with silence(probe):
            probe.run(3.0)
            require(probe.is_in("hold"), "RETURN before 5 s")
            probe.await_mode("return", 5.0 + HOLD_BEFORE_S)
            beat = probe.heartbeat()
        require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")


@failsafe_book.rule(PX4_OFFBOARD, flavours=PX4_ONLY)
def offboard_loss_time_is_the_parameter(probe: VehicleProbe) -> None:
    """COM_OF_LOSS_T says how long setpoints may be missing."""
    require(read(probe, "COM_OF_LOSS_T").kind == REAL32, "COM_OF_LOSS_T is no float")
    require(read(probe, "COM_OBL_RC_ACT").kind == INT32, "COM_OBL_RC_ACT is no integer")
    with parameter_set(probe, "COM_OF_LOSS_T", 4.0):
        stop = begin(probe)
        stop()
        probe.run(2.5)
        early = probe.request(mavlink.MAVLink_heartbeat_message)
        require(early.custom_mode == OFFBOARD_NUMBER, "lost after 2.5 s")
        probe.run(2.5)
        late = probe.request(mavlink.MAVLink_heartbeat_message)
        require(late.custom_mode != OFFBOARD_NUMBER, "not lost after 5 s")


@failsafe_book.rule(
    "MAVLink common, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN; SYSTEM_TIME", effect=CHANGES
)
def reboot_restarts_the_clock_and_keeps_parameters(probe: VehicleProbe) -> None:
    """Disarmed it reboots on command: time_boot_ms begins anew, changed parameters stay."""
    probe.get_ready()
    name = float_name(probe)
    with parameter_set(probe, name, 4.5):
        probe.run(2.0)
        old_ms = probe.request(mavlink.MAVLink_system_time_message).time_boot_ms
        probe.reboot()
        new_ms = probe.request(mavlink.MAVLink_system_time_message).time_boot_ms
        kept = read(probe, name).value(probe)
    require(new_ms < old_ms, f"time_boot_ms went from {old_ms} to {new_ms}")
    require(kept == 4.5, f"{name} is {kept} after the reboot")
