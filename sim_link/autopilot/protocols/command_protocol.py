"""The command protocol: one answer for every command, and later ones for those that take time.

Theory of operation. `receive` turns COMMAND_LONG, COMMAND_INT, SET_MODE and COMMAND_CANCEL into a
value the vehicle obeys, or answers by itself: a command repeated because its ACK was lost gets
the same ACK and is not obeyed twice, one that is under way already gets TEMPORARILY_REJECTED.
The vehicle's result goes in by `answer`; IN_PROGRESS keeps a command open until another result
comes. Every ACK names the sender and goes only where the command came from.

Source: MAVLink developer guide, "Command Protocol" and "Redundancy and Deduplication".

TIMESYNC and PING: exchange of clock readings.

Source: MAVLink developer guide, "Time Synchronization" and "Ping Protocol"; PX4 1.15 and
ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

from companion.mav.dialect import MAVLink_command_cancel_message, Message, mavlink
from companion.mav.payloads import TargetedTimesync, targets_of_frame
from sim_link.autopilot.protocols.addressing import Addressing, Newest, Outgoing, Partner

DEGREE = 1e7
NO_VALUE = 2**31 - 1
"""Integer that means NaN in COMMAND_INT."""
UNKNOWN_PROGRESS = 255
REPEAT_WINDOW_S = 3.0
"""Time for which a client may repeat a command: MAVSDK gives up after 2 s."""
UNANSWERED = -1
"""The result of a command that gets no ACK."""
MAX_REMEMBERED = 64
MAX_RUNNING = 16

Params = tuple[float, float, float, float, float, float, float]


class CommandResult(IntEnum):
    """MAV_RESULT; the dialect's own enum ends at CANCELLED or soon after."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6
    COMMAND_LONG_ONLY = 7
    COMMAND_INT_ONLY = 8
    UNSUPPORTED_MAV_FRAME = 9


ASKS_FOR_A_MESSAGE = frozenset(
    {
        mavlink.MAV_CMD_REQUEST_MESSAGE,
        mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
        mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION,
        mavlink.MAV_CMD_GET_HOME_POSITION,
        mavlink.MAV_CMD_GET_MESSAGE_INTERVAL,
    }
)
"""Commands that are executed each time: a client repeats one if the message is missing."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command, whichever message carried it."""

    number: int
    params: Params
    """NaN where the client leaves a parameter open. COMMAND_INT's x and y are floats here,
    exactly, in 1e-7 degrees where the frame is global."""
    partner: Partner
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT; None for COMMAND_LONG, which has none."""
    confirmation: int = 0
    acknowledged_as: int | None = None
    """Command number in the ACK, if it differs from the command's own."""

    def whole(self, number: int, default: int | None = None) -> int | None:
        """Return a parameter by number, from 1; None if it is not whole, `default` if NaN."""
        value = self.params[number - 1]
        if math.isnan(value):
            return default
        return int(value) if math.isfinite(value) and value == int(value) else None

    @property
    def position_e7(self) -> tuple[int, int] | None:
        """Parameters 5 and 6 as latitude and longitude, 1e-7 degrees; None if one is left open."""
        x, y = self.params[4:6]
        if self.frame is not None:
            return None if NO_VALUE in (x, y) else (int(x), int(y))
        is_given = math.isfinite(x) and math.isfinite(y)
        return (round(x * DEGREE), round(y * DEGREE)) if is_given else None


@dataclass(frozen=True, slots=True)
class Cancel:
    """Request to end a command that is under way."""

    number: int


@dataclass(frozen=True, slots=True)
class CommandForms:
    """Commands that have one form only, and the meaning of SET_MODE."""

    int_only: frozenset[int] = frozenset()
    """UNSUPPORTED as COMMAND_LONG."""
    splits_custom_mode: bool = True
    """True if DO_SET_MODE carries main and sub mode separately (PX4); else the custom mode."""
    acknowledges_set_mode_as: int = mavlink.MAV_CMD_DO_SET_MODE
    """ArduPilot: by the number of the message."""


def command_from(
    message: Message, partner: Partner, *, splits_custom_mode: bool = True
) -> Command | None:
    """Return the command in a message, or None."""
    match message:
        case mavlink.MAVLink_command_long_message():
            four = (message.param1, message.param2, message.param3, message.param4)
            params: Params = (*four, message.param5, message.param6, message.param7)
            return Command(message.command, params, partner, confirmation=message.confirmation)
        case mavlink.MAVLink_command_int_message():
            x, y = float(message.x), float(message.y)
            four = (message.param1, message.param2, message.param3, message.param4)
            return Command(message.command, (*four, x, y, message.z), partner, message.frame)
        case mavlink.MAVLink_set_mode_message():
            main, sub = float(message.custom_mode), math.nan
            if splits_custom_mode:
                main = float(message.custom_mode >> 16 & 0xFF)
                sub = float(message.custom_mode >> 24 & 0xFF)
            rest = (math.nan, math.nan, math.nan, math.nan)
            params = (float(message.base_mode), main, sub, *rest)
            return Command(mavlink.MAV_CMD_DO_SET_MODE, params, partner)
    return None


