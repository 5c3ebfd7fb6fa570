"""PX4's OFFBOARD and ArduCopter's GUIDED: what the mode needs, and what ends it."""

from __future__ import annotations

import math
from functools import partial

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import protocol_clients as plans
from sim_link.lab.conformance.mavlink_oracle import (
    ACCELERATION,
    BODY_NED,
    BODY_OFFSET,
    FAILED,
    LOCAL_OFFSET,
    POSITION,
    TEMPORARILY_REJECTED,
    VELOCITY,
    GlobalSetpoint,
    LocalSetpoint,
    moved_e7,
)
from sim_link.lab.conformance.protocol_clients import INT32, await_value, circle, restored, write
from sim_link.lab.conformance.rules import ARDUPILOT_ONLY, FLIES, PX4_ONLY, Role, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import ACCEPTED, ARM, VehicleProbe, nothing_moved
from sim_link.lab.conformance.vehicle_probe import FORCE as FORCE_DISARM
from sim_link.lab.conformance.vehicle_rules.setpoint_rules import (
    begin,
    fly,
    follow,
    here,
    invalid_setpoints,
    require_place,
)
from sim_link.lab.conformance.vehicle_rules.upload_rules import disable_fence, enable_fence

guided_book = RuleBook(Role.VEHICLE, "guided", FLIES, flavours=ARDUPILOT_ONLY)
PAGE = "ArduPilot wiki, Copter Commands in Guided Mode"
GUIDED_OBSERVED = f"{PAGE}; ArduCopter 4.5, observed in SITL"
GUID_TIMEOUT_S = 3.0


def send(probe: VehicleProbe, setpoint: LocalSetpoint | GlobalSetpoint) -> None:
    """Send one setpoint, once."""
    probe.send(setpoint.message(probe.target))


def require_stopped(probe: VehicleProbe, when: str, limit_mps: float = 0.5) -> None:
    """The vehicle must stand."""
    speed_mps = math.hypot(*probe.speed())
    require(speed_mps < limit_mps, f"{speed_mps:.1f} m/s {when}")


@guided_book.rule(GUIDED_OBSERVED)
def guided_needs_no_stream(probe: VehicleProbe) -> None:
    """GUIDED is given without setpoints, and kept without them."""
    probe.take_off()
    probe.run(10.0)
    require(probe.is_in("offboard"), "it left GUIDED")
    require(probe.is_armed(), "it disarmed")


@guided_book.rule(GUIDED_OBSERVED)
def setpoint_before_take_off_does_nothing(probe: VehicleProbe) -> None:
    """Armed on the ground, setpoints do nothing: NAV_TAKEOFF comes first."""
    probe.arm()
    before = probe.place()
    fly(probe, LocalSetpoint((before[0] + 10.0, before[1], before[2] - 10.0)), 5.0)
    nothing_moved(before, probe.place(), 1.0)


@guided_book.rule(GUIDED_OBSERVED)
def one_position_is_flown_and_held(probe: VehicleProbe) -> None:
    """One position message is flown to its end and held, without any stream."""
    probe.take_off()
    north, east, down = probe.place()
    wanted = (north + 25.0, east, down)
    send(probe, LocalSetpoint(wanted))
    probe.run(15.0)
    require_place(probe, wanted, "after 15 s")
    probe.run(15.0)
    require_place(probe, wanted, "after 30 s")


@guided_book.rule(f"{GUIDED_OBSERVED}; GUID_TIMEOUT")
def velocity_times_out(probe: VehicleProbe) -> None:
    """A velocity without a stream is flown for 3 s, then stopped; the mode stays GUIDED."""
    probe.take_off()
    setpoint = LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=VELOCITY)
    send(probe, setpoint)
    probe.run(2.5)
    require(probe.speed()[0] > 2.0, f"{probe.speed()[0]:.1f} m/s after 2.5 s")
    probe.run(4.0)
    require_stopped(probe, "after 6.5 s")
    require(probe.is_in("offboard"), "it left GUIDED")


@guided_book.rule(GUIDED_OBSERVED)
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


