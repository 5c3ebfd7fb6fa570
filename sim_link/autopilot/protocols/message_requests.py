"""Commands that ask for messages, once or regularly, on the channel they came from.

Source: MAVLink common, MAV_CMD_REQUEST_MESSAGE and SET_MESSAGE_INTERVAL, with their older forms;
PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.base import Channel, Outgoing, Partner
from sim_link.autopilot.protocols.commands import Command, CommandResult
from sim_link.autopilot.protocols.statustext import StatusTexts
from sim_link.autopilot.protocols.streams import StreamRules, StreamTable

MAX_MESSAGE_ID = 2**24 - 1
MAX_PEERS = 16
"""Peers with streams of their own; a stranger with many ports gets none for the oldest of them."""
MAX_INTERVAL_ID = 0xFFFF
"""MESSAGE_INTERVAL.message_id has 16 bits."""
PROTOCOL_VERSION = 300
"""Id of a message that the dialect does not have any more."""
SHORTHANDS = {
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: PROTOCOL_VERSION,
    mavlink.MAV_CMD_GET_HOME_POSITION: mavlink.MAVLINK_MSG_ID_HOME_POSITION,
}
"""Commands that mean REQUEST_MESSAGE of one message."""

Build = Callable[[int], Message | None]
"""Makes the message with an id; None if it is unknown or has nothing to say now."""


@dataclass(frozen=True, slots=True)
class RequestRules:
    """By which results an autopilot refuses."""

    no_message: CommandResult
    """REQUEST_MESSAGE of what is unknown or has no data."""
    no_stream: CommandResult
    """SET_MESSAGE_INTERVAL of what is unknown or cannot be changed."""
    no_interval: CommandResult
    """GET_MESSAGE_INTERVAL of what is unknown; MESSAGE_INTERVAL with 0 goes before it."""
    has_texts: bool = False
    """A refused SET_MESSAGE_INTERVAL is explained."""


PX4_REQUESTS = RequestRules(CommandResult.DENIED, CommandResult.FAILED, CommandResult.ACCEPTED)
ARDUPILOT_REQUESTS = RequestRules(
    CommandResult.FAILED, CommandResult.DENIED, CommandResult.FAILED, has_texts=True
)


class MessageRequests:
    """Keeps the streams of every channel and obeys what is asked about messages.

    Args:
        streams: Of the autopilot that is played.
        rules: Likewise.
        build: Makes messages.
        texts: Numbers texts.
    """

    def __init__(
        self, streams: StreamRules, rules: RequestRules, build: Build, texts: StatusTexts
    ) -> None:
        self._stream_rules = streams
        self._rules = rules
        self._build = build
        self._texts = texts
        self._tables: OrderedDict[Channel, StreamTable] = OrderedDict()

    def open(self, channel: Channel, now_s: float) -> None:
        """Begin the default streams of a new channel; the oldest of too many peers end."""
        if channel not in self._tables:
            self._tables[channel] = StreamTable(self._stream_rules, now_s)
        self._tables.move_to_end(channel)
        peers = [each for each in self._tables if each.peer is not None]
        if len(peers) > MAX_PEERS:
            del self._tables[peers[0]]

    @property
    def channels(self) -> Collection[Channel]:
        """Those that have streams: every link, and every peer that asked for rates of its own."""
        return self._tables.keys()

    def forget(self, channel: Channel) -> None:
        """End the streams of a channel that is gone."""
        self._tables.pop(channel, None)

    def take_due(self, now_s: float) -> list[tuple[Channel, int]]:
        """Which messages go where at `now_s`."""
        return [
            (channel, number)
            for channel, table in self._tables.items()
            for number in table.take_due(now_s)
        ]

    def next_timer_s(self) -> float:
        """When the next message of any channel is due; infinity if all is quiet."""
        return min((table.next_due_s() for table in self._tables.values()), default=math.inf)

    def obey(self, command: Command, now_s: float) -> tuple[CommandResult, list[Outgoing]] | None:
        """Obey a command about messages.

        Returns:
            Its result and what to send before the ACK; None if it is about something else.
        """
        match command.number:
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request(command, now_s)
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                return self._tell_interval(command.whole(1), command.partner, now_s)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(command, now_s)
        shorthand = SHORTHANDS.get(command.number)
        return None if shorthand is None else self._send(shorthand, command.partner)

    def obey_data_stream(self, message: Message, partner: Partner, now_s: float) -> None:
        """Obey a REQUEST_DATA_STREAM that is for us; it has no answer."""
        if isinstance(message, mavlink.MAVLink_request_data_stream_message):
            self._table(partner.channel, now_s).set_group(
                message.req_stream_id,
                message.req_message_rate,
                is_on=message.start_stop == 1,
                now_s=now_s,
            )

    def _table(self, channel: Channel, now_s: float) -> StreamTable:
        self.open(channel, now_s)
        return self._tables[channel]

    def _request(self, command: Command, now_s: float) -> tuple[CommandResult, list[Outgoing]]:
        number = command.whole(1)
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._tell_interval(command.whole(2), command.partner, now_s)
        if number is None or not 0 <= number <= MAX_MESSAGE_ID:
            return CommandResult.DENIED, []
        return self._send(number, command.partner)

    def _send(self, number: int, partner: Partner) -> tuple[CommandResult, list[Outgoing]]:
        message = self._build(number)
        if message is None:
            return self._rules.no_message, []
        return CommandResult.ACCEPTED, [Outgoing(message, partner.channel)]

    def _tell_interval(
        self, number: int | None, partner: Partner, now_s: float
    ) -> tuple[CommandResult, list[Outgoing]]:
        if number is None or not 0 <= number <= MAX_INTERVAL_ID:
            return CommandResult.DENIED, []
        table = self._table(partner.channel, now_s)
        message = mavlink.MAVLink_message_interval_message(number, table.interval_us(number))
        result = CommandResult.ACCEPTED if table.knows(number) else self._rules.no_interval
        return result, [Outgoing(message, partner.channel)]

    def _set_interval(self, command: Command, now_s: float) -> tuple[CommandResult, list[Outgoing]]:
        number, interval_us = command.whole(1), command.params[1]
        if number is None or not math.isfinite(interval_us):
            return CommandResult.DENIED, []
        table = self._table(command.partner.channel, now_s)
        if table.set_interval_us(number, interval_us, now_s):
            return CommandResult.ACCEPTED, []
        if table.can_change(number):
            return CommandResult.DENIED, []  # the stream is fine, the interval makes no sense
        return self._rules.no_stream, self._explain(number, command.partner)

    def _explain(self, number: int, partner: Partner) -> list[Outgoing]:
        if not self._rules.has_texts:
            return []
        messages = self._texts.messages(
            mavlink.MAV_SEVERITY_WARNING, f"no stream of message {number} can be set"
        )
        return [Outgoing(message, partner.channel) for message in messages]