@dataclass(slots=True)
class _Answered:
    """The last command of a partner that was accepted."""

    key: tuple[int, int | None, bytes]
    confirmation: int
    time_s: float


@dataclass(slots=True)
class _Running:
    command: Command
    progress: int = UNKNOWN_PROGRESS


class Commands:
    """Takes commands from all partners and answers them."""

    def __init__(self, forms: CommandForms) -> None:
        self._forms = forms
        self._running: dict[int, _Running] = {}
        self._answered: Newest[Partner, _Answered] = Newest(MAX_REMEMBERED)

    def receive(
        self, message: Message, partner: Partner, now_s: float
    ) -> tuple[Command | Cancel | None, list[Outgoing]]:
        """Return the command to carry out, and the answers that are due already.

        A `Command` is answered by `answer`, a `Cancel` by `finish` or not at all.
        """
        if isinstance(message, MAVLink_command_cancel_message):
            return (Cancel(message.command) if message.command in self._running else None), []
        command = command_from(message, partner, splits_custom_mode=self._forms.splits_custom_mode)
        if command is None:
            return None, []
        if isinstance(message, mavlink.MAVLink_set_mode_message):
            command = replace(command, acknowledged_as=self._forms.acknowledges_set_mode_as)
        result = self._refusal(command, now_s)
        if result is None:
            return command, []
        progress = UNKNOWN_PROGRESS
        if result is CommandResult.IN_PROGRESS:
            progress = self._running[command.number].progress
        return None, [_ack(command, result, progress)]

    def answer(
        self, command: Command, result: int, now_s: float, *, progress: int = UNKNOWN_PROGRESS
    ) -> Outgoing:
        """Return the ACK of a command; IN_PROGRESS, with its percentage, leaves it open."""
        if result == CommandResult.IN_PROGRESS:
            if command.number in self._running or len(self._running) < MAX_RUNNING:
                self._running[command.number] = _Running(command, progress)
        else:
            self._running.pop(command.number, None)
        if result in (CommandResult.ACCEPTED, CommandResult.IN_PROGRESS):
            self._remember(command, now_s)
        return _ack(command, result, progress)

    @staticmethod
    def reject(message: Message, partner: Partner) -> Outgoing:
        """Return FAILED for a command that is for another component."""
        number, result = int(message.command), CommandResult.FAILED  # type: ignore[attr-defined]
        ack = mavlink.MAVLink_command_ack_message(number, result, 0, 0, *partner.ids)
        return Outgoing(ack, partner.channel)

    def report(self, number: int, progress: int, now_s: float) -> list[Outgoing]:
        """Return IN_PROGRESS for a command that is under way; nothing if it is not."""
        running = self._running.get(number)
        if running is None:
            return []
        result = CommandResult.IN_PROGRESS
        return [self.answer(running.command, result, now_s, progress=progress)]

    def finish(self, number: int, result: int, now_s: float) -> list[Outgoing]:
        """Return the last ACK of a command that was under way, to its sender."""
        running = self._running.get(number)
        return [] if running is None else [self.answer(running.command, result, now_s)]

    def is_running(self, number: int) -> bool:
        """Return True if a command is under way."""
        return number in self._running

    def _refusal(self, command: Command, now_s: float) -> CommandResult | None:
        if command.frame is None and command.number in self._forms.int_only:
            return CommandResult.UNSUPPORTED
        # Accepted a moment ago, and now with a higher confirmation number.
        last = self._answered.get(command.partner)
        is_repeated = (
            last is not None
            and last.key == _key(command)
            and command.confirmation > last.confirmation
            and now_s - last.time_s <= REPEAT_WINDOW_S
        )
        if command.number in self._running:
            own = self._running[command.number].command.partner == command.partner
            if is_repeated and own:
                return CommandResult.IN_PROGRESS
            return CommandResult.TEMPORARILY_REJECTED
        return CommandResult.ACCEPTED if is_repeated else None

    def _remember(self, command: Command, now_s: float) -> None:
        if command.number not in ASKS_FOR_A_MESSAGE:
            answered = _Answered(_key(command), command.confirmation, now_s)
            self._answered[command.partner] = answered


def _key(command: Command) -> tuple[int, int | None, bytes]:
    """Return the identity of a command for comparison; NaN equals NaN here."""
    return command.number, command.frame, repr(command.params).encode()


def _ack(command: Command, result: int, progress: int) -> Outgoing:
    partner, shown = command.partner, progress if result == CommandResult.IN_PROGRESS else 0
    number = command.number if command.acknowledged_as is None else command.acknowledged_as
    message = mavlink.MAVLink_command_ack_message(number, result, shown, 0, *partner.ids)
    return Outgoing(message, partner.channel)


NS_PER_S = 1_000_000_000
LOOP_S = 0.0025
"""Period at which ArduCopter reads its links: SCHED_LOOP_RATE is 400 Hz."""
ROUNDING_S = 1e-9
"""Rounding between times since boot and since the simulator began."""
RECEIVE_BUFFER = 512
"""Bytes of a port that can wait to be read: AP_HAL_SITL `UARTDriver`, `_readbuffer`."""
BITS_PER_BYTE = 10
"""Bits per byte of a UART: start bit, eight bits, stop bit."""


