"""Take-off, landing, return, reposition and reactions to failsafes."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import ACCEPTED, REFUSALS, TAKE_OFF
from sim_link.lab.conformance.protocol_clients import ParameterClient, SetpointClient
from sim_link.lab.conformance.rules import ARDUPILOT, ASKS, CHANGES, FLIES, PX4, RuleBook, require
from sim_link.lab.conformance.vehicle_probe import VehicleProbe

SERVICE = "MAVLink guide, Command Protocol"
STRICT = "(stricter than the real one, which accepts it)"
LOCATION = f"{SERVICE} (location commands belong in COMMAND_INT); {mav.OBSERVED_ARDUPILOT}"
REBOOTING = "MAVLink common, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN"
NO_PLACE = (1_000_000_000, 85_000_000, 500.0)
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
        height_m = -self.place()[2] + self.home().z
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
        down_m = self.place()[2]
        wanted = ACCEPTED if self.is_px4 else mav.FAILED
        self.require_result(wanted, TAKE_OFF, *self.takeoff_params(10.0))
        self.run(3.0)
        require(abs(self.place()[2] - down_m) < 1.5, "it left its height")

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
        """NAV_LAND comes down, reports ON_GROUND and disarms by itself."""
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
        distance_m = math.dist(self.place()[:2], (home.x, home.y))
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
        """DO_REPOSITION to no latitude or in a local frame is refused, and nothing moves."""
        self.take_off()
        before = self.place()
        cases = {
            "a latitude of 100 degrees": (mavlink.MAV_FRAME_GLOBAL, NO_PLACE),
            "local frame": (mavlink.MAV_FRAME_LOCAL_NED, (10, 10, -10.0)),
            "frame 20": (mavlink.MAV_FRAME_LOCAL_FRD, (10, 10, -10.0)),
        }
        if not self.is_px4:  # PX4 flies to 0/0 as to anywhere
            cases["latitude and longitude 0"] = (mavlink.MAV_FRAME_GLOBAL, (0, 0, 500.0))
        for name, (frame, place) in cases.items():
            result = self.reposition(frame, place)
            require(result in REFUSALS, f"{name}: result {result}")
        self.run(3.0)
        require(math.dist(before, self.place()) < 1.5, "it moved")

    @book.rule(mav.OBSERVED_ARDUPILOT, flavours=ARDUPILOT)
    def reposition_outside_guided_needs_its_flag(self) -> None:
        """Outside GUIDED, DO_REPOSITION without the change-mode flag is DENIED."""
        self.take_off()
        here = self.request(mav.GlobalPosition)
        self.set_mode("loiter")
        place = (here.lat, here.lon, here.alt / 1e3)
        result = self.reposition(mavlink.MAV_FRAME_GLOBAL, place, flags=0.0)
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
        """DO_SET_HOME to no latitude is refused and home stays."""
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
        """With NAV_DLL_ACT 2, COM_DL_LOSS_T without a ground station: Hold for a while, RETURN."""
        self.change("NAV_DLL_ACT", 2.0)
        self.change("COM_DL_LOSS_T", 5.0)
        self.take_off()
        self._require_return(3.0, "hold", 5.0 + HOLD_BEFORE_S)

    @book.rule("PX4 user guide, Offboard Mode, COM_OF_LOSS_T", flavours=PX4)
    def offboard_loss_time_is_the_parameter(self) -> None:
        """COM_OF_LOSS_T says how long setpoints may be missing."""
        require(self.read("COM_OF_LOSS_T").kind == mav.REAL32, "COM_OF_LOSS_T is no float")
        require(self.read("COM_OBL_RC_ACT").kind == mav.INT32, "COM_OBL_RC_ACT is no integer")
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
