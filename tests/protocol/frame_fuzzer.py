"""Random frames against an endpoint in memory, and a twin that is spared some of them.

Theory of operation. Two endpoints of the same seed run side by side. Both receive frames addressed
to the vehicle. The first one also receives irrelevant input: frames for other systems, and bytes
that are not a frame. The two vehicles' own output must then stay the same, byte for byte; frames
that the first one forwards are not its own and are left out. An exception of either ends the
campaign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from companion.mav.codec import message_id
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk, Endpoint
from sim_link.lab.conformance.mavlink_oracle import FrameSpec, build_raw
from sim_link.lab.conformance.rules import Flavour

PEER = ("127.0.0.1", 50_001)
VEHICLE_SYSTEM = 1
UNKNOWN_SYSTEMS = (2, 42, 77, 254)
FOREIGN_COMPONENTS = (77, 100, 191)
STEP_S = 0.02
FRAMES_PER_STEP = 10
SPECIAL_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e30, -1.0, 1.0, 21_196.0)
NEVER_SENT = frozenset({mavlink.MAVLINK_MSG_ID_SETUP_SIGNING})
"""A random key would silence everything after it."""
HANDLED: tuple[type[Message], ...] = (
    mavlink.MAVLink_command_long_message,
    mavlink.MAVLink_command_int_message,
    mavlink.MAVLink_set_position_target_local_ned_message,
    mavlink.MAVLink_set_position_target_global_int_message,
    mavlink.MAVLink_set_attitude_target_message,
    mavlink.MAVLink_set_mode_message,
    mavlink.MAVLink_param_set_message,
    mavlink.MAVLink_param_request_read_message,
    mavlink.MAVLink_param_request_list_message,
    mavlink.MAVLink_mission_count_message,
    mavlink.MAVLink_mission_item_int_message,
    mavlink.MAVLink_mission_item_message,
    mavlink.MAVLink_mission_request_int_message,
    mavlink.MAVLink_mission_request_message,
    mavlink.MAVLink_mission_request_list_message,
    mavlink.MAVLink_mission_ack_message,
    mavlink.MAVLink_mission_clear_all_message,
    mavlink.MAVLink_mission_set_current_message,
    mavlink.MAVLink_request_data_stream_message,
    mavlink.MAVLink_set_gps_global_origin_message,
    mavlink.MAVLink_rc_channels_override_message,
    mavlink.MAVLink_manual_control_message,
    mavlink.MAVLink_ping_message,
    mavlink.MAVLink_timesync_message,
)
"""Messages that an autopilot handles; the other half of the frames is any message of the
dialect."""
COMMANDS = (16, 20, 21, 22, 92, 176, 178, 179, 192, 193, 224, 241, 246, 300, 400, 410, 510, 511)
COMMANDS_ALL = (*COMMANDS, 512, 519, 520, 31_999)
COMMAND_IDS = (75, 76)
COMMAND_OFFSET = 28
"""Offset of the command's number in the payload of COMMAND_LONG and COMMAND_INT."""