class StampClock:
    """The vehicle's own clock, for stamps and TIMESYNC; physics and streams go by true time."""

    def __init__(self) -> None:
        self._rates: list[tuple[float, float]] = []
        """Start and rate of the coming changes, latest first."""
        self._since_s = self._shown_s = 0.0
        self._rate = 1.0

    def read_s(self, now_s: float) -> float:
        """Return the reading of the clock at true seconds since boot, s; never less than 0."""
        while self._rates and self._rates[-1][0] <= now_s:
            from_s, rate = self._rates.pop()
            self._set(from_s, rate)
        return max(0.0, self._shown_s + self._rate * (now_s - self._since_s))

    def slip(self, step_s: float, now_s: float) -> None:
        """Step the clock, ahead if positive."""
        self._set(now_s, self._rate, step_s)

    def run(self, rate: float, now_s: float, until_s: float) -> None:
        """Run the clock at `rate` seconds per second, then at one."""
        self._set(now_s, rate)
        self._rates = [(until_s, 1.0)]

    def _set(self, now_s: float, rate: float, step_s: float = 0.0) -> None:
        self._shown_s += self._rate * (now_s - self._since_s) + step_s
        self._since_s, self._rate = now_s, rate


@dataclass(slots=True)
class _Question:
    """A TIMESYNC request that waits in ArduPilot's receive buffer."""

    request: mavlink.MAVLink_timesync_message
    partner: Partner
    arrived_s: float
    bytes_waiting: int
    """Bytes of this frame and of those queued after it."""


class Clocks:
    """Answers for one vehicle.

    ArduPilot dates a request's arrival back by the request and all that waits behind it in the
    buffer, at `dated_back_baud`, also of a socket; it sends the older TIMESYNC answer, which does
    not name the requester. Source: ArduPilot 4.5, `GCS_MAVLINK::timesync_receive_timestamp_ns` and
    AP_HAL_SITL `UARTDriver::receive_time_constraint_us`.
    """

    def __init__(
        self,
        addressing: Addressing,
        clock: Callable[[float], float] = lambda now_s: now_s,
        *,
        names_targets: bool = True,
        answers_ping: bool = True,
        dated_back_baud: int | None = None,
    ) -> None:
        self.addressing = addressing
        self._clock = clock
        self._names_targets = names_targets
        self._answers_ping = answers_ping
        self._byte_s = BITS_PER_BYTE / dated_back_baud if dated_back_baud else None
        self._waiting: list[_Question] = []

    def count(self, message: Message, partner: Partner) -> None:
        """Note a received message; it waits behind the requests of its channel."""
        for question in self._waiting:
            if question.partner.channel == partner.channel:
                question.bytes_waiting += len(message.get_msgbuf())

    def timesync(self, message: Message, partner: Partner, now_s: float) -> Message | None:
        """Return the answer to a TIMESYNC; None if it is sent later, and for an answer to ours."""
        if not isinstance(message, mavlink.MAVLink_timesync_message) or message.tc1 != 0:
            return None
        system_id, component_id = targets_of_frame(bytes(message.get_msgbuf()))
        own = self.addressing
        if system_id not in (0, own.system_id) or component_id not in (0, own.component_id):
            return None
        if self._byte_s is None:
            return self._answer(message, partner, self._clock(now_s))
        length = len(message.get_msgbuf())
        self._waiting.append(_Question(message, partner, now_s, length))
        return None

    def next_s(self) -> float:
        """Return the time of the next waiting answer, seconds since boot."""
        return self._waiting[0].arrived_s + LOOP_S if self._waiting else math.inf

    def due(self, now_s: float) -> list[Outgoing]:
        """Return answers that waited for the autopilot's loop."""
        until_s = now_s + ROUNDING_S
        ready = [each for each in self._waiting if until_s >= each.arrived_s + LOOP_S]
        self._waiting = self._waiting[len(ready) :]
        outgoing = []
        for each in ready:
            back_s = min(each.bytes_waiting, RECEIVE_BUFFER) * (self._byte_s or 0.0)
            answer = self._answer(each.request, each.partner, self._clock(each.arrived_s) - back_s)
            outgoing.append(Outgoing(answer, each.partner.channel))
        return outgoing

    def _answer(
        self, request: mavlink.MAVLink_timesync_message, partner: Partner, boot_s: float
    ) -> Message:
        own_ns = max(1, round(NS_PER_S * boot_s))
        if not self._names_targets:
            return mavlink.MAVLink_timesync_message(own_ns, request.ts1)
        return TargetedTimesync(own_ns, request.ts1, *partner.ids)

    def ping(self, message: Message, partner: Partner, _now_s: float = 0.0) -> Message | None:
        """Return the answer to a PING request; None for one with a target, which is an answer."""
        if not self._answers_ping or not isinstance(message, mavlink.MAVLink_ping_message):
            return None
        if message.target_system != 0 or message.target_component != 0:
            return None
        return mavlink.MAVLink_ping_message(message.time_usec, message.seq, *partner.ids)
