"""Rules for a companion: its identity, and the commands that it answers and sends."""

from __future__ import annotations

import itertools
from collections import Counter

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.mavlink_oracle import ACCEPTED, MAGIC_V2, UNSUPPORTED, build_frame
from sim_link.lab.conformance.puppet import (
    CommandMessage,
    CompanionProbe,
    Policy,
    accept,
    stay_silent,
)
from sim_link.lab.conformance.rules import NotApplicable, Role, RuleBook, require
from sim_link.lab.conformance.station import brief, heartbeat

identity_book = RuleBook(Role.COMPANION, "identity")
HEARTBEAT_SERVICE = "MAVLink guide, Heartbeat/Connection Protocol"
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


@identity_book.rule(IDS)
def shares_the_vehicles_system(probe: CompanionProbe) -> None:
    """The companion has the system id of its vehicle."""
    require(probe.companion[0] == probe.system_id, f"system {probe.companion[0]}")


@identity_book.rule(IDS)
def is_an_onboard_computer(probe: CompanionProbe) -> None:
    """Its component id is one of an onboard computer, 191 to 194."""
    require(191 <= probe.companion[1] <= 194, f"component {probe.companion[1]}")


@identity_book.rule(HEARTBEAT_SERVICE)
def tells_an_onboard_controller(probe: CompanionProbe) -> None:
    """HEARTBEAT tells ONBOARD_CONTROLLER, no autopilot, no mode, ACTIVE and version 3."""
    m = newest(probe)
    told = (m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status, m.mavlink_version)
    kind, none = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
    require(told == (kind, none, 0, 0, mavlink.MAV_STATE_ACTIVE, 3), brief(m))


@identity_book.rule(HEARTBEAT_SERVICE)
def says_so_once_a_second(probe: CompanionProbe) -> None:
    """HEARTBEAT comes once a second."""
    mark = probe.mark
    probe.run(LISTEN_S)
    times = probe.times(Heartbeat, mark)
    require(len(times) >= LISTEN_S - 1, f"{len(times)} in {LISTEN_S:g} s")
    for earlier, later in itertools.pairwise(times):
        require(0.7 < later - earlier < 1.4, f"{later - earlier:.2f} s between two")


@identity_book.rule("MAVSDK mavsdk_impl.cpp (255/190 is the ground station)")
def is_no_ground_station(probe: CompanionProbe) -> None:
    """It is not at a ground station's address."""
    require(probe.companion != (255, 190), "it is 255/190")


@identity_book.rule(SERIALIZATION)
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


@identity_book.rule("MAVLink guide, Packet Loss")
def sequence_counts_every_message(probe: CompanionProbe) -> None:
    """The sequence number goes up by one with each message."""
    probe.run(2.0)
    counts = [e.message.get_seq() for e in probe.inbox if e.source == probe.companion]
    for first, second in itertools.pairwise(counts):
        require(second == (first + 1) % 256, f"sequence {first} is followed by {second}")


@identity_book.rule(SERIALIZATION)
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


@identity_book.rule(f"{IDS} (latch the first autopilot)")
def second_autopilot_is_ignored(probe: CompanionProbe) -> None:
    """Another system's autopilot does not make it change its system id."""
    foreign = Heartbeat(2, 12, 1, 0x60000, 4, 3)
    for _ in range(3):
        probe.send_as(foreign, OTHER_SYSTEM, 1)
        probe.run(1.0)
    require(newest(probe).get_srcSystem() == probe.system_id, "it changed its system")


@identity_book.rule(HEARTBEAT_SERVICE)
def heartbeat_goes_on_without_the_vehicle(probe: CompanionProbe) -> None:
    """When the vehicle falls silent its own HEARTBEAT goes on."""
    probe.go_silent()
    probe.run(4.0)
    newest(probe)
    probe.come_back()


