"""JSON lines, as docs/radios has them."""

from __future__ import annotations

import math

import pytest

from companion.radios.decoder import AngleFrame, RadioReading
from companion.radios.json_radios import NdjsonDecoder

RANGE = b'{"emitter_id":7,"time_usec":1718000000123456,"range":42.5,"range_std":1.5}\n'
BEARING = (
    b'{"emitter_id":"aa:bb:cc:dd:ee:ff","bearing":-0.7853981633974483,"bearing_std":0.09,'
    b'"body_frame":true,"quality":61}\n'
)
BOTH = (
    b'{"emitter_id":7,"range":12.0,"range_std":null,"bearing":0.5,"elevation":-0.2,'
    b'"line_of_sight":false}\n'
)
READINGS = [
    RadioReading(
        emitter=7,
        device_time_s=1718000000.123456,
        range_m=42.5,
        range_sigma_m=1.5,
        frame=AngleFrame.NORTH,
    ),
    RadioReading(
        emitter="aa:bb:cc:dd:ee:ff",
        azimuth_rad=-math.pi / 4,
        azimuth_sigma_rad=0.09,
        frame=AngleFrame.NOSE,
        quality=0.61,
    ),
    RadioReading(
        emitter=7,
        range_m=12.0,
        azimuth_rad=0.5,
        elevation_rad=-0.2,
        frame=AngleFrame.NORTH,
        line_of_sight=False,
    ),
]


def test_the_lines_of_the_reference_are_read() -> None:
    assert NdjsonDecoder().feed(RANGE + BEARING + BOTH, 0.0) == READINGS


@pytest.mark.parametrize("power_dbm", [-71.5, 0])
def test_a_received_power_is_enough(power_dbm: float) -> None:
    line = f'{{"emitter_id":7,"power_dbm":{power_dbm}}}\n'
    assert NdjsonDecoder().feed(line.encode(), 0.0) == [
        RadioReading(emitter=7, power_dbm=power_dbm, frame=AngleFrame.NORTH)
    ]


@pytest.mark.parametrize("body_frame", ["true", "false", "null"])
def test_what_an_array_prints_is_said_to_be_an_arcsine_and_so_is_of_its_own_frame(
    body_frame: str,
) -> None:
    line = f'{{"bearing":0.326,"elevation":-1.047,"array_angle":true,"body_frame":{body_frame}}}\n'
    assert NdjsonDecoder().feed(line.encode(), 0.0) == [
        RadioReading(azimuth_rad=0.326, elevation_rad=-1.047, frame=AngleFrame.ARRAY)
    ]
    plain = line.replace('"array_angle":true', '"array_angle":false').encode()
    (reading,) = NdjsonDecoder().feed(plain, 0.0)
    assert reading.frame is (AngleFrame.NOSE if body_frame == "true" else AngleFrame.NORTH)


def test_separators_comments_blank_lines_and_crlf_are_no_matter() -> None:
    decoder = NdjsonDecoder()
    stream = b"\x1e" + RANGE[:-1] + b"\r\n\n# by hand\n  \n" + BEARING + b" " + BOTH
    assert decoder.feed(stream, 0.0) == READINGS
    assert decoder.counts.frames == decoder.counts.readings == 3
    assert not decoder.counts.refused


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b'{"emitter_id":7,"bearing":45}', "bearing is in radians"),
        (b'{"emitter_id":7,"elevation":-30}', "elevation is in radians"),
        (b'{"emitter_id":7,"range":NaN}', "not JSON"),
        (b'{"emitter_id":7,"range":Infinity}', "not JSON"),
        (b'{"emitter_id":7,"range":1.0', "not JSON"),
        (b'{"emitter_id":7,"range":1.0} {}', "not JSON"),
        (b'{"emitter_id":7,"x":' + b"[" * 4000, "not JSON"),
        (b'{"emitter_id":"\xff","range":1.0}', "not UTF-8"),
        (b"[7, 1.0]", "not a JSON object"),
        (b'{"emitter_id":7}', "no range, bearing, elevation or power"),
        (b'{"emitter_id":7,"range":null}', "no range, bearing, elevation or power"),
        (b'{"emitter_id":7,"range":1e999}', "range must be a number of metres"),
        (b'{"emitter_id":7,"range":"12"}', "range must be a number of metres"),
        (
            b'{"emitter_id":7,"range":1,"range_std":-1}',
            "range_std must be a number of metres, not negative",
        ),
        (
            b'{"emitter_id":65536,"range":1}',
            "emitter_id must be 0 to 65535, or a name in quotes",
        ),
        (b'{"emitter_id":"","range":1}', "emitter_id must be 0 to 65535, or a name in quotes"),
        (b'{"range":1,"quality":101}', "quality must be a whole number from 0 to 100"),
        (b'{"bearing":1,"array_angle":1}', "array_angle must be true or false"),
        (b'{"range":1,"time_usec":-1}', "time_usec must be whole microseconds, not negative"),
        (b'{"range":1,"range_m":1' + b" " * 4096 + b"}", "line is too long"),
    ],
)
def test_a_line_that_cannot_be_used_is_refused_with_its_reason(line: bytes, reason: str) -> None:
    decoder = NdjsonDecoder()
    assert decoder.feed(line + b"\n" + RANGE, 0.0) == READINGS[:1]
    assert decoder.counts.refused == {reason: 1}


@pytest.mark.parametrize("extra", [0, 1])
def test_a_line_may_have_4096_bytes(extra: int) -> None:
    line = b'{"emitter_id":7,"range":1,"pad":"' + b"x" * (4096 - 35 + extra) + b'"}'
    assert len(line) == 4096 + extra
    assert len(NdjsonDecoder().feed(line + b"\n", 0.0)) == 1 - extra


def test_without_an_emitter_the_settings_must_name_it() -> None:
    assert NdjsonDecoder().feed(b'{"range":1.0}\n', 0.0)[0].emitter is None


def test_bearings_may_go_all_the_way_round() -> None:
    assert len(NdjsonDecoder().feed(b'{"bearing":6.283185307179586}\n', 0.0)) == 1
