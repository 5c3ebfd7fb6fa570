"""Frames: checksums, flags, truncation and source ids; garbage costs nothing but itself."""

from __future__ import annotations

import itertools
from dataclasses import replace

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    MAGIC_V1,
    MAGIC_V2,
    FrameSpec,
    base_length,
    build_frame,
    build_raw,
    payload_of,
)
from sim_link.lab.conformance.rules import Role, RuleBook, Violation, require
from sim_link.lab.conformance.station import heartbeat
from sim_link.lab.conformance.vehicle_probe import ACK_S, VehicleProbe

book = RuleBook(Role.VEHICLE, "frames")
SERIALIZATION = "MAVLink guide, Packet Serialization"
VERSIONS = "MAVLink guide, MAVLink Versions"
PACKET_LOSS = "MAVLink guide, Packet Loss"
UNKNOWN_ID = 45_999
LISTEN_S = 3.0
LONGEST_FRAME, SHORTEST_HEARTBEAT = 280, 17


def question(probe: VehicleProbe) -> mavlink.MAVLink_timesync_message:
    """A TIMESYNC request that no other was like."""
    return mavlink.MAVLink_timesync_message(0, 7_000_000_000 + probe.mark)


def is_answered(
    probe: VehicleProbe,
    data: bytes,
    asked: int,
    within_s: float = ACK_S,
    *,
    has_junk: bool = False,
) -> bool:
    """Whether a TIMESYNC with `ts1` = `asked` comes back after `data` was sent."""
    mark = probe.mark
    probe.send_raw(data)
    if has_junk:
        push_through(probe)
    return probe.is_synchronised(asked, mark, within_s)


