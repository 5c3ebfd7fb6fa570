"""Frames of somebody who should not be there, made from what the vehicle sent.

An attacker on the same network hears everything. It has no key: on a signed link its own frames
carry a signature with a key of its own, none at all, or one that was used before.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import mavlink
from companion.mav.framing import frame_crc, message_id, without_signature
from companion.mav.signing import MAX_HEARD, Signing, SigningKey
from sim_link.faults.host_kinds import (
    ForeignFrames,
    ForgedFrames,
    ReplayedFrames,
    SecurityFault,
    UnsignedFrames,
)
from sim_link.faults.rewriting import rewritten

MEMORY = 4000
"""Frames that are kept for a replay."""
WRONG_KEY = SigningKey(bytes(range(1, 33)))
SYSTEM_BYTE = 5
FOREIGN_SYSTEM = 77


class Attacker:
    """Makes frames.

    Args:
        rng: Of the attacker.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._heard: deque[bytes] = deque(maxlen=MEMORY)
        self._signing = Signing(WRONG_KEY)

    def overhear(self, frame: bytes) -> None:
        """Remember what the vehicle sent."""
        self._heard.append(frame)

    def next(self, fault: SecurityFault) -> bytes | None:
        """The next frame of an attack, or None while nothing was heard yet."""
        if not self._heard:
            return None
        model = self._heard[int(self._rng.integers(len(self._heard)))]
        match fault:
            case ReplayedFrames():
                return model
            case UnsignedFrames():
                return self._lie(model)
            case ForeignFrames():
                return self._from_elsewhere(model)
            case ForgedFrames():
                return self._forged(model)
        return None

    def _lie(self, model: bytes) -> bytes:
        """The same kind of frame, unsigned, with other content."""
        bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
        return rewritten(bare, self._change, None)

    def _change(self, message: Any) -> None:
        match message:
            case mavlink.MAVLink_heartbeat_message():
                message.custom_mode = int(self._rng.integers(0, 10)) << 16
                message.base_mode = int(self._rng.integers(0, 256))
            case mavlink.MAVLink_local_position_ned_message():
                message.x += float(self._rng.normal(0.0, 50.0))
                message.y += float(self._rng.normal(0.0, 50.0))
            case mavlink.MAVLink_home_position_message():
                message.latitude += 10_000
            case mavlink.MAVLink_gps_global_origin_message():
                message.latitude += 10_000

    def _forged(self, model: bytes) -> bytes:
        """Signed with a wrong key, with a timestamp from the past to the end of time."""
        lie = self._lie(model)
        self._signing = Signing(WRONG_KEY, int(self._rng.integers(0, MAX_HEARD)))
        return self._signing.sign(lie, 0, CRC_EXTRA_BY_ID[message_id(lie)])

    def _from_elsewhere(self, model: bytes) -> bytes:
        bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
        head = bare[:SYSTEM_BYTE] + bytes((FOREIGN_SYSTEM,)) + bare[SYSTEM_BYTE + 1 : -2]
        return head + frame_crc(head, CRC_EXTRA_BY_ID[message_id(bare)]).to_bytes(2, "little")
