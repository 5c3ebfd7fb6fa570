"""An attacker's frames, against their classification by the link layer."""

from __future__ import annotations

import numpy as np
import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.signing import LinkSigning, SignatureVerdict, Signing, SigningKey
from sim_link.lab.faults.fault_models import (
    ForeignFrames,
    ForgedFrames,
    ReplayedFrames,
    SecurityFault,
    UnsignedFrames,
)
from sim_link.lab.faults.faulty_link import FOREIGN_SYSTEM, Attacker

KEY = SigningKey(bytes(range(32)))


def overheard(signing: Signing) -> tuple[Attacker, list[bytes]]:
    """An attacker that heard some signed heartbeats and positions."""
    codec = MavCodec(1, 1, LinkSigning(signing, 0))
    frames = []
    for i in range(20):
        frames.append(codec.encode(mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)))
        frames.append(codec.encode(mavlink.MAVLink_local_position_ned_message(i, *[1.0] * 6)))
    attacker = Attacker(np.random.default_rng(1))
    assert attacker.next(ForgedFrames()) is None
    for frame in frames:
        attacker.overhear(frame)
    return attacker, frames


@pytest.mark.parametrize(
    ("fault", "verdicts"),
    [
        (ForgedFrames(), {SignatureVerdict.BAD_SIGNATURE}),
        (UnsignedFrames(), {SignatureVerdict.UNSIGNED}),
        (ReplayedFrames(), {SignatureVerdict.REPLAYED}),
    ],
)
def test_no_frame_of_an_attacker_is_proved(
    fault: SecurityFault, verdicts: set[SignatureVerdict]
) -> None:
    attacker, frames = overheard(Signing(KEY, 1000))
    receiver = Signing(KEY, 1000)
    assert {receiver.verify(frame) for frame in frames} == {SignatureVerdict.SIGNED}
    attack = [attacker.next(fault) for _ in range(200)]
    assert {receiver.verify(frame) for frame in attack if frame} == verdicts


def test_a_lie_is_a_well_formed_frame_in_the_vehicles_name() -> None:
    attacker, _ = overheard(Signing(KEY, 1000))
    attack = [attacker.next(UnsignedFrames()) for _ in range(100)]
    messages = MavCodec(9, 9).decode(b"".join(frame for frame in attack if frame))
    assert len(messages) == 100
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {(1, 1)}
    heartbeat = mavlink.MAVLink_heartbeat_message
    modes = {m.custom_mode for m in messages if isinstance(m, heartbeat)}
    assert len(modes) > 5


def test_a_foreign_frame_has_another_system_id() -> None:
    attacker, _ = overheard(Signing(KEY, 1000))
    frame = attacker.next(ForeignFrames())
    assert frame is not None
    (message,) = MavCodec(9, 9).decode(frame)
    assert message.get_srcSystem() == FOREIGN_SYSTEM
