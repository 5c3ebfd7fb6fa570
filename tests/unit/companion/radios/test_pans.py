"""Lines and answers of a DWM1001 with PANS."""

from __future__ import annotations

import pytest

from companion.radios.decoder import Poll, RadioReading, radio_kind
from companion.radios.fira_pans import PansDecoder, PansOptions, PansTlvDecoder

FOUR = (
    "DIST,4,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.68,"
    "AN2,DCAE,0.00,8.03,0.00,7.76,AN3,5431,0.00,0.00,0.00,8.73,POS,6.95,5.37,-1.97,52"
)
THREE = (
    "DIST,3,AN0,2F2F,3.05,2.68,0.00,2.20,AN1,2ED0,3.02,0.00,0.00,2.23,"
    "AN2,2BA2,0.00,0.00,0.00,3.13,POS,1.76,1.59,0.51,40"
)
BRACKETS = (
    "022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 DCAE[0.00,8.03,0.00]=7.73 "
    "5431[0.00,0.00,0.00]=9.01 le_us=3082 est[6.97,5.17,-1.77,53]"
)
OWN_POSITION = "POS,7.10,5.24,-2.03,53"
TORN = "DIST,4,AN0,0090,1.00,2.00,0.00,3.00,AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00"
POSITION = bytes.fromhex("4b 0a 00 00 1f 04 00 00 9c 0e 00 00 64")
ANSWER = bytes.fromhex(
    "40 01 00 41 0d e0 06 00 00 36 06 00 00 fe 01 00 00 28"
    "49 29 02 2f 2f 98 08 00 00 64 ea 0b 00 00 78 0a 00 00 00 00 00 00 64"
    "d0 2e b6 08 00 00 64 cc 0b 00 00 00 00 00 00 00 00 00 00 64"
)


def ranges(readings: list[RadioReading]) -> dict[object, float | None]:
    return {reading.emitter: reading.range_m for reading in readings}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (FOUR, {"022E": 3.44, "9280": 5.68, "DCAE": 7.76, "5431": 8.73}),
        (THREE, {"2F2F": 2.20, "2ED0": 2.23, "2BA2": 3.13}),
        (FOUR.partition(",POS")[0], {"022E": 3.44, "9280": 5.68, "DCAE": 7.76, "5431": 8.73}),
        (BRACKETS, {"022E": 3.38, "9280": 5.49, "DCAE": 7.73, "5431": 9.01}),
        (f"dwm> {FOUR}", {"022E": 3.44, "9280": 5.68, "DCAE": 7.76, "5431": 8.73}),
        ("DIST,0,POS,6.95,5.37,-1.97,52", {}),
        (OWN_POSITION, {}),
    ],
)
def test_a_line_tells_a_range_an_anchor_and_nothing_of_the_own_place(
    line: str, expected: dict[object, float]
) -> None:
    decoder = PansDecoder()
    assert ranges(decoder.feed(f"{line}\r\n".encode(), 0.0)) == expected
    assert decoder.counts.frames == 1
    assert not decoder.counts.refused


@pytest.mark.parametrize(
    "line",
    [
        TORN,
        "DIST,4,AN0,0090,...,AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00",
        FOUR.replace("DIST,4", "DIST,3"),
        FOUR.replace("DIST,4", "DIST,5"),
        FOUR[:-3],
        FOUR + ",1",
        FOUR.replace("3.44", "3.4.4"),
        BRACKETS.replace("]=7.73", "]="),
        BRACKETS[: BRACKETS.index("]=9.01") + 3],
        *(THREE[:end] for end in range(THREE.index(",POS") - 3, THREE.index(",POS"))),
    ],
)
def test_a_torn_line_is_refused_whole(line: str) -> None:
    decoder = PansDecoder()
    assert decoder.feed(f"{line}\n{THREE}\n".encode(), 0.0)[0].emitter == "2F2F"
    assert decoder.counts.refused == {"torn line": 1}


def test_what_else_a_shell_says_is_passed_over() -> None:
    decoder = PansDecoder()
    assert decoder.feed(b"\r\n DWM1001 TWR Real Time Location System\r\ndwm> ", 0.0) == []
    assert not decoder.counts.refused
    assert decoder.counts.frames == 0


def test_lines_are_switched_on_only_if_that_is_asked_for() -> None:
    assert PansDecoder().hello() == b""
    assert PansDecoder(PansOptions(send_lec=True)).hello() == b"\r\rlec\r"


def test_an_answer_tells_a_range_an_anchor_with_its_quality() -> None:
    assert PansTlvDecoder().feed(ANSWER, 0.0) == [
        RadioReading(emitter="2F2F", range_m=2.2, quality=1.0),
        RadioReading(emitter="2ED0", range_m=2.23, quality=1.0),
    ]


def test_an_answer_need_not_have_a_place_and_its_place_does_not_matter() -> None:
    bare = ANSWER[:3] + ANSWER[18:]
    moved = ANSWER[:5] + POSITION + ANSWER[18:]
    decoder = PansTlvDecoder()
    expected = {"2F2F": 2.2, "2ED0": 2.23}
    assert [ranges(decoder.feed(stream, 0.0)) for stream in (bare, moved)] == [expected, expected]


def test_an_anchor_tells_its_tags() -> None:
    tags = bytes.fromhex("48 0e 01 0102030405060708 4e0c0000 5f")
    (reading,) = PansTlvDecoder().feed(ANSWER[:18] + tags, 0.0)
    assert reading == RadioReading(emitter="0807060504030201", range_m=3.15, quality=0.95)


def test_an_error_is_reported_and_what_fits_no_answer_costs_a_byte() -> None:
    decoder = PansTlvDecoder()
    wrong = ANSWER[:20] + b"\x03" + ANSWER[21:]
    assert len(decoder.feed(b"\x40\x01\x04" + wrong + ANSWER, 0.0)) == 2
    assert decoder.counts.refused == {"answer: busy": 1}
    assert decoder.counts.frames == 2
    assert decoder.counts.resync_bytes == len(wrong)


def test_a_tag_is_asked_as_often_as_it_ranges_at_most() -> None:
    assert radio_kind("pans_tlv").poll == Poll("", 0.1, b"\x0c\x00")


def test_an_answer_that_has_not_changed_is_no_new_one() -> None:
    decoder = PansTlvDecoder()
    moved = ANSWER[:5] + POSITION + ANSWER[18:]
    counts = [len(decoder.feed(answer, 0.0)) for answer in (ANSWER, ANSWER, moved, moved, ANSWER)]
    assert counts == [2, 0, 2, 0, 2]
    assert decoder.counts.refused == {"seen before": 2}
