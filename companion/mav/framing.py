"""Frame splitter: length, magic and CRC of MAVLink frames, before any message class sees them.

Theory of operation. A link delivers chunks of bytes: whole frames and junk in a datagram, arbitrary
pieces of them in a stream. A candidate starts at a magic byte (0xFD for MAVLink 2, 0xFE for 1). It
is a frame only if its CRC-16/MCRF4XX over everything between the magic and the CRC, plus the
message's CRC_EXTRA, matches; otherwise exactly one byte is discarded and the search continues, so a
wrong length byte never swallows the good frame behind it. A MAVLink 2 frame with an unknown
incompatibility flag is dropped whole, as the protocol requires, once its CRC has verified it.

A message that is not in the dialect cannot be verified. For a router it is assumed a frame, but
kept apart, if it ends where the data ends or a frame begins and no good frame lies within it. The
end of a datagram ends every candidate; a stream keeps at most one unfinished frame (280 bytes).

Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

from fastcrc import crc16

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
HEADER_LENGTH = {MAGIC_V1: 6, MAGIC_V2: 10}
CRC_LENGTH = 2
SIGNATURE_LENGTH = 13
INCOMPAT_SIGNED = 0x01
HEADER_LENGTH_V2 = HEADER_LENGTH[MAGIC_V2]
SHORTEST_V2 = HEADER_LENGTH_V2 + CRC_LENGTH
_TAIL_BY_FLAGS = {0: CRC_LENGTH, INCOMPAT_SIGNED: CRC_LENGTH + SIGNATURE_LENGTH}
"""Bytes behind the payload by incompatibility flags; other flags are unknown."""
MAGIC = re.compile(bytes((ord("["), MAGIC_V2, MAGIC_V1, ord("]"))))


@dataclass(slots=True)
class FrameCounters:
    """Counters since the splitter was created."""

    good: int = 0
    bad_crc: int = 0
    """Candidates of a known message with a wrong CRC, including junk that resembles one."""
    unknown: int = 0
    """Candidates with a message id that is not in the dialect."""
    incompatible: int = 0
    """Frames with an unknown incompatibility flag."""
    junk_bytes: int = 0


class FrameSplitter:
    """Splitter of a stream or datagrams into CRC-checked frames; may keep unknown messages."""

    def __init__(self, crc_extra_by_id: Mapping[int, int], *, keeps_unknown: bool = False) -> None:
        self.counters = FrameCounters()
        self._crc_extra_by_id = crc_extra_by_id
        self._keeps_unknown = keeps_unknown
        self._pending = b""
        self._unknown: list[bytes] = []

    def split(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        """Return the frames completed by `data`; an unfinished one at a datagram's end is junk.

        Most datagrams are one good frame of MAVLink 2 without unknown flags: they are done first.
        """
        size = len(data)
        if is_datagram and size >= SHORTEST_V2 and data[0] == MAGIC_V2 and not self._pending:
            crc_extra = self._crc_extra_by_id.get(data[7] | data[8] << 8 | data[9] << 16)
            at = HEADER_LENGTH_V2 + data[1]
            if crc_extra is not None and size == at + _TAIL_BY_FLAGS.get(data[2], -1):
                crc = crc16.mcrf4xx(data[1:at] + bytes((crc_extra,)))
                if crc == data[at] | data[at + 1] << 8:
                    self.counters.good += 1
                    return [data]
        return self._split(data, is_datagram=is_datagram)

    def _split(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        buffer = self._pending + data
        frames: list[bytes] = []
        taken: list[tuple[int, int]] = []
        guesses: list[tuple[int, int]] = []
        start = 0
        while True:
            magic = MAGIC.search(buffer, start)
            candidate = len(buffer) if magic is None else magic.start()
            self.counters.junk_bytes += candidate - start
            start = candidate
            if magic is None:
                break
            end = frame_end(buffer, start)
            if end > len(buffer) and not is_datagram:
                break
            frame = buffer[start:end]
            if end <= len(buffer) and self._is_valid(frame):
                taken.append((start, end))
                if frame[0] == MAGIC_V2 and frame[2] & ~INCOMPAT_SIGNED:
                    self.counters.incompatible += 1
                else:
                    frames.append(frame)
                start = end
                continue
            if self._keeps_unknown and end <= len(buffer):
                guesses.append((start, end))
            self.counters.junk_bytes += 1
            start += 1
        if guesses:
            start = max(start, self._keep_unknown(buffer, guesses, taken))
        self._pending = buffer[start:]  # empty after a datagram
        self.counters.good += len(frames)
        return frames

    def take_unknown(self) -> list[bytes]:
        """Return unverified frames of unknown messages since the last call."""
        unknown, self._unknown = self._unknown, []
        return unknown

    def _keep_unknown(
        self, buffer: bytes, guesses: list[tuple[int, int]], taken: list[tuple[int, int]]
    ) -> int:
        """Keep those candidates that are likely frames; return the end of the last one."""
        free_from = guesses[0][0]
        good_ends = [end for _, end in taken]
        for start, end in guesses:
            if message_id(buffer[start:end]) in self._crc_extra_by_id:
                continue  # a known message with a wrong CRC
            ends_well = end == len(buffer) or buffer[end] in HEADER_LENGTH
            next_good = bisect_right(good_ends, start)
            is_free = start >= free_from and not (
                next_good < len(taken) and taken[next_good][0] < end
            )
            if ends_well and is_free:
                self._unknown.append(buffer[start:end])
                free_from = end
        return free_from

    def _is_valid(self, frame: bytes) -> bool:
        crc_extra = self._crc_extra_by_id.get(message_id(frame))
        if crc_extra is None:
            self.counters.unknown += 1
            return False
        if has_good_crc(frame, crc_extra):
            return True
        self.counters.bad_crc += 1
        return False


def frame_end(buffer: bytes, start: int) -> int:
    """Return the end of the frame at the magic byte `start`, by its header; may exceed `buffer`."""
    magic = buffer[start]
    header_end = start + HEADER_LENGTH[magic]
    if header_end > len(buffer):
        return header_end
    end = header_end + buffer[start + 1] + CRC_LENGTH
    if magic == MAGIC_V2 and buffer[start + 2] & INCOMPAT_SIGNED:
        end += SIGNATURE_LENGTH
    return end


def message_id(frame: bytes) -> int:
    """Return the message id in a frame's header."""
    if frame[0] == MAGIC_V1:
        return frame[5]
    return frame[7] | frame[8] << 8 | frame[9] << 16