@guided_book.rule(GUIDED_OBSERVED)
def acceleration_times_out(probe: VehicleProbe) -> None:
    """An acceleration without a stream ends after 3 s, and the vehicle stops."""
    probe.take_off()
    setpoint = LocalSetpoint(acceleration_mps2=(1.0, 0.0, 0.0), mask=ACCELERATION)
    send(probe, setpoint)
    probe.run(GUID_TIMEOUT_S + 6.0)
    require_stopped(probe, "after 9 s")


@guided_book.rule(f"{GUIDED_OBSERVED}, type_mask")
def one_masked_axis_masks_the_group(probe: VehicleProbe) -> None:
    """One ignored axis ignores its whole group; with nothing left the vehicle stops."""
    probe.take_off()
    before = probe.place()
    for bit in (1, 2, 4):
        send(probe, LocalSetpoint((before[0] + 30.0, *before[1:]), mask=POSITION | bit))
        probe.run(2.0)
        nothing_moved(before, probe.place(), 1.5)


@guided_book.rule(f"{GUIDED_OBSERVED}, coordinate_frame")
def offset_frames_are_relative(probe: VehicleProbe) -> None:
    """LOCAL_OFFSET_NED and BODY_OFFSET_NED positions count from the vehicle."""
    probe.take_off()
    for frame in (LOCAL_OFFSET, BODY_OFFSET):
        before = probe.place()
        yaw = probe.yaw() if frame == BODY_OFFSET else 0.0
        send(probe, LocalSetpoint((6.0, 0.0, 0.0), frame=frame))
        probe.run(9.0)
        wanted = (before[0] + 6.0 * math.cos(yaw), before[1] + 6.0 * math.sin(yaw), before[2])
        require_place(probe, wanted, f"frame {frame}")


@guided_book.rule(f"{GUIDED_OBSERVED}, coordinate_frame")
def body_position_is_about_the_origin(probe: VehicleProbe) -> None:
    """A position in BODY_NED is turned by the heading and counts from the EKF origin."""
    probe.take_off()
    yaw = probe.yaw()
    down = probe.place()[2]
    setpoint = LocalSetpoint((12.0, 0.0, down), frame=BODY_NED)
    send(probe, setpoint)
    probe.run(14.0)
    turned = (12.0 * math.cos(yaw), 12.0 * math.sin(yaw), down)
    place = probe.place()
    near = min(math.dist(place, turned), math.dist(place, (12.0, 0.0, down)))
    require(near < 1.5, f"at {place}, wanted about {turned}")


@guided_book.rule(f"{GUIDED_OBSERVED}, coordinate_frame")
def foreign_frame_stops_the_vehicle(probe: VehicleProbe) -> None:
    """A setpoint in a frame that is not known stops the vehicle."""
    probe.take_off()
    fly(probe, LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=VELOCITY), 3.0)
    send(probe, LocalSetpoint((50.0, 0.0, -10.0), frame=20))
    probe.run(2.5)
    require_stopped(probe, "after 2.5 s", 1.0)


@guided_book.rule(GUIDED_OBSERVED)
def global_frames_without_int_are_accepted(probe: VehicleProbe) -> None:
    """GLOBAL_INT setpoints are flown in frames 0 and 3 as in 5 and 6."""
    probe.take_off()
    origin, home = probe.origin(), probe.home()
    north, east, down = probe.place()
    for number, frame in enumerate((0, 3)):
        wanted = (north + 5.0 + number, east + 4.0, down)
        place = moved_e7(origin.latitude, origin.longitude, wanted[0], wanted[1])
        altitude_m = origin.altitude / 1e3 - down if frame == 0 else home.z - down
        send(probe, GlobalSetpoint(*place, altitude_m, frame))
        probe.run(8.0)
        require_place(probe, wanted, f"frame {frame}")


