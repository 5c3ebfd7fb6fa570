"""A ground station that flies a vehicle to try it."""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.mav.dialect import Message, mavlink
from sim_link.conformance.rules import Violation, require
from sim_link.conformance.setpoints import distance_m
from sim_link.conformance.vehicle_station import ACCEPTED, NAN, READY_S, VehicleStation

BOOT_S = 60.0
SPENT_PERCENT = 30
"""A battery that may not last for the next flight."""
FLIGHT_HEIGHT_M = 10.0
CLIMB_S = 40.0
LAND_S = 60.0
NEAR_M = 20.0
GO_BACK_S = 60.0
STREAM_PERIOD_S = 0.1

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
FORCE = 21196.0
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK


class VehicleProbe(VehicleStation):
    """Tries one vehicle in short flights."""

    def get_ready(self) -> None:
        """Wait until it can be armed, in the mode that flights begin in.

        Raises:
            Violation: It never gets ready.
        """
        self._begin_flight()
        if 0 <= self.latest(mavlink.MAVLink_sys_status_message).battery_remaining < SPENT_PERCENT:
            self.reboot()
            self._begin_flight()
        self.await_prearm()
        self.watch(mavlink.MAVLink_local_position_ned_message)

    def _begin_flight(self) -> None:
        self.set_mode("hold" if self.is_px4 else "offboard")
        self.watch(mavlink.MAVLink_sys_status_message, 0.2)

    def reboot(self) -> None:
        """Restart the autopilot; a simulated one has a fresh battery then.

        Raises:
            Violation: It refuses, or does not come back.
        """
        result = self.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0, 0.0, 0.0)
        require(result == ACCEPTED, f"the reboot gave result {result}")
        mark = self.mark
        back = self.run_until(
            lambda: bool(self.heard_since(mavlink.MAVLink_heartbeat_message, mark)), BOOT_S
        )
        require(back, f"it did not come back within {BOOT_S:g} s of a reboot")

    def await_prearm(self) -> None:
        """Wait until SYS_STATUS says that it can be armed.

        Raises:
            Violation: It never does.
        """
        ready = self.run_until(self._is_ready, READY_S)
        require(ready, f"not ready to arm within {READY_S:g} s (SYS_STATUS, PREARM_CHECK)")

    def arm(self) -> None:
        """Get ready and arm.

        Raises:
            Violation: It refuses.
        """
        self.get_ready()
        result = self.command(ARM, 1.0, 0.0)
        require(result == ACCEPTED, f"arming gave result {result}")

    def take_off(self, height_m: float = FLIGHT_HEIGHT_M) -> None:
        """Arm, climb above home and hover there.

        Raises:
            Violation: It does not get there.
        """
        self.arm()
        altitude_m = height_m
        unused = 0.0
        if self.is_px4:
            altitude_m += self.home().altitude / 1e3
            unused = NAN
        start_down_m = self.place()[2]
        params = (*[unused] * 6, altitude_m)
        result = self.command(mavlink.MAV_CMD_NAV_TAKEOFF, *params)
        require(result == ACCEPTED, f"NAV_TAKEOFF gave result {result}")
        climbed = self.run_until(lambda: start_down_m - self.place()[2] > height_m - 0.5, CLIMB_S)
        require(climbed, f"did not climb {height_m:g} m within {CLIMB_S:g} s")
        if self.is_px4:
            self.await_mode("hold", CLIMB_S)
        self.run(2.0)

    def stream(self, build: Callable[[], Message]) -> Callable[[], None]:
        """Send setpoints at 10 Hz until the returned function is called."""
        return self.repeat(build, STREAM_PERIOD_S)

    def enter_offboard(self, build: Callable[[], Message]) -> Callable[[], None]:
        """In the air: stream setpoints and let the vehicle follow them.

        Raises:
            Violation: It refuses.
        """
        stop = self.stream(build)
        self.run(1.2)
        result = self.set_mode("offboard")
        require(result == ACCEPTED, f"OFFBOARD or GUIDED gave result {result}")
        self.await_mode("offboard")
        return stop

    def come_to_rest(self, base_e7: tuple[int, int] | None = None) -> tuple[int, int]:
        """Land if it flies and wait until it is disarmed; for whoever tries the next rule.

        Args:
            base_e7: Where flights began, 1e-7 degrees: it goes back there from afar, or the next
                flights would lead ever farther away. None: here.

        Returns:
            The base.
        """
        self.signer = None
        here = self._where()
        if not self.is_armed():
            return base_e7 or here
        if base_e7 is not None:
            self._go_back(base_e7)
        self.set_mode("land")
        self.await_disarmed(LAND_S)
        return base_e7 or here

    def _where(self) -> tuple[int, int]:
        report = self.request(mavlink.MAVLink_global_position_int_message)
        return (report.lat, report.lon)

    def _go_back(self, base_e7: tuple[int, int]) -> None:
        """Fly to the base, unless it is near or the vehicle does not want to."""
        if distance_m(self._where(), base_e7) < NEAR_M:
            return
        above_home_m = max(FLIGHT_HEIGHT_M, self.home().z - self.place()[2])
        result = self.command_int(
            mavlink.MAV_CMD_DO_REPOSITION,
            mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
            (-1.0, 1.0, 0.0, NAN),
            (*base_e7, above_home_m),
        )
        if result == ACCEPTED:
            self.run_until(lambda: self._is_near(base_e7), GO_BACK_S)

    def _is_near(self, base_e7: tuple[int, int]) -> bool:
        self.run(1.0)
        return distance_m(self._where(), base_e7) < NEAR_M / 2.0

    def _is_ready(self) -> bool:
        status = self.from_vehicle(mavlink.MAVLink_sys_status_message)
        return bool(status) and bool(status[-1].onboard_control_sensors_health & PREARM)


def nothing_moved(
    before: tuple[float, float, float], after: tuple[float, float, float], tolerance_m: float
) -> None:
    """Raise `Violation` if two places differ by more than a tolerance."""
    moved_m = math.dist(before, after)
    if moved_m > tolerance_m:
        raise Violation(f"moved by {moved_m:.1f} m")
