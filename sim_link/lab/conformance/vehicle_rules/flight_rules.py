"""Take-off, landing, return, reposition, failsafes, and the loss of PX4's OFFBOARD."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import ACCEPTED, REFUSALS, TAKE_OFF, LocalSetpoint
from sim_link.lab.conformance.protocol_clients import ParameterClient, SetpointClient
from sim_link.lab.conformance.rules import (
    ARDUPILOT,
    ASKS,
    CHANGES,
    FLIES,
    PX4,
    Flavour,
    RuleBook,
    require,
)
from sim_link.lab.conformance.vehicle_probe import VehicleProbe, require_unmoved
from sim_link.lab.conformance.vehicle_rules.setpoint_rules import invalid_setpoints

SERVICE = "MAVLink guide, Command Protocol"
STRICT = "(stricter than real autopilots, which accept it)"
LOCATION = f"{SERVICE} (location commands belong in COMMAND_INT); {mav.OBSERVED_ARDUPILOT}"
REBOOTING = "MAVLink common, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN"
OFF_EARTH = (1_000_000_000, 85_000_000, 500.0)
"""Position at a latitude of 100 degrees."""


class FlightRules(VehicleProbe):
    """Take-off, landing, return and reposition."""

    book = RuleBook("flights", FLIES)

    def _require_landed_state(self, wanted: int, when: str) -> None:
        state = self.latest(mav.SysState).landed_state
        require(state == wanted, f"landed_state {state}{when}")

    @book.rule("MAVLink common, MAV_CMD_NAV_TAKEOFF")
    def takeoff_climbs_to_its_altitude(self) -> None:
        """NAV_TAKEOFF climbs to the altitude it names and stays there."""
        self.take_off(12.0)
        self.run(3.0)
        height_m = -self.position()[2] + self.home().z
        require(abs(height_m - 12.0) < 1.0, f"{height_m:.1f} m above home")

    @book.rule(f"{mav.OBSERVED_ARDUPILOT} {STRICT}", flavours=ARDUPILOT, harms=True)
    def takeoff_without_altitude_is_refused(self) -> None:
        """NAV_TAKEOFF with NaN, zero or less is refused: it would climb without end."""
        self.arm()
        for altitude in (mav.NAN, 0.0, -5.0, math.inf):
            self.require_result(REFUSALS, TAKE_OFF, 0, 0, 0, 0, 0, 0, altitude)

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def takeoff_needs_guided_and_arming(self) -> None:
        """NAV_TAKEOFF fails while disarmed, and in STABILIZE."""
        self.get_ready()
        params = self.takeoff_params(10.0)
        self.require_result(mav.FAILED, TAKE_OFF, *params)
        self.set_mode("stabilized")
        self.command(mav.ARM, 1.0, 0.0)
        self.require_result(mav.FAILED, TAKE_OFF, *params)

    @book.rule(f"{SERVICE} (commands are idempotent)")
    def takeoff_in_the_air_is_answered(self) -> None:
        """NAV_TAKEOFF in the air is ACCEPTED and does not bring the vehicle down."""
        self.take_off()
        down_m = self.position()[2]
        wanted = ACCEPTED if self.is_px4 else mav.FAILED
        self.require_result(wanted, TAKE_OFF, *self.takeoff_params(10.0))
        self.run(3.0)
        require(abs(self.position()[2] - down_m) < 1.5, "it left its height")

    @book.rule(f"{SERVICE} (never guess another frame)")
    def takeoff_in_a_foreign_frame_is_refused(self) -> None:
        """NAV_TAKEOFF as COMMAND_INT in a frame that is not known for it is refused."""
        self.arm()
        wanted = (mav.UNSUPPORTED_FRAME,) if self.is_px4 else REFUSALS
        for frame in (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_NED, 99):
            result = self.command_int(TAKE_OFF, frame, (0.0, 0.0, 0.0, mav.NAN), (0, 0, 10.0))
            require(result in wanted, f"frame {frame}: result {result}")

    @book.rule("MAVLink common, MAV_CMD_NAV_LAND; PX4 COM_DISARM_LAND; ArduPilot DISARM_DELAY")
    def land_ends_disarmed_on_the_ground(self) -> None:
        """NAV_LAND descends, reports ON_GROUND and disarms by itself."""
        self.take_off(5.0)
        self.watch(mav.SysState, 0.2)
        self._require_landed_state(mavlink.MAV_LANDED_STATE_IN_AIR, " in the air")
        self.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_LAND)
        self.await_mode("land")
        self.await_disarmed(40.0)
        self.run(0.5)
        self._require_landed_state(mavlink.MAV_LANDED_STATE_ON_GROUND, "")

    @book.rule("MAVLink common, MAV_CMD_NAV_RETURN_TO_LAUNCH")
    def return_comes_home_and_lands(self) -> None:
        """NAV_RETURN_TO_LAUNCH lands at home and disarms."""
        self.take_off(5.0)
        home = self.home()
        self.require_result(ACCEPTED, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
        self.await_mode("return")
        self.await_disarmed(120.0)
        distance_m = math.dist(self.position()[:2], (home.x, home.y))
        require(distance_m < 2.0, f"{distance_m:.1f} m from home")

    @book.rule("MAVLink common, MAV_CMD_DO_REPOSITION; MAVSDK action.goto_location")
    def reposition_flies_there(self) -> None:
        """DO_REPOSITION as COMMAND_INT in GLOBAL_INT flies to its position and altitude."""
        self.take_off()
        self.watch(mav.GlobalPosition, 0.1)
        here = self.latest(mav.GlobalPosition)
        wanted = (here.lat + 2_000, here.lon + 1_000, here.alt / 1e3 + 3.0)
        frame = mavlink.MAV_FRAME_GLOBAL_INT if self.is_px4 else mavlink.MAV_FRAME_GLOBAL
        result = self.reposition(frame, wanted)
        require(result == ACCEPTED, f"result {result}")
        near = self.run_until(lambda: self._distance_m(wanted) < 1.0, 40.0)
        require(near, f"{self._distance_m(wanted):.1f} m away after 40 s")

    def _distance_m(self, wanted: tuple[int, int, float]) -> float:
        """Return the newest GLOBAL_POSITION_INT's distance from a position, metres; flat earth."""
        here = self.expect(mav.GlobalPosition, within_s=3.0)
        return math.hypot(
            mav.distance_m((here.lat, here.lon), wanted[:2]), here.alt / 1e3 - wanted[2]
        )

    @book.rule(f"{mav.OBSERVED_ARDUPILOT} {STRICT}", harms=True)
    def senseless_reposition_is_refused(self) -> None:
        """DO_REPOSITION to a bad latitude or in a local frame is refused, and nothing moves."""
        self.take_off()
        before = self.position()
        cases = {
            "a latitude of 100 degrees": (mavlink.MAV_FRAME_GLOBAL, OFF_EARTH),
            "local frame": (mavlink.MAV_FRAME_LOCAL_NED, (10, 10, -10.0)),
            "frame 20": (mavlink.MAV_FRAME_LOCAL_FRD, (10, 10, -10.0)),
        }
        if not self.is_px4:  # PX4 flies to 0/0 as to anywhere
            cases["latitude and longitude 0"] = (mavlink.MAV_FRAME_GLOBAL, (0, 0, 500.0))
        for name, (frame, position) in cases.items():
            result = self.reposition(frame, position)
            require(result in REFUSALS, f"{name}: result {result}")
        self.run(3.0)
        require(math.dist(before, self.position()) < 1.5, "it moved")

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def reposition_outside_guided_needs_its_flag(self) -> None:
        """Outside GUIDED, DO_REPOSITION without the change-mode flag is DENIED."""
        self.take_off()
        here = self.request(mav.GlobalPosition)
        self.set_mode("loiter")
        position = (here.lat, here.lon, here.alt / 1e3)
        result = self.reposition(mavlink.MAV_FRAME_GLOBAL, position, flags=0.0)
        require(result == mav.DENIED, f"result {result}")

    @book.rule(LOCATION, flavours=ARDUPILOT, effect=ASKS)
    def reposition_as_long_is_refused(self) -> None:
        """DO_REPOSITION as COMMAND_LONG is refused."""
        params = (-1.0, 1.0, 0.0, mav.NAN, 47.0, 8.0, 500.0)
        wanted = (mav.UNSUPPORTED, mav.COMMAND_INT_ONLY, mav.DENIED, mav.FAILED)
        self.require_result(wanted, mavlink.MAV_CMD_DO_REPOSITION, *params)

    @book.rule("MAVLink common, MAV_CMD_DO_CHANGE_SPEED")
    def speed_change_is_accepted_in_flight(self) -> None:
        """DO_CHANGE_SPEED in flight is ACCEPTED."""
        self.take_off(5.0)
        self.require_result(ACCEPTED, mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 4.0, -1.0)

    @book.rule(REBOOTING, harms=True)
    def reboot_is_refused_while_armed(self) -> None:
        """PREFLIGHT_REBOOT_SHUTDOWN is refused while armed."""
        self.arm()
        self.require_result(REFUSALS, mav.REBOOT, 1.0, 0.0, 0.0)
        require(self.is_alive(), "it rebooted")
        require(self.is_armed(), "it disarmed")

    @book.rule("MAVLink common, MAV_CMD_DO_SET_HOME; HOME_POSITION", effect=CHANGES)
    def home_can_be_set(self) -> None:
        """DO_SET_HOME to a position near by moves HOME_POSITION there."""
        self.get_ready()
        home = self.home()
        lat, lon = home.latitude + 500, home.longitude - 500
        result = self.set_home((lat, lon, home.altitude / 1e3))
        require(result == ACCEPTED, f"result {result}")
        moved = self.home()
        require(abs(moved.latitude - lat) <= 1, f"latitude {moved.latitude}, not {lat}")
        require(abs(moved.longitude - lon) <= 1, f"longitude {moved.longitude}, not {lon}")

    @book.rule(f"MAVLink common, MAV_CMD_DO_SET_HOME {STRICT}", effect=CHANGES, harms=True)
    def senseless_home_is_refused(self) -> None:
        """DO_SET_HOME to a bad latitude is refused and home stays."""
        self.get_ready()
        before = self.home()
        result = self.set_home((1_000_000_000, 0, 488.0))
        require(result in REFUSALS, f"result {result}")
        require(self.home().latitude == before.latitude, "home moved")


