"""Message streams of a channel: which, at which rate, and how clients change it.

Theory of operation. Every stream has a start and counts its messages from there: number n is due at
start + n / rate, so rounding never adds up and a stream of 30 Hz on a clock of 50 Hz leaves after
40, 40 and 20 ms and has exactly 30 messages in each second. What a caller missed is skipped, in
step. Each channel has a table of its own, as each of PX4's and ArduPilot's links has.

`MessageRequests` obeys the commands that ask for messages, once or regularly, on the channel they
came from.

Source: MAVLink common, MAV_CMD_REQUEST_MESSAGE and MAV_CMD_SET_MESSAGE_INTERVAL with their older
forms, REQUEST_DATA_STREAM, MESSAGE_INTERVAL; PX4 1.15 and ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import (
    Channel,
    LinkMode,
    LinkSetup,
    Outgoing,
    Partner,
    StatusTexts,
)
from sim_link.autopilot.protocols.command_protocol import Command, CommandResult

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
US_PER_S = 1e6
DUE_TOLERANCE_S = 1e-6
"""Tolerance of a due time, because a clock of whole steps may be early by rounding."""
MAX_INTERVAL_US = 3600e6
OFF, DEFAULT = -1.0, 0.0


IDS = {kind.msgname: number for number, kind in mavlink.mavlink_map.items()}


def message_id(name: str) -> int:
    """Return the id of a message by its name."""
    return IDS[name]


def message_ids(names: str) -> tuple[int, ...]:
    """Return the ids of messages by their names, separated by blanks."""
    return tuple(map(message_id, names.split()))


@dataclass(frozen=True, slots=True)
class StreamProfile:
    """The streams of an autopilot."""

    default_rates_hz: Mapping[int, float]
    """Rates by message id; 0 for one that is sent only on request."""
    min_interval_s: float
    """Shortest interval of a stream: PX4 sends 123 Hz where 1 ms is requested, ArduPilot 333 Hz."""
    rates_by_mode_hz: Mapping[LinkMode, Mapping[int, float]] = field(default_factory=dict)
    """Rates of the links of a mode; messages not listed there are sent only on request."""
    min_interval_by_mode_s: Mapping[LinkMode, float] = field(default_factory=dict)
    stopped_interval_us: int = -1
    """Value of MESSAGE_INTERVAL for a stream that is off."""
    fixed: frozenset[int] = frozenset({HEARTBEAT})
    """Messages whose rate cannot be changed."""
    groups: Mapping[int, tuple[int, ...]] = field(default_factory=dict)
    """Messages of each REQUEST_DATA_STREAM group; empty where that message is not known."""


@dataclass(slots=True)
class _Stream:
    interval_s: float
    started_s: float
    due_s: float
    sent: int = 0


class StreamTable:
    """The streams of one channel."""

    def __init__(
        self, rules: StreamProfile, started_s: float = 0.0, mode: LinkMode = "onboard"
    ) -> None:
        self._rules = rules
        self._rates_hz = rules.rates_by_mode_hz.get(mode, rules.default_rates_hz)
        self._min_interval_s = rules.min_interval_by_mode_s.get(mode, rules.min_interval_s)
        self._streams: dict[int, _Stream] = {}
        for number in rules.default_rates_hz:
            self._start(number, self._default_interval_s(number), started_s)

    def take_due(self, now_s: float) -> list[int]:
        """Return ids of the messages due at `now_s`, each once, even after missed periods."""
        latest_s, streams = now_s + DUE_TOLERANCE_S, self._streams
        due = [(each.due_s, number) for number, each in streams.items() if each.due_s <= latest_s]
        due.sort()
        for due_s, number in due:
            stream = streams[number]
            stream.sent += 1 + math.floor((latest_s - due_s) / stream.interval_s)
            stream.due_s = stream.started_s + stream.sent * stream.interval_s
        return [number for _, number in due]

    def knows(self, number: int) -> bool:
        """Return True if the autopilot has such a message."""
        return number in self._rules.default_rates_hz

    def can_change(self, number: int) -> bool:
        """Return True if there is such a message, and its rate is not fixed."""
        return self.knows(number) and number not in self._rules.fixed

    def interval_us(self, number: int) -> int:
        """Return MESSAGE_INTERVAL.interval_us; 0 if there is no such message."""
        if not self.knows(number):
            return 0
        stream = self._streams.get(number)
        if stream is None:
            return self._rules.stopped_interval_us
        return round(US_PER_S * stream.interval_s)

    def set_interval_us(self, number: int, interval_us: float, now_s: float) -> bool:
        """Change a stream, due at once (-1 stops it, 0: default); False if a value is invalid."""
        if not self.can_change(number):
            return False
        if interval_us == DEFAULT:
            self._start(number, self._default_interval_s(number), now_s)
        elif interval_us == OFF:
            self._start(number, None, now_s)
        elif 0.0 < interval_us <= MAX_INTERVAL_US:
            self._start(number, interval_us / US_PER_S, now_s)
        else:
            return False
        return True

    def set_group(self, group: int, rate_hz: int, *, is_on: bool, now_s: float) -> None:
        """Obey a REQUEST_DATA_STREAM; group 0 is all groups, a rate of 0 stops them too."""
        groups = self._rules.groups
        chosen = groups if group == mavlink.MAV_DATA_STREAM_ALL else {group} & groups.keys()
        interval_us = US_PER_S / rate_hz if is_on and rate_hz > 0 else OFF
        for number in sorted({number for each in chosen for number in groups[each]}):
            self.set_interval_us(number, interval_us, now_s)

    def _default_interval_s(self, number: int) -> float | None:
        rate_hz = self._rates_hz.get(number, 0.0)
        return 1.0 / rate_hz if rate_hz else None

    def _start(self, number: int, interval_s: float | None, now_s: float) -> None:
        if interval_s is None:
            self._streams.pop(number, None)
            return
        interval_s = max(interval_s, self._min_interval_s)
        running = self._streams.get(number)
        if running is not None and running.interval_s == interval_s:
            return  # the same rate as before: its phase stays
        self._streams[number] = _Stream(interval_s, now_s, now_s)


MAX_MESSAGE_ID = 2**24 - 1
MAX_PEERS = 16
"""Largest number of peers with separate streams; one with many ports loses its oldest."""
MAX_INTERVAL_ID = 0xFFFF
PROTOCOL_VERSION = 300
"""Id of a message that the dialect does not have any more."""
SHORTHANDS = {
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: PROTOCOL_VERSION,
    mavlink.MAV_CMD_GET_HOME_POSITION: mavlink.MAVLINK_MSG_ID_HOME_POSITION,
}
"""Commands that mean REQUEST_MESSAGE of one message."""


def cast_to_uint32(value: float) -> int:
    """Return the value as autopilots' processors cast it; NaN becomes 0."""
    return int(value) & 0xFFFF_FFFF if math.isfinite(value) else 0