def push_through(probe: VehicleProbe) -> None:
    """On a byte stream, send as much as a lying length byte can make a parser wait for."""
    if probe.link.is_datagram:
        return
    for _ in range(LONGEST_FRAME // SHORTEST_HEARTBEAT + 1):
        probe.send(heartbeat(mavlink.MAV_TYPE_GCS))


def require_answer(probe: VehicleProbe, spec: FrameSpec, problem: str) -> None:
    """The vehicle must take a TIMESYNC sent as `spec` says."""
    message = question(probe)
    if not is_answered(probe, build_frame(message, spec), message.ts1):
        raise Violation(problem)


def require_silence(probe: VehicleProbe, spec: FrameSpec, problem: str) -> None:
    """The vehicle must not take a TIMESYNC sent as `spec` says, but the next right one."""
    message = question(probe)
    if is_answered(probe, build_frame(message, spec), message.ts1, 0.5):
        raise Violation(problem)
    push_through(probe)  # a byte of what was dropped may look like the beginning of a frame
    probe.require_hearing()


@book.rule(SERIALIZATION)
def mavlink2_is_understood(probe: VehicleProbe) -> None:
    """A MAVLink 2 frame is understood."""
    require_answer(probe, probe.spec(), "a MAVLink 2 request is not answered")


@book.rule(VERSIONS)
def mavlink1_is_understood(probe: VehicleProbe) -> None:
    """A MAVLink 1 frame is understood, and answered in either version."""
    require_answer(probe, probe.spec(version=1), "a MAVLink 1 request is not answered")


@book.rule(VERSIONS)
def one_version_per_channel(probe: VehicleProbe) -> None:
    """To a client that speaks MAVLink 2 every frame is MAVLink 2."""
    probe.is_alive()
    mark = probe.mark
    probe.run(LISTEN_S)
    versions = {entry.frame[0] for entry in probe.inbox[mark:]}
    require(versions == {MAGIC_V2}, f"magic bytes {sorted(map(hex, versions))}")


@book.rule(VERSIONS + "; MAVLink common, MAV_PROTOCOL_CAPABILITY")
def mavlink2_capability_is_told(probe: VehicleProbe) -> None:
    """AUTOPILOT_VERSION has the MAVLINK2 capability."""
    version = probe.request(mavlink.MAVLink_autopilot_version_message)
    bit = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    require(bool(version.capabilities & bit), f"capabilities {version.capabilities:#x}")


@book.rule(SERIALIZATION)
def trailing_zeros_are_cut(probe: VehicleProbe) -> None:
    """A sent MAVLink 2 payload ends in no zero byte, except a single one."""
    probe.run(LISTEN_S)
    for entry in probe.inbox:
        frame = entry.frame
        if frame[0] == MAGIC_V2 and entry.source == probe.target:
            payload, name = frame[10 : 10 + frame[1]], entry.message.get_type()
            is_cut = len(payload) >= 1 and (len(payload) == 1 or payload[-1] != 0)
            require(is_cut, f"{name} carries {len(payload)} bytes, the last one zero")


def require_obeyed(
    probe: VehicleProbe, target: tuple[int, int], spec: FrameSpec | None = None
) -> None:
    """A REQUEST_MESSAGE to a target, sent as `spec` says, must be obeyed."""
    number, request = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, mavlink.MAV_CMD_REQUEST_MESSAGE
    command = mavlink.MAVLink_command_long_message(*target, request, 0, number, *[0] * 6)
    mark = probe.mark
    probe.send(command, spec)
    probe.expect(mavlink.MAVLink_autopilot_version_message, mark=mark)


@book.rule(SERIALIZATION)
def uncut_payload_is_accepted(probe: VehicleProbe) -> None:
    """A payload whose trailing zeros were not cut is understood."""
    require_obeyed(probe, probe.target, replace(probe.spec(), trim=False))


@book.rule(SERIALIZATION)
def cut_payload_is_accepted(probe: VehicleProbe) -> None:
    """A payload whose trailing zeros were cut is understood."""
    require_obeyed(probe, (0, 0))


@book.rule(SERIALIZATION + " (extension fields are no part of CRC_EXTRA)")
def message_without_its_extensions_is_understood(probe: VehicleProbe) -> None:
    """A message that ends before its extension fields, as in MAVLink 1, is understood."""
    message = mavlink.MAVLink_mission_request_list_message(*probe.target, 0)
    short = payload_of(message)[: base_length(message)]
    frames = {
        "MAVLink 2": build_raw(message.get_msgId(), short, type(message).crc_extra, probe.spec()),
        "MAVLink 1": build_frame(message, probe.spec(version=1)),
    }
    for version, frame in frames.items():
        mark = probe.mark
        probe.send_raw(frame)
        probe.expect(
            mavlink.MAVLink_mission_count_message,
            lambda m: m.mission_type == 0,
            mark=mark,
            what=f"answer to one in {version}",
        )
        probe.send(mavlink.MAVLink_mission_ack_message(*probe.target, 0, 0))


@book.rule(VERSIONS)
def mavlink1_frame_is_sent_whole_and_without_extensions(probe: VehicleProbe) -> None:
    """What is sent in MAVLink 1, if anything is, has its whole payload and no extensions."""
    message = question(probe)
    mark = probe.mark
    probe.send_raw(build_frame(message, probe.spec(version=1)))
    probe.run(LISTEN_S)
    for entry in probe.inbox[mark:]:
        if entry.frame[0] == MAGIC_V1:
            name, wanted = entry.message.get_type(), base_length(entry.message)
            require(entry.frame[1] == wanted, f"{name}: {entry.frame[1]} bytes, not {wanted}")
    probe.require_hearing()


@book.rule(SERIALIZATION)
def bad_crc_is_dropped(probe: VehicleProbe) -> None:
    """A frame whose CRC is wrong has no effect."""
    for change in (0x0001, 0x8000, 0xFFFF):
        spec = replace(probe.spec(), crc_change=change)
        require_silence(probe, spec, f"taken with its CRC changed by {change:#06x}")


@book.rule(SERIALIZATION)
def wrong_crc_extra_is_dropped(probe: VehicleProbe) -> None:
    """A frame made with another CRC_EXTRA, as from another dialect, has no effect."""
    message = question(probe)
    payload = build_frame(message, replace(probe.spec(), trim=False))[10:26]
    crc_extra = (type(message).crc_extra + 1) & 0xFF
    frame = build_raw(message.get_msgId(), payload, crc_extra, probe.spec())
    require(not is_answered(probe, frame, message.ts1, 0.5), "taken with a wrong CRC_EXTRA")
    push_through(probe)
    probe.require_hearing()


@book.rule(SERIALIZATION)
def unknown_incompat_bit_is_dropped(probe: VehicleProbe) -> None:
    """A frame with an unknown bit in `incompat_flags` is dropped."""
    for bit in (0x02, 0x40, 0x80):
        require_silence(probe, probe.spec(incompat=bit), f"taken with incompat {bit:#04x}")


@book.rule(SERIALIZATION)
def unknown_compat_bit_is_handled(probe: VehicleProbe) -> None:
    """A frame with an unknown bit in `compat_flags` is handled as usual."""
    for bit in (0x01, 0x80, 0xFF):
        require_answer(probe, probe.spec(compat=bit), f"dropped with compat {bit:#04x}")


@book.rule("MAVLink guide, MAVLink IDs; MAVSDK drops system 0 as well")
def source_system_zero_is_ignored(probe: VehicleProbe) -> None:
    """A frame from system 0, which nobody may be, has no effect."""
    spec = replace(probe.spec(), system_id=0)
    require_silence(probe, spec, "a request from system 0 is answered")


@book.rule(
    "pymavlink mavutil.mavlink_connection, source_component=0 by default; the MAVLink guide gives "
    "0 to nobody, but scripts that leave it so depend on it"
)
def source_component_zero_is_heard(probe: VehicleProbe) -> None:
    """A frame from component 0, as pymavlink sends unless told otherwise, is handled."""
    spec = replace(probe.spec(), component_id=0)
    require_answer(probe, spec, "a request from component 0 is not answered")


@book.rule(PACKET_LOSS)
def sequence_counts_every_message(probe: VehicleProbe) -> None:
    """The sequence number goes up by one, modulo 256, with each message of a component."""
    probe.run(LISTEN_S)
    counts = [e.message.get_seq() for e in probe.inbox if e.source == probe.target]
    require(len(counts) > 2, "too few messages to tell")
    for first, second in itertools.pairwise(counts):
        require(second == (first + 1) % 256, f"sequence {first} is followed by {second}")


@book.rule(SERIALIZATION + " (resynchronising is this project's own rule)")
def garbage_costs_nothing(probe: VehicleProbe) -> None:
    """A good frame behind garbage is found."""
    for garbage in (b"\x00\x01\x02", bytes((MAGIC_V2,)), bytes((MAGIC_V1, 3)), b"\xff" * 40):
        message = question(probe)
        data = garbage + build_frame(message, probe.spec())
        is_found = is_answered(probe, data, message.ts1, has_junk=True)
        require(is_found, f"not found behind {garbage[:4].hex()}... ({len(garbage)} bytes)")


@book.rule(SERIALIZATION + " (resynchronising is this project's own rule)")
def truncated_frame_costs_nothing(probe: VehicleProbe) -> None:
    """A good frame behind half a frame is found: a bad CRC costs one byte."""
    for share in (5, 11, 20):
        message = question(probe)
        frame = build_frame(message, probe.spec())
        is_found = is_answered(probe, frame[:share] + frame, message.ts1, has_junk=True)
        require(is_found, f"not found behind the first {share} bytes of another")


@book.rule(SERIALIZATION)
def several_frames_in_one_piece(probe: VehicleProbe) -> None:
    """All frames of one datagram, or of one read, are taken."""
    first, second = question(probe), question(probe)
    second.ts1 = first.ts1 + 1
    mark = probe.mark
    probe.send_raw(build_frame(first, probe.spec()) + build_frame(second, probe.spec()))
    for stamp in (first.ts1, second.ts1):
        require(probe.is_synchronised(stamp, mark, ACK_S), f"{stamp} is not answered")


@book.rule(SERIALIZATION)
def unknown_message_id_is_ignored(probe: VehicleProbe) -> None:
    """A frame with a message id that nobody knows does no harm."""
    probe.send_raw(build_raw(UNKNOWN_ID, b"\x01\x02\x03\x04", 17, probe.spec()))
    probe.require_hearing()


@book.rule(SERIALIZATION)
def every_sent_frame_has_a_right_crc(probe: VehicleProbe) -> None:
    """What the vehicle sends passes its CRC."""
    probe.run(LISTEN_S)
    counters = probe.reader.counters
    require(counters.good > 0, "nothing was heard")
    require(counters.bad_crc == 0, f"{counters.bad_crc} frames are broken")


@book.rule("MAVLink guide, MAVLink IDs")
def sends_valid_source_ids(probe: VehicleProbe) -> None:
    """Every frame has a source system and component from 1 to 255."""
    probe.run(LISTEN_S)
    for entry in probe.inbox:
        require(min(entry.source) >= 1, f"{entry.message.get_type()} from {entry.source}")