@guided_book.rule(f"{GUIDED_OBSERVED}; ArduPilot wiki, Fences")
def destination_outside_the_fence_is_refused(probe: VehicleProbe) -> None:
    """Outside the fence a position is ignored and DO_REPOSITION fails."""
    probe.take_off()
    plans.require_upload(probe, circle(probe, 40.0), plans.FENCE)
    enable_fence(probe)
    before = probe.place()
    send(probe, LocalSetpoint((before[0] + 90.0, *before[1:])))
    probe.run(4.0)
    nothing_moved(before, probe.place(), 1.5)
    home = probe.home()
    place = moved_e7(home.latitude, home.longitude, 90.0, 0.0)
    result = probe.reposition(mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, (*place, 10.0))
    disable_fence(probe)
    plans.clear(probe, plans.FENCE)
    require(result == FAILED, f"DO_REPOSITION: result {result}")


@guided_book.rule(GUIDED_OBSERVED)
def running_stream_acts_when_guided_returns(probe: VehicleProbe) -> None:
    """A stream that never stopped acts at once when GUIDED is chosen again."""
    probe.take_off()
    north, east, down = probe.place()
    setpoint = LocalSetpoint((north + 15.0, east, down))
    probe.require_mode("loiter")
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(2.0)
    nothing_moved((north, east, 0.0), (*probe.place()[:2], 0.0), 1.5)
    probe.require_mode("offboard")
    probe.run(10.0)
    stop()
    require_place(probe, setpoint.position_m, "back in GUIDED")


def lose_stream(probe: VehicleProbe) -> LocalSetpoint:
    """Fly in OFFBOARD and end the stream; the setpoint that it had."""
    stop = begin(probe)
    setpoint = here(probe)
    stop()
    return setpoint


offboard_loss_book = RuleBook(Role.VEHICLE, "offboard_loss", FLIES, flavours=PX4_ONLY)
PX4_PAGE = "PX4 user guide, Offboard Mode"
OFFBOARD_OBSERVED = "PX4 1.15, observed in SITL"

OFFBOARD_NUMBER = 6 << 16
Heartbeat = mavlink.MAVLink_heartbeat_message
CRITICAL, ACTIVE = mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_ACTIVE
LOSS_MODES = {0: "position", 3: "return", 4: "land", 5: "hold"}


@offboard_loss_book.rule(f"{PX4_PAGE}; {OFFBOARD_OBSERVED}")
def offboard_needs_a_stream_in_the_air(probe: VehicleProbe) -> None:
    """In the air OFFBOARD is refused without a stream, and given with one."""
    probe.take_off()
    result = probe.set_mode("offboard")
    require(result == TEMPORARILY_REJECTED, f"without a stream: result {result}")
    setpoint = here(probe)
    probe.enter_offboard(lambda: setpoint.message(probe.target))()


@offboard_loss_book.rule(f"{PX4_PAGE}; {OFFBOARD_OBSERVED}")
def offboard_without_a_stream_cannot_be_armed(probe: VehicleProbe) -> None:
    """Disarmed OFFBOARD is given without a stream, but arming is refused until there is one."""
    probe.get_ready()
    probe.require_mode("offboard")
    probe.require_result(TEMPORARILY_REJECTED, ARM, 1.0, 0.0)
    setpoint = here(probe)
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.run(1.5)
    probe.require_result(ACCEPTED, ARM, 1.0, 0.0)
    probe.require_result(ACCEPTED, ARM, 0.0, FORCE_DISARM)
    stop()
    probe.set_mode("hold")


@offboard_loss_book.rule(f"{PX4_PAGE}, COM_OF_LOSS_T; {OFFBOARD_OBSERVED}")
def lost_stream_is_a_failsafe(probe: VehicleProbe) -> None:
    """A second without setpoints ends OFFBOARD: another mode, and system_status CRITICAL."""
    stop = begin(probe)
    stop()
    probe.run(0.7)
    probe.request(Heartbeat)
    beat = probe.latest(Heartbeat)
    require(beat.system_status == ACTIVE, "failsafe before COM_OF_LOSS_T")
    probe.run(1.0)
    beat = probe.request(Heartbeat)
    require(beat.system_status == CRITICAL, f"system_status {beat.system_status}")
    require(beat.custom_mode != OFFBOARD_NUMBER, "still OFFBOARD")


