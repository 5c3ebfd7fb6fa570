"""TIMESYNC and PING: exchange of clock readings.

Source: MAVLink developer guide, "Time Synchronization" and "Ping Protocol"; PX4 1.15 and
ArduCopter 4.5 as observed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.mav.addressing import TargetedTimesync, targets_of_frame
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.addressing import Addressing, Outgoing, Partner

NS_PER_S = 1_000_000_000
LOOP_S = 0.0025
"""Period at which ArduCopter reads its links: SCHED_LOOP_RATE is 400 Hz."""
ROUNDING_S = 1e-9
"""Times since boot and since the simulator began differ by less, but they differ."""
RECEIVE_BUFFER = 512
"""Bytes of a port that can wait to be read: AP_HAL_SITL `UARTDriver`, `_readbuffer`."""
BITS_PER_BYTE = 10
"""Bits per byte of a UART: start bit, eight bits, stop bit."""


class StampClock:
    """The vehicle's own clock: it stamps all messages, and answers TIMESYNC.

    Physics and streams go by true time; only reported times go by this.
    """

    def __init__(self) -> None:
        self._rates: list[tuple[float, float]] = []
        """Start and rate of the coming changes, latest first."""
        self._since_s = self._shown_s = 0.0
        self._rate = 1.0

    def read_s(self, now_s: float) -> float:
        """Return the reading of the clock, s; never less than 0.

        Args:
            now_s: True seconds since boot.
        """
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
    """Bytes of this frame and of those behind it."""


class Clocks:
    """Answers for one vehicle.

    ArduPilot stamps a request by when its first byte would have come over a UART: it dates the
    arrival back by the request and by everything that waits behind it in the buffer, at the baud
    rate of the port, also where that is a socket.

    Args:
        clock: The vehicle's clock at a time since boot.
        names_targets: Whether a TIMESYNC answer names the asker, as the guide wants; ArduPilot
            sends the older form without targets.
        dated_back_baud: Baud rate by which answers are dated back; None: they are not.

    Source: ArduPilot 4.5, `GCS_MAVLINK::timesync_receive_timestamp_ns` and AP_HAL_SITL
    `UARTDriver::receive_time_constraint_us`.
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
        """Note a message that has come; it waits behind the requests of its channel."""
        for question in self._waiting:
            if question.partner.channel == partner.channel:
                question.bytes_waiting += len(message.get_msgbuf())

    def timesync(self, message: Message, partner: Partner, now_s: float) -> Message | None:
        """Return the answer to a TIMESYNC; None if it comes later, and for an answer to ours."""
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

    def ping(self, message: Message, partner: Partner) -> Message | None:
        """Return the answer to a PING request.

        None for a PING with a target, which is an answer.
        """
        if not self._answers_ping or not isinstance(message, mavlink.MAVLink_ping_message):
            return None
        if message.target_system != 0 or message.target_component != 0:
            return None
        return mavlink.MAVLink_ping_message(message.time_usec, message.seq, *partner.ids)