@identity_book.rule("MAVLink guide, Ping Protocol")
def ping_response_is_never_answered(probe: CompanionProbe) -> None:
    """A PING with a target is a response, and is not answered."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_ping_message(1, 4_712, *probe.companion))
    probe.expect_none(
        mavlink.MAVLink_ping_message, lambda m: m.seq == 4_712, mark=mark, what="answered"
    )


@identity_book.rule("MAVLink guide, Ping Protocol")
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


@identity_book.rule("MAVLink guide, Time Synchronization")
def timesync_response_is_never_answered(probe: CompanionProbe) -> None:
    """TIMESYNC with tc1 is a response, and is not answered."""
    mark = probe.mark
    probe.send(mavlink.MAVLink_timesync_message(55, 66))
    probe.expect_none(
        mavlink.MAVLink_timesync_message, lambda m: m.ts1 == 66, mark=mark, what="answered"
    )


@identity_book.rule("MAVLink guide, Message Signing; MAVLink guide, Routing")
def signing_setup_is_not_passed_on(probe: CompanionProbe) -> None:
    """SETUP_SIGNING, which holds a key, is neither echoed nor passed on."""
    key = bytes(range(1, 33))
    mark = len(probe.datagrams)
    probe.send(mavlink.MAVLink_setup_signing_message(*probe.companion, list(key), 0))
    probe.run(1.0)
    require(not any(key in data for _, data in probe.datagrams[mark:]), "the key came back")


request_book = RuleBook(Role.COMPANION, "requests")
COMMAND_SERVICE = "MAVLink guide, Command Protocol"
ROUTING = "MAVLink guide, Routing"
UNKNOWN_COMMAND = 31_999
ASKS_FOR_STREAMS = (
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
)
MAX_RATE_HZ = 25.0
MAX_REPEATS = 10


@request_book.rule(COMMAND_SERVICE)
def unknown_command_is_unsupported(probe: CompanionProbe) -> None:
    """A command for this very component that it does not know is acknowledged UNSUPPORTED."""
    result = probe.ask_companion(UNKNOWN_COMMAND, target=probe.companion)
    require(result is not None, "not acknowledged")
    require(result == UNSUPPORTED, f"result {result}")


@request_book.rule(ROUTING)
def command_for_another_component_is_ignored(probe: CompanionProbe) -> None:
    """A command for another component of the system is not acknowledged."""
    for component in (1, 100, 158):
        result = probe.ask_companion(UNKNOWN_COMMAND, target=(probe.system_id, component))
        require(result is None, f"component {component}: result {result}")


@request_book.rule(ROUTING)
def command_for_another_system_is_ignored(probe: CompanionProbe) -> None:
    """A command for another system is not acknowledged."""
    result = probe.ask_companion(UNKNOWN_COMMAND, target=(77, probe.companion[1]))
    require(result is None, f"result {result}")


@request_book.rule("MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL (ArduPilot sends nothing unasked)")
def asks_for_its_streams(probe: CompanionProbe) -> None:
    """It asks the autopilot for the streams that it needs."""
    probe.run(3.0)
    asked = [c for _, c in probe.commands() if c.command in ASKS_FOR_STREAMS]
    streams = probe.heard(mavlink.MAVLink_request_data_stream_message)
    require(bool(asked) or bool(streams), "nothing was asked for")


@request_book.rule(ROUTING)
def commands_name_the_vehicle(probe: CompanionProbe) -> None:
    """Its commands are addressed to the autopilot, system and component."""
    probe.run(3.0)
    for _, command in probe.commands():
        target = (command.target_system, command.target_component)
        require(target == (probe.system_id, probe.component_id), brief(command))


@request_book.rule(COMMAND_SERVICE)
def requests_are_paced(probe: CompanionProbe) -> None:
    """It does not flood the autopilot with commands, answered or not."""
    probe.policy = stay_silent
    mark = probe.mark
    probe.run(5.0)
    rate_hz = len(probe.commands(mark)) / 5.0
    require(rate_hz < MAX_RATE_HZ, f"{rate_hz:.0f} commands a second")


@request_book.rule(f"{COMMAND_SERVICE} (retries)")
def unanswered_command_is_repeated_a_few_times(probe: CompanionProbe) -> None:
    """A command without an answer is repeated with a rising confirmation, and given up."""
    mark = 0 if probe.policy is stay_silent else probe.mark
    probe.policy = stay_silent
    probe.run(12.0)
    sent = Counter(
        (c.command, c.confirmation)
        for _, c in probe.commands(mark)
        if isinstance(c, mavlink.MAVLink_command_long_message) and c.command not in ASKS_FOR_STREAMS
    )
    if not sent:
        raise NotApplicable("it commands nothing but streams meanwhile")
    for number, confirmation in sent:
        is_first = confirmation == 0
        require(is_first or (number, confirmation - 1) in sent, f"{number}: jumps a confirmation")
        require(confirmation < MAX_REPEATS, f"{number}: repeated {confirmation} times")
    for number in {number for number, _ in sent}:
        require((number, 1) in sent, f"command {number} is not repeated")


@request_book.rule(COMMAND_SERVICE)
def acknowledgement_of_another_system_is_ignored(probe: CompanionProbe) -> None:
    """A COMMAND_ACK from a foreign system is not taken for the vehicle's."""
    probe.policy = foreign_answers(probe)
    mark = probe.mark
    probe.run(4.0)
    asked = [c for _, c in probe.commands(mark) if c.command in ASKS_FOR_STREAMS]
    probe.policy = accept
    if not asked:
        raise NotApplicable("nothing was asked meanwhile")
    probe.run(2.0)
    require(probe.companion[0] == probe.system_id, "it changed its system")


def foreign_answers(probe: CompanionProbe) -> Policy:
    """A policy that stays silent and lets a foreign system accept."""

    def policy(command: CommandMessage) -> int | None:
        """Have an unknown system accept the command."""
        ack = mavlink.MAVLink_command_ack_message(command.command, ACCEPTED, 0, 0, 0, 0)
        probe.send_as(ack, 77, 1)
        return None

    return policy
