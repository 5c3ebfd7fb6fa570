"""The log of inputs: exact, in order, and honest about what is missing."""

import math
import struct
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.guidance.events import StopRequested
from companion.io.log_files import Input, InputKind, InputLog, parse_inputs, read_inputs
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink

PEER = ("192.168.1.7", 14550)
HEADER_SIZE, CRC_SIZE = 19, 4
FRAME = MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))


def written(path: Path, times_s: list[float]) -> list[Input]:
    log = InputLog(path)
    for time_s in times_s:
        log.frame(FRAME, 1, PEER, time_s)
        log.tick(time_s)
    log.event(StopRequested(times_s[-1]))
    log.close(10.0)
    return list(read_inputs(path))


def test_inputs_come_back_exactly_and_in_order(tmp_path: Path) -> None:
    times_s = [0.1 + 0.2, math.pi, math.nextafter(4.0, 5.0)]
    inputs = written(tmp_path / "flight.inputs", times_s)
    assert [value.time_s for value in inputs[::2]] == [*times_s, times_s[-1]]
    assert inputs[0] == Input(InputKind.FRAME, times_s[0], 1, PEER, FRAME)
    assert inputs[1] == Input(InputKind.TICK, times_s[0])
    assert inputs[-1] == Input(InputKind.STOP, times_s[-1])


def test_a_frame_without_a_sender_has_none(tmp_path: Path) -> None:
    log = InputLog(tmp_path / "flight.inputs")
    log.frame(FRAME, 0, None, 1.0)
    log.close(10.0)
    assert [value.peer for value in read_inputs(tmp_path / "flight.inputs")] == [None]


def test_a_frame_that_carries_a_key_is_not_kept(tmp_path: Path) -> None:
    log = InputLog(tmp_path / "flight.inputs")
    setup = mavlink.MAVLink_setup_signing_message(1, 1, b"k" * 32, 0)
    log.frame(MavCodec(255, 190).encode(setup), 0, None, 1.0)
    log.close(10.0)
    assert b"kkkk" not in (tmp_path / "flight.inputs").read_bytes()
    assert list(read_inputs(tmp_path / "flight.inputs")) == []


def test_a_file_cut_anywhere_gives_what_came_before(tmp_path: Path) -> None:
    path = tmp_path / "flight.inputs"
    inputs = written(path, [1.0, 2.0])
    whole = path.read_bytes()
    first = len(whole) - len(whole[whole.index(FRAME[:3]) :])
    counts = set()
    for length in range(first, len(whole)):
        path.write_bytes(whole[:length])
        found = list(read_inputs(path))
        assert found == inputs[: len(found)]
        counts.add(len(found))
    assert counts == set(range(len(inputs)))


def test_a_lost_record_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "flight.inputs"
    written(path, [1.0, 2.0])
    data = path.read_bytes()
    at = data.index(FRAME)
    start = at - len(f"{PEER[0]} {PEER[1]}") - HEADER_SIZE
    path.write_bytes(data[:start] + data[at + len(FRAME) + CRC_SIZE :])
    with pytest.raises(ConfigError, match="record 1 is missing"):
        list(read_inputs(path))


@pytest.mark.parametrize("content", [b"", b"x", b"\x00" * 400])
def test_other_files_are_refused_in_words(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "flight.inputs"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"flight\.inputs: "):
        list(read_inputs(path))


def test_a_missing_file_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        list(read_inputs(tmp_path / "nowhere"))


def test_a_file_of_another_version_is_called_that(tmp_path: Path) -> None:
    path = tmp_path / "flight.inputs"
    written(path, [1.0])
    data = path.read_bytes()
    path.write_bytes(data[:17] + data[19:].replace(b"companion inputs 3", b"companion inputs 1"))
    with pytest.raises(ConfigError, match="of another version"):
        list(read_inputs(path))


def test_no_flipped_bit_is_taken_for_an_input(tmp_path: Path) -> None:
    path = tmp_path / "flight.inputs"
    inputs = written(path, [1.0, 2.0])
    data = path.read_bytes()
    begin = data.index(b"companion inputs") + len("companion inputs 3") + CRC_SIZE
    for bit in range(8 * begin, 8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged: list[int] = []
        found = list(parse_inputs(bytes(flipped), "flipped", damaged.append))
        assert damaged
        assert found == [value for value in inputs if value in found]
        assert len(found) >= len(inputs) - 1


def test_a_log_of_the_format_before_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.inputs"
    inputs = written(path, [1.0, 2.0])
    data, before, at = path.read_bytes(), b"", 0
    while at < len(data):
        sizes = struct.unpack_from("<BI", data, at + 14)
        end = at + HEADER_SIZE + sum(sizes)
        before += data[at:end].replace(b"companion inputs 3", b"companion inputs 2")
        at = end + CRC_SIZE
    path.write_bytes(before)
    assert list(read_inputs(path)) == inputs
