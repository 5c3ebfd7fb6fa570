"""Setpoints: what both autopilots do with them. PX4's OFFBOARD and ArduPilot's GUIDED."""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    ACCELERATION,
    BODY_NED,
    FORCE,
    NOTHING,
    POSITION_VELOCITY,
    POSITION_YAW,
    VELOCITY,
    VELOCITY_YAW_RATE,
    GlobalSetpoint,
    LocalSetpoint,
    Triple,
    moved_e7,
)
from sim_link.lab.conformance.rules import FLIES, Role, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import NAN, VehicleProbe, nothing_moved

book = RuleBook(Role.VEHICLE, "offboard", FLIES)
PX4_PAGE = "PX4 user guide, Offboard Mode"
COMMON = "MAVLink common, SET_POSITION_TARGET_LOCAL_NED"
GLOBAL = "MAVLink common, SET_POSITION_TARGET_GLOBAL_INT"
OBSERVED = "PX4 1.15, observed in SITL"
BOTH_OBSERVED = "PX4 1.15 and ArduCopter 4.5, observed in SITL"
LOCAL = f"{COMMON}; {BOTH_OBSERVED}"


def here(probe: VehicleProbe) -> LocalSetpoint:
    """A setpoint where the vehicle is."""
    return LocalSetpoint(probe.place())


def begin(probe: VehicleProbe) -> Callable[[], None]:
    """Take off and follow a streamed setpoint where the vehicle is; ends the stream."""
    probe.take_off()
    setpoint = here(probe)
    stop = probe.enter_offboard(lambda: setpoint.message(probe.target))
    probe.run(1.0)
    return stop


def fly(
    probe: VehicleProbe,
    setpoint: LocalSetpoint | GlobalSetpoint,
    duration_s: float,
    target: tuple[int, int] | None = None,
) -> None:
    """Stream one setpoint for a while, to the vehicle or to another target."""
    stop = probe.stream(lambda: setpoint.message(target or probe.target))
    probe.run(duration_s)
    stop()


def measure_speed(probe: VehicleProbe, setpoint: LocalSetpoint) -> Triple:
    """Stream one setpoint for 4 s; the velocity then, while it still flows."""
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(4.0)
    speed = probe.speed()
    stop()
    return speed


def follow(probe: VehicleProbe, setpoint: LocalSetpoint, duration_s: float) -> None:
    """Stream one setpoint for a while, and until HEARTBEAT shows that it is followed."""
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(duration_s)
    probe.await_mode("offboard", 3.0)
    stop()


def require_place(probe: VehicleProbe, wanted: Triple, what: str) -> None:
    """The vehicle must be at a place, to half a metre and what is left of the wind."""
    off_m = math.dist(probe.place(), wanted)
    require(off_m < 1.0, f"{what}: {off_m:.1f} m off")


@book.rule(LOCAL)
def position_is_flown(probe: VehicleProbe) -> None:
    """A position setpoint in LOCAL_NED is flown to."""
    begin(probe)()
    north, east, down = probe.place()
    wanted = (north + 8.0, east - 6.0, down - 4.0)
    fly(probe, LocalSetpoint(wanted), 12.0)
    require_place(probe, wanted, "local position")


@book.rule(LOCAL)
def velocity_is_flown(probe: VehicleProbe) -> None:
    """A velocity setpoint is flown: north, east and down."""
    begin(probe)()
    for wanted in ((2.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, -1.0)):
        speed = measure_speed(probe, LocalSetpoint(velocity_mps=wanted, mask=VELOCITY))
        off_mps = math.dist(speed, wanted)
        require(off_mps < 0.5, f"{wanted}: off by {off_mps:.1f} m/s")


@book.rule(LOCAL)
def position_with_velocity_is_flown(probe: VehicleProbe) -> None:
    """Position and velocity together are accepted, and the vehicle nears the position."""
    begin(probe)()
    north, east, down = probe.place()
    wanted = (north + 10.0, east, down)
    fly(probe, LocalSetpoint(wanted, (0.5, 0.0, 0.0), mask=POSITION_VELOCITY), 12.0)
    require(math.dist(probe.place(), wanted) < 3.0, "it did not get near")


@book.rule(LOCAL)
def acceleration_is_flown(probe: VehicleProbe) -> None:
    """An acceleration setpoint makes the vehicle faster that way."""
    begin(probe)()
    fly(probe, LocalSetpoint(acceleration_mps2=(1.0, 0.0, 0.0), mask=ACCELERATION), 2.0)
    require(probe.speed()[0] > 0.5, f"{probe.speed()[0]:.1f} m/s north after 2 s")


