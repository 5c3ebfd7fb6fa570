"""An endpoint whose traffic is tampered with: defects for the suite to find."""

from __future__ import annotations

from collections.abc import Callable

from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk, Endpoint
from sim_link.lab.conformance.mavlink_oracle import FrameSpec, build_raw

Edit = Callable[[bytes], list[bytes]]
"""Function from a frame to the frames that replace it."""

HEADER = 10


def lose(frame: bytes) -> list[bytes]:
    del frame
    return []


def unchanged(frame: bytes) -> list[bytes]:
    return [frame]


class Tampered:
    """An endpoint behind which every frame is edited.

    Args:
        endpoint: The peer itself.
        inbound: Edit of each frame before it arrives.
        outbound: Edit of each frame that it sends.
    """

    def __init__(
        self, endpoint: Endpoint, inbound: Edit = unchanged, outbound: Edit = unchanged
    ) -> None:
        self._endpoint = endpoint
        self._inbound = inbound
        self._outbound = outbound

    def receive(self, chunk: Chunk, now_s: float) -> None:
        for data in self._inbound(chunk.data):
            self._endpoint.receive(chunk._replace(data=data), now_s)

    def handle_timer(self, now_s: float) -> None:
        self._endpoint.handle_timer(now_s)

    def next_timer_s(self) -> float:
        return self._endpoint.next_timer_s()

    def take_output(self) -> list[Chunk]:
        return [
            chunk._replace(data=data)
            for chunk in self._endpoint.take_output()
            for data in self._outbound(chunk.data)
        ]

    def request_stop(self, now_s: float) -> None:
        self._endpoint.request_stop(now_s)

    @property
    def is_finished(self) -> bool:
        return self._endpoint.is_finished


class DeafRecording:
    """Output of an endpoint without input, recorded until it is read."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._wakeups: list[tuple[float, list[Chunk]]] = []

    def wakeup(self, number: int) -> tuple[float, list[Chunk]]:
        """Return the time and output of the wake-up of this index."""
        while len(self._wakeups) <= number:
            now_s = self._endpoint.next_timer_s()
            self._endpoint.handle_timer(now_s)
            self._wakeups.append((now_s, self._endpoint.take_output()))
        return self._wakeups[number]


class Deaf:
    """An endpoint that hears nothing: since nothing can change what it says, a recording of it."""

    is_finished = False

    def __init__(self, recording: DeafRecording) -> None:
        self._recording = recording
        self._next = 0
        self._output: list[Chunk] = []

    def receive(self, chunk: Chunk, now_s: float) -> None:
        pass

    def handle_timer(self, now_s: float) -> None:
        while self.next_timer_s() <= now_s:
            self._output += self._recording.wakeup(self._next)[1]
            self._next += 1

    def next_timer_s(self) -> float:
        return self._recording.wakeup(self._next)[0]

    def take_output(self) -> list[Chunk]:
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        pass


def id_of(frame: bytes) -> int:
    return int.from_bytes(frame[7:10], "little")


def is_version2(frame: bytes) -> bool:
    return len(frame) > HEADER and frame[0] == 0xFD


def rebuilt(frame: bytes, payload: bytes, incompat: int = 0) -> bytes:
    """The frame with another payload and a right CRC."""
    spec = FrameSpec(frame[5], frame[6], frame[4], incompat=incompat)
    crc_extra = int(mavlink.mavlink_map[id_of(frame)].crc_extra)
    return build_raw(id_of(frame), payload, crc_extra, spec)


def full_payload(frame: bytes) -> bytearray:
    """The payload with all its trailing zeros."""
    length = mavlink.mavlink_map[id_of(frame)].unpacker.size
    return bytearray(frame[HEADER : HEADER + frame[1]].ljust(length, b"\0"))


def only(message_id: int, edit: Edit) -> Edit:
    """An edit of one kind of message."""
    return lambda frame: (
        edit(frame) if is_version2(frame) and id_of(frame) == message_id else [frame]
    )


def drop(message_id: int) -> Edit:
    return only(message_id, lose)


def set_byte(message_id: int, offset: int, value: int) -> Edit:
    """Change one byte of the payload of a kind of message."""

    def edit(frame: bytes) -> list[bytes]:
        payload = full_payload(frame)
        payload[offset] = value
        return [rebuilt(frame, bytes(payload).rstrip(b"\0") or b"\0")]

    return only(message_id, edit)


def every(count: int, edit: Edit) -> Edit:
    """An edit of each `count`th frame."""
    seen = 0

    def edit_some(frame: bytes) -> list[bytes]:
        nonlocal seen
        seen += 1
        return edit(frame) if seen % count == 0 else [frame]

    return edit_some
