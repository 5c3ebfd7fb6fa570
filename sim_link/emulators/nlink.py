"""Nooploop LinkTrack and LinkTrack AOA: NLink frames on a serial port at 921600 baud.

A tag that hears anchors: the emitter is the anchor. Little-endian; a frame is 0x55, its mark, its
length, and ends with the low byte of its sum. An angle is positive to the left.

Source: Nooploop, nlink_unpack and nlink_parser (frame layouts and test vectors).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from companion.domain import PositionEnu
from sim_link.emulators.emulator import U32, Answer, Emulator, Round, clamped

ANCHOR, TAG = 1, 2
MAX_INT24 = (1 << 23) - 1
TAG_FRAME_BYTES, TAG_FRAME_ANCHORS = 128, 8
LOS_GAP_DB, NLOS_GAP_DB = 2.0, 12.0
"""Power of all signals above that of the first path (DW1000: under 6 is direct)."""
VOLTAGE_V = 4.85
SATURATED_DEG = 90.0
MARK_TAG0, MARK_NODE2, MARK_NODE3, MARK_AOA, MARK_NODE5 = 1, 4, 5, 7, 8


@dataclass(frozen=True, slots=True)
class Peer:
    """One anchor in a frame; None: not measured."""

    id: int
    range_m: float | None
    fp_dbm: float
    rx_dbm: float
    left_deg: float | None = None
    up_deg: float | None = None
    role: int = ANCHOR
    reserved: bytes = b"\0\0"
    system_ms: int = 0

    @property
    def distance(self) -> bytes:
        """Millimetres in three bytes; 0: none."""
        return int24(0.0 if self.range_m is None else self.range_m)

    @property
    def powers(self) -> bytes:
        """Powers of the first path and of the whole signal, dBm."""
        return bytes(clamped(-2.0 * dbm, 0, 255) for dbm in (self.fp_dbm, self.rx_dbm))


@dataclass(frozen=True, slots=True)
class Node:
    """Header fields of a frame that describe its own node."""

    id: int = 0
    local_ms: int = 0
    system_ms: int = 0
    voltage_v: float = VOLTAGE_V
    role: int = TAG
    reserved: bytes = b"\0\0\0\0"

    @property
    def clocks(self) -> bytes:
        """Clocks of the node and of the network; 0 while there is none."""
        return struct.pack("<II", self.local_ms % U32, self.system_ms % U32)

    @property
    def millivolts(self) -> bytes:
        """Supply voltage in mV."""
        return struct.pack("<H", clamped(1e3 * self.voltage_v, 0, 0xFFFF))


@dataclass(frozen=True, slots=True)
class NodeState:
    """Position, velocity and attitude of a node in NodeFrame2."""

    eop: bytes = b"\xff\xff\xff"
    """Expected error of east, north, up in centimetres."""
    position_m: PositionEnu = (0.0, 0.0, 0.0)
    velocity_mps: PositionEnu = (0.0, 0.0, 0.0)
    inertial: bytes = bytes(71)
    """Gyroscope, accelerometer and derived fields in the order of the frame."""
    reserved: bytes = bytes(10)


def int24(metres: float, scale: float = 1e3) -> bytes:
    """Return three bytes, two's complement."""
    return clamped(scale * metres, -MAX_INT24, MAX_INT24).to_bytes(3, "little", signed=True)


def with_sum(frame: bytes) -> bytes:
    """Return the frame with its checksum appended."""
    return frame + bytes((sum(frame) & 0xFF,))


def variable_frame(mark: int, body: bytes, head: int = 0x55) -> bytes:
    """Return a frame that contains its length."""
    return with_sum(bytes((head, mark)) + struct.pack("<H", 5 + len(body)) + body)


def aoa_frame(node: Node, peers: Sequence[Peer]) -> bytes:
    """Return AOA_NodeFrame0: ranges and angles."""
    elements = (
        bytes((p.role, p.id)) + p.distance + centidegrees(p.left_deg) + p.powers + p.reserved
        for p in peers
    )
    return variable_frame(MARK_AOA, _head_of(node, len(peers)) + b"".join(elements))


def node_frame3(node: Node, peers: Sequence[Peer]) -> bytes:
    """Return LinkTrack_NodeFrame3: ranges."""
    elements = (bytes((p.role, p.id)) + p.distance + p.powers for p in peers)
    return variable_frame(MARK_NODE3, _head_of(node, len(peers)) + b"".join(elements))


def node_frame5(node: Node, peers: Sequence[Peer]) -> bytes:
    """Return LinkTrack_NodeFrame5: ranges of nodes with long ids."""
    body = struct.pack("<BI", node.role, node.id) + node.clocks + node.reserved
    body += node.millivolts + bytes((len(peers),))
    for p in peers:
        body += struct.pack("<BI", p.role, p.id) + p.distance + p.powers
    return variable_frame(MARK_NODE5, body)


def node_frame2(node: Node, motion: NodeState, peers: Sequence[Peer]) -> bytes:
    """Return LinkTrack_NodeFrame2: position and motion, and ranges."""
    body = struct.pack("<BBI", node.role, node.id, node.system_ms % U32) + motion.eop
    body += b"".join(int24(metres) for metres in motion.position_m)
    body += b"".join(int24(mps, 1e4) for mps in motion.velocity_mps) + motion.inertial
    body += struct.pack("<I", node.local_ms % U32) + motion.reserved + node.millivolts
    body += bytes((len(peers),))
    for p in peers:
        body += bytes((p.role, p.id)) + p.distance + p.powers
        body += struct.pack("<I", p.system_ms % U32) + p.reserved
    return variable_frame(MARK_NODE2, body)