AVAILABLE_MODES = mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES
Build = Callable[[int], Message | None]
"""Builds the message with an id; None if unknown, or without current data."""


@dataclass(frozen=True, slots=True)
class RequestProfile:
    """Results with which an autopilot refuses requests."""

    no_message: CommandResult
    """Result of REQUEST_MESSAGE for an unknown message or one without data."""
    no_stream: CommandResult
    """Result of SET_MESSAGE_INTERVAL for an unknown message or a fixed rate."""
    no_interval: CommandResult
    """Result of GET_MESSAGE_INTERVAL for an unknown message, sent after a MESSAGE_INTERVAL of 0."""
    not_on_request: frozenset[int] = frozenset()
    """Messages that are streamed, but refused by REQUEST_MESSAGE."""
    has_texts: bool = False
    """True if a refused SET_MESSAGE_INTERVAL is explained by a text."""
    casts_id: bool = False
    """True if REQUEST_MESSAGE cuts a fraction off the id, and takes NaN for 0."""
    reports_protocol_version: bool = True
    """True if it supports REQUEST_PROTOCOL_VERSION."""
    capabilities_need_one: bool = False
    """True if REQUEST_AUTOPILOT_CAPABILITIES is refused unless its first parameter is 1."""


class MessageRequests:
    """Keeps the streams of every channel and answers message requests."""

    def __init__(
        self,
        streams: StreamProfile,
        rules: RequestProfile,
        build: Build,
        texts: StatusTexts,
        links: Sequence[LinkSetup] = (LinkSetup(),),
        modes: Sequence[Message] = (),
    ) -> None:
        self._stream_rules = streams
        self._modes = modes
        self._rules = rules
        self._links = links
        self._build = build
        self._texts = texts
        self._tables: OrderedDict[Channel, StreamTable] = OrderedDict()

    def open(self, channel: Channel, now_s: float) -> None:
        """Begin the default streams of a new channel; the oldest of too many peers end."""
        if channel not in self._tables:
            mode = self._links[channel.link].mode
            self._tables[channel] = StreamTable(self._stream_rules, now_s, mode)
        self._tables.move_to_end(channel)
        peers = [each for each in self._tables if each.peer is not None]
        if len(peers) > MAX_PEERS:
            del self._tables[peers[0]]

    @property
    def channels(self) -> Collection[Channel]:
        """Channels with streams: every link, and every peer that requested its own rates."""
        return self._tables.keys()

    def forget(self, channel: Channel) -> None:
        """End the streams of a channel that is gone."""
        self._tables.pop(channel, None)

    def take_due(self, now_s: float) -> list[tuple[Channel, int]]:
        """Return the messages due at `now_s`, with their channels."""
        return [
            (channel, number)
            for channel, table in self._tables.items()
            for number in table.take_due(now_s)
        ]

    def handle_command(
        self, command: Command, now_s: float
    ) -> tuple[CommandResult, list[Outgoing]] | None:
        """Return the result and the messages before the ACK; None for other commands."""
        match command.number:
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request(command, now_s)
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                return self._report_interval(command.whole(1), command.partner, now_s)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(command, now_s)
        number, rules = SHORTHANDS.get(command.number), self._rules
        if number is None or (number == PROTOCOL_VERSION and not rules.reports_protocol_version):
            return None
        is_wanted = command.params[0] == 1.0 or not rules.capabilities_need_one
        if number == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION and not is_wanted:
            return rules.no_message, []
        return self._send(number, command.partner)

    def set_data_stream(self, message: Message, partner: Partner, now_s: float) -> None:
        """Obey a REQUEST_DATA_STREAM that is for us; it has no answer."""
        if isinstance(message, mavlink.MAVLink_request_data_stream_message):
            table, is_on = self._table(partner.channel, now_s), message.start_stop == 1
            group, rate_hz = message.req_stream_id, message.req_message_rate
            table.set_group(group, rate_hz, is_on=is_on, now_s=now_s)

    def _table(self, channel: Channel, now_s: float) -> StreamTable:
        self.open(channel, now_s)
        return self._tables[channel]

    def _request(self, command: Command, now_s: float) -> tuple[CommandResult, list[Outgoing]]:
        number = cast_to_uint32(command.params[0]) if self._rules.casts_id else command.whole(1)
        if number in self._rules.not_on_request:
            return self._rules.no_message, []
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._report_interval(command.whole(2), command.partner, now_s)
        if number is None or not 0 <= number <= MAX_MESSAGE_ID:
            return self._rules.no_message, []
        if number == AVAILABLE_MODES:
            index = command.whole(2)
            wanted = self._modes if index == 0 else self._modes[index - 1 : index] if index else ()
            result = CommandResult.ACCEPTED if wanted else self._rules.no_message
            return result, [Outgoing(mode, command.partner.channel) for mode in wanted]
        return self._send(number, command.partner)

    def _send(self, number: int, partner: Partner) -> tuple[CommandResult, list[Outgoing]]:
        message = None if number in self._rules.not_on_request else self._build(number)
        if message is None:
            return self._rules.no_message, []
        return CommandResult.ACCEPTED, [Outgoing(message, partner.channel)]

    def _report_interval(
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
        if not self._rules.has_texts:
            return self._rules.no_stream, []
        text = f"no stream of message {number} can be set"
        return self._rules.no_stream, self._texts.warn(command.partner, text)
