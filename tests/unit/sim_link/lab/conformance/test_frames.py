"""Frames made by hand, against pymavlink's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.signing import SigningKey
from sim_link.lab.conformance.mavlink_oracle import (
    SIGNED,
    FrameSpec,
    build_frame,
    crc_x25,
    payload_of,
    sign,
    signature_of,
)

MESSAGES: list[Message] = [
    mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
    mavlink.MAVLink_command_long_message(1, 1, 512, 0, 148.0, 0, 0, 0, 0, 0, 0),
    mavlink.MAVLink_param_request_read_message(1, 1, b"SYS_AUTOSTART", -1),
    mavlink.MAVLink_statustext_message(6, b"a text", 0, 0),
    mavlink.MAVLink_timesync_message(0, 1_234_567),
]
SPEC = FrameSpec(255, 190, 7)
KEY = bytes(range(32))


def test_crc_of_the_check_string() -> None:
    assert crc_x25(b"123456789") == 0x6F91


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.get_type())
@pytest.mark.parametrize("version", [1, 2])
def test_a_frame_is_pymavlinks(message: Message, version: int) -> None:
    packer = mavlink.MAVLink(None, 255, 190)
    packer.seq = 7
    theirs = message.pack(packer, force_mavlink1=version == 1)
    assert build_frame(message, replace(SPEC, version=version)) == theirs


def test_an_uncut_frame_is_longer_and_reads_the_same() -> None:
    message = MESSAGES[1]
    cut, uncut = build_frame(message, SPEC), build_frame(message, replace(SPEC, trim=False))
    assert len(uncut) - len(cut) == payload_of(message).__len__() - cut[1]
    (first,), (second,) = MavCodec(1, 1).decode(cut), MavCodec(1, 1).decode(uncut)
    assert first.to_dict() == second.to_dict()


def test_a_changed_crc_is_refused() -> None:
    codec = MavCodec(1, 1)
    assert codec.decode(build_frame(MESSAGES[0], replace(SPEC, crc_change=1))) == []
    assert codec.counters.bad_crc == 1


def test_a_signature_is_the_signing_modules() -> None:
    frame = sign(build_frame(MESSAGES[0], replace(SPEC, incompat=SIGNED)), KEY, 3, 99)
    assert frame[-6:] == SigningKey(KEY).signature_of(frame[:-6])
    read = signature_of(frame, KEY)
    assert read is not None
    assert (read.link_id, read.timestamp, read.is_right) == (3, 99, True)


def test_a_wrong_signature_and_none_are_distinguished() -> None:
    plain = build_frame(MESSAGES[0], SPEC)
    assert signature_of(plain, KEY) is None
    signed = sign(build_frame(MESSAGES[0], replace(SPEC, incompat=SIGNED)), KEY, 3, 99)
    other = signature_of(signed, b"\x01" * 32)
    assert other is not None
    assert not other.is_right


def test_nan_survives() -> None:
    message = mavlink.MAVLink_command_long_message(1, 1, 22, 0, *[math.nan] * 7)
    (read,) = MavCodec(1, 1).decode(build_frame(message, SPEC))
    assert isinstance(read, mavlink.MAVLink_command_long_message)
    assert math.isnan(read.param7)
