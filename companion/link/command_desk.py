"""Commands to the companion itself: few are known, every one is answered.

Source: MAVLink developer guide, "Command Protocol".
"""

from __future__ import annotations

from companion.guidance.events import ControlGranted
from companion.link import outbound
from companion.link.executor import SessionExecutor
from companion.link.outlet import Outlet
from companion.link.parameter_server import ParameterServer
from companion.link.rate_limit import RateLimit
from companion.mav.dialect import mavlink

COMMANDS_PER_S = 20
"""Commands to us that are answered; a flood of them must not become a flood of answers."""
REQUEST_CAPABILITIES = 520
"""MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, which older ground stations still send."""
VERSION_ID = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION

AddressedCommand = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message


class CommandDesk:
    """Answers commands.

    Args:
        executor: Takes what they mean for the session.
        parameters: Whose encoding our AUTOPILOT_VERSION tells.
        outlet: The way out.
    """

    def __init__(
        self, executor: SessionExecutor, parameters: ParameterServer, outlet: Outlet
    ) -> None:
        self._executor = executor
        self._parameters = parameters
        self._outlet = outlet
        self._limit = RateLimit(COMMANDS_PER_S, COMMANDS_PER_S)

    def receive(self, message: AddressedCommand, now_s: float, *, may_grant: bool) -> None:
        """Answer a command to this very component.

        Args:
            message: Any command.
            now_s: The present.
            may_grant: Whether its sender may give control.
        """
        if (message.target_system, message.target_component) != self._outlet.own_ids:
            return
        if not self._limit.allows(now_s):
            return
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == mavlink.MAV_CMD_NAV_GUIDED_ENABLE:
            result = mavlink.MAV_RESULT_DENIED
            if may_grant and message.param1 == 1.0 and self._executor.may_engage:
                result = mavlink.MAV_RESULT_ACCEPTED
                self._executor.handle(ControlGranted(now_s), now_s)
        is_version_wanted = _wants_version(message)
        if is_version_wanted:
            result = mavlink.MAV_RESULT_ACCEPTED
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            result = mavlink.MAV_RESULT_DENIED
        ack = outbound.command_ack(message.command, result, message)
        self._outlet.broadcast(ack, now_s)
        if is_version_wanted:
            version = outbound.autopilot_version(self._parameters.capability)
            self._outlet.broadcast(version, now_s, can_be_spared=True)


def _wants_version(message: AddressedCommand) -> bool:
    """Whether a command asks for AUTOPILOT_VERSION, in the new way or in the old one."""
    if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
        return bool(message.param1 == VERSION_ID)
    return bool(message.command == REQUEST_CAPABILITIES and message.param1 == 1.0)