class Meant(Enum):
    """Addressee of a piece of bytes."""

    VEHICLE = "the vehicle"
    OTHERS = "another system"
    NO_FRAME = "no frame"


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes to send, and their addressee."""

    data: bytes
    meant: Meant


def random_fields(
    size: int, rng: np.random.Generator, special: Sequence[float] = SPECIAL_FLOATS
) -> bytes:
    """Return random bytes, or plausible floats and small integers, which do more harm."""
    if rng.random() < 0.5:
        return rng.bytes(size)
    payload = bytearray(size)
    for start in range(0, size - 3, 4):
        draw = rng.random()
        if draw < 0.5:
            value = special[int(rng.integers(len(special)))]
            payload[start : start + 4] = np.float32(value).tobytes()
        elif draw < 0.8:
            payload[start] = int(rng.integers(16))
        else:
            payload[start : start + 4] = np.float32(rng.normal(0.0, 100.0)).tobytes()
    return bytes(payload)


class FrameFuzzer:
    """Makes frames with random fields, and bytes that are not frames.

    Args:
        rng: Source of all randomness.
        flavour: Autopilot they are for: PX4 refuses commands for others, ArduPilot stands in for
            components of its system, so that these concern the vehicle too.
    """

    def __init__(self, rng: np.random.Generator, flavour: Flavour) -> None:
        self._rng = rng
        self._flavour = flavour
        self._kinds = [
            kind for number, kind in mavlink.mavlink_map.items() if number not in NEVER_SENT
        ]
        self._sequence = 0

    def next(self) -> Piece:
        """Return the next piece."""
        draw = self._rng.random()
        kinds = HANDLED if draw < 0.7 else self._kinds
        kind = kinds[int(self._rng.integers(len(kinds)))]
        frame, meant = self._frame(kind)
        if draw > 0.9:
            return Piece(self._broken(frame), Meant.NO_FRAME)
        return Piece(frame, meant)

    def _frame(self, kind: type[Message]) -> tuple[bytes, Meant]:
        payload = bytearray(random_fields(int(kind.unpacker.size), self._rng))
        meant = Meant.VEHICLE
        if "target_system" in kind.fieldnames:
            meant = self._address(kind, payload)
        if kind.id in COMMAND_IDS:
            number = COMMANDS_ALL[int(self._rng.integers(len(COMMANDS_ALL)))]
            payload[COMMAND_OFFSET : COMMAND_OFFSET + 2] = number.to_bytes(2, "little")
        self._sequence = (self._sequence + 1) % 256
        spec = FrameSpec(255, 190, self._sequence)
        cut = bytes(payload).rstrip(b"\0") or b"\0"
        return build_raw(int(kind.id), cut, int(kind.crc_extra), spec), meant

    def _address(self, kind: type[Message], payload: bytearray) -> Meant:
        draw = self._rng.random()
        component = 0 if draw < 0.1 else 1
        system, meant = VEHICLE_SYSTEM, Meant.VEHICLE
        if draw > 0.85:
            system, meant = (
                UNKNOWN_SYSTEMS[int(self._rng.integers(len(UNKNOWN_SYSTEMS)))],
                Meant.OTHERS,
            )
        elif draw > 0.7 and "target_component" in kind.fieldnames:
            component = FOREIGN_COMPONENTS[int(self._rng.integers(len(FOREIGN_COMPONENTS)))]
            is_stand_in = self._flavour is Flavour.ARDUPILOT
            meant = Meant.VEHICLE if is_stand_in else Meant.OTHERS
        if kind.id in COMMAND_IDS and self._flavour is Flavour.PX4:
            meant = Meant.VEHICLE
        _set_field(kind, payload, "target_system", system)
        if "target_component" in kind.fieldnames:
            _set_field(kind, payload, "target_component", component)
        return meant

    def _broken(self, frame: bytes) -> bytes:
        match int(self._rng.integers(6)):
            case 0:
                return self._rng.bytes(int(self._rng.integers(1, 300)))
            case 1:
                return frame[: int(self._rng.integers(1, len(frame)))]
            case 2:
                offset = int(self._rng.integers(10, len(frame)))
                flipped = frame[offset] ^ (1 << int(self._rng.integers(8)))
                return frame[:offset] + bytes((flipped,)) + frame[offset + 1 :]
            case 3:
                return frame[:1] + bytes((int(self._rng.integers(256)),)) + frame[2:-1]
            case 4:
                return frame[:2] + bytes((frame[2] | 0x40,)) + frame[3:]
            case _:
                return bytes((0xFD,)) * int(self._rng.integers(1, 40))


def _set_field(kind: type[Message], payload: bytearray, name: str, value: int) -> None:
    """Write a one-byte field at its offset on the wire."""
    offset = 0
    for field in kind.ordered_fieldnames:
        index = kind.fieldnames.index(field)
        count = max(1, int(kind.array_lengths[kind.ordered_fieldnames.index(field)]))
        if field == name:
            payload[offset] = value
            return
        offset += SIZES[str(kind.fieldtypes[index])] * count
    raise KeyError(name)


SIZES = {
    "char": 1,
    "int8_t": 1,
    "uint8_t": 1,
    "uint8_t_mavlink_version": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
    "float": 4,
    "int64_t": 8,
    "uint64_t": 8,
    "double": 8,
}


class FuzzFailure(Exception):  # noqa: N818
    """Finding of a campaign; the text names the frame."""


class FuzzCampaign:
    """Feeds two twins.

    Args:
        make_endpoint: A new vehicle of a flavour; called twice, both of the same seed.
    """

    def __init__(
        self, make_endpoint: Callable[[], Endpoint], rng: np.random.Generator, flavour: Flavour
    ) -> None:
        self._fuzzer = FrameFuzzer(rng, flavour)
        self._tried, self._spared = make_endpoint(), make_endpoint()
        self.now_s = 0.0
        self.frames = 0
        self.answers = 0
        """Frames that the vehicle sent of its own."""

    def run(self, frames: int) -> None:
        """Send more frames.

        Raises:
            FuzzFailure: An exception was raised, or irrelevant input had an effect.
        """
        for _ in range(frames):
            piece = self._fuzzer.next()
            self.frames += 1
            self._send(piece)
            if self.frames % FRAMES_PER_STEP == 0:
                self._step(piece)

    def _send(self, piece: Piece) -> None:
        chunk = Chunk(0, piece.data, PEER)
        try:
            self._tried.receive(chunk, self.now_s)
            if piece.meant is Meant.VEHICLE:
                self._spared.receive(chunk, self.now_s)
        except Exception as error:
            raise FuzzFailure(self._describe(piece, f"{type(error).__name__}: {error}")) from error
        self._compare(piece)

    def _step(self, piece: Piece) -> None:
        self.now_s += STEP_S
        try:
            self._tried.handle_timer(self.now_s)
            self._spared.handle_timer(self.now_s)
        except Exception as error:
            problem = f"{type(error).__name__} in the step after it: {error}"
            raise FuzzFailure(self._describe(piece, problem)) from error
        self._compare(piece)

    def _compare(self, piece: Piece) -> None:
        mine, its = own_frames(self._tried), own_frames(self._spared)
        self.answers += len(mine)
        if mine != its:
            problem = f"meant for {piece.meant.value}, and the vehicle sends {len(mine)} frames "
            problem += f"where its spared twin sends {len(its)}, or others"
            raise FuzzFailure(self._describe(piece, problem))

    def _describe(self, piece: Piece, problem: str) -> str:
        return f"frame {self.frames} ({piece.data.hex()}): {problem}"


def own_frames(endpoint: Endpoint) -> list[bytes]:
    """Return the frames that a vehicle sends without those it only forwards.

    Nor answers to TIMESYNC: ArduPilot dates them back by the bytes that wait on the line, and so by
    those that mean nothing to it.
    """
    return [
        chunk.data
        for chunk in endpoint.take_output()
        if len(chunk.data) > 6
        and chunk.data[5] == VEHICLE_SYSTEM
        and message_id(chunk.data) != mavlink.MAVLINK_MSG_ID_TIMESYNC
    ]