HOLD_BEFORE_S = 6.0
"""PX4 holds for COM_FAIL_ACT_T, 5 s by default, before it returns."""


class FailsafeRules(ParameterClient, SetpointClient):
    """Failsafes of a vehicle, and their parameters."""

    book = RuleBook("failsafes", FLIES)

    def _require_return(self, early_s: float, mode: str, within_s: float) -> None:
        """Silent: it must stay in a mode for a while, then return, which is CRITICAL."""
        with self.silence():
            self.run(early_s)
            name = "RTL" if mode == "offboard" else "RETURN"
            require(self.is_in(mode), f"{name} before 5 s")
            self.await_mode("return", within_s)
            status = self.heartbeat().system_status
        require(status == mav.CRITICAL, f"system_status {status}")

    @book.rule(f"{mav.OBSERVED_ARDUPILOT}, FS_GCS_ENABLE, SYSID_MYGCS", flavours=ARDUPILOT)
    def lost_ground_station_returns(self) -> None:
        """FS_GCS_ENABLE: five seconds without a ground station's heartbeat end in RTL, CRITICAL."""
        self.change("FS_GCS_ENABLE", 1.0)
        self.take_off()
        mark = self.mark
        self._require_return(3.5, "offboard", 5.0)
        texts = [m.text for m in self.heard(mav.StatusText, mark)]
        require(any("GCS" in text for text in texts), f"texts {texts}")

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def lost_ground_station_is_nothing_by_default(self) -> None:
        """Without FS_GCS_ENABLE a silent ground station changes nothing."""
        self.take_off()
        with self.silence():
            self.run(9.0)
            require(self.is_in("offboard"), "it left GUIDED")

    @book.rule("PX4 user guide, Safety Configuration, NAV_DLL_ACT, COM_DL_LOSS_T", flavours=PX4)
    def lost_data_link_returns(self) -> None:
        """NAV_DLL_ACT 2: COM_DL_LOSS_T without a ground station end in Hold, then in RETURN."""
        self.change("NAV_DLL_ACT", 2.0)
        self.change("COM_DL_LOSS_T", 5.0)
        self.take_off()
        self._require_return(3.0, "hold", 5.0 + HOLD_BEFORE_S)

    @book.rule("PX4 user guide, Offboard Mode, COM_OF_LOSS_T", flavours=PX4)
    def offboard_loss_time_is_the_parameter(self) -> None:
        """COM_OF_LOSS_T is the longest permitted gap between setpoints."""
        require(self.read("COM_OF_LOSS_T").kind == mav.REAL32, "COM_OF_LOSS_T is not a float")
        require(self.read("COM_OBL_RC_ACT").kind == mav.INT32, "COM_OBL_RC_ACT is not an integer")
        number = mav.custom_mode(self.flavour, "offboard")
        self.change("COM_OF_LOSS_T", 4.0)
        self.begin_streaming()()
        self.run(2.5)
        require(self.request(mav.Heartbeat).custom_mode == number, "lost after 2.5 s")
        self.run(2.5)
        require(self.request(mav.Heartbeat).custom_mode != number, "not lost after 5 s")

    @book.rule(f"{REBOOTING}; SYSTEM_TIME", effect=CHANGES, harms=True)
    def reboot_restarts_the_clock_and_keeps_parameters(self) -> None:
        """Disarmed it reboots on command: time_boot_ms restarts, changed parameters stay."""
        self.get_ready()
        name = self.float_name
        self.change(name, 4.5)
        self.run(2.0)
        old_ms = self.request(mav.SystemTime).time_boot_ms
        self.reboot()
        new_ms = self.request(mav.SystemTime).time_boot_ms
        kept = self.read(name).value
        require(new_ms < old_ms, f"time_boot_ms went from {old_ms} to {new_ms}")
        require(kept == 4.5, f"{name} is {kept} after the reboot")


