"""Ultra-wideband radios with binary protocols: FiRa UCI, NXP SR150 as PX4 reads it, PANS TLV.

Sources: google/pica, `uci_packets.pdl`; PX4, `uwb_sr150` and `SensorUwb.msg`; Decawave, `dwm_api`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from companion.domain import PositionEnu
from sim_link.emulators.emulator import U32, Answer, Emulator, Round, clamped

SESSION = 42
OK, RX_TIMEOUT = 0x00, 0x21
LOS, NLOS, UNKNOWN_PATH = 0, 1, 0xFF
NO_DISTANCE_CM = 0xFFFF
MAX_PAYLOAD = 255
UCI_BOOT = bytes.fromhex("6001000101")
"""CORE_DEVICE_STATUS_NTF: ready."""
SR150_ADDRESS = 0x1122


def uci_record(
    address: int,
    status: int = OK,
    path: int = LOS,
    distance_cm: int = NO_DISTANCE_CM,
    azimuth: tuple[float | None, int] = (None, 0),
    elevation: tuple[float | None, int] = (None, 0),
    rssi_dbm: float = 0.0,
) -> bytes:
    """Return a peer of a session, 31 bytes; angles in degrees with a figure of merit, 0: none."""
    head = struct.pack("<HBBH", address, status, path, distance_cm)
    tail = bytes((1, clamped(-2.0 * rssi_dbm, 0, 255)))
    return head + fom_angle(*azimuth) + fom_angle(*elevation) + bytes(6) + tail + bytes(11)


def q9_7(angle_deg: float) -> int:
    """Return degrees in 128ths."""
    return clamped(128.0 * angle_deg, -0x8000, 0x7FFF)


def fom_angle(angle_deg: float | None, fom: int) -> bytes:
    """Return an angle and its figure of merit."""
    if angle_deg is None:
        return b"\0\0\0"
    return struct.pack("<hB", q9_7(angle_deg), fom)


def session_info(
    sequence: int, records: Sequence[bytes], session: int = SESSION, interval_ms: int = 200
) -> bytes:
    """Return SESSION_INFO_NTF of a round, in as many packets as it takes."""
    head = struct.pack("<IIBIBBB", sequence, session, 0, interval_ms, 1, 0, 0)
    payload = head + bytes(8) + bytes((len(records),)) + b"".join(records)
    # all packets but the last announce a continuation
    pieces = [payload[at : at + MAX_PAYLOAD] for at in range(0, len(payload), MAX_PAYLOAD)]
    packets = b""
    for number, piece in enumerate(pieces, 1):
        follows = 0x10 if number < len(pieces) else 0
        packets += bytes((0x62 | follows, 0x00, 0x00, len(piece))) + piece
    return packets


def path_of(answer: Answer) -> int:
    """Return the line-of-sight flag; LOS where the radio does not report it."""
    return NLOS if answer.heard is not None and answer.heard.line_of_sight is False else LOS


def degrees_of(angle_rad: float | None) -> float | None:
    """Return degrees, or None for None."""
    return None if angle_rad is None else math.degrees(angle_rad)


class FiraUci(Emulator):
    """A FiRa controller with three antennas; angles to the right and upwards."""

    name = "fira_uci"
    title = "FiRa UCI, SESSION_INFO_NTF"
    antenna = "two_axis"
    measures = "both"
    rate_hz = 5.0
    banner = UCI_BOOT

    def encode(self, asked: Round) -> bytes:
        """Return a notification with all peers."""
        return session_info(self.next_number(), [self._record(each) for each in asked.answers])

    def _record(self, answer: Answer) -> bytes:
        if answer.heard is None:
            return uci_record(answer.emitter_id, RX_TIMEOUT, UNKNOWN_PATH)
        range_m, fom = answer.range_m, clamped(100.0 * answer.quality, 1, 100)
        return uci_record(
            answer.emitter_id,
            OK,
            path_of(answer),
            NO_DISTANCE_CM if range_m is None else clamped(100.0 * range_m, 0, NO_DISTANCE_CM - 1),
            (degrees_of(answer.azimuth_rad), fom),
            (degrees_of(answer.elevation_rad), fom),
            answer.power_dbm,
        )


def sr150_frame(
    sequence: int,
    peer: int,
    status: int = OK,
    distance_cm: int = NO_DISTANCE_CM,
    path: int = LOS,
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
) -> bytes:
    """Return 36 bytes without a checksum; a figure of merit of 0 means no angle."""
    head = (0x8E, 0x30, sequence, SESSION, 100, SR150_ADDRESS, peer, status)
    azimuth, elevation = (q9_7(deg or 0.0) for deg in (azimuth_deg, elevation_deg))
    azimuth_fom = 0 if azimuth_deg is None else 90
    elevation_fom = 0 if elevation_deg is None else 80
    body = struct.pack("<HBhhhh", distance_cm, path, azimuth, elevation, 0, 0)
    foms = bytes((azimuth_fom, elevation_fom, 0, 0))
    return struct.pack("<BHIIIHHB", *head) + body + foms + b"\x1b"


class Sr150(Emulator):
    """The module that PX4 reads, with two pairs of antennas; angles to the left and downwards.

    A frame follows the last at once: there is a pause only after a round.
    """

    name = "sr150"
    title = "NXP SR150, as PX4's uwb_sr150 reads it"
    antenna = "two_axis"
    measures = "both"

    def encode(self, asked: Round) -> bytes:
        """Return a frame for each peer."""
        return b"".join(self._frame(answer) for answer in asked.answers)

    def _frame(self, answer: Answer) -> bytes:
        sequence, range_m = self.next_number(), answer.range_m
        if answer.heard is None:
            return sr150_frame(sequence, answer.emitter_id, RX_TIMEOUT, path=NLOS)
        azimuth_deg = degrees_of(answer.azimuth_rad)
        elevation_deg = degrees_of(answer.elevation_rad)
        return sr150_frame(
            sequence,
            answer.emitter_id,
            OK,
            NO_DISTANCE_CM if range_m is None else clamped(100.0 * range_m, 0, NO_DISTANCE_CM - 1),
            path_of(answer),
            None if azimuth_deg is None else -azimuth_deg,
            None if elevation_deg is None else -elevation_deg,
        )


def pans_anchor(
    address: int, distance_mm: int, position_m: PositionEnu = (0.0, 0.0, 0.0), quality: int = 100
) -> bytes:
    """Return distance, its quality and position of one anchor in a tag's answer, 20 bytes."""
    position_mm = (round(1e3 * metres) for metres in position_m)
    head = struct.pack("<HIB", address, distance_mm, quality)
    return head + struct.pack("<iiiB", *position_mm, 100)


