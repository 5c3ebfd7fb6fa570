"""The wire between companion and vehicle, and observers of the frames on it.

The wire delays or drops datagrams. Observers see every frame that was sent or received, and every
physics step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol, TypeVar

from companion.domain import FlightMode
from companion.mav import codec
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec
from companion.mav.dialect import Message
from companion.mav.endpoint import Address
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.neighbours import Neighbour

Delivery = tuple[float, bytes]


class Lane(Enum):
    """One direction of one link."""

    TO_COMPANION = "vehicle to companion"
    TO_VEHICLE = "companion to vehicle"
    RANGING = "radio to companion, over a link of its own"


class Wire(Protocol):
    """Carries datagrams; their fate depends only on its seed and its input."""

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """Return the deliveries of a datagram sent at `now_s`: none, one, or several copies."""


class PerfectWire:
    """Everything arrives at once and as it was sent."""

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Return the datagram, delivered at the time it was sent."""
        return [(now_s, data)]


SHORTEST = 8
_READER = MavCodec(9, 9)
_UNREAD = object()


@dataclass(slots=True)
class Frame:
    """One frame at one end of the wire."""

    time_s: float
    data: bytes
    lane: Lane
    is_genuine: bool = True
    """True if it came from the other end of the wire, damaged or not, and not from an attacker."""
    is_intact: bool = False
    """True if it is bit by bit as it was sent; otherwise decoding shows if it is valid."""
    peer: Address | None = None
    """Address that a frame to the companion came from."""
    _message: object = field(default=_UNREAD, repr=False)

    @property
    def number(self) -> int:
        """The message id, read from the header."""
        return codec.message_id(self.data)

    @property
    def sender(self) -> tuple[int, int]:
        """System and component id, read from the header."""
        start = 5 if self.data[0] == codec.MAGIC_V2 else 3
        return self.data[start], self.data[start + 1]

    @property
    def message(self) -> Message | None:
        """Message in the frame, decoded once; None if its checksum is wrong or it is invalid."""
        if self._message is _UNREAD:
            self._message = _READER.decode_frame(self.data)
        return self._message  # type: ignore[return-value]

    @property
    def is_readable(self) -> bool:
        """True if its checksum is right."""
        return self.is_intact or self.message is not None


class Observer:
    """Observer of a flight; a subclass overrides the handlers it needs."""

    def sent(self, frame: Frame) -> None:
        """Handle a frame that the companion sent."""

    def heard(self, frame: Frame) -> None:
        """Handle a frame that reached the companion, still unread."""

    def read(self, frame: Frame) -> None:
        """Handle the companion's reading of a frame."""

    def vehicle_sent(self, frame: Frame) -> None:
        """Handle a frame of the vehicle or its radio."""

    def vehicle_heard(self, frame: Frame) -> None:
        """Handle a frame that reached the vehicle, still unread."""

    def neighbour_heard(self, frame: Frame, neighbour: Neighbour) -> None:
        """Handle a frame that reached another vehicle."""

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:
        """Handle a physics step of the vehicle."""

    def ticked(self, now_s: float) -> None:
        """Handle the end of the companion's control tick."""

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Handle a journal entry of the companion; texts and results are kinds as well."""

    def companion_started(self, now_s: float) -> None:
        """Handle the start or restart of the companion process."""

    def companion_suspended(self, now_s: float, until_s: float) -> None:
        """Handle a suspension of the companion process until then."""

    def companion_ended(self, now_s: float) -> None:
        """Handle the end or kill of the companion process."""

    def mode_chosen(self, mode: FlightMode, now_s: float) -> None:
        """Handle a mode switch by the pilot or the operator."""

    def vehicle_rebooted(self, now_s: float) -> None:
        """Handle a reboot of the vehicle."""


T = TypeVar("T")


def overriding(objects: Iterable[T], base: type[T], what: str) -> list[T]:
    """Return the objects whose class overrides a method of the base."""
    inherited = getattr(base, what)
    return [each for each in objects if getattr(type(each), what) is not inherited]


class Observers(list[Observer]):
    """Observers of a flight; frequent calls go only to those that implement them."""

    def __init__(self) -> None:
        super().__init__()
        self._known: list[Observer] = []
        self._listeners: dict[str, list[Callable[..., None]]] = {}

    def of(self, what: str) -> list[Callable[..., None]]:
        """Return the observers' methods of a name in `Observer`, in the order of the observers."""
        if self._known != self:
            self._known = list(self)
            self._listeners.clear()
        listeners = self._listeners.get(what)
        if listeners is None:
            looking = overriding(self, Observer, what)
            listeners = self._listeners[what] = [getattr(each, what) for each in looking]
        return listeners

    def notify(self, what: str, *values: object) -> None:
        """Call a method of `Observer` on every observer that overrides it, in order."""
        for listener in self.of(what):
            listener(*values)


def frames_in(data: bytes) -> list[bytes]:
    """Return the frames of a datagram, by the lengths in their headers or, among junk, by CRC."""
    frames = []
    start = 0
    while start + SHORTEST <= len(data) and data[start] in codec.HEADER_LENGTH:
        length = codec.HEADER_LENGTH[data[start]] + data[start + 1] + codec.CRC_LENGTH
        if data[start] == codec.MAGIC_V2 and data[start + 2] & codec.INCOMPAT_SIGNED:
            length += codec.SIGNATURE_LENGTH
        if start + length > len(data):
            break
        frames.append(data[start : start + length])
        start += length
    if start == len(data):
        return frames
    return codec.FrameSplitter(CRC_EXTRA_BY_ID).split(data, is_datagram=True)