PX4_PAGE = "PX4 user guide, Offboard Mode"
OFFBOARD = f"{PX4_PAGE}; {mav.OBSERVED_PX4}"
LOSS_ACTION = "COM_OBL_RC_ACT"
LOSS_MODES = {0: "position", 3: "return", 4: "land", 5: "hold"}
OFFBOARD_NUMBER = mav.custom_mode(Flavour.PX4, "offboard")


class OffboardLossRules(SetpointClient, ParameterClient):
    """Conditions of PX4's OFFBOARD, and the events that end it."""

    book = RuleBook("offboard_loss", FLIES, PX4)

    def _lose_stream(self) -> LocalSetpoint:
        """Fly in OFFBOARD and end the stream; return its setpoint."""
        stop = self.begin_streaming()
        setpoint = LocalSetpoint(self.position())
        stop()
        return setpoint

    @book.rule(OFFBOARD)
    def offboard_needs_a_stream_in_the_air(self) -> None:
        """In the air OFFBOARD is refused without a stream, and given with one."""
        self.take_off()
        result = self.set_mode("offboard")
        require(result == mav.TEMPORARILY_REJECTED, f"without a stream: result {result}")
        self.enter_offboard(LocalSetpoint(self.position()))()

    @book.rule(OFFBOARD)
    def offboard_without_a_stream_cannot_be_armed(self) -> None:
        """Disarmed OFFBOARD is given without a stream, but arming is refused until there is one."""
        self.get_ready()
        self.require_mode("offboard")
        self.require_result(mav.TEMPORARILY_REJECTED, mav.ARM, 1.0, 0.0)
        stop = self.stream(LocalSetpoint(self.position()))
        self.run(1.5)
        self.require_result(mav.ACCEPTED, mav.ARM, 1.0, 0.0)
        self.require_result(mav.ACCEPTED, mav.ARM, 0.0, mav.FORCE_DISARM)
        stop()
        self.set_mode("hold")

    @book.rule(f"{PX4_PAGE}, COM_OF_LOSS_T; {mav.OBSERVED_PX4}")
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

    @book.rule(f"{PX4_PAGE}, COM_OBL_RC_ACT; {mav.OBSERVED_PX4}")
    def loss_action_is_the_parameter(self) -> None:
        """The mode after the loss is COM_OBL_RC_ACT's: position, return, land or hold."""
        setpoint = self._lose_stream()
        for action, mode in LOSS_MODES.items():
            self.change(LOSS_ACTION, float(action))
            self.follow(setpoint, 3.0)
            self.await_mode(mode, 4.0)

    @book.rule(mav.OBSERVED_PX4)
    def returning_stream_returns_offboard(self) -> None:
        """OFFBOARD resumes without a command when the setpoints return."""
        setpoint = self._lose_stream()
        self.run(2.5)
        require(not self.is_in("offboard"), "no failsafe")
        stop = self.stream(setpoint)
        self.await_mode("offboard", 3.0)
        stop()

    @book.rule(mav.OBSERVED_PX4)
    def chosen_mode_ends_the_wish_for_offboard(self) -> None:
        """A mode chosen during the failsafe remains when the setpoints return."""
        setpoint = self._lose_stream()
        self.run(2.0)
        self.require_mode("hold")
        self.fly(setpoint, 2.0)
        require(self.is_in("hold"), "OFFBOARD resumed against the operator's choice")

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
        position = self.begin()
        for name, setpoint in invalid_setpoints(self, position).items():
            self.follow(LocalSetpoint(position), 1.5)
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

    @book.rule(mav.OBSERVED_PX4)
    def missing_axis_holds_place(self) -> None:
        """A position with one axis masked off stays in OFFBOARD and in place."""
        before = self.begin()
        far = (before[0] + 30.0, before[1], before[2] - 20.0)
        self.fly(LocalSetpoint(far, mask=mav.POSITION | 4), 3.0)
        require(self.is_in("offboard"), "it left OFFBOARD")
        require_unmoved(before, self.position(), 1.5)
