"""HEARTBEAT and routing: who a vehicle is, who is addressed, and what is passed on to whom."""

from __future__ import annotations

import itertools

from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance import mavlink_oracle
from sim_link.lab.conformance.mavlink_oracle import (
    OBSERVED_ARDUPILOT,
    OBSERVED_PX4,
    SIGNED,
    build_frame,
    build_raw,
    sign,
)
from sim_link.lab.conformance.protocol_clients import float_name, read, write
from sim_link.lab.conformance.rules import (
    ARDUPILOT_ONLY,
    CHANGES,
    FLIES,
    PX4_ONLY,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.lab.conformance.station import Station, brief, heartbeat
from sim_link.lab.conformance.vehicle_probe import ACCEPTED, ARM, ARMED, FORCE, PREARM, VehicleProbe

heartbeat_book = RuleBook(Role.VEHICLE, "heartbeat")
Heartbeat = mavlink.MAVLink_heartbeat_message
SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
PX4_MODES = "PX4 px4_custom_mode.h; MAVSDK px4_custom_mode.h"
ARDUPILOT_MODES = "ArduPilot ArduCopter/mode.h"
COPTERS = (
    mavlink.MAV_TYPE_QUADROTOR,
    mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_COAXIAL,
)
PERIODS = 5
JITTER_S = 0.25


@heartbeat_book.rule(SERVICE)
def once_a_second(probe: VehicleProbe) -> None:
    """HEARTBEAT comes once a second."""
    probe.run(PERIODS + 1.0)
    beats = [e for e in probe.inbox if isinstance(e.message, Heartbeat)]
    times = [e.time_s for e in beats if e.source == probe.target]
    require(len(times) >= PERIODS, f"{len(times)} in {PERIODS + 1} s")
    for first, second in itertools.pairwise(times):
        gap_s = second - first
        require(abs(gap_s - 1.0) < JITTER_S, f"{gap_s:.2f} s between two")


@heartbeat_book.rule(SERVICE + "; MAVSDK system_impl.cpp is_autopilot")
def comes_from_component_one(probe: VehicleProbe) -> None:
    """The autopilot is component 1: MAVSDK takes no other for one."""
    require(probe.target[1] == mavlink.MAV_COMP_ID_AUTOPILOT1, f"component {probe.target[1]}")


@heartbeat_book.rule(SERVICE)
def tells_type_and_autopilot(probe: VehicleProbe) -> None:
    """HEARTBEAT tells a multicopter, the flavour's autopilot and MAVLink version 3."""
    message = probe.heartbeat()
    require(message.type in COPTERS, f"type {message.type}")
    wanted = mavlink_oracle.AUTOPILOT_OF[probe.flavour]
    require(message.autopilot == wanted, f"autopilot {message.autopilot}")
    require(message.mavlink_version == 3, f"mavlink_version {message.mavlink_version}")


@heartbeat_book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
def is_no_ground_station(probe: VehicleProbe) -> None:
    """The vehicle is not at a ground station's address."""
    require(probe.target != (255, 190), "the vehicle is 255/190")


@heartbeat_book.rule("MAVLink common, MAV_MODE_FLAG")
def custom_mode_flag_is_set(probe: VehicleProbe) -> None:
    """base_mode has CUSTOM_MODE_ENABLED."""
    message = probe.heartbeat()
    require(bool(message.base_mode & mavlink_oracle.CUSTOM), f"base_mode {message.base_mode}")


def check_modes(probe: VehicleProbe, table: dict[str, int]) -> None:
    """Choose each mode of a table, disarmed; HEARTBEAT must show it."""
    probe.require_disarmed()
    try:
        for mode, base_mode in table.items():
            probe.require_mode(mode)
            probe.await_mode(mode, 3.0)
            shown = probe.heartbeat().base_mode & ~mavlink.MAV_MODE_FLAG_HIL_ENABLED
            require(shown == base_mode, f"{mode}: base_mode {shown:#x}, not {base_mode:#x}")
    finally:
        probe.set_mode("hold" if probe.is_px4 else "stabilized")


@heartbeat_book.rule(f"{PX4_MODES}; {OBSERVED_PX4}", effect=CHANGES, flavours=PX4_ONLY)
def px4_modes_are_packed(probe: VehicleProbe) -> None:
    """custom_mode is main << 16 | sub << 24, and base_mode has the flags that PX4 sends."""
    names = ("hold", "land", "return", "takeoff")
    check_modes(probe, {name: mavlink_oracle.PX4_BASE_MODE[name] for name in names})


@heartbeat_book.rule(f"{PX4_MODES}; {OBSERVED_PX4}", effect=CHANGES, flavours=PX4_ONLY)
def px4_stick_modes_are_packed(probe: VehicleProbe) -> None:
    """POSCTL and ALTCTL are shown with the manual-input and stabilise flags."""
    names = ("position", "altitude")
    check_modes(probe, {name: mavlink_oracle.PX4_BASE_MODE[name] for name in names})


@heartbeat_book.rule(
    f"{ARDUPILOT_MODES}; {OBSERVED_ARDUPILOT}", effect=CHANGES, flavours=ARDUPILOT_ONLY
)
def ardupilot_modes_are_numbered(probe: VehicleProbe) -> None:
    """custom_mode is ArduCopter's mode number, and base_mode has the flags that it sends."""
    probe.get_ready()
    check_modes(
        probe, {k: v for k, v in mavlink_oracle.ARDUCOPTER_BASE_MODE.items() if k != "mission"}
    )


@heartbeat_book.rule(OBSERVED_ARDUPILOT, effect=CHANGES, flavours=ARDUPILOT_ONLY)
def mode_change_is_told_at_once(probe: VehicleProbe) -> None:
    """A changed mode is told by a HEARTBEAT of its own, without waiting for the next second."""
    probe.set_mode("stabilized")
    probe.heartbeat()
    probe.run(0.2)
    mark, number = probe.mark, mavlink_oracle.ARDUCOPTER["altitude"]
    probe.set_mode("altitude")
    probe.expect(Heartbeat, lambda m: m.custom_mode == number, within_s=0.4, mark=mark)
    probe.set_mode("stabilized")


@heartbeat_book.rule(f"MAVLink common, MAV_STATE; {OBSERVED_PX4}")
def disarmed_and_ready_is_standby(probe: VehicleProbe) -> None:
    """Disarmed and ready to arm, system_status is STANDBY."""
    probe.get_ready()
    message = probe.heartbeat()
    require(message.system_status == mavlink.MAV_STATE_STANDBY, brief(message))


@heartbeat_book.rule(f"MAVLink common, MAV_STATE; {OBSERVED_PX4}", flavours=PX4_ONLY)
def not_ready_is_uninit(probe: VehicleProbe) -> None:
    """While arming would be refused, system_status is UNINIT and the prearm bit is bad."""
    status = probe.expect(mavlink.MAVLink_sys_status_message, within_s=3.0)
    if status.onboard_control_sensors_health & PREARM:
        raise NotApplicable("it is ready already; seen only right after boot")
    message = probe.from_vehicle(Heartbeat)[-1]
    require(message.system_status == mavlink.MAV_STATE_UNINIT, brief(message))


@heartbeat_book.rule("MAVLink common, MAV_MODE_FLAG_SAFETY_ARMED", effect=FLIES)
def armed_flag_follows_arming(probe: VehicleProbe) -> None:
    """base_mode has SAFETY_ARMED exactly while the vehicle is armed."""
    require(not probe.is_armed(), "SAFETY_ARMED before arming")
    probe.arm()
    require(probe.is_armed(), "no SAFETY_ARMED after arming")
    probe.require_result(ACCEPTED, ARM, 0.0, FORCE)
    require(not probe.is_armed(), "SAFETY_ARMED after disarming")


@heartbeat_book.rule(
    "MAVLink common, MAV_STATE",
    effect=FLIES,
    ardupilot="ArduCopter stays STANDBY while armed on the ground, ACTIVE in the air",
)
def armed_and_flying_is_active(probe: VehicleProbe) -> None:
    """In the air system_status is ACTIVE."""
    probe.arm()
    on_ground = probe.heartbeat()
    require(bool(on_ground.base_mode & ARMED), brief(on_ground))
    wanted = mavlink.MAV_STATE_ACTIVE if probe.is_px4 else mavlink.MAV_STATE_STANDBY
    require(on_ground.system_status == wanted, f"armed on the ground: {brief(on_ground)}")
    probe.take_off()
    flying = probe.heartbeat()
    require(flying.system_status == mavlink.MAV_STATE_ACTIVE, f"in the air: {brief(flying)}")


routing_book = RuleBook(Role.VEHICLE, "routing")
ROUTING = "MAVLink guide, Routing"
REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE
VERSION_ID = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
Ack = mavlink.MAVLink_command_ack_message
CommandLong = mavlink.MAVLink_command_long_message
Version = mavlink.MAVLink_autopilot_version_message
UNKNOWN_ID = 45_998
FOREIGN_KEY = b"\x5a" * 32
SETTLE_S = 0.3


def request_version(system: int, component: int) -> Message:
    """A command that is harmless wherever it is obeyed."""
    return CommandLong(system, component, REQUEST, 0, VERSION_ID, 0, 0, 0, 0, 0, 0)


def unknown_system(probe: VehicleProbe) -> int:
    """A system id that nobody has."""
    return 77 if probe.target[0] != 77 else 78


def require_ignored(probe: VehicleProbe, system: int, component: int) -> None:
    """A command to an address must be neither obeyed nor acknowledged."""
    mark = probe.mark
    probe.send(request_version(system, component))
    probe.expect_none(Ack, lambda m: m.command == REQUEST, mark=mark, what="acknowledged")
    probe.expect_none(Version, for_s=0.1, mark=mark, what="obeyed")
    probe.require_hearing()


def require_obeyed(probe: VehicleProbe, system: int, component: int) -> None:
    """A command to an address must be obeyed and acknowledged."""
    mark = probe.mark
    probe.ask(request_version(system, component), Version)
    probe.expect(Ack, lambda m: m.command == REQUEST and m.result == 0, mark=mark)


@routing_book.rule(ROUTING, px4="PX4 1.15 answers FAILED; here it is asked to be silent")
def command_for_another_system_is_ignored(probe: VehicleProbe) -> None:
    """A command for another system is neither obeyed nor acknowledged."""
    require_ignored(probe, unknown_system(probe), probe.target[1])


@routing_book.rule(
    ROUTING,
    px4="PX4 1.15 answers FAILED; here it is asked to be silent",
    ardupilot="ArduCopter 4.5 obeys it; here it is asked to be silent",
)
def command_for_another_component_is_ignored(probe: VehicleProbe) -> None:
    """A command for another component of the same system is neither obeyed nor acknowledged."""
    require_ignored(probe, probe.target[0], 77)


@routing_book.rule(ROUTING)
def broadcast_is_obeyed(probe: VehicleProbe) -> None:
    """A command for system 0 and component 0 is obeyed."""
    require_obeyed(probe, 0, 0)


@routing_book.rule(ROUTING)
def component_zero_is_obeyed(probe: VehicleProbe) -> None:
    """A command for the right system and component 0 is obeyed."""
    require_obeyed(probe, probe.target[0], 0)


@routing_book.rule(ROUTING, px4="PX4 1.15 answers FAILED to system 0 with its own component")
def system_zero_is_obeyed(probe: VehicleProbe) -> None:
    """A command for system 0 and the right component is obeyed."""
    require_obeyed(probe, 0, probe.target[1])


@routing_book.rule("MAVLink guide, Command Protocol")
def acknowledgement_names_the_asker(probe: VehicleProbe) -> None:
    """COMMAND_ACK has the sender of the command as its target."""
    ack = probe.ask(request_version(*probe.target), Ack, lambda m: m.command == REQUEST)
    target = (ack.target_system, ack.target_component)
    require(target == (probe.system_id, probe.component_id), f"target {target}")


def frames_at(station: Station, mark: int, containing: bytes) -> list[bytes]:
    """The frames with certain bytes in them that a station got since `mark`."""
    station.run(SETTLE_S)
    return [frame for frame in station.frames_since(mark) if containing in frame]


def text_message(text: bytes) -> Message:
    """A STATUSTEXT, which is for everyone."""
    return mavlink.MAVLink_statustext_message(6, text, 0, 0)


def require_not_forwarded(
    probe: VehicleProbe, other: Station, target: tuple[int, int], what: str = "forwarded"
) -> None:
    """A command for a target must not reach a second station."""
    mark = other.mark
    probe.send(request_version(*target))
    other.expect_none(CommandLong, mark=mark, what=what)
    probe.require_hearing()


def require_forwarded(probe: VehicleProbe, frame: bytes) -> None:
    """A frame must reach a companion as it is."""
    other = companion_of(probe)
    mark = len(other.datagrams)
    probe.send_raw(frame)
    require(bool(frames_at(other, mark, frame)), "it was not forwarded")


def companion_of(probe: VehicleProbe) -> Station:
    """A companion of the same vehicle, on a connection of its own."""
    return probe.another(probe.target[0], 191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)


@routing_book.rule(ROUTING)
def broadcast_is_forwarded_unaltered(probe: VehicleProbe) -> None:
    """A broadcast of one client reaches the others byte for byte."""
    other = companion_of(probe)
    mark = len(other.datagrams)
    probe.send(text_message(b"forward me"))
    arrived = frames_at(other, mark, b"forward me")
    require(len(arrived) >= 1, "the other client did not get it")
    require(len(arrived) == 1, f"the other client got it {len(arrived)} times")
    source = (arrived[0][5], arrived[0][6])
    require(source == (probe.system_id, probe.component_id), f"it came as from {source}")


@routing_book.rule(ROUTING + "; PX4 1.15 and ArduCopter 4.5, observed in SITL")
def heartbeats_of_others_are_forwarded(probe: VehicleProbe) -> None:
    """A ground station hears the heartbeat of a companion on another connection."""
    mark = probe.mark
    other = companion_of(probe)
    other.send(heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER))
    source = (probe.target[0], 191)
    probe.expect(
        Heartbeat, lambda m: (m.get_srcSystem(), m.get_srcComponent()) == source, mark=mark
    )