@offboard_loss_book.rule(f"{PX4_PAGE}, COM_OBL_RC_ACT; {OFFBOARD_OBSERVED}")
def loss_action_is_the_parameter(probe: VehicleProbe) -> None:
    """The mode after the loss is COM_OBL_RC_ACT's: position, return, land or hold."""
    with restored(probe, "COM_OBL_RC_ACT"):
        setpoint = lose_stream(probe)
        for action, mode in LOSS_MODES.items():
            mark = write(probe, "COM_OBL_RC_ACT", float(action), INT32)
            await_value(probe, mark, "COM_OBL_RC_ACT")
            follow(probe, setpoint, 3.0)
            probe.await_mode(mode, 4.0)


@offboard_loss_book.rule(OFFBOARD_OBSERVED)
def returning_stream_returns_offboard(probe: VehicleProbe) -> None:
    """When the setpoints come back, OFFBOARD comes back without a command."""
    setpoint = lose_stream(probe)
    probe.run(2.5)
    require(not probe.is_in("offboard"), "no failsafe")
    stop = probe.stream(lambda: setpoint.message(probe.target))
    probe.await_mode("offboard", 3.0)
    stop()


@offboard_loss_book.rule(OFFBOARD_OBSERVED)
def chosen_mode_ends_the_wish_for_offboard(probe: VehicleProbe) -> None:
    """A mode chosen during the failsafe stays when the setpoints come back."""
    setpoint = lose_stream(probe)
    probe.run(2.0)
    probe.require_mode("hold")
    fly(probe, setpoint, 2.0)
    require(probe.is_in("hold"), "OFFBOARD came back against the operator's choice")


@offboard_loss_book.rule(f"{PX4_PAGE}; {OFFBOARD_OBSERVED}")
def short_gap_is_no_loss(probe: VehicleProbe) -> None:
    """Gaps of 0.3, 0.6 and 0.9 s change nothing; 2 Hz is enough."""
    begin(probe)()
    setpoint = here(probe)
    for gap_s in (0.3, 0.6, 0.9, 0.5, 0.5):
        send(probe, setpoint)
        mark = probe.mark
        probe.run(gap_s)
        for beat in probe.from_vehicle(Heartbeat, mark):
            require(beat.custom_mode == OFFBOARD_NUMBER, f"lost in a gap of {gap_s} s")


@offboard_loss_book.rule(
    f"{PX4_PAGE}; {OFFBOARD_OBSERVED} (stricter: a NaN invalidates the whole message)"
)
def senseless_setpoint_is_no_proof_of_life(probe: VehicleProbe) -> None:
    """A stream of invalid setpoints counts as lost."""
    begin(probe)()
    place = probe.place()
    hold = LocalSetpoint(place)
    for name, setpoint in invalid_setpoints(probe, place).items():
        follow(probe, hold, 1.5)
        stop = probe.stream(partial(setpoint.message, probe.target))
        probe.run(2.5)
        is_alive = probe.is_in("offboard")
        stop()
        require(not is_alive, f"{name}: OFFBOARD goes on")


@offboard_loss_book.rule(f"{PX4_PAGE} (unknown frame: a text)")
def unknown_frame_is_told(probe: VehicleProbe) -> None:
    """A setpoint in a frame that is not known is answered by a text."""
    begin(probe)()
    setpoint = LocalSetpoint(probe.place(), frame=20)
    mark = probe.mark
    fly(probe, setpoint, 2.0)
    require(bool(probe.heard(mavlink.MAVLink_statustext_message, mark)), "no text")


@offboard_loss_book.rule(OFFBOARD_OBSERVED)
def missing_axis_holds_place(probe: VehicleProbe) -> None:
    """A position with one axis masked off stays in OFFBOARD and in place."""
    begin(probe)()
    before = probe.place()
    far = (before[0] + 30.0, before[1], before[2] - 20.0)
    fly(probe, LocalSetpoint(far, mask=POSITION | 4), 3.0)
    require(probe.is_in("offboard"), "it left OFFBOARD")
    nothing_moved(before, probe.place(), 1.5)
