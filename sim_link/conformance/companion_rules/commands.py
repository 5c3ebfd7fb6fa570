"""Commands to a companion, and the commands that it sends."""

from __future__ import annotations

from collections import Counter

from companion.mav.dialect import mavlink
from sim_link.conformance.puppet import CommandMessage, CompanionProbe, Policy, accept, stay_silent
from sim_link.conformance.rules import NotApplicable, Role, RuleBook, require
from sim_link.conformance.station import brief

book = RuleBook(Role.COMPANION, "requests")
SERVICE = "MAVLink guide, Command Protocol"
ROUTING = "MAVLink guide, Routing"
UNKNOWN_COMMAND = 31_999
ASKS_FOR_STREAMS = (
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
)
ACCEPTED, TEMPORARILY_REJECTED, UNSUPPORTED = 0, 1, 3
MAX_RATE_HZ = 25.0
MAX_REPEATS = 10


@book.rule(SERVICE)
def unknown_command_is_unsupported(probe: CompanionProbe) -> None:
    """A command for this very component that it does not know is acknowledged UNSUPPORTED."""
    result = probe.ask_companion(UNKNOWN_COMMAND, target=probe.companion)
    require(result is not None, "not acknowledged")
    require(result == UNSUPPORTED, f"result {result}")


@book.rule(ROUTING)
def command_for_another_component_is_ignored(probe: CompanionProbe) -> None:
    """A command for another component of the system is not acknowledged."""
    for component in (1, 100, 158):
        result = probe.ask_companion(UNKNOWN_COMMAND, target=(probe.system_id, component))
        require(result is None, f"component {component}: result {result}")


@book.rule(ROUTING)
def command_for_another_system_is_ignored(probe: CompanionProbe) -> None:
    """A command for another system is not acknowledged."""
    result = probe.ask_companion(UNKNOWN_COMMAND, target=(77, probe.companion[1]))
    require(result is None, f"result {result}")


@book.rule("MAVLink common, MAV_CMD_SET_MESSAGE_INTERVAL (ArduPilot sends nothing unasked)")
def asks_for_its_streams(probe: CompanionProbe) -> None:
    """It asks the autopilot for the streams that it needs."""
    probe.run(3.0)
    asked = [c for _, c in probe.commands() if c.command in ASKS_FOR_STREAMS]
    streams = probe.heard(mavlink.MAVLink_request_data_stream_message)
    require(bool(asked) or bool(streams), "nothing was asked for")


@book.rule(ROUTING)
def commands_name_the_vehicle(probe: CompanionProbe) -> None:
    """Its commands are addressed to the autopilot, system and component."""
    probe.run(3.0)
    for _, command in probe.commands():
        target = (command.target_system, command.target_component)
        require(target == (probe.system_id, probe.component_id), brief(command))


@book.rule(SERVICE)
def requests_are_paced(probe: CompanionProbe) -> None:
    """It does not flood the autopilot with commands, answered or not."""
    probe.policy = stay_silent
    mark = probe.mark
    probe.run(5.0)
    rate_hz = len(probe.commands(mark)) / 5.0
    require(rate_hz < MAX_RATE_HZ, f"{rate_hz:.0f} commands a second")


@book.rule(f"{SERVICE} (retries)")
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


@book.rule(SERVICE)
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
        """Have a stranger accept the command."""
        ack = mavlink.MAVLink_command_ack_message(command.command, ACCEPTED, 0, 0, 0, 0)
        probe.send_as(ack, 77, 1)
        return None

    return policy
