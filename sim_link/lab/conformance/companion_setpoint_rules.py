"""The setpoint stream of a companion: before, during and after it is in control."""

from __future__ import annotations

import itertools
import math

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle as mav
from sim_link.lab.conformance.mavlink_oracle import METRES_PER_E7, LocalTarget
from sim_link.lab.conformance.puppet import PLACE, SETPOINTS, CompanionProbe, SetpointMessage
from sim_link.lab.conformance.rules import PX4, Flavour, RuleBook, assume, require
from sim_link.lab.conformance.station import brief

PX4_PAGE = "PX4 user guide, Offboard Mode"
COMMON = "MAVLink common, SET_POSITION_TARGET_LOCAL_NED"
OBSERVED = f"{COMMON}; {mav.OBSERVED_BOTH}"
ROUTING = "MAVLink guide, Routing"
HEARTBEAT_SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
OWN_RULE = "this project's own rule"
MIN_RATE_HZ = 2.0
MAX_GAP_S = 0.5
MAX_RATE_HZ = 55.0
LISTEN_S = 5.0
LOOK_S = 2.0
REACTION_S = 1.0
QUIET_S = 2.0
"""PX4 may report the failsafe that took the mode one HEARTBEAT, a second, after the mode."""
STAYS_M = 2.0
GROUPS = (7, 56, 448)
"""Bits of position, velocity and acceleration in a mask."""
NEVER_NAN = ("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
LOCAL_FRAMES = {Flavour.PX4: (1, 8), Flavour.ARDUPILOT: (1, 7, 8, 9)}
GLOBAL_FRAMES = {Flavour.PX4: (5, 6), Flavour.ARDUPILOT: (0, 3, 5, 6)}
FOREIGN_MODES = {
    Flavour.PX4: ("position", "return", "hold"),
    Flavour.ARDUPILOT: ("loiter", "return"),
}
FAR_M = 1_000.0


class SetpointRules(CompanionProbe):
    """The setpoint stream of a companion."""

    book = RuleBook("setpoints")

    def _require_rate(self) -> float:
        """Require a stream without gaps; return its rate."""
        mark = self.mark
        self.run(LISTEN_S)
        times = self.times(SETPOINTS, mark)
        require(len(times) > 1, f"{len(times)} setpoints in {LISTEN_S:g} s")
        gap_s = max(later - earlier for earlier, later in itertools.pairwise(times))
        rate_hz = len(times) / LISTEN_S
        is_good = rate_hz >= MIN_RATE_HZ and gap_s <= MAX_GAP_S
        require(is_good, f"{rate_hz:.1f} Hz, gap {gap_s:.2f} s")
        return rate_hz

    def _all_setpoints(self) -> list[SetpointMessage]:
        self.give_control()
        self.run(LOOK_S)
        return self.setpoints()

    def _late_setpoints(self, mode: str, listen_s: float = LISTEN_S) -> int:
        """Count the setpoints that come although another mode was chosen a second ago."""
        self.choose(mode)
        self.run(REACTION_S)
        mark = self.mark
        self.run(listen_s)
        return len(self.setpoints(mark))

    def _require_undisturbed(self, beat: Message, sender: tuple[int, int]) -> None:
        """Require setpoints for 3 s while another system sends a HEARTBEAT each second."""
        self.give_control()
        mark = self.mark
        for _ in range(3):
            self.send_as(beat, *sender)
            self.run(1.0)
        count = len(self.setpoints(mark))
        require(count >= MIN_RATE_HZ * 3.0, f"{count} setpoints in 3 s")

    @book.rule(PX4_PAGE, flavours=PX4)
    def stream_runs_before_the_mode(self) -> None:
        """Setpoints flow at 2 Hz or more before OFFBOARD is chosen."""
        self.await_setpoints()
        self._require_rate()

    @book.rule(PX4_PAGE)
    def stream_goes_on_in_the_mode(self) -> None:
        """In OFFBOARD or GUIDED setpoints flow at 2 Hz or more, without gaps, and not too fast."""
        self.give_control()
        rate_hz = self._require_rate()
        require(rate_hz <= MAX_RATE_HZ, f"{rate_hz:.0f} Hz")

    @book.rule(ROUTING)
    def setpoints_name_the_vehicle(self) -> None:
        """Setpoints are addressed to the autopilot, system and component."""
        self.require_addressed(self._all_setpoints())

    @book.rule(OBSERVED)
    def frame_is_one_the_vehicle_knows(self) -> None:
        """coordinate_frame is one that the autopilot flies."""
        for message in self._all_setpoints():
            is_local = isinstance(message, LocalTarget)
            known = (LOCAL_FRAMES if is_local else GLOBAL_FRAMES)[self.flavour]
            require(message.coordinate_frame in known, f"frame {message.coordinate_frame}")

    @book.rule(
        f"{COMMON}, POSITION_TARGET_TYPEMASK; ArduPilot wiki, Copter Commands in Guided Mode"
    )
    def type_mask_leaves_whole_groups(self) -> None:
        """The mask leaves a whole position, velocity or acceleration, never the FORCE bit."""
        for message in self._all_setpoints():
            mask = message.type_mask
            require(not mask & mav.FORCE, f"mask {mask:#x} has FORCE_SET")
            is_whole = all(mask & bits in (0, bits) for bits in GROUPS)
            require(is_whole, f"mask {mask:#x} splits a group")
            require(any(mask & bits == 0 for bits in GROUPS), f"mask {mask:#x} asks for nothing")

    @book.rule(OBSERVED)
    def used_fields_are_finite(self) -> None:
        """No field is NaN or infinite, used or not: ArduPilot has died of it."""
        for message in self._all_setpoints():
            place = ("x", "y", "z") if isinstance(message, LocalTarget) else ("alt",)
            for name in NEVER_NAN + place:
                require(math.isfinite(getattr(message, name)), f"{name} in {brief(message)}")

    @book.rule(f"{OWN_RULE}: nothing protects an autopilot from a wrong setpoint")
    def setpoints_stay_near(self) -> None:
        """A position setpoint is no kilometre away from the vehicle."""
        for message in self._all_setpoints():
            if message.type_mask & 7:
                continue
            if isinstance(message, LocalTarget):
                distance_m = math.dist(place_of(message), (10.0, 10.0, self.down_m))
            else:
                place = (message.lat_int, message.lon_int)
                distance_m = math.dist(place, PLACE[:2]) * METRES_PER_E7
            require(distance_m < FAR_M, f"{distance_m:.0f} m away")

    @book.rule("MAVLink common, SET_POSITION_TARGET_LOCAL_NED.time_boot_ms")
    def stamps_rise(self) -> None:
        """time_boot_ms never goes back."""
        stamps = [message.time_boot_ms for message in self._all_setpoints()]
        for earlier, later in itertools.pairwise(stamps):
            require(later >= earlier, f"{earlier} is followed by {later}")

    @book.rule(f"{mav.OBSERVED_BOTH}: a stream still running acts when the mode returns")
    def foreign_mode_ends_the_stream(self) -> None:
        """Setpoints stop within a second after the operator takes the mode away.

        A stream that makes ready for the next time begins no sooner than two seconds after the
        mode, only where the autopilot needs it, and moves nothing.
        """
        self.give_control()
        late = self._late_setpoints(FOREIGN_MODES[self.flavour][0], QUIET_S - REACTION_S)
        require(not late, f"{late} setpoints after the mode was taken away")
        mark = self.mark
        self.run(LISTEN_S)
        for message in self.setpoints(mark):
            require(self.flavour in PX4, "setpoints that this autopilot does not need")
            if isinstance(message, LocalTarget):
                off_m = math.dist(place_of(message), (10.0, 10.0, self.down_m))
                require(off_m <= STAYS_M, f"a setpoint {off_m:.1f} m away in another mode")

    @book.rule(f"{OWN_RULE}: a mode that was taken away is not taken back")
    def taken_mode_is_not_asked_back(self) -> None:
        """It does not command its mode again after the operator took it away."""
        self.give_control()
        self.choose(FOREIGN_MODES[self.flavour][0])
        mark = self.mark
        self.run(8.0)
        for command in self.commands(mark):
            require(command.command != mavlink.MAV_CMD_DO_SET_MODE, brief(command))
        require(not self.heard(mavlink.MAVLink_set_mode_message, mark), "SET_MODE was sent")

    @book.rule(f"{mav.OBSERVED_PX4} (returning setpoints return OFFBOARD)")
    def failsafe_ends_the_stream(self) -> None:
        """Setpoints stop when a failsafe takes the mode: going on would take the vehicle back."""
        self.give_control()
        self.is_failsafe = True
        late = self._late_setpoints(FOREIGN_MODES[self.flavour][1])
        self.is_failsafe = False
        require(not late, f"{late} setpoints during the failsafe")

    @book.rule(HEARTBEAT_SERVICE)
    def lost_vehicle_ends_control(self) -> None:
        """After five seconds of silence from the vehicle no new motion is commanded."""
        self.give_control()
        self.go_silent()
        self.run(6.0)
        mark = self.mark
        self.run(2.0)
        places = {place_of(message) for message in self.setpoints(mark)}
        self.come_back()
        require(len(places) <= 1, f"{len(places)} different setpoints to a silent vehicle")

    @book.rule(ROUTING)
    def other_vehicles_mode_changes_nothing(self) -> None:
        """Another vehicle's heartbeat, in whatever mode, neither starts nor stops the stream."""
        self._require_undisturbed(mav.Heartbeat(2, 12, 0x81, 0x50000 | 4 << 16, 4, 3), (77, 1))

    @book.rule(f"{HEARTBEAT_SERVICE} (heartbeats of others are forwarded)")
    def ground_stations_heartbeat_changes_nothing(self) -> None:
        """A ground station's forwarded heartbeat, which shows no mode, does not stop the stream."""
        self._require_undisturbed(mav.Heartbeat(6, 8, 0, 0, 4, 3), (255, 190))

    @book.rule(f"{OWN_RULE}: control is given, not found")
    def disarmed_vehicle_is_not_armed_unasked(self) -> None:
        """A disarmed vehicle is not armed unless it is set to launch by itself."""
        self.is_armed = False
        self.down_m = 0.0
        mark = self.mark
        self.run(8.0)
        forces = [c.param2 for c in self.commands(mark) if c.command == mav.ARM]
        is_by_force = forces[:1] in ([], [mav.FORCE_DISARM])
        assume(is_by_force, "it is configured to launch by itself")
        require(not forces, "armed by force")


def place_of(message: SetpointMessage) -> tuple[float, ...]:
    """Return the position of a setpoint."""
    if isinstance(message, LocalTarget):
        return (message.x, message.y, message.z)
    return (message.lat_int, message.lon_int, message.alt)
