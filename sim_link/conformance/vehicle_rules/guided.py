"""ArduCopter's GUIDED: no stream before it, positions latched, velocities that time out."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.conformance import plan_client as plans
from sim_link.conformance.plan_shapes import circle
from sim_link.conformance.rules import ARDUPILOT_ONLY, Effect, Role, RuleBook, require
from sim_link.conformance.setpoints import (
    ACCELERATION,
    BODY_NED,
    BODY_OFFSET,
    LOCAL_OFFSET,
    POSITION,
    VELOCITY,
    GlobalSetpoint,
    LocalSetpoint,
    moved_e7,
)
from sim_link.conformance.vehicle_probe import VehicleProbe, nothing_moved
from sim_link.conformance.vehicle_rules.fences import disable_fence, enable_fence
from sim_link.conformance.vehicle_rules.offboard import fly, require_place
from sim_link.conformance.vehicle_station import ACCEPTED, NAN

book = RuleBook(Role.VEHICLE, "guided")
PAGE = "ArduPilot wiki, Copter Commands in Guided Mode"
OBSERVED = f"{PAGE}; ArduCopter 4.5, observed in SITL"
FLIES = Effect.FLIES
FAILED = 4
GUID_TIMEOUT_S = 3.0
STOPPED_MPS = 0.5


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def guided_needs_no_stream(probe: VehicleProbe) -> None:
    """GUIDED is given without setpoints, and kept without them."""
    probe.take_off()
    probe.run(10.0)
    require(probe.is_in("offboard"), "it left GUIDED")
    require(probe.is_armed(), "it disarmed")


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def setpoint_before_take_off_does_nothing(probe: VehicleProbe) -> None:
    """Armed on the ground, setpoints do nothing: NAV_TAKEOFF comes first."""
    probe.arm()
    before = probe.place()
    fly(probe, LocalSetpoint((before[0] + 10.0, before[1], before[2] - 10.0)), 5.0)
    nothing_moved(before, probe.place(), 1.0)


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def one_position_is_flown_and_held(probe: VehicleProbe) -> None:
    """One position message is flown to its end and held, without any stream."""
    probe.take_off()
    north, east, down = probe.place()
    wanted = (north + 25.0, east, down)
    probe.send(LocalSetpoint(wanted).message(probe.target))
    probe.run(15.0)
    require_place(probe, wanted, "after 15 s")
    probe.run(15.0)
    require_place(probe, wanted, "after 30 s")


@book.rule(f"{OBSERVED}; GUID_TIMEOUT", effect=FLIES, flavours=ARDUPILOT_ONLY)
def velocity_times_out(probe: VehicleProbe) -> None:
    """A velocity without a stream is flown for 3 s, then stopped; the mode stays GUIDED."""
    probe.take_off()
    setpoint = LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=VELOCITY)
    probe.send(setpoint.message(probe.target))
    probe.run(2.5)
    require(probe.speed()[0] > 2.0, f"{probe.speed()[0]:.1f} m/s after 2.5 s")
    probe.run(4.0)
    speed_mps = math.hypot(*probe.speed())
    require(speed_mps < STOPPED_MPS, f"{speed_mps:.1f} m/s after 6.5 s")
    require(probe.is_in("offboard"), "it left GUIDED")


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def slow_velocity_stream_is_enough(probe: VehicleProbe) -> None:
    """A velocity every 2 s keeps the vehicle moving."""
    probe.take_off()
    setpoint = LocalSetpoint(velocity_mps=(2.0, 0.0, 0.0), mask=VELOCITY)
    stop = probe.repeat(lambda: setpoint.message(probe.target), 2.0)
    probe.run(3.0)
    for _ in range(4):
        probe.run(1.0)
        require(probe.speed()[0] > 1.5, f"{probe.speed()[0]:.1f} m/s")
    stop()


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def acceleration_times_out(probe: VehicleProbe) -> None:
    """An acceleration without a stream ends after 3 s, and the vehicle stops."""
    probe.take_off()
    setpoint = LocalSetpoint(acceleration_mps2=(1.0, 0.0, 0.0), mask=ACCELERATION)
    probe.send(setpoint.message(probe.target))
    probe.run(GUID_TIMEOUT_S + 6.0)
    speed_mps = math.hypot(*probe.speed())
    require(speed_mps < STOPPED_MPS, f"{speed_mps:.1f} m/s after 9 s")


@book.rule(f"{OBSERVED}, type_mask", effect=FLIES, flavours=ARDUPILOT_ONLY)
def one_masked_axis_masks_the_group(probe: VehicleProbe) -> None:
    """One ignored axis ignores its whole group; with nothing left the vehicle stops."""
    probe.take_off()
    before = probe.place()
    for bit in (1, 2, 4):
        probe.send(
            LocalSetpoint((before[0] + 30.0, *before[1:]), mask=POSITION | bit).message(
                probe.target
            )
        )
        probe.run(2.0)
        nothing_moved(before, probe.place(), 1.5)


@book.rule(f"{OBSERVED}, coordinate_frame", effect=FLIES, flavours=ARDUPILOT_ONLY)
def offset_frames_are_relative(probe: VehicleProbe) -> None:
    """LOCAL_OFFSET_NED and BODY_OFFSET_NED positions count from the vehicle."""
    probe.take_off()
    for frame in (LOCAL_OFFSET, BODY_OFFSET):
        before = probe.place()
        yaw = probe.request(mavlink.MAVLink_attitude_message).yaw if frame == BODY_OFFSET else 0.0
        probe.send(LocalSetpoint((6.0, 0.0, 0.0), frame=frame).message(probe.target))
        probe.run(9.0)
        wanted = (before[0] + 6.0 * math.cos(yaw), before[1] + 6.0 * math.sin(yaw), before[2])
        require_place(probe, wanted, f"frame {frame}")


@book.rule(f"{OBSERVED}, coordinate_frame", effect=FLIES, flavours=ARDUPILOT_ONLY)
def body_position_is_about_the_origin(probe: VehicleProbe) -> None:
    """A position in BODY_NED is turned by the heading and counts from the EKF origin."""
    probe.take_off()
    yaw = probe.request(mavlink.MAVLink_attitude_message).yaw
    down = probe.place()[2]
    setpoint = LocalSetpoint((12.0, 0.0, down), frame=BODY_NED)
    probe.send(setpoint.message(probe.target))
    probe.run(14.0)
    turned = (12.0 * math.cos(yaw), 12.0 * math.sin(yaw), down)
    place = probe.place()
    near = min(math.dist(place, turned), math.dist(place, (12.0, 0.0, down)))
    require(near < 1.5, f"at {place}, wanted about {turned}")


@book.rule(f"{OBSERVED}, coordinate_frame", effect=FLIES, flavours=ARDUPILOT_ONLY)
def foreign_frame_stops_the_vehicle(probe: VehicleProbe) -> None:
    """A setpoint in a frame that is not known stops the vehicle."""
    probe.take_off()
    fly(probe, LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=VELOCITY), 3.0)
    probe.send(LocalSetpoint((50.0, 0.0, -10.0), frame=20).message(probe.target))
    probe.run(2.5)
    speed_mps = math.hypot(*probe.speed())
    require(speed_mps < 1.0, f"{speed_mps:.1f} m/s after 2.5 s")


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def global_frames_without_int_are_accepted(probe: VehicleProbe) -> None:
    """GLOBAL_INT setpoints are flown in frames 0 and 3 as in 5 and 6."""
    probe.take_off()
    origin, home = probe.origin(), probe.home()
    north, east, down = probe.place()
    for number, frame in enumerate((0, 3)):
        wanted = (north + 5.0 + number, east + 4.0, down)
        place = moved_e7(origin.latitude, origin.longitude, wanted[0], wanted[1])
        altitude_m = origin.altitude / 1e3 - down if frame == 0 else home.z - down
        probe.send(GlobalSetpoint(*place, altitude_m, frame).message(probe.target))
        probe.run(8.0)
        require_place(probe, wanted, f"frame {frame}")


@book.rule(f"{OBSERVED}; ArduPilot wiki, Fences", effect=FLIES, flavours=ARDUPILOT_ONLY)
def destination_outside_the_fence_is_refused(probe: VehicleProbe) -> None:
    """Outside the fence a position is ignored and DO_REPOSITION fails."""
    probe.take_off()
    plans.require_upload(probe, circle(probe, 40.0), plans.FENCE)
    enable_fence(probe)
    before = probe.place()
    probe.send(LocalSetpoint((before[0] + 90.0, *before[1:])).message(probe.target))
    probe.run(4.0)
    nothing_moved(before, probe.place(), 1.5)
    home = probe.home()
    place = moved_e7(home.latitude, home.longitude, 90.0, 0.0)
    result = probe.command_int(
        mavlink.MAV_CMD_DO_REPOSITION,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        (-1.0, 1.0, 0.0, NAN),
        (*place, 10.0),
    )
    disable_fence(probe)
    plans.clear(probe, plans.FENCE)
    require(result == FAILED, f"DO_REPOSITION: result {result}")


@book.rule(OBSERVED, effect=FLIES, flavours=ARDUPILOT_ONLY)
def running_stream_acts_when_guided_returns(probe: VehicleProbe) -> None:
    """A stream that never stopped acts at once when GUIDED is chosen again."""
    probe.take_off()
    north, east, down = probe.place()
    setpoint = LocalSetpoint((north + 15.0, east, down))
    require(probe.set_mode("loiter") == ACCEPTED, "LOITER is refused")
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(2.0)
    nothing_moved((north, east, 0.0), (*probe.place()[:2], 0.0), 1.5)
    require(probe.set_mode("offboard") == ACCEPTED, "GUIDED is refused")
    probe.run(10.0)
    stop()
    require_place(probe, setpoint.position_m, "back in GUIDED")
