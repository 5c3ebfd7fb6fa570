from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from companion.errors import ConfigError
from companion.io.log_files import TlogWriter, read_tlog
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink

KEY = bytes(range(1, 33))


def _messages() -> list[Message]:
    return [
        message
        for number in range(100)
        for message in (
            mavlink.MAVLink_heartbeat_message(18, 8, 0, number, 4, 3),
            mavlink.MAVLink_local_position_ned_message(number, 1.5, -2.0, 3.0, 0.0, 0.0, 0.0),
            MAVLink_radio_ranging_message(number, 80.0, 3.0, 0.5, 0.125, 0.0, 0.125, 7, 100, 0),
        )
    ]


def _read_back(path: Path) -> list[tuple[float, dict[str, object]]]:
    log: Any = mavutil.mavlink_connection(str(path), dialect="development")  # type: ignore[no-untyped-call]
    found = []
    while (message := log.recv_msg()) is not None:
        found.append((message._timestamp, message.to_dict()))
    log.f.close()
    return found


@pytest.fixture(autouse=True)
def _mavlink2(monkeypatch: pytest.MonkeyPatch) -> None:
    """pymavlink's log reader takes the MAVLink 2 dialects only where this is set."""
    monkeypatch.setenv("MAVLINK20", "1")


def test_pymavlink_reads_back_every_message_in_order(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    codec, writer, sent = MavCodec(1, 191), TlogWriter(path), _messages()
    for index, message in enumerate(sent):
        writer.write(codec.encode(message), 1_800_000_000.25 + index)
    writer.close()
    read = _read_back(path)
    assert [values for _, values in read] == [message.to_dict() for message in sent]
    assert [stamp for stamp, _ in read] == [1_800_000_000.25 + i for i in range(len(sent))]
    assert writer.dropped == 0


def _signed_frame() -> bytes:
    signer = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    signer.signing.secret_key = KEY
    signer.signing.sign_outgoing = True
    signer.signing.timestamp = 77
    return bytes(mavlink.MAVLink_heartbeat_message(18, 8, 0, 5, 4, 3).pack(signer))


def test_a_signature_is_left_out_and_the_frame_still_reads(tmp_path: Path) -> None:
    frame = _signed_frame()
    signature = frame[-13:]
    path = tmp_path / "flight.tlog"
    writer = TlogWriter(path)
    writer.write(frame, 1_800_000_000.0)
    writer.close()
    assert len(path.read_bytes()) == 8 + len(frame) - 13
    assert signature[-6:] not in path.read_bytes()
    (only,) = MavCodec(1, 1).decode(path.read_bytes()[8:])
    assert only.to_dict()["custom_mode"] == 5
    assert [values["custom_mode"] for _, values in _read_back(path)] == [5]


def test_an_unknown_message_keeps_its_length_but_not_its_signature(tmp_path: Path) -> None:
    frame = bytearray(_signed_frame())
    frame[7:10] = (54321).to_bytes(3, "little")
    path = tmp_path / "flight.tlog"
    writer = TlogWriter(path)
    writer.write(bytes(frame), 0.0)
    writer.close()
    assert path.read_bytes() == bytes(8) + bytes(frame[:-13]) + bytes(13)


def test_frames_and_times_come_back(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    log, codec = TlogWriter(path), MavCodec(1, 191)
    frames = [codec.encode(message) for message in _messages()]
    for number, frame in enumerate(frames):
        log.write(frame, 1.8e9 + 0.01 * number)
    log.close(10.0)
    records = list(read_tlog(path))
    assert [record.frame for record in records] == frames
    assert records[7].unix_us == round((1.8e9 + 0.07) * 1e6)
    path.write_bytes(path.read_bytes()[:-3])
    assert [record.frame for record in read_tlog(path)] == frames[:-1]


def test_what_is_no_tlog_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"no MAVLink in here at all")
    with pytest.raises(ConfigError, match="is this a tlog"):
        list(read_tlog(path))
    with pytest.raises(ConfigError, match="cannot be read"):
        list(read_tlog(tmp_path / "nowhere"))


def test_no_flipped_bit_of_a_frame_is_taken_for_a_frame(tmp_path: Path) -> None:
    path, codec = tmp_path / "flight.tlog", MavCodec(1, 191)
    log = TlogWriter(path)
    frames = [codec.encode(message) for message in _messages()[:4]]
    for frame in frames:
        log.write(frame, 1.8e9)
    log.close(10.0)
    data = path.read_bytes()
    begin = len(frames[0]) + 8 + 8  # of the second frame
    for bit in range(8 * begin, 8 * (begin + len(frames[1]))):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        damaged: list[int] = []
        found = [record.frame for record in read_tlog(path, damaged.append)]
        assert damaged
        assert found == [frames[0], *frames[2:]]
