"""Who a companion says it is, how often, and whom it listens to."""

from __future__ import annotations

import itertools

from companion.mav.dialect import mavlink
from sim_link.conformance.frames import MAGIC_V2, build_frame
from sim_link.conformance.puppet import CompanionProbe
from sim_link.conformance.rules import NotApplicable, Role, RuleBook, require
from sim_link.conformance.station import brief, heartbeat

book = RuleBook(Role.COMPANION, "identity")
SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
IDS = "MAVLink guide, MAVLink IDs"
SERIALIZATION = "MAVLink guide, Packet Serialization"
Heartbeat = mavlink.MAVLink_heartbeat_message
LISTEN_S = 6.0
OTHER_SYSTEM = 7


def newest(probe: CompanionProbe) -> Heartbeat:
    """A new HEARTBEAT of the companion."""
    return probe.expect(
        Heartbeat, lambda m: m.autopilot == mavlink.MAV_AUTOPILOT_INVALID, within_s=3.0
    )


@book.rule(IDS)
def shares_the_vehicles_system(probe: CompanionProbe) -> None:
    """The companion has the system id of its vehicle."""
    require(probe.companion[0] == probe.system_id, f"system {probe.companion[0]}")


@book.rule(IDS)
def is_an_onboard_computer(probe: CompanionProbe) -> None:
    """Its component id is one of an onboard computer, 191 to 194."""
    require(191 <= probe.companion[1] <= 194, f"component {probe.companion[1]}")


@book.rule(SERVICE)
def tells_an_onboard_controller(probe: CompanionProbe) -> None:
    """HEARTBEAT tells ONBOARD_CONTROLLER, no autopilot, no mode, ACTIVE and version 3."""
    message = newest(probe)
    require(message.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER, brief(message))
    require(message.autopilot == mavlink.MAV_AUTOPILOT_INVALID, brief(message))
    require(message.base_mode == 0 and message.custom_mode == 0, brief(message))
    require(message.system_status == mavlink.MAV_STATE_ACTIVE, brief(message))
    require(message.mavlink_version == 3, brief(message))


@book.rule(SERVICE)
def says_so_once_a_second(probe: CompanionProbe) -> None:
    """HEARTBEAT comes once a second."""
    mark = probe.mark
    probe.run(LISTEN_S)
    times = [e.time_s for e in probe.inbox[mark:] if isinstance(e.message, Heartbeat)]
    require(len(times) >= LISTEN_S - 1, f"{len(times)} in {LISTEN_S:g} s")
    for earlier, later in itertools.pairwise(times):
        require(0.7 < later - earlier < 1.4, f"{later - earlier:.2f} s between two")


@book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
def is_no_ground_station(probe: CompanionProbe) -> None:
    """It is not at a ground station's address."""
    require(probe.companion != (255, 190), "it is 255/190")


@book.rule(SERIALIZATION)
def sends_mavlink2_with_right_crc(probe: CompanionProbe) -> None:
    """What it sends is MAVLink 2, passes its CRC and has its trailing zeros cut."""
    probe.run(2.0)
    require(probe.reader.counters.bad_crc == 0, f"{probe.reader.counters.bad_crc} broken frames")
    for entry in probe.inbox:
        frame = entry.frame
        require(frame[0] == MAGIC_V2, f"{entry.message.get_type()} in MAVLink 1")
        payload = frame[10 : 10 + frame[1]]
        cut = len(payload) == 1 or payload[-1] != 0
        require(cut, f"{entry.message.get_type()} is not cut")


@book.rule("MAVLink guide, Packet Loss")
def sequence_counts_every_message(probe: CompanionProbe) -> None:
    """The sequence number goes up by one with each message."""
    probe.run(2.0)
    counts = [e.message.get_seq() for e in probe.inbox if e.source == probe.companion]
    for first, second in itertools.pairwise(counts):
        require(second == (first + 1) % 256, f"sequence {first} is followed by {second}")


@book.rule(SERIALIZATION)
def garbage_does_no_harm(probe: CompanionProbe) -> None:
    """Garbage, broken frames and unknown flags do not stop it."""
    message = heartbeat(mavlink.MAV_TYPE_GCS)
    good = build_frame(message, probe.spec())
    for data in (
        b"\x00" * 50,
        good[:9],
        good[:-1] + b"\x00",
        build_frame(message, probe.spec(incompat=4)),
    ):
        probe.send_raw(data)
    newest(probe)


@book.rule(f"{IDS} (latch the first autopilot)")
def second_autopilot_is_ignored(probe: CompanionProbe) -> None:
    """Another system's autopilot does not make it change its system id."""
    foreign = Heartbeat(2, 12, 1, 0x60000, 4, 3)
    for _ in range(3):
        probe.send_as(foreign, OTHER_SYSTEM, 1)
        probe.run(1.0)
    require(newest(probe).get_srcSystem() == probe.system_id, "it changed its system")


@book.rule(SERVICE)
def heartbeat_goes_on_without_the_vehicle(probe: CompanionProbe) -> None:
    """When the vehicle falls silent its own HEARTBEAT goes on."""
    probe.go_silent()
    probe.run(4.0)
    newest(probe)
    probe.come_back()


@book.rule("MAVLink guide, Ping Protocol")
def ping_response_is_never_answered(probe: CompanionProbe) -> None:
    """A PING with a target is a response, and is not answered."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_ping_message(1, 4_712, *probe.companion))
    probe.expect_none(
        mavlink.MAVLink_ping_message, lambda m: m.seq == 4_712, mark=mark, what="answered"
    )


@book.rule("MAVLink guide, Ping Protocol")
def ping_request_is_answered_rightly(probe: CompanionProbe) -> None:
    """A PING to 0/0, if it is answered, comes back to its sender with time and sequence."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_ping_message(123_456, 4_711, 0, 0))
    probe.run(1.0)
    answers = [
        e.message for e in probe.inbox[mark:] if isinstance(e.message, mavlink.MAVLink_ping_message)
    ]
    if not answers:
        raise NotApplicable("it does not answer PING, which is optional")
    answer = answers[0]
    require((answer.time_usec, answer.seq) == (123_456, 4_711), brief(answer))
    require((answer.target_system, answer.target_component) == (probe.system_id, 1), brief(answer))


@book.rule("MAVLink guide, Time Synchronization")
def timesync_response_is_never_answered(probe: CompanionProbe) -> None:
    """TIMESYNC with tc1 is a response, and is not answered."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_timesync_message(55, 66))
    probe.expect_none(
        mavlink.MAVLink_timesync_message, lambda m: m.ts1 == 66, mark=mark, what="answered"
    )


@book.rule("MAVLink guide, Message Signing; MAVLink guide, Routing")
def signing_setup_is_not_passed_on(probe: CompanionProbe) -> None:
    """SETUP_SIGNING, which holds a key, is neither echoed nor passed on."""
    key = bytes(range(1, 33))
    mark = len(probe.datagrams)
    probe.send(mavlink.MAVLink_setup_signing_message(*probe.companion, list(key), 0))
    probe.run(1.0)
    require(not any(key in data for _, data in probe.datagrams[mark:]), "the key came back")