@book.rule(f"{COMMON} (yaw: 0 is north, clockwise)")
def yaw_is_flown(probe: VehicleProbe) -> None:
    """A position with a yaw turns the nose there."""
    begin(probe)()
    place = probe.place()
    for yaw in (math.pi / 2.0, -2.0):
        fly(probe, LocalSetpoint(place, yaw_rad=yaw, mask=POSITION_YAW), 8.0)
        shown = probe.yaw()
        off = math.remainder(shown - yaw, math.tau)
        require(abs(off) < 0.15, f"yaw {shown:.2f}, not {yaw:.2f} rad")


@book.rule(f"{COMMON} (yaw rate: clockwise)")
def yaw_rate_is_flown(probe: VehicleProbe) -> None:
    """A velocity with a yaw rate keeps turning the nose."""
    begin(probe)()
    before = probe.yaw()
    fly(probe, LocalSetpoint(yaw_rate_radps=0.3, mask=VELOCITY_YAW_RATE), 4.0)
    turned = math.remainder(probe.yaw() - before, math.tau)
    require(0.5 < turned < 1.8, f"turned by {turned:.2f} rad in 4 s at 0.3 rad/s")


@book.rule(f"{COMMON} (frame BODY_NED: relative to the nose)")
def body_velocity_is_relative_to_the_nose(probe: VehicleProbe) -> None:
    """A velocity in BODY_NED is flown relative to the nose."""
    begin(probe)()
    fly(probe, LocalSetpoint(probe.place(), yaw_rad=math.pi / 2.0, mask=POSITION_YAW), 8.0)
    forward = LocalSetpoint(velocity_mps=(2.0, 0.0, 0.0), mask=VELOCITY, frame=BODY_NED)
    north, east, _ = measure_speed(probe, forward)
    require(east > 1.3 and abs(north) < 0.8, f"{north:.1f} m/s north, {east:.1f} east")


@book.rule(f"{GLOBAL}; {BOTH_OBSERVED}")
def global_position_is_flown(probe: VehicleProbe) -> None:
    """A global setpoint above sea level (frame GLOBAL_INT) is flown to."""
    begin(probe)()
    wanted, latitude, longitude = target_north_east(probe)
    altitude_m = probe.origin().altitude / 1e3 - wanted[2]
    fly(probe, GlobalSetpoint(latitude, longitude, altitude_m), 14.0)
    require_place(probe, wanted, "frame 5")


@book.rule(GLOBAL, px4="PX4 1.15 is wrong by twice the difference of origin and home")
def relative_altitude_is_above_home(probe: VehicleProbe) -> None:
    """A global setpoint in GLOBAL_RELATIVE_ALT_INT has its altitude above home."""
    begin(probe)()
    wanted, latitude, longitude = target_north_east(probe)
    above_home_m = -(wanted[2] - probe.home().z)
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    fly(probe, GlobalSetpoint(latitude, longitude, above_home_m, frame), 14.0)
    require_place(probe, wanted, "frame 6")


def target_north_east(probe: VehicleProbe) -> tuple[Triple, int, int]:
    """A place 8 m north, 6 m east and 3 m higher: local, latitude and longitude."""
    north, east, down = probe.place()
    origin = probe.origin()
    wanted = (north + 8.0, east + 6.0, down - 3.0)
    return wanted, *moved_e7(origin.latitude, origin.longitude, wanted[0], wanted[1])


@book.rule(f"{COMMON}, POSITION_TARGET_LOCAL_NED")
def flown_target_is_told(probe: VehicleProbe) -> None:
    """POSITION_TARGET_LOCAL_NED tells the target that is flown."""
    begin(probe)()
    north, east, down = probe.place()
    wanted = (north + 5.0, east, down)
    probe.set_interval(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 0.1)
    fly(probe, LocalSetpoint(wanted), 8.0)
    told = probe.latest(mavlink.MAVLink_position_target_local_ned_message)
    off_m = math.dist((told.x, told.y, told.z), wanted)
    require(off_m < 1.0, f"told {off_m:.1f} m off")


@book.rule("MAVLink guide, Routing")
def setpoint_for_another_system_is_ignored(probe: VehicleProbe) -> None:
    """Setpoints for another system or component move nothing."""
    stop = begin(probe)
    before = probe.place()
    far = LocalSetpoint((before[0] + 30.0, before[1], before[2]))
    for target in ((77, 1), (probe.target[0], 77)):
        if target[0] == probe.target[0] and not probe.is_px4:
            continue  # ArduCopter 4.5 obeys any component of its system
        fly(probe, far, 3.0, target)
    stop()
    nothing_moved(before, probe.place(), 1.5)