@routing_book.rule(ROUTING)
def addressed_message_reaches_its_target(probe: VehicleProbe) -> None:
    """A command for a companion reaches the connection where it was heard."""
    other = companion_of(probe)
    mark = other.mark
    probe.send(request_version(probe.target[0], 191))
    other.expect(CommandLong, mark=mark)


@routing_book.rule(ROUTING)
def component_zero_reaches_the_whole_system(probe: VehicleProbe) -> None:
    """A command for all components of a system reaches every connection where it was heard."""
    first = probe.another(42, 191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    second = probe.another(42, 100, mavlink.MAV_TYPE_CAMERA)
    other = probe.another(43, 191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    marks = [station.mark for station in (first, second, other)]
    probe.send(request_version(42, 0))
    for station, mark in ((first, marks[0]), (second, marks[1])):
        station.expect(CommandLong, mark=mark)
    other.expect_none(CommandLong, mark=marks[2], what="leaked")


@routing_book.rule(ROUTING)
def addressed_message_reaches_nobody_else(probe: VehicleProbe) -> None:
    """A command for one component is not sent to where others were heard."""
    companion_of(probe)
    require_not_forwarded(probe, probe.another(253, 190), (probe.target[0], 191), "leaked")


@routing_book.rule(ROUTING)
def message_for_the_vehicle_stays_with_it(probe: VehicleProbe) -> None:
    """A command for the vehicle is not forwarded to its other clients."""
    require_not_forwarded(probe, companion_of(probe), probe.target)


@routing_book.rule(ROUTING)
def unknown_target_reaches_nobody(probe: VehicleProbe) -> None:
    """A command for a system that was never heard is not forwarded."""
    require_not_forwarded(probe, companion_of(probe), (unknown_system(probe), 1))


@routing_book.rule(ROUTING)
def own_message_never_returns(probe: VehicleProbe) -> None:
    """What a client sends is not sent back to it."""
    companion_of(probe)
    mark = len(probe.datagrams)
    probe.send(text_message(b"no echo please"))
    require(not frames_at(probe, mark, b"no echo please"), "it came back")
    probe.require_hearing()


@routing_book.rule(ROUTING)
def unknown_message_is_forwarded(probe: VehicleProbe) -> None:
    """A message that the vehicle cannot decode is forwarded all the same."""
    require_forwarded(probe, build_raw(UNKNOWN_ID, b"\x01\x02\x03\x04\x05", 17, probe.spec()))


@routing_book.rule(ROUTING)
def unauthenticated_frame_is_forwarded_unaltered(probe: VehicleProbe) -> None:
    """A frame signed with a key that the vehicle does not have goes on, signature and all."""
    frame = build_frame(text_message(b"signed by a stranger"), probe.spec(incompat=SIGNED))
    require_forwarded(probe, sign(frame, FOREIGN_KEY, 3, 10**13))


@routing_book.rule(ROUTING + "; MAVLink guide, Message Signing")
def signing_setup_is_never_forwarded(probe: VehicleProbe) -> None:
    """SETUP_SIGNING, which holds a key, is never passed on."""
    other = companion_of(probe)
    mark = len(other.datagrams)
    key = bytes(range(1, 33))
    for target in ((probe.target[0], 191), (unknown_system(probe), 1)):
        probe.send(mavlink.MAVLink_setup_signing_message(*target, list(key), 0))
    require(not frames_at(other, mark, key), "the key was passed on")
    probe.require_hearing()


@routing_book.rule(ROUTING)
def reboot_of_a_system_clears_its_routes(probe: VehicleProbe) -> None:
    """A system whose SYSTEM_TIME goes back has rebooted: what was behind it is forgotten."""
    other = probe.another(42, 1, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    behind = Station(other.link, 42, 7, None)
    behind.send(heartbeat(mavlink.MAV_TYPE_CAMERA))
    mark = behind.mark
    probe.send(request_version(42, 7))
    behind.run(SETTLE_S)
    if not behind.heard(CommandLong):
        raise NotApplicable("commands are not forwarded to components behind a client")
    other.send(mavlink.MAVLink_system_time_message(0, 500_000))
    other.send(mavlink.MAVLink_system_time_message(0, 1_000))
    mark = behind.mark
    probe.send(request_version(42, 7))
    behind.expect_none(CommandLong, mark=mark, what="still routed")


@routing_book.rule(ROUTING, effect=CHANGES)
def parameter_change_reaches_all_clients(probe: VehicleProbe) -> None:
    """A changed parameter is told to every client."""
    other = companion_of(probe)
    name = float_name(probe)
    present = read(probe, name)
    mark = other.mark
    write(probe, name, present.value(probe), present.kind)
    other.expect(mavlink.MAVLink_param_value_message, lambda m: m.param_id == name, mark=mark)