LOC_GET, UNKNOWN_COMMAND = b"\x0c\x00", b"\x40\x01\x01"


def pans_location(position_m: PositionEnu, quality: int, anchors: Sequence[bytes]) -> bytes:
    """Return the answer to `dwm_loc_get`: no error, the tag's position, its anchors."""
    position = struct.pack("<iiiB", *(round(1e3 * metres) for metres in position_m), quality)
    distances = bytes((len(anchors),)) + b"".join(anchors)
    return b"\x40\x01\x00\x41\x0d" + position + bytes((0x49, len(distances))) + distances


class PansTlv(Emulator):
    """DWM1001 tag that sends its last measurement only on request."""

    name = "pans_tlv"
    title = "Decawave DWM1001 PANS, TLV"
    names = "{0:04X}"
    most = 12
    request = LOC_GET

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        super().__init__(clock_s, rng)
        self._latest = pans_location((0.0, 0.0, 0.0), 0, ())
        self._request = b""

    def hear(self, data: bytes) -> bytes:
        """Return an answer a request: tag, length, value."""
        answers, request = b"", self._request + data
        while len(request) >= 2 and len(request) >= 2 + request[1]:
            whole, request = request[: 2 + request[1]], request[2 + request[1] :]
            answers += self._latest if whole == LOC_GET else UNKNOWN_COMMAND
        self._request = request
        return answers

    def encode(self, asked: Round) -> bytes:
        """Keep the round for the next request; return nothing."""
        anchors = [
            pans_anchor(
                answer.emitter_id,
                clamped(1e3 * answer.range_m, 0, U32 - 1),
                quality=clamped(100.0 * answer.quality, 0, 100),
            )
            for answer in asked.heard
            if answer.range_m is not None
        ]
        self._latest = pans_location((0.0, 0.0, 0.0), 0, anchors)
        return b""