def header_of(frame: bytes) -> tuple[int, tuple[int, int], int]:
    """Return sequence number, sender's system and component id, and message id of a frame."""
    if frame[0] == MAGIC_V1:
        return frame[2], (frame[3], frame[4]), frame[5]
    return frame[4], (frame[5], frame[6]), frame[7] | frame[8] << 8 | frame[9] << 16


def sender_of(frame: bytes) -> tuple[int, int]:
    """Return the sender's system and component id in a frame's header."""
    at = 3 if frame[0] == MAGIC_V1 else 5
    return (frame[at], frame[at + 1])


def frame_crc(frame: bytes, crc_extra: int) -> int:
    """Return the CRC that a frame must have, from its header and payload."""
    end = HEADER_LENGTH[frame[0]] + frame[1]
    return crc16.mcrf4xx(frame[1:end] + bytes((crc_extra,)))


def has_good_crc(frame: bytes, crc_extra: int) -> bool:
    """Return True if a whole frame has the right CRC."""
    end = HEADER_LENGTH[frame[0]] + frame[1]
    return frame_crc(frame, crc_extra) == frame[end] | frame[end + 1] << 8


def without_signature(frame: bytes, crc_extra: int | None) -> bytes:
    """Return the frame unsigned, for logs: a signature must not be stored (developer guide).

    Without a CRC_EXTRA its length and flag stay, which the CRC covers, and the signature is
    blanked.
    """
    if frame[0] != MAGIC_V2 or not frame[2] & INCOMPAT_SIGNED:
        return frame
    end = HEADER_LENGTH[MAGIC_V2] + frame[1]
    if crc_extra is None:
        return frame[: end + CRC_LENGTH] + bytes(SIGNATURE_LENGTH)
    unsigned = frame[:2] + bytes((frame[2] & ~INCOMPAT_SIGNED,)) + frame[3:end]
    return unsigned + frame_crc(unsigned, crc_extra).to_bytes(CRC_LENGTH, "little")
