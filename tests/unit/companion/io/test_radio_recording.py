from __future__ import annotations

import math
from pathlib import Path

import pytest

from companion.errors import CompanionError, ConfigError
from companion.geometry.coordinates import Projection
from companion.io.radio_recording import (
    MAX_DATA_BYTES,
    RadioBytes,
    RadioRecordingWriter,
    Record,
    RecordedOrigin,
    RecordedRadio,
    RecordingHeader,
    TimedPose,
    is_radio_recording,
    read_radio_recording,
)

ORIGIN = RecordedOrigin(
    latitude_deg=46.5, longitude_deg=8.25, altitude_m=1200.0, projection=Projection.SPHERE
)
HEADER = RecordingHeader(
    started_unix_s=1.7e9,
    radios=(
        RecordedRadio(
            name="esp32_ftm",
            url="serial:/dev/ttyUSB0:115200",
            options={"emitter": 7},
            settings={"range_offset_m": 27.5},
        ),
        RecordedRadio(name="ndjson", url="stdin:"),
    ),
)
RECORDS: list[Record] = [
    RadioBytes(12.25, 0, b"\x55\x00\xffI (393564)"),
    ORIGIN,
    TimedPose(12.3, (1.0, -2.0, 30.5), yaw_rad=0.5, roll_rad=-0.01, pitch_rad=0.02, sigma_m=0.4),
    TimedPose(12.4, (1.1, -2.0, 30.5)),
    RadioBytes(12.5, 1, b""),
]


def written(path: Path, records: list[Record] = RECORDS) -> Path:
    with RadioRecordingWriter(path, HEADER) as writer:
        for record in records:
            writer.write(record)
    return path


def test_what_was_recorded_is_read_again(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio")
    header, records = read_radio_recording(path)
    assert header == HEADER
    assert list(records) == RECORDS
    assert is_radio_recording(path)


def test_a_torn_last_line_is_left_out_wherever_it_tore(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio")
    whole = path.read_bytes()
    last_begins = whole.rindex(b"\n", 0, -1) + 1
    for end in range(last_begins, len(whole) - 1):
        path.write_bytes(whole[:end])
        assert list(read_radio_recording(path)[1]) == RECORDS[:-1]


def test_a_broken_line_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio")
    lines = path.read_bytes().splitlines(keepends=True)
    lines[2] = b'{"kind":"bytes","t_s":"noon","radio":0,"data":""}\n'
    path.write_bytes(b"".join(lines))
    with pytest.raises(
        ConfigError, match=r"walk.radio: line 3: \$\.t_s: expected a number, got text"
    ) as caught:
        list(read_radio_recording(path)[1])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("block", [bytes(4096), b"\xff" * 700, b"9" * 40, b"\n" * 300])
def test_a_damaged_block_costs_the_lines_that_it_covers(tmp_path: Path, block: bytes) -> None:
    wanted: list[Record] = [RadioBytes(0.01 * n, 0, b"range 12.5 m") for n in range(400)]
    path = written(tmp_path / "walk.radio", wanted)
    data, at, damaged = path.read_bytes(), 9000, list[int]()
    path.write_bytes(data[:at] + block + data[at + len(block) :])
    with pytest.raises(ConfigError, match=r"walk.radio: line \d+: "):
        list(read_radio_recording(path)[1])
    found = list(read_radio_recording(path, damaged.append)[1])
    lost = [record for record in wanted if record not in found]
    assert damaged
    assert [record for record in wanted if record in found] == found
    assert 0 < len(lost) <= 2 + len(block) // 50


def test_bytes_of_a_radio_that_the_header_lacks_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio", [RadioBytes(1.0, 2, b"x")])
    with pytest.raises(ConfigError, match="line 2: the header has no radio 2"):
        list(read_radio_recording(path)[1])


@pytest.mark.parametrize("content", [b"", b"t_s,range_m\n", b'{"kind":"pose"}\n', b"\xff\xfe\n"])
def test_another_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    assert not is_radio_recording(path)
    with pytest.raises(ConfigError, match="header") as caught:
        read_radio_recording(path)
    assert "\n" not in str(caught.value)


def test_a_line_without_end_is_not_read_into_memory(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio")
    with path.open("ab") as file:
        file.write(b"x" * 1_000_000)
    with pytest.raises(ConfigError, match="line 7: longer than any record"):
        list(read_radio_recording(path)[1])


def test_a_later_version_is_reported_from_a_broken_file(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.radio")
    path.write_bytes(path.read_bytes().replace(b'"version":1', b'"version":2', 1))
    with pytest.raises(ConfigError, match="a recording of version 2"):
        read_radio_recording(path)


def test_records_reach_the_disk_as_whole_lines_within_a_second(tmp_path: Path) -> None:
    path = tmp_path / "walk.radio"
    writer = RadioRecordingWriter(path, HEADER)
    for number in range(4000):
        writer.write(RadioBytes(0.01 * number, 0, b"x" * 100))
        if number % 101 == 100:
            content = path.read_bytes()
            assert content.endswith(b"\n")
            _, records = read_radio_recording(path)
            *_, last = records
            assert isinstance(last, RadioBytes)
            assert last.t_s > 0.01 * number - 1.02
    writer.close()


def test_a_flood_becomes_records_that_can_be_read(tmp_path: Path) -> None:
    flood = bytes(range(256)) * 1000
    path = written(tmp_path / "walk.radio", [RadioBytes(1.0, 0, flood)])
    records = [r for r in read_radio_recording(path)[1] if isinstance(r, RadioBytes)]
    assert b"".join(record.data for record in records) == flood
    assert max(len(record.data) for record in records) == MAX_DATA_BYTES


def test_a_pose_without_numbers_is_dropped_and_counted(tmp_path: Path) -> None:
    with RadioRecordingWriter(tmp_path / "walk.radio", HEADER) as writer:
        writer.write(TimedPose(1.0, (math.nan, 0.0, 0.0)))
        writer.write(TimedPose(1.0, (0.0, 0.0, 0.0), yaw_rad=math.inf))
        writer.write(TimedPose(1.0, (0.0, 0.0, 0.0)))
    assert writer.dropped == 2
    assert list(read_radio_recording(tmp_path / "walk.radio")[1]) == [TimedPose(1.0, (0.0,) * 3)]


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match="cannot be written"):
        RadioRecordingWriter(tmp_path / "no" / "walk.radio", HEADER)


def test_a_full_disk_is_said() -> None:
    with pytest.raises(CompanionError, match="is the disk full"):
        RadioRecordingWriter(Path("/dev/full"), HEADER)
