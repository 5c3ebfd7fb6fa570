"""The setpoint stream of a companion: before, during and after it is in control."""

from __future__ import annotations

import itertools
import math

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    FORCE,
    METRES_PER_E7,
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
)
from sim_link.lab.conformance.puppet import PLACE, CompanionProbe, LocalTarget, SetpointMessage
from sim_link.lab.conformance.rules import PX4_ONLY, Flavour, NotApplicable, Role, RuleBook, require
from sim_link.lab.conformance.station import brief

book = RuleBook(Role.COMPANION, "setpoints")
PX4_PAGE = "PX4 user guide, Offboard Mode"
ARDUPILOT_PAGE = "ArduPilot wiki, Copter Commands in Guided Mode"
COMMON = "MAVLink common, SET_POSITION_TARGET_LOCAL_NED"
MIN_RATE_HZ = 2.0
MAX_GAP_S = 0.5
MAX_RATE_HZ = 55.0
LISTEN_S = 5.0
LOOK_S = 2.0
REACTION_S = 1.0
FIELDS = (
    (7, ("x", "y", "z")),
    (56, ("vx", "vy", "vz")),
    (448, ("afx", "afy", "afz")),
)
LOCAL_FRAMES = {Flavour.PX4: (1, 8), Flavour.ARDUPILOT: (1, 7, 8, 9)}
GLOBAL_FRAMES = {Flavour.PX4: (5, 6), Flavour.ARDUPILOT: (0, 3, 5, 6)}
FOREIGN_MODES = {
    Flavour.PX4: ("position", "return", "hold"),
    Flavour.ARDUPILOT: ("loiter", "return"),
}
FAR_M = 1_000.0


def rate_of(probe: CompanionProbe) -> tuple[float, float]:
    """Rate of the stream and its longest gap, over some seconds."""
    mark = probe.mark
    probe.run(LISTEN_S)
    times = [time_s for time_s, _ in probe.setpoints(mark)]
    require(len(times) > 1, f"{len(times)} setpoints in {LISTEN_S:g} s")
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    return len(times) / LISTEN_S, max(gaps)


def all_setpoints(probe: CompanionProbe) -> list[SetpointMessage]:
    """Setpoints from before and in control."""
    probe.give_control()
    probe.run(LOOK_S)
    return [message for _, message in probe.setpoints()]


def late_setpoints(probe: CompanionProbe, mode: str) -> int:
    """How many setpoints come although another mode was chosen a second ago."""
    probe.choose(mode)
    probe.run(REACTION_S)
    mark = probe.mark
    probe.run(LISTEN_S)
    return len(probe.setpoints(mark))


def disturbed_setpoints(probe: CompanionProbe, beat: Message, sender: tuple[int, int]) -> int:
    """How many setpoints come in 3 s in which another says a HEARTBEAT each second."""
    probe.give_control()
    mark = probe.mark
    for _ in range(3):
        probe.send_as(beat, *sender)
        probe.run(1.0)
    return len(probe.setpoints(mark))


@book.rule(PX4_PAGE, flavours=PX4_ONLY)
def stream_runs_before_the_mode(probe: CompanionProbe) -> None:
    """Setpoints flow at 2 Hz or more before OFFBOARD is chosen."""
    probe.await_setpoints()
    rate_hz, gap_s = rate_of(probe)
    require(rate_hz >= MIN_RATE_HZ and gap_s <= MAX_GAP_S, f"{rate_hz:.1f} Hz, gap {gap_s:.2f} s")


@book.rule(PX4_PAGE)
def stream_goes_on_in_the_mode(probe: CompanionProbe) -> None:
    """In OFFBOARD or GUIDED setpoints flow at 2 Hz or more, without gaps, and not too fast."""
    probe.give_control()
    rate_hz, gap_s = rate_of(probe)
    require(rate_hz >= MIN_RATE_HZ and gap_s <= MAX_GAP_S, f"{rate_hz:.1f} Hz, gap {gap_s:.2f} s")
    require(rate_hz <= MAX_RATE_HZ, f"{rate_hz:.0f} Hz")


@book.rule("MAVLink guide, Routing")
def setpoints_name_the_vehicle(probe: CompanionProbe) -> None:
    """Setpoints are addressed to the autopilot, system and component."""
    for message in all_setpoints(probe):
        target = (message.target_system, message.target_component)
        require(target == (probe.system_id, probe.component_id), brief(message))


@book.rule(f"{COMMON}; {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}")
def frame_is_one_the_vehicle_knows(probe: CompanionProbe) -> None:
    """coordinate_frame is one that the autopilot flies."""
    for message in all_setpoints(probe):
        is_local = isinstance(message, LocalTarget)
        known = (LOCAL_FRAMES if is_local else GLOBAL_FRAMES)[probe.flavour]
        require(message.coordinate_frame in known, f"frame {message.coordinate_frame}")


@book.rule(f"{COMMON}, POSITION_TARGET_TYPEMASK; {ARDUPILOT_PAGE}")
def type_mask_leaves_whole_groups(probe: CompanionProbe) -> None:
    """The mask leaves a whole position, velocity or acceleration, never the FORCE bit."""
    for message in all_setpoints(probe):
        mask = message.type_mask
        require(not mask & FORCE, f"mask {mask:#x} has FORCE_SET")
        shares = [mask & bits for bits, _ in FIELDS]
        whole = [share in (0, bits) for share, (bits, _) in zip(shares, FIELDS, strict=True)]
        require(all(whole), f"mask {mask:#x} splits a group")
        require(0 in shares, f"mask {mask:#x} asks for nothing")


