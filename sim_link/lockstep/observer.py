"""Who watches a flight: every frame that was sent or heard, and every step of the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message
from companion.mav.framing import (
    CRC_LENGTH,
    HEADER_LENGTH,
    INCOMPAT_SIGNED,
    MAGIC_V2,
    SIGNATURE_LENGTH,
    message_id,
)
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lockstep.wire import Lane

_READER = MavCodec(9, 9)
_UNREAD = object()


@dataclass(slots=True)
class Frame:
    """One frame at one end of the wire."""

    time_s: float
    data: bytes
    lane: Lane
    is_genuine: bool = True
    """Whether it came from the other end of the wire, damaged or not, and not from an attacker."""
    _message: object = field(default=_UNREAD, repr=False)

    @property
    def number(self) -> int:
        """The message id, read from the header."""
        return message_id(self.data)

    @property
    def message(self) -> Message | None:
        """What it says, decoded once; None if its checksum is wrong or it makes no sense."""
        if self._message is _UNREAD:
            self._message = _READER.decode_frame(self.data)
        return self._message  # type: ignore[return-value]


class Observer:
    """Watches a flight; a subclass overrides what it wants to see."""

    def sent(self, frame: Frame) -> None:
        """The companion sent this."""

    def heard(self, frame: Frame) -> None:
        """This reached the companion, which has not read it yet."""

    def read(self, frame: Frame) -> None:
        """The companion has read what it heard."""

    def vehicle_sent(self, frame: Frame) -> None:
        """The vehicle, or its radio, sent this."""

    def vehicle_heard(self, frame: Frame) -> None:
        """This reached the vehicle, which has not read it yet."""

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:
        """The vehicle moved by a physics step."""

    def ticked(self, now_s: float) -> None:
        """The companion's control tick is over."""

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """The companion wrote this into its journal; texts and results are kinds as well."""

    def companion_started(self, now_s: float) -> None:
        """The companion process began, at the start or anew."""

    def companion_suspended(self, now_s: float, until_s: float) -> None:
        """The companion process gets no time until then."""

    def companion_ended(self, now_s: float) -> None:
        """The companion process ended or was killed."""

    def vehicle_rebooted(self, now_s: float) -> None:
        """The vehicle begins anew."""


def frames_in(data: bytes) -> list[bytes]:
    """The frames of a datagram by the lengths in their headers; junk ends the list."""
    frames = []
    start = 0
    while start + HEADER_LENGTH[MAGIC_V2] <= len(data) and data[start] in HEADER_LENGTH:
        length = HEADER_LENGTH[data[start]] + data[start + 1] + CRC_LENGTH
        if data[start] == MAGIC_V2 and data[start + 2] & INCOMPAT_SIGNED:
            length += SIGNATURE_LENGTH
        if start + length > len(data):
            break
        frames.append(data[start : start + length])
        start += length
    return frames