@book.rule(f"MAVLink guide, Routing; {BOTH_OBSERVED}")
def broadcast_setpoint_is_flown(probe: VehicleProbe) -> None:
    """A setpoint for system 0 and component 0 is flown."""
    begin(probe)()
    north, east, down = probe.place()
    setpoint = LocalSetpoint((north + 6.0, east, down))
    fly(probe, setpoint, 9.0, (0, 0))
    require_place(probe, setpoint.position_m, "broadcast")


@book.rule(f"{PX4_PAGE}; {BOTH_OBSERVED}")
def setpoints_outside_the_mode_move_nothing(probe: VehicleProbe) -> None:
    """Outside OFFBOARD or GUIDED setpoints do not move the vehicle."""
    probe.take_off()
    probe.require_mode("hold" if probe.is_px4 else "loiter")
    probe.run(1.0)
    before = probe.place()
    fly(probe, LocalSetpoint((before[0] + 30.0, before[1], before[2])), 5.0)
    nothing_moved((*before[:2], 0.0), (*probe.place()[:2], 0.0), 1.5)


@book.rule(f"{COMMON} {BOTH_OBSERVED}")
def setpoint_before_arming_moves_nothing(probe: VehicleProbe) -> None:
    """Disarmed, setpoints neither arm nor move anything."""
    probe.get_ready()
    before = probe.place()
    fly(probe, LocalSetpoint((before[0] + 30.0, before[1], before[2] - 10.0)), 3.0)
    require(not probe.is_armed(), "it is armed")
    nothing_moved(before, probe.place(), 1.0)


def invalid_setpoints(
    probe: VehicleProbe, place: Triple
) -> dict[str, LocalSetpoint | GlobalSetpoint]:
    """Setpoints that ask for nothing sensible, by what is wrong with them."""
    far = (place[0] + 40.0, place[1], place[2])
    origin = probe.origin()
    cases: dict[str, LocalSetpoint | GlobalSetpoint] = {
        "x is NaN": LocalSetpoint((NAN, *far[1:])),
        "z is infinite": LocalSetpoint((*far[:2], -math.inf)),
        "velocity is NaN": LocalSetpoint(velocity_mps=(NAN, 0.0, 0.0), mask=VELOCITY),
        "everything is masked": LocalSetpoint(far, mask=NOTHING),
        "mask 0xFFFF": LocalSetpoint(far, mask=0xFFFF),
        "force bit": LocalSetpoint(far, acceleration_mps2=(0.5, 0, 0), mask=ACCELERATION | FORCE),
        "global frame in a local message": LocalSetpoint(far, frame=mavlink.MAV_FRAME_GLOBAL),
        "frame 20": LocalSetpoint(far, frame=20),
        "frame 99": LocalSetpoint(far, frame=99),
    }
    if probe.is_px4:
        cases["position in BODY_NED"] = LocalSetpoint(far, frame=BODY_NED)
        cases["frame 7"] = LocalSetpoint(far, frame=7)
    cases["latitude 100 degrees"] = GlobalSetpoint(1_000_000_000, origin.longitude, 500.0)
    cases["altitude is NaN"] = GlobalSetpoint(origin.latitude, origin.longitude, NAN)
    if not probe.is_px4:  # PX4 knows terrain altitudes, and flies to 0/0 as to anywhere
        cases["terrain altitude without terrain"] = GlobalSetpoint(
            origin.latitude, origin.longitude, 10.0, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
        )
        cases["latitude and longitude 0"] = GlobalSetpoint(0, 0, origin.altitude / 1e3 + 10.0)
    return cases


@book.rule(f"{COMMON}; {BOTH_OBSERVED} (stricter: no terrain or 0/0 without terrain data)")
def senseless_setpoint_moves_nothing(probe: VehicleProbe) -> None:
    """NaN, a foreign frame, an empty mask, 0/0 or no latitude never moves the vehicle."""
    begin(probe)()
    before = probe.place()
    hold = LocalSetpoint(before)
    for name, setpoint in invalid_setpoints(probe, before).items():
        fly(probe, setpoint, 2.5)
        off_m = math.dist(before, probe.place())
        require(off_m < 4.0, f"{name}: moved by {off_m:.1f} m")
        follow(probe, hold, 3.0)
