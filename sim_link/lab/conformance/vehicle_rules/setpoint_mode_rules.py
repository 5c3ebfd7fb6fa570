"""PX4's OFFBOARD and ArduCopter's GUIDED: what the mode needs, and what ends it."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import GlobalSetpoint, LocalSetpoint
from sim_link.lab.conformance.protocol_clients import ParameterClient, PlanClient, SetpointClient
from sim_link.lab.conformance.rules import ARDUPILOT, FLIES, PX4, Flavour, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import VehicleProbe, require_unmoved
from sim_link.lab.conformance.vehicle_rules.setpoint_rules import invalid_setpoints

GUIDED = "ArduPilot wiki, Copter Commands in Guided Mode; ArduCopter 4.5, observed in SITL"
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
        north, east, down = self.place()
        wanted = (north + 25.0, east, down)
        self.send_setpoint(LocalSetpoint(wanted))
        for when in ("after 15 s", "after 30 s"):
            self.run(15.0)
            self.require_place(wanted, when)

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
        before = self.place()
        for bit in (1, 2, 4):
            far = (before[0] + 30.0, *before[1:])
            self.send_setpoint(LocalSetpoint(far, mask=mav.POSITION | bit))
            self.run(2.0)
            require_unmoved(before, self.place(), 1.5)

    @book.rule(f"{GUIDED}, coordinate_frame")
    def offset_frames_are_relative(self) -> None:
        """LOCAL_OFFSET_NED, BODY_NED and BODY_OFFSET_NED positions count from the vehicle."""
        for frame in (mav.LOCAL_OFFSET, mav.BODY_NED, mav.BODY_OFFSET):
            north, east, down = self.place()
            yaw = 0.0 if frame == mav.LOCAL_OFFSET else self.request(mav.Attitude).yaw
            self.send_setpoint(LocalSetpoint((6.0, 0.0, -2.0), frame=frame))
            self.run(9.0)
            wanted = (north + 6.0 * math.cos(yaw), east + 6.0 * math.sin(yaw), down - 2.0)
            self.require_place(wanted, f"frame {frame}")

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
        north, east, down = self.place()
        for number, frame in enumerate((0, 3)):
            wanted = (north + 5.0 + number, east + 4.0, down)
            place = mav.moved_e7(origin.latitude, origin.longitude, *wanted[:2])
            altitude_m = origin.altitude / 1e3 - down if frame == 0 else home.z - down
            self.send_setpoint(GlobalSetpoint(*place, altitude_m, frame))
            self.run(8.0)
            self.require_place(wanted, f"frame {frame}")

    @book.rule(f"{GUIDED}; ArduPilot wiki, Fences")
    def destination_outside_the_fence_is_refused(self) -> None:
        """Outside the fence a position is ignored and DO_REPOSITION fails."""
        self.require_upload(self.circle(40.0), mav.FENCE)
        self.enable_fence()
        before = self.place()
        self.send_setpoint(LocalSetpoint((before[0] + 90.0, *before[1:])))
        self.run(4.0)
        require_unmoved(before, self.place(), 1.5)
        home = self.home()
        place = mav.moved_e7(home.latitude, home.longitude, 90.0, 0.0)
        result = self.reposition(mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, (*place, 10.0))
        require(result == mav.FAILED, f"DO_REPOSITION: result {result}")

    @book.rule(GUIDED)
    def running_stream_acts_when_guided_returns(self) -> None:
        """A stream that never stopped acts at once when GUIDED is chosen again."""
        north, east, down = self.place()
        wanted = (north + 15.0, east, down)
        self.require_mode("loiter")
        stop = self.stream(LocalSetpoint(wanted))
        self.run(2.0)
        require_unmoved((north, east), self.place()[:2], 1.5)
        self.require_mode("offboard")
        self.run(10.0)
        stop()
        self.require_place(wanted, "back in GUIDED")


OFFBOARD_OBSERVED = "PX4 1.15, observed in SITL"
PX4_PAGE = "PX4 user guide, Offboard Mode"
OFFBOARD = f"{PX4_PAGE}; {OFFBOARD_OBSERVED}"
LOSS_ACTION = "COM_OBL_RC_ACT"
LOSS_MODES = {0: "position", 3: "return", 4: "land", 5: "hold"}
OFFBOARD_NUMBER = mav.custom_mode(Flavour.PX4, "offboard")


class OffboardLossRules(SetpointClient, ParameterClient):
    """Conditions of PX4's OFFBOARD, and the events that end it."""

    book = RuleBook("offboard_loss", FLIES, PX4)

    def _lose_stream(self) -> LocalSetpoint:
        """Fly in OFFBOARD and end the stream; return its setpoint."""
        stop = self.begin_streaming()
        setpoint = LocalSetpoint(self.place())
        stop()
        return setpoint

    @book.rule(OFFBOARD)
    def offboard_needs_a_stream_in_the_air(self) -> None:
        """In the air OFFBOARD is refused without a stream, and given with one."""
        self.take_off()
        result = self.set_mode("offboard")
        require(result == mav.TEMPORARILY_REJECTED, f"without a stream: result {result}")
        self.enter_offboard(LocalSetpoint(self.place()))()

    @book.rule(OFFBOARD)
    def offboard_without_a_stream_cannot_be_armed(self) -> None:
        """Disarmed OFFBOARD is given without a stream, but arming is refused until there is one."""
        self.get_ready()
        self.require_mode("offboard")
        self.require_result(mav.TEMPORARILY_REJECTED, mav.ARM, 1.0, 0.0)
        stop = self.stream(LocalSetpoint(self.place()))
        self.run(1.5)
        self.require_result(mav.ACCEPTED, mav.ARM, 1.0, 0.0)
        self.require_result(mav.ACCEPTED, mav.ARM, 0.0, mav.FORCE_DISARM)
        stop()
        self.set_mode("hold")

    @book.rule(f"{PX4_PAGE}, COM_OF_LOSS_T; {OFFBOARD_OBSERVED}")
    def lost_stream_is_a_failsafe(self) -> None:
        """A second without setpoints ends OFFBOARD: another mode, and system_status CRITICAL."""
        self.begin_streaming()()
        self.run(0.7)
        early = self.request(mav.Heartbeat)
        require(early.system_status == mav.ACTIVE, "failsafe before COM_OF_LOSS_T")
        self.run(1.0)
        beat = self.request(mav.Heartbeat)
        require(beat.system_status == mav.CRITICAL, f"system_status {beat.system_status}")
        require(beat.custom_mode != OFFBOARD_NUMBER, "still OFFBOARD")

    @book.rule(f"{PX4_PAGE}, COM_OBL_RC_ACT; {OFFBOARD_OBSERVED}")
    def loss_action_is_the_parameter(self) -> None:
        """The mode after the loss is COM_OBL_RC_ACT's: position, return, land or hold."""
        setpoint = self._lose_stream()
        for action, mode in LOSS_MODES.items():
            self.change(LOSS_ACTION, float(action))
            self.follow(setpoint, 3.0)
            self.await_mode(mode, 4.0)

    @book.rule(OFFBOARD_OBSERVED)
    def returning_stream_returns_offboard(self) -> None:
        """OFFBOARD comes back without a command when the setpoints come back."""
        setpoint = self._lose_stream()
        self.run(2.5)
        require(not self.is_in("offboard"), "no failsafe")
        stop = self.stream(setpoint)
        self.await_mode("offboard", 3.0)
        stop()

    @book.rule(OFFBOARD_OBSERVED)
    def chosen_mode_ends_the_wish_for_offboard(self) -> None:
        """A mode chosen during the failsafe stays when the setpoints come back."""
        setpoint = self._lose_stream()
        self.run(2.0)
        self.require_mode("hold")
        self.fly(setpoint, 2.0)
        require(self.is_in("hold"), "OFFBOARD came back against the operator's choice")

    @book.rule(OFFBOARD)
    def short_gap_is_no_loss(self) -> None:
        """Gaps of 0.3, 0.6 and 0.9 s change nothing; 2 Hz is enough."""
        setpoint = LocalSetpoint(self.begin())
        for gap_s in (0.3, 0.6, 0.9, 0.5, 0.5):
            self.send_setpoint(setpoint)
            self.run(gap_s)
            for beat in self.from_vehicle(mav.Heartbeat, self.asked):
                require(beat.custom_mode == OFFBOARD_NUMBER, f"lost in a gap of {gap_s} s")

    @book.rule(f"{OFFBOARD} (stricter: a NaN invalidates the whole message)", harms=True)
    def senseless_setpoint_is_no_proof_of_life(self) -> None:
        """A stream of invalid setpoints counts as lost."""
        place = self.begin()
        for name, setpoint in invalid_setpoints(self, place).items():
            self.follow(LocalSetpoint(place), 1.5)
            stop = self.stream(setpoint)
            self.run(2.5)
            is_alive = self.is_in("offboard")
            stop()
            require(not is_alive, f"{name}: OFFBOARD goes on")

    @book.rule(f"{PX4_PAGE} (unknown frame: a text)")
    def unknown_frame_is_answered(self) -> None:
        """A setpoint in a frame that is not known is answered by a text."""
        setpoint = LocalSetpoint(self.begin(), frame=20)
        mark = self.mark
        self.fly(setpoint, 2.0)
        require(bool(self.heard(mav.StatusText, mark)), "no text")

    @book.rule(OFFBOARD_OBSERVED)
    def missing_axis_holds_place(self) -> None:
        """A position with one axis masked off stays in OFFBOARD and in place."""
        before = self.begin()
        far = (before[0] + 30.0, before[1], before[2] - 20.0)
        self.fly(LocalSetpoint(far, mask=mav.POSITION | 4), 3.0)
        require(self.is_in("offboard"), "it left OFFBOARD")
        require_unmoved(before, self.place(), 1.5)