def tag_frame0(node: Node, peers: Sequence[Peer]) -> bytes:
    """Return LinkTrack_TagFrame0: 128 bytes, a distance for each of the anchors 0 to 7."""
    frame = bytearray(TAG_FRAME_BYTES - 1)
    frame[0:4] = (0x55, MARK_TAG0, node.id, node.role)
    for peer in peers:
        frame[22 + 3 * peer.id : 25 + 3 * peer.id] = peer.distance
    frame[88:104] = struct.pack("<4f", 1.0, 0.0, 0.0, 0.0)
    frame[108:116] = struct.pack("<II", node.local_ms % U32, node.system_ms % U32)
    frame[117:120] = b"\xff\xff\xff"
    frame[120:122] = node.millivolts
    return with_sum(bytes(frame))


def iot_frame(node: Node, peers: Sequence[tuple[Peer, bytes]], io: int = 0) -> bytes:
    """Return IoT_Frame0: ranges, azimuths and elevations, each with up to 15 bytes of a user."""
    body = struct.pack("<IIBB", node.id, node.system_ms % U32, io, len(peers))
    for peer, data in peers:
        body += struct.pack("<I", peer.id) + peer.distance + centidegrees(peer.left_deg)
        body += centidegrees(peer.up_deg) + peer.powers + bytes((len(data),)) + data
    return variable_frame(0, body, head=0x6A)


def centidegrees(angle_deg: float | None) -> bytes:
    """Return two bytes; without a measurement, those of an invalid phase difference."""
    angle_deg = SATURATED_DEG if angle_deg is None else angle_deg
    return struct.pack("<h", clamped(100.0 * angle_deg, -18_000, 18_000))


def _head_of(node: Node, count: int) -> bytes:
    head = bytes((node.role, node.id)) + node.clocks + node.reserved
    return head + node.millivolts + bytes((count,))


class NLinkEmulator(Emulator):
    """A LinkTrack tag that prints one kind of frame."""

    rate_hz = 50.0
    ids = range(255)
    most = 40

    def encode(self, asked: Round) -> bytes:
        """Return a frame; it lists no nodes if no emitter answered."""
        clock_ms = self.device_ms(asked.sent_at_s)
        return self.frame(self.node(clock_ms), [self.peer(answer) for answer in asked.heard])

    def node(self, clock_ms: int) -> Node:
        """Return the tag's header at a time."""
        return Node(local_ms=clock_ms, system_ms=clock_ms)

    def peer(self, answer: Answer) -> Peer:
        """Return an anchor that answered."""
        heard = answer.heard
        is_blocked = heard is not None and heard.line_of_sight is False
        rx_dbm = answer.power_dbm
        return Peer(
            answer.emitter_id,
            answer.range_m,
            rx_dbm - (NLOS_GAP_DB if is_blocked else LOS_GAP_DB),
            rx_dbm,
            None if answer.azimuth_rad is None else -math.degrees(answer.azimuth_rad),
            None if answer.elevation_rad is None else math.degrees(answer.elevation_rad),
        )

    def frame(self, node: Node, peers: Sequence[Peer]) -> bytes:
        """Return the frame of the round's answers."""
        raise NotImplementedError


class NLinkAoa(NLinkEmulator):
    """Two antennas: the arcsine of the component to the side, folded front to back."""

    name = "nlink_aoa"
    title = "Nooploop LinkTrack AOA, AOA_NodeFrame0"
    antenna = "line"
    measures = "both"

    def node(self, clock_ms: int) -> Node:
        """Return the header; without a network its clock stands still."""
        return Node(local_ms=clock_ms)

    frame = staticmethod(aoa_frame)


class NLinkNode3(NLinkEmulator):
    """The usual one of ranges."""

    name = "nlink_node3"
    title = "Nooploop LinkTrack, NodeFrame3"
    frame = staticmethod(node_frame3)


class NLinkNode5(NLinkEmulator):
    """A tag that prints NodeFrame5, with long ids."""

    name = "nlink_node5"
    title = "Nooploop LinkTrack, NodeFrame5"
    ids: ClassVar[range] = range(1 << 16)
    frame = staticmethod(node_frame5)


class NLinkNode2(NLinkEmulator):
    """A tag that prints NodeFrame2, with the node's position, here unknown."""

    name = "nlink_node2"
    title = "Nooploop LinkTrack, NodeFrame2"

    def frame(self, node: Node, peers: Sequence[Peer]) -> bytes:
        """Return a frame with all nodes that answered."""
        return node_frame2(node, NodeState(), peers)


class NLinkTag0(NLinkEmulator):
    """A tag that prints TagFrame0, with a slot for each of eight anchors."""

    name = "nlink_tag0"
    title = "Nooploop LinkTrack, TagFrame0"
    ids: ClassVar[range] = range(TAG_FRAME_ANCHORS)
    most: ClassVar[int] = TAG_FRAME_ANCHORS
    frame = staticmethod(tag_frame0)


class NLinkIot(NLinkEmulator):
    """Azimuth and elevation."""

    name = "nlink_iot"
    title = "Nooploop IoT series, IoT_Frame0"
    antenna = "two_axis"
    measures = "both"
    ids: ClassVar[range] = range(1 << 16)

    def frame(self, node: Node, peers: Sequence[Peer]) -> bytes:
        """Return a frame with all nodes that answered."""
        return iot_frame(node, [(peer, b"") for peer in peers])
