"""Setpoints that both autopilots fly, and those of ArduCopter's GUIDED."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import GlobalSetpoint, LocalSetpoint, Triple
from sim_link.lab.conformance.protocol_clients import PlanClient, Setpoint, SetpointClient
from sim_link.lab.conformance.rules import ARDUPILOT, FLIES, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import VehicleProbe, require_unmoved

COMMON = "MAVLink common, SET_POSITION_TARGET_LOCAL_NED"
GLOBAL = "MAVLink common, SET_POSITION_TARGET_GLOBAL_INT"
BOTH_OBSERVED = "PX4 1.15 and ArduCopter 4.5, observed in SITL"
LOCAL = f"{COMMON}; {BOTH_OBSERVED}"


class OffboardRules(SetpointClient):
    """Setpoints that both autopilots fly, and those that neither does."""

    book = RuleBook("offboard", FLIES)

    @book.rule(LOCAL)
    def position_is_flown(self) -> None:
        """A position setpoint in LOCAL_NED is flown to."""
        north, east, down = self.begin()
        wanted = (north + 8.0, east - 6.0, down - 4.0)
        self.fly(LocalSetpoint(wanted), 12.0)
        self.require_position(wanted, "local position")

    @book.rule(LOCAL)
    def velocity_is_flown(self) -> None:
        """A velocity setpoint is flown: north, east and down."""
        self.begin()
        for wanted in ((2.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, -1.0)):
            speed = self.measure_speed(LocalSetpoint(velocity_mps=wanted, mask=mav.VELOCITY))
            off_mps = math.dist(speed, wanted)
            require(off_mps < 0.5, f"{wanted}: off by {off_mps:.1f} m/s")

    @book.rule(LOCAL)
    def position_with_velocity_is_flown(self) -> None:
        """Position and velocity together are accepted, and the vehicle nears the position."""
        north, east, down = self.begin()
        wanted = (north + 10.0, east, down)
        self.fly(LocalSetpoint(wanted, (0.5, 0.0, 0.0), mask=mav.POSITION_VELOCITY), 12.0)
        require(math.dist(self.position(), wanted) < 3.0, "it did not get near")

    @book.rule(LOCAL)
    def acceleration_is_flown(self) -> None:
        """An acceleration setpoint makes the vehicle faster that way."""
        self.begin()
        self.fly(LocalSetpoint(acceleration_mps2=(1.0, 0.0, 0.0), mask=mav.ACCELERATION), 2.0)
        speed_mps = self.speed()[0]
        require(speed_mps > 0.5, f"{speed_mps:.1f} m/s north after 2 s")

    @book.rule(f"{COMMON} (yaw: 0 is north, clockwise)")
    def yaw_is_flown(self) -> None:
        """A position with a yaw turns the nose there."""
        position = self.begin()
        for yaw in (math.pi / 2.0, -2.0):
            self.fly(LocalSetpoint(position, yaw_rad=yaw, mask=mav.POSITION_YAW), 8.0)
            shown = self.request(mav.Attitude).yaw
            off = math.remainder(shown - yaw, math.tau)
            require(abs(off) < 0.15, f"yaw {shown:.2f}, not {yaw:.2f} rad")

    @book.rule(f"{COMMON} (yaw rate: clockwise)")
    def yaw_rate_is_flown(self) -> None:
        """A velocity with a yaw rate keeps turning the nose."""
        self.begin()
        before = self.request(mav.Attitude).yaw
        self.fly(LocalSetpoint(yaw_rate_radps=0.3, mask=mav.VELOCITY_YAW_RATE), 4.0)
        turned = math.remainder(self.request(mav.Attitude).yaw - before, math.tau)
        require(0.5 < turned < 1.8, f"turned by {turned:.2f} rad in 4 s at 0.3 rad/s")

    @book.rule(f"{COMMON} (frame BODY_NED: relative to the nose)")
    def body_velocity_is_relative_to_the_nose(self) -> None:
        """A velocity in BODY_NED is flown relative to the nose."""
        position = self.begin()
        self.fly(LocalSetpoint(position, yaw_rad=math.pi / 2.0, mask=mav.POSITION_YAW), 8.0)
        forward = LocalSetpoint(velocity_mps=(2.0, 0.0, 0.0), mask=mav.VELOCITY, frame=mav.BODY_NED)
        north, east, _ = self.measure_speed(forward)
        require(east > 1.3 and abs(north) < 0.8, f"{north:.1f} m/s north, {east:.1f} east")

    def _target_north_east(self) -> tuple[Triple, int, int]:
        """Return a position 8 m north, 6 m east and 3 m higher: local, latitude and longitude."""
        north, east, down = self.begin()
        origin = self.request(mav.Origin)
        wanted = (north + 8.0, east + 6.0, down - 3.0)
        return wanted, *mav.moved_e7(origin.latitude, origin.longitude, *wanted[:2])

    @book.rule(f"{GLOBAL}; {BOTH_OBSERVED}")
    def global_position_is_flown(self) -> None:
        """A global setpoint above sea level (frame GLOBAL_INT) is flown to."""
        wanted, latitude, longitude = self._target_north_east()
        altitude_m = self.request(mav.Origin).altitude / 1e3 - wanted[2]
        self.fly(GlobalSetpoint(latitude, longitude, altitude_m), 14.0)
        self.require_position(wanted, "frame 5")

    @book.rule(GLOBAL)
    def relative_altitude_is_above_home(self) -> None:
        """A global setpoint in GLOBAL_RELATIVE_ALT_INT has its altitude above home."""
        wanted, latitude, longitude = self._target_north_east()
        above_home_m = -(wanted[2] - self.home().z)
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
        self.fly(GlobalSetpoint(latitude, longitude, above_home_m, frame), 14.0)
        self.require_position(wanted, "frame 6")

    @book.rule(f"{COMMON}, POSITION_TARGET_LOCAL_NED")
    def flown_target_is_reported(self) -> None:
        """POSITION_TARGET_LOCAL_NED reports the target that is flown."""
        north, east, down = self.begin()
        wanted = (north + 5.0, east, down)
        target = mavlink.MAVLink_position_target_local_ned_message
        self.set_interval(target, 0.1)
        self.fly(LocalSetpoint(wanted), 8.0)
        reported = self.latest(target)
        off_m = math.dist((reported.x, reported.y, reported.z), wanted)
        require(off_m < 1.0, f"reported {off_m:.1f} m off")

    @book.rule("MAVLink guide, Routing")
    def setpoint_for_another_system_is_ignored(self) -> None:
        """Setpoints for another system or component move nothing."""
        stop = self.begin_streaming()
        before = self.position()
        far = LocalSetpoint((before[0] + 30.0, *before[1:]))
        self.fly(far, 3.0, (77, 1))
        if self.is_px4:  # ArduCopter 4.5 obeys any component of its system
            self.fly(far, 3.0, (self.target[0], 77))
        stop()
        require_unmoved(before, self.position(), 1.5)

    @book.rule(f"MAVLink guide, Routing; {BOTH_OBSERVED}")
    def broadcast_setpoint_is_flown(self) -> None:
        """A setpoint for system 0 and component 0 is flown."""
        north, east, down = self.begin()
        wanted = (north + 6.0, east, down)
        self.fly(LocalSetpoint(wanted), 9.0, (0, 0))
        self.require_position(wanted, "broadcast")

    @book.rule(f"PX4 user guide, Offboard Mode; {BOTH_OBSERVED}")
    def setpoints_outside_the_mode_move_nothing(self) -> None:
        """Outside OFFBOARD or GUIDED setpoints do not move the vehicle."""
        self.take_off()
        self.require_mode("hold" if self.is_px4 else "loiter")
        self.run(1.0)
        before = self.position()
        self.fly(LocalSetpoint((before[0] + 30.0, *before[1:])), 5.0)
        require_unmoved(before[:2], self.position()[:2], 1.5)

    @book.rule(f"{COMMON} {BOTH_OBSERVED}")
    def setpoint_before_arming_moves_nothing(self) -> None:
        """Disarmed, setpoints neither arm nor move anything."""
        self.get_ready()
        before = self.position()
        self.fly(LocalSetpoint((before[0] + 30.0, before[1], before[2] - 10.0)), 3.0)
        require(not self.is_armed(), "it is armed")
        require_unmoved(before, self.position(), 1.0)

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def setpoint_before_take_off_moves_nothing(self) -> None:
        """Armed on the ground, setpoints do nothing: NAV_TAKEOFF comes first."""
        self.arm()
        before = self.position()
        self.fly(LocalSetpoint((before[0] + 10.0, before[1], before[2] - 10.0)), 5.0)
        require_unmoved(before, self.position(), 1.0)

    @book.rule(f"{LOCAL} (stricter: no terrain or 0/0 without terrain data)", harms=True)
    def senseless_setpoint_moves_nothing(self) -> None:
        """NaN, a foreign frame, an empty mask, 0/0 or a bad latitude never moves the vehicle."""
        before = self.begin()
        for name, setpoint in invalid_setpoints(self, before).items():
            self.fly(setpoint, 2.5)
            off_m = math.dist(before, self.position())
            require(off_m < 4.0, f"{name}: moved by {off_m:.1f} m")
            self.follow(LocalSetpoint(before), 3.0)


def invalid_setpoints(probe: SetpointClient, position: Triple) -> dict[str, Setpoint]:
    """Return invalid setpoints by their fault."""
    far = (position[0] + 40.0, position[1], position[2])
    origin = probe.request(mav.Origin)
    force = mav.ACCELERATION | mav.FORCE
    cases: dict[str, Setpoint] = {
        "x is NaN": LocalSetpoint((mav.NAN, *far[1:])),
        "z is infinite": LocalSetpoint((*far[:2], -math.inf)),
        "velocity is NaN": LocalSetpoint(velocity_mps=(mav.NAN, 0.0, 0.0), mask=mav.VELOCITY),
        "everything is masked": LocalSetpoint(far, mask=mav.NOTHING),
        "mask 0xFFFF": LocalSetpoint(far, mask=0xFFFF),
        "force bit": LocalSetpoint(far, acceleration_mps2=(0.5, 0, 0), mask=force),
        "global frame in a local message": LocalSetpoint(far, frame=mavlink.MAV_FRAME_GLOBAL),
        "frame 20": LocalSetpoint(far, frame=20),
        "frame 99": LocalSetpoint(far, frame=99),
    }
    if probe.is_px4:
        cases["position in BODY_NED"] = LocalSetpoint(far, frame=mav.BODY_NED)
        cases["frame 7"] = LocalSetpoint(far, frame=7)
    cases["latitude 100 degrees"] = GlobalSetpoint(1_000_000_000, origin.longitude, 500.0)
    cases["altitude is NaN"] = GlobalSetpoint(origin.latitude, origin.longitude, mav.NAN)
    if not probe.is_px4:  # PX4 knows terrain altitudes, and flies to 0/0 as to anywhere
        cases["terrain altitude without terrain"] = GlobalSetpoint(
            origin.latitude, origin.longitude, 10.0, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
        )
        cases["latitude and longitude 0"] = GlobalSetpoint(0, 0, origin.altitude / 1e3 + 10.0)
    return cases


GUIDED = f"ArduPilot wiki, Copter Commands in Guided Mode; {mav.OBSERVED_ARDUPILOT}"
GUID_TIMEOUT_S = 3.0


class GuidedRules(SetpointClient, PlanClient):
    """ArduCopter's GUIDED."""

    book = RuleBook("guided", FLIES, ARDUPILOT, VehicleProbe.take_off)

    def _require_stopped(self, when: str, limit_mps: float = 0.5) -> None:
        speed_mps = math.hypot(*self.speed())
        require(speed_mps < limit_mps, f"{speed_mps:.1f} m/s {when}")

    @book.rule(GUIDED)
    def guided_needs_no_stream(self) -> None:
        """GUIDED is given without setpoints, and kept without them."""
        self.run(10.0)
        require(self.is_in("offboard"), "it left GUIDED")
        require(self.is_armed(), "it disarmed")

    @book.rule(GUIDED)
    def one_position_is_flown_and_held(self) -> None:
        """One position message is flown to its end and held, without any stream."""
        north, east, down = self.position()
        wanted = (north + 25.0, east, down)
        self.send_setpoint(LocalSetpoint(wanted))
        for when in ("after 15 s", "after 30 s"):
            self.run(15.0)
            self.require_position(wanted, when)

    @book.rule(f"{GUIDED}; GUID_TIMEOUT")
    def velocity_times_out(self) -> None:
        """A velocity without a stream is flown for 3 s, then stopped; the mode stays GUIDED."""
        self.send_setpoint(LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=mav.VELOCITY))
        self.run(2.5)
        speed_mps = self.speed()[0]
        require(speed_mps > 2.0, f"{speed_mps:.1f} m/s after 2.5 s")
        self.run(4.0)
        self._require_stopped("after 6.5 s")
        require(self.is_in("offboard"), "it left GUIDED")

    @book.rule(GUIDED)
    def slow_velocity_stream_is_enough(self) -> None:
        """A velocity every 2 s keeps the vehicle moving."""
        setpoint = LocalSetpoint(velocity_mps=(2.0, 0.0, 0.0), mask=mav.VELOCITY)
        stop = self.stream(setpoint, period_s=2.0)
        self.run(3.0)
        for _ in range(4):
            self.run(1.0)
            speed_mps = self.speed()[0]
            require(speed_mps > 1.5, f"{speed_mps:.1f} m/s")
        stop()

    @book.rule(GUIDED)
    def acceleration_times_out(self) -> None:
        """An acceleration without a stream ends after 3 s, and the vehicle stops."""
        self.send_setpoint(LocalSetpoint(acceleration_mps2=(1.0, 0.0, 0.0), mask=mav.ACCELERATION))
        self.run(GUID_TIMEOUT_S + 6.0)
        self._require_stopped("after 9 s")

    @book.rule(f"{GUIDED}, type_mask")
    def one_masked_axis_masks_the_group(self) -> None:
        """One ignored axis ignores its whole group; with nothing left the vehicle stops."""
        before = self.position()
        for bit in (1, 2, 4):
            far = (before[0] + 30.0, *before[1:])
            self.send_setpoint(LocalSetpoint(far, mask=mav.POSITION | bit))
            self.run(2.0)
            require_unmoved(before, self.position(), 1.5)

    @book.rule(f"{GUIDED}, coordinate_frame")
    def offset_frames_are_relative(self) -> None:
        """LOCAL_OFFSET_NED, BODY_NED and BODY_OFFSET_NED positions count from the vehicle."""
        for frame in (mav.LOCAL_OFFSET, mav.BODY_NED, mav.BODY_OFFSET):
            north, east, down = self.position()
            yaw = 0.0 if frame == mav.LOCAL_OFFSET else self.request(mav.Attitude).yaw
            self.send_setpoint(LocalSetpoint((6.0, 0.0, -2.0), frame=frame))
            self.run(9.0)
            wanted = (north + 6.0 * math.cos(yaw), east + 6.0 * math.sin(yaw), down - 2.0)
            self.require_position(wanted, f"frame {frame}")

    @book.rule(f"{GUIDED}, coordinate_frame")
    def foreign_frame_stops_the_vehicle(self) -> None:
        """A setpoint in a frame that is not known stops the vehicle."""
        self.fly(LocalSetpoint(velocity_mps=(3.0, 0.0, 0.0), mask=mav.VELOCITY), 3.0)
        self.send_setpoint(LocalSetpoint((50.0, 0.0, -10.0), frame=20))
        self.run(2.5)
        self._require_stopped("after 2.5 s", 1.0)

    @book.rule(GUIDED)
    def global_frames_without_int_are_accepted(self) -> None:
        """GLOBAL_INT setpoints are flown in frames 0 and 3 as in 5 and 6."""
        origin, home = self.request(mav.Origin), self.home()
        north, east, down = self.position()
        for number, frame in enumerate((0, 3)):
            wanted = (north + 5.0 + number, east + 4.0, down)
            position = mav.moved_e7(origin.latitude, origin.longitude, *wanted[:2])
            altitude_m = origin.altitude / 1e3 - down if frame == 0 else home.z - down
            self.send_setpoint(GlobalSetpoint(*position, altitude_m, frame))
            self.run(8.0)
            self.require_position(wanted, f"frame {frame}")

    @book.rule(f"{GUIDED}; ArduPilot wiki, Fences")
    def destination_outside_the_fence_is_refused(self) -> None:
        """Outside the fence a position is ignored and DO_REPOSITION fails."""
        self.require_upload(self.circle(40.0), mav.FENCE)
        self.enable_fence()
        before = self.position()
        self.send_setpoint(LocalSetpoint((before[0] + 90.0, *before[1:])))
        self.run(4.0)
        require_unmoved(before, self.position(), 1.5)
        home = self.home()
        position = mav.moved_e7(home.latitude, home.longitude, 90.0, 0.0)
        result = self.reposition(mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, (*position, 10.0))
        require(result == mav.FAILED, f"DO_REPOSITION: result {result}")

    @book.rule(GUIDED)
    def running_stream_acts_when_guided_returns(self) -> None:
        """A stream that never stopped acts at once when GUIDED is chosen again."""
        north, east, down = self.position()
        wanted = (north + 15.0, east, down)
        self.require_mode("loiter")
        stop = self.stream(LocalSetpoint(wanted))
        self.run(2.0)
        require_unmoved((north, east), self.position()[:2], 1.5)
        self.require_mode("offboard")
        self.run(10.0)
        stop()
        self.require_position(wanted, "back in GUIDED")
