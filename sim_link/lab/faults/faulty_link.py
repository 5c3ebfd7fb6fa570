"""A link with faults, in memory on invented time, repeatable from its seed; and the attacker on it.

Theory of operation. Every fault gets effects with a generator of their own: one per direction for a
fault of the link, one for all frames of the vehicle and its radio for a fault of content. A
datagram passes those that act when it is sent, in a fixed order: first its content, then what is
lost, damaged, copied, late. A radio on a link of its own is touched by faults of content only.

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
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults import fault_effects
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.lockstep.observer import Delivery, Lane

LINK_LANES = {
    "both": (Lane.TO_COMPANION, Lane.TO_VEHICLE),
    "to_companion": (Lane.TO_COMPANION,),
    "to_vehicle": (Lane.TO_VEHICLE,),
}
CONTENT_LANES = (Lane.TO_COMPANION, Lane.RANGING)
LINK_RANKS = {kind: rank for rank, kind in enumerate(fault_effects.LINK_EFFECTS, 1)}
"""The order in which faults of the link act, after those of content."""


class FaultyLink:
    """A wire with faults; an `observer.Wire`.

    Faults that are of neither link nor content are left to others. All that is random follows from
    the seed. With a key, changed frames are signed again where they are signed.
    """

    def __init__(self, schedule: faults.Schedule, seed: int, key: SigningKey | None = None) -> None:
        self._seed = seed
        self._key = key
        self._count = 0
        self._effects: dict[Lane, list[fault_effects.FaultEffect[Any]]] = {
            lane: [] for lane in Lane
        }
        for fault in schedule.faults:
            self.add(fault, 0.0)

    def add(self, fault: FaultRecord, began_s: float) -> None:
        """Add a fault, its times counted from `began_s`."""
        self._count += 1
        kind, seed = type(fault), (self._seed, self._count)
        if kind in fault_effects.CONTENT_EFFECTS:
            rng = np.random.default_rng(seed)
            effect = fault_effects.CONTENT_EFFECTS[kind](fault, rng, began_s, self._key)
            for lane in CONTENT_LANES:
                self._effects[lane].append(effect)
        if isinstance(fault, faults.LinkFault):
            for lane in LINK_LANES[fault.direction]:
                rng = np.random.default_rng((*seed, LINK_LANES["both"].index(lane)))
                effect = fault_effects.LINK_EFFECTS[kind](fault, rng, began_s)
                self._effects[lane].append(effect)
        for effects in self._effects.values():
            effects.sort(key=lambda effect: LINK_RANKS.get(type(effect.fault), 0))

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """Return the deliveries of a datagram that is sent at `now_s`."""
        deliveries: list[Delivery] = [(now_s, data)]
        for effect in self._effects[lane]:
            if effect.start_s <= now_s < effect.end_s:
                deliveries = effect.apply(deliveries, now_s)
            else:
                effect.watch(data)
        return deliveries


MEMORY = 4000
"""Frames that are kept for a replay."""
WRONG_KEY = SigningKey(bytes(range(1, 33)))
SYSTEM_BYTE = 5
FOREIGN_SYSTEM = 77


class Attacker:
    """Makes frames."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._heard: deque[bytes] = deque(maxlen=MEMORY)

    def overhear(self, frame: bytes) -> None:
        """Remember what the vehicle sent."""
        self._heard.append(frame)

    def next(self, fault: faults.SecurityFault) -> bytes | None:
        """Return the next frame of an attack, or None while nothing was heard yet."""
        if not self._heard:
            return None
        model = self._heard[int(self._rng.integers(len(self._heard)))]
        match fault:
            case faults.ReplayedFrames():
                return model
            case faults.UnsignedFrames():
                return self._lie(model)
            case faults.ForeignFrames():
                bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
                head = bare[:SYSTEM_BYTE] + bytes((FOREIGN_SYSTEM,)) + bare[SYSTEM_BYTE + 1 : -2]
                crc = frame_crc(head, CRC_EXTRA_BY_ID[message_id(bare)])
                return head + crc.to_bytes(2, "little")
            case faults.ForgedFrames():  # with a timestamp from the past to the end of time
                lie = self._lie(model)
                signing = Signing(WRONG_KEY, int(self._rng.integers(0, MAX_HEARD)))
                return signing.sign(lie, 0, CRC_EXTRA_BY_ID[message_id(lie)])
        return None

    def _lie(self, model: bytes) -> bytes:
        """Return the same kind of frame, unsigned, with other content."""
        bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
        return fault_effects.rewrite_frame(bare, self._change, None)

    def _change(self, message: Any) -> None:
        match message:
            case mavlink.MAVLink_heartbeat_message():
                message.custom_mode = int(self._rng.integers(0, 10)) << 16
                message.base_mode = int(self._rng.integers(0, 256))
            case mavlink.MAVLink_local_position_ned_message():
                message.x += float(self._rng.normal(0.0, 50.0))
                message.y += float(self._rng.normal(0.0, 50.0))
            case (
                mavlink.MAVLink_home_position_message()
                | mavlink.MAVLink_gps_global_origin_message()
            ):
                message.latitude += 10_000
