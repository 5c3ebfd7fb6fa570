"""Scripted MAVLink station: send, advance time, expect.

`ProbeLink` is what it needs of a link: to send bytes, and to wait for bytes until a time. A
`Baseline` is the state of a vehicle before its rules were tried, to be put back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.lab.conformance.mavlink_oracle import (
    HEADER_LENGTH,
    SIGNED,
    FrameSpec,
    build_frame,
    build_raw,
    cut,
    sign,
)
from sim_link.lab.conformance.rules import Violation


class ProbeLink(Protocol):
    """One client's connection to the peer under test; its time is the peer's own, in seconds."""

    @property
    def now_s(self) -> float:
        """The time of the link."""

    @property
    def is_datagram(self) -> bool:
        """True if one `send` arrives as one piece."""

    def send(self, data: bytes) -> None:
        """Send bytes as one piece."""

    def poll(self, until_s: float) -> list[bytes]:
        """Return the first data to arrive, in order; empty when there are none until `until_s`."""

    def another(self) -> ProbeLink | None:
        """Return a second client of the same peer; None where the link has room for one only."""

    def close_others(self) -> None:
        """Close the connections made from this one: a server accepts only a few."""


MAVLINK_VERSION = 3
HEARTBEAT_PERIOD_S = 1.0

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Heard:
    """A message and its time of arrival."""

    time_s: float
    message: Message

    @property
    def source(self) -> tuple[int, int]:
        """System and component of the sender."""
        return source_of(self.message)

    @property
    def frame(self) -> bytes:
        """The bytes on the wire."""
        return bytes(self.message.get_msgbuf())

    @property
    def payload(self) -> bytes:
        """Payload of the message."""
        start = HEADER_LENGTH[self.frame[0]]
        return self.frame[start : start + self.frame[1]]


@dataclass(slots=True)
class _Task:
    period_s: float
    due_s: float
    build: Callable[[], Message]


@dataclass(slots=True)
class Signer:
    """Signs the frames of a station."""

    key: bytes
    timestamp: int
    link_id: int = 1

    def sign(self, frame: bytes) -> bytes:
        """Return a frame with the signed flag, completed; the timestamp moves on."""
        self.timestamp += 1
        return sign(frame, self.key, self.link_id, self.timestamp)


class Station:
    """One component on a link; of a kind (MAV_TYPE) it sends a heartbeat each second."""

    def __init__(
        self,
        link: ProbeLink,
        system_id: int = 255,
        component_id: int = 190,
        kind: int | None = mavlink.MAV_TYPE_GCS,
    ) -> None:
        self.link = link
        self.system_id = system_id
        self.component_id = component_id
        self.inbox: list[Heard] = []
        self.datagrams: list[bytes] = []
        """Bytes received, as they arrived: on a byte stream in pieces of any length."""
        self.reader = MavCodec(system_id, component_id)
        self.signer: Signer | None = None
        self.on_message: Callable[[Message], None] = lambda _: None
        """Called with each message as it arrives."""
        self.asked = 0
        """Mark before the last message sent; repetitions do not count."""
        self._pending: deque[bytes] = deque()
        self._is_taking = False
        self._sequence = 0
        self._tasks: list[_Task] = []
        self._kind = kind
        self._stop_heartbeat: Callable[[], None] = lambda: None
        self._be_heard()

    def _be_heard(self) -> None:
        if self._kind is not None:
            beat = heartbeat(self._kind)
            self._stop_heartbeat = self.repeat(lambda: beat, HEARTBEAT_PERIOD_S)

    @contextmanager
    def silence(self) -> Iterator[None]:
        """Stop the station's own heartbeat for a while."""
        self._stop_heartbeat()
        try:
            yield
        finally:
            self._be_heard()

    @property
    def now_s(self) -> float:
        """The time of the link."""
        return self.link.now_s

    def run(self, duration_s: float) -> None:
        """Advance the time."""
        until_s = self.now_s + duration_s
        while self.now_s < until_s:
            self._advance(until_s)

    def run_until(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Advance the time until a condition holds; return True if it did in time."""
        until_s = self.now_s + within_s
        while not condition():
            if self.now_s >= until_s:
                return False
            self._advance(until_s)
        return True

    def is_own(self, message: Message) -> bool:  # noqa: ARG002
        """Return True if the peer itself sent it."""
        return True

    def is_heard(self, within_s: float) -> bool:
        """Advance the time; return True if the peer sends anything."""
        mark = self.mark
        return self.run_until(
            lambda: any(self.is_own(entry.message) for entry in self.inbox[mark:]), within_s
        )

    def repeat(self, build: Callable[[], Message], period_s: float) -> Callable[[], None]:
        """Send a message now and each period; the returned handle ends that."""
        task = _Task(period_s, self.now_s, build)
        self._tasks.append(task)

        def stop() -> None:
            if task in self._tasks:
                self._tasks.remove(task)

        return stop

    def send(self, message: Message, spec: FrameSpec | None = None) -> None:
        """Send a message as this station, or by `spec`."""
        self.send_raw(self._frame_of(message, spec or self.spec()))

    def _frame_of(self, message: Message, spec: FrameSpec) -> bytes:
        if self.signer is None:
            return build_frame(message, spec)
        spec = FrameSpec(spec.system_id, spec.component_id, spec.sequence, incompat=SIGNED)
        return self.signer.sign(build_frame(message, spec))

    def spec(self, *, version: int = 2, incompat: int = 0, compat: int = 0) -> FrameSpec:
        """Return a frame of this station with the next sequence number."""
        sequence, self._sequence = self._sequence, (self._sequence + 1) % 256
        return FrameSpec(self.system_id, self.component_id, sequence, version, incompat, compat)

    def send_raw(self, data: bytes) -> None:
        """Send bytes as they are."""
        self.asked = self.mark
        self._transmit(data)

    def _transmit(self, data: bytes) -> None:
        self.link.send(data)
        self._take(self.link.poll(self.now_s))

    def send_payload(self, kind: type[Message], payload: bytes) -> None:
        """Send a message whose payload is given as bytes."""
        cut = payload.rstrip(b"\0") or payload[:1]
        self.send_raw(build_raw(int(kind.id), cut, int(kind.crc_extra), self.spec()))

    def require_no_answer(
        self, messages: Sequence[Message], kind: type[M], where: Callable[[M], bool] | None = None
    ) -> None:
        """Send messages that nothing of a kind may follow."""
        mark = self.mark
        for message in messages:
            self.send(message)
        self.expect_none(kind, where, mark=mark, what="answered")

    @property
    def mark(self) -> int:
        """Position in the inbox after which messages are new."""
        return len(self.inbox)

    def listen(self, duration_s: float) -> list[Heard]:
        """Advance the time; return the messages received until then."""
        mark = self.mark
        self.run(duration_s)
        return self.inbox[mark:]

    def heard(self, kind: type[M], mark: int = 0) -> list[M]:
        """Return the messages of a kind received after a mark."""
        return [e.message for e in self.inbox[mark:] if isinstance(e.message, kind)]

    def times(self, kind: type[M] | tuple[type[M], ...], mark: int = 0) -> list[float]:
        """Return the times of the messages of a kind after a mark, s."""
        return [e.time_s for e in self.inbox[mark:] if isinstance(e.message, kind)]

    def expect(
        self,
        kind: type[M] | tuple[type[M], ...],
        where: Callable[[M], bool] | None = None,
        *,
        within_s: float = 2.0,
        mark: int | None = None,
        what: str = "",
    ) -> M:
        """Return the first message of a kind after `mark` (default: from now on)."""
        found: list[M] = []
        cursor = self.mark if mark is None else mark

        def is_there() -> bool:
            nonlocal cursor
            while cursor < len(self.inbox) and not found:
                message = self.inbox[cursor].message
                cursor += 1
                if isinstance(message, kind) and (where is None or where(message)):
                    found.append(message)
            return bool(found)

        if not self.run_until(is_there, within_s):
            raise Violation(f"no {what or name_of(kind)} within {within_s:g} s")
        return found[0]

    def ask(
        self,
        message: Message,
        kind: type[M],
        where: Callable[[M], bool] | None = None,
        *,
        within_s: float = 2.0,
        what: str = "",
    ) -> M:
        """Send a message; return the first of a kind after it."""
        self.send(message)
        return self.expect(kind, where, within_s=within_s, mark=self.asked, what=what)

    def expect_none(
        self,
        kind: type[M],
        where: Callable[[M], bool] | None = None,
        *,
        for_s: float = 1.0,
        mark: int | None = None,
        what: str = "",
    ) -> None:
        """Advance the time; require no message of a kind after `mark` (default: from now on)."""
        mark = self.mark if mark is None else mark
        self.run(for_s)
        for message in self.heard(kind, mark):
            if where is None or where(message):
                raise Violation(f"{what or 'not to be sent'}: {brief(message)}")

    def frames_since(self, mark: int) -> list[bytes]:
        """Return the frames that arrived after this number of chunks."""
        return cut(b"".join(self.datagrams[mark:]))

    def _advance(self, until_s: float) -> None:
        due_s = min([until_s, *(task.due_s for task in self._tasks)])
        if due_s > self.now_s:
            self._take(self.link.poll(due_s))
        for task in list(self._tasks):
            if task.due_s <= self.now_s:
                task.due_s = max(task.due_s + task.period_s, self.now_s)
                self._transmit(self._frame_of(task.build(), self.spec()))

    def _take(self, pieces: list[bytes]) -> None:
        """Process received data; replies to our own answers are processed after it."""
        self._pending.extend(pieces)
        if self._is_taking:
            return
        self._is_taking = True
        while self._pending:
            data = self._pending.popleft()
            self.datagrams.append(data)
            for message in self.reader.decode(data, is_datagram=self.link.is_datagram):
                self.inbox.append(Heard(self.now_s, message))
                self.on_message(message)
        self._is_taking = False


def source_of(message: Message) -> tuple[int, int]:
    """Return the system and component of the sender."""
    return (message.get_srcSystem(), message.get_srcComponent())


def heartbeat(kind: int, autopilot: int = mavlink.MAV_AUTOPILOT_INVALID) -> Message:
    """Return the HEARTBEAT of a component that is not an autopilot."""
    return mavlink.MAVLink_heartbeat_message(
        kind, autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, MAVLINK_VERSION
    )


def name_of(kind: type[Message] | tuple[type[Message], ...]) -> str:
    """Return the MAVLink name of a message class, or of the first of several."""
    first = kind[0] if isinstance(kind, tuple) else kind
    return str(getattr(first, "msgname", first.__name__))


def brief(message: Message) -> str:
    """Return a message in one line."""
    source = "/".join(map(str, source_of(message)))
    text = str(message)
    return f"{text if len(text) < 160 else text[:157] + '...'} from {source}"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One PARAM_VALUE, its value kept as the four bytes on the wire."""

    name: str
    kind: int
    raw: bytes
    index: int
    count: int
    value: float
    """The number, decoded as the flavour encodes."""


@dataclass(slots=True)
class Baseline:
    """State of the vehicle before the rules changed it; shared by all probes of a run."""

    allows_harm: bool = False
    report: Callable[[str], None] = lambda _: None
    """Called with the cause of each wait."""
    custom_mode: int | None = None
    parameters: dict[str, Parameter] = field(default_factory=dict)
    plans: dict[int, list[Any] | None] = field(default_factory=dict)
    """The items of each MAV_MISSION_TYPE; None if they could not be read."""
    intervals: dict[int, float] = field(default_factory=dict)
    """Seconds between messages whose rates are not the link's own any more, as before; -1: off."""
    unknown_rates: set[int] = field(default_factory=set)
    """Messages whose rates could not be read before they were changed."""
    home: tuple[int, int, float] | None = None
    start_e7: tuple[int, int] | None = None
    """Start of the flights; they return there, or the next ones would lead ever farther away."""
    unready: str = ""
    """Reason why it could not be armed, after which later rules do not wait as long."""
    serves_one_client: bool = False

    def leftovers(self) -> list[str]:
        """Return everything that was not restored, with the remedy."""
        left = [
            f"{p.name} is not restored: set it to {p.value:.9g}" for p in self.parameters.values()
        ]
        left += [
            f"plan of type {kind} is not restored: "
            + ("it could not be read before" if items is None else f"it had {len(items)} items")
            for kind, items in self.plans.items()
        ]
        if self.unknown_rates:
            names = ", ".join(
                mavlink.mavlink_map[number].msgname for number in sorted(self.unknown_rates)
            )
            left.append(f"rates are the mode's default now, they could not be read: {names}")
        return left + (["home is not restored: set it again"] if self.home else [])