@book.rule(f"{COMMON}; {OBSERVED_PX4}; {OBSERVED_ARDUPILOT}")
def used_fields_are_finite(probe: CompanionProbe) -> None:
    """No field is NaN or infinite, used or not: ArduPilot has died of it."""
    names = ("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    for message in all_setpoints(probe):
        is_local = isinstance(message, LocalTarget)
        place = ("x", "y", "z") if is_local else ("alt",)
        for name in names + place:
            require(math.isfinite(getattr(message, name)), f"{name} in {brief(message)}")


@book.rule("this project's own rule: nothing protects an autopilot from a wrong setpoint")
def setpoints_stay_near(probe: CompanionProbe) -> None:
    """A position setpoint is no kilometre away from the vehicle."""
    for message in all_setpoints(probe):
        if message.type_mask & 7:
            continue
        if isinstance(message, LocalTarget):
            distance_m = math.dist((message.x, message.y, message.z), (10.0, 10.0, probe.down_m))
        else:
            north_m = (message.lat_int - PLACE[0]) * METRES_PER_E7
            east_m = (message.lon_int - PLACE[1]) * METRES_PER_E7
            distance_m = math.hypot(north_m, east_m)
        require(distance_m < FAR_M, f"{distance_m:.0f} m away")


@book.rule("MAVLink common, SET_POSITION_TARGET_LOCAL_NED.time_boot_ms")
def stamps_rise(probe: CompanionProbe) -> None:
    """time_boot_ms never goes back."""
    stamps = [message.time_boot_ms for message in all_setpoints(probe)]
    for earlier, later in itertools.pairwise(stamps):
        require(later >= earlier, f"{earlier} is followed by {later}")


@book.rule(
    f"{OBSERVED_PX4}; {OBSERVED_ARDUPILOT}: a stream still running acts when the mode returns"
)
def foreign_mode_ends_the_stream(probe: CompanionProbe) -> None:
    """When the operator takes the mode away, setpoints stop within a second."""
    probe.give_control()
    late = late_setpoints(probe, FOREIGN_MODES[probe.flavour][0])
    require(not late, f"{late} setpoints after the mode was taken away")


@book.rule("this project's own rule: a mode that was taken away is not taken back")
def taken_mode_is_not_asked_back(probe: CompanionProbe) -> None:
    """It does not command its mode again after the operator took it away."""
    probe.give_control()
    probe.choose(FOREIGN_MODES[probe.flavour][0])
    mark = probe.mark
    probe.run(8.0)
    for _, command in probe.commands(mark):
        require(command.command != mavlink.MAV_CMD_DO_SET_MODE, brief(command))
    require(not probe.heard(mavlink.MAVLink_set_mode_message, mark), "SET_MODE was sent")


@book.rule(f"{OBSERVED_PX4} (returning setpoints return OFFBOARD)")
def failsafe_ends_the_stream(probe: CompanionProbe) -> None:
    """When a failsafe takes the mode, setpoints stop: going on would take the vehicle back."""
    probe.give_control()
    probe.is_failsafe = True
    late = late_setpoints(probe, FOREIGN_MODES[probe.flavour][1])
    probe.is_failsafe = False
    require(not late, f"{late} setpoints during the failsafe")


@book.rule("MAVLink guide, Heartbeat/Connection Protocol")
def lost_vehicle_ends_control(probe: CompanionProbe) -> None:
    """When the vehicle falls silent for five seconds nothing new is commanded to move."""
    probe.give_control()
    probe.go_silent()
    probe.run(6.0)
    mark = probe.mark
    probe.run(2.0)
    places = {place_of(message) for _, message in probe.setpoints(mark)}
    probe.come_back()
    require(len(places) <= 1, f"{len(places)} different setpoints to a silent vehicle")


def place_of(message: SetpointMessage) -> tuple[float, ...]:
    """Where a setpoint goes."""
    if isinstance(message, LocalTarget):
        return (message.x, message.y, message.z)
    return (message.lat_int, message.lon_int, message.alt)


@book.rule("MAVLink guide, Routing")
def other_vehicles_mode_changes_nothing(probe: CompanionProbe) -> None:
    """Another vehicle's heartbeat, in whatever mode, neither starts nor stops the stream."""
    foreign = mavlink.MAVLink_heartbeat_message(2, 12, 0x81, 0x50000 | 4 << 16, 4, 3)
    count = disturbed_setpoints(probe, foreign, (77, 1))
    require(count >= MIN_RATE_HZ * 3.0, f"{count} setpoints in 3 s")


@book.rule("MAVLink guide, Heartbeat/Connection Protocol (heartbeats of others are forwarded)")
def ground_stations_heartbeat_changes_nothing(probe: CompanionProbe) -> None:
    """A ground station's forwarded heartbeat, which shows no mode, does not stop the stream."""
    station = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    count = disturbed_setpoints(probe, station, (255, 190))
    require(count >= MIN_RATE_HZ * 3.0, f"{count} setpoints in 3 s")


@book.rule("this project's own rule: control is given, not found")
def disarmed_vehicle_is_not_armed_unasked(probe: CompanionProbe) -> None:
    """A disarmed vehicle is not armed unless the companion was told to fly by itself."""
    probe.is_armed = False
    probe.down_m = 0.0
    mark = probe.mark
    probe.run(8.0)
    number = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    arming = [c for _, c in probe.commands(mark) if c.command == number]
    if arming and arming[0].param2 != 21_196.0:
        raise NotApplicable("it is configured to launch by itself")
    require(not arming, "armed by force")
