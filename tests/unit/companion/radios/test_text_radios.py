from __future__ import annotations

import math

import pytest

from companion.errors import ConfigError
from companion.radios.decoder import AngleFrame, RadioReading, radio_kind
from companion.radios.text_radios import (
    LinesDecoder,
    LinesOptions,
    MakerfabsAtDecoder,
    SlotOptions,
    Sx1280Decoder,
    Sx1280Options,
    TrekDecoder,
    UudfDecoder,
)

MAKERFABS = (
    "AT+RANGE=tid:1,mask:04,seq:63,range:(0,0,30,0,0,0,0,0),"
    "rssi:(0.00,0.00,-77.93,0.00,0.00,0.00,0.00,0.00)",
    "AT+RANGE=tid:7,mask:0F,seq:128,range:(997,1321,911,738,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)",
    "AT+RANGE=tid:0,mask:80,seq:197,range:(0,0,0,0,0,0,0,0),"
    "rssi:(0.00,0.00,0.00,0.00,0.00,0.00,0.00,0.00)",
)
UUDF = (
    '+UUDF:CCF9578E0D8A,-42,20,0,-43,37,"CCF9578E0D89","",15869,23',
    '+UUDF:CCF9578E0D8A,-42,-10,2,-43,39,"CCF9578E0D89","",15921,25',
    '+UUDF:6C1DEBA41845,-56,-11,20,0,39,"6C1DEBA79D14","",746675',
)
SX12XX = (
    "TransmitRanging,Calibration,11220,IRQ,200,Valid,RAW,47,Distance,3.2m,Time,33mS,OKCount,88,"
    "ErrorCount,0"
)


def read(
    decoder: MakerfabsAtDecoder | UudfDecoder | Sx1280Decoder | LinesDecoder, *lines: str
) -> list[RadioReading]:
    return decoder.feed("".join(f"{line}\r\n" for line in lines).encode(), 0.0)


def test_a_makerfabs_report_is_a_range_of_each_anchor_that_answered() -> None:
    decoder = MakerfabsAtDecoder()
    ranges = [(reading.emitter, reading.range_m) for reading in read(decoder, *MAKERFABS)]

    assert ranges == [(2, 0.30), (0, 9.97), (1, 13.21), (2, 9.11), (3, 7.38)]
    assert decoder.counts.refused == {"no slot answered": 1}


def test_some_firmware_puts_blanks_after_commas() -> None:
    spaced = MAKERFABS[1].replace(",", ", ")

    assert read(MakerfabsAtDecoder(), spaced) == read(MakerfabsAtDecoder(), MAKERFABS[1])


def test_a_hidden_tag_is_named_by_its_own_number_and_ranged_by_our_anchor() -> None:
    (reading,) = read(MakerfabsAtDecoder(SlotOptions(hidden="tag", slot=1)), MAKERFABS[1])

    assert (reading.emitter, reading.range_m) == (7, 13.21)


def test_a_slot_that_did_not_answer_keeps_its_old_range_to_itself() -> None:
    (reading,) = read(MakerfabsAtDecoder(), MAKERFABS[1].replace("mask:0F", "mask:02"))

    assert reading.emitter == 1


@pytest.mark.parametrize(
    "torn",
    [
        MAKERFABS[1][:60],
        MAKERFABS[1].replace("738,0,", "738,"),
        MAKERFABS[1].replace("997", "9x7"),
        MAKERFABS[1].replace("-1,-1)", "-1)"),
    ],
)
def test_a_torn_makerfabs_report_is_refused(torn: str) -> None:
    decoder = MakerfabsAtDecoder()

    assert read(decoder, torn) == []
    assert decoder.counts.refused == {"torn report": 1}


def test_makerfabs_reports_are_turned_on() -> None:
    assert MakerfabsAtDecoder().hello() == b"AT+SETRPT=1\r\n"


@pytest.mark.parametrize(
    ("line", "tag", "azimuth_deg", "elevation_deg", "time_s"),
    [
        (UUDF[0], "CCF9578E0D8A", 20, 0, 15.869),
        (UUDF[1], "CCF9578E0D8A", -10, 2, 15.921),
        (UUDF[2], "6C1DEBA41845", -11, 20, 746.675),
    ],
)
def test_an_event_of_u_blox_is_two_angles_and_the_board_s_time(
    line: str, tag: str, azimuth_deg: float, elevation_deg: float, time_s: float
) -> None:
    (reading,) = read(UudfDecoder(), line)

    assert reading.emitter == tag
    assert reading.azimuth_rad == pytest.approx(math.radians(azimuth_deg))
    assert reading.elevation_rad == pytest.approx(math.radians(elevation_deg))
    assert reading.device_time_s == pytest.approx(time_s)
    assert reading.range_m is None


def test_the_user_s_text_may_hold_commas_and_quotes() -> None:
    text = UUDF[0].replace('"",', '"roof, ""north"", 3",')

    assert read(UudfDecoder(), text) == read(UudfDecoder(), UUDF[0])


def test_other_events_are_passed_over_and_a_restart_does_not_stop_it() -> None:
    decoder = UudfDecoder()
    readings = read(decoder, "+UUDFP:CCF9578E0D8A,-42,20,0", UUDF[2], "+STARTUP", UUDF[0])

    assert [reading.device_time_s for reading in readings] == [746.675, 15.869]
    assert not decoder.counts.refused


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (UUDF[0][:40], "torn event"),
        (UUDF[0].replace("-42,20", "-42,2O"), "torn event"),
        (UUDF[0].replace("-42,20", "-42,200"), "angle is out of bounds"),
        (UUDF[0].replace("CCF9578E0D8A", "CCF957"), "torn event"),
    ],
)
def test_events_that_cannot_be_used_are_counted(line: str, reason: str) -> None:
    decoder = UudfDecoder()

    assert read(decoder, line) == []
    assert decoder.counts.refused == {reason: 1}


@pytest.mark.parametrize(
    ("line", "range_m"),
    [
        ("[SX1280] Distance:\t\t\t12.34 meters (raw)", 12.34),
        ("Valid,Register,47,Distance,3.2,RSSIReg,4E,RSSI,-39dBm", 3.2),
        (SX12XX, 3.2),
    ],
    ids=["RadioLib", "master", "calibration"],
)
def test_both_libraries_lines_are_read(line: str, range_m: float) -> None:
    (reading,) = read(Sx1280Decoder(), line)

    assert reading.range_m == range_m
    assert reading.emitter is None


@pytest.mark.parametrize(
    ("raw", "range_m"),
    [("47", 3.200), ("1F", 1.397), ("19", 1.127), ("FFFFFF", -0.0451), ("FFFFB9", -3.200)],
)
def test_with_the_bandwidth_the_register_is_read_and_may_be_negative(
    raw: str, range_m: float
) -> None:
    decoder = Sx1280Decoder(Sx1280Options(bandwidth_khz=812.5))
    (reading,) = read(decoder, SX12XX.replace("RAW,47", f"RAW,{raw}"))

    assert reading.range_m == pytest.approx(range_m, abs=5e-4)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("NotValid,Irq,8000", "not valid"),
        ("[SX1280] Ranging ... timed out!", "timed out"),
        ("[SX1280] Ranging ... failed, code -7", "failed"),
        (SX12XX.replace("RAW,47", "RAW,FFFFB9"), "below zero: set bandwidth_khz"),
        (SX12XX.replace("RAW,47", "RAW,4G"), "torn line"),
        (SX12XX[: SX12XX.index(".2m")], "torn line"),
    ],
)
def test_ranging_that_failed_is_counted_by_reason(line: str, reason: str) -> None:
    decoder = Sx1280Decoder()

    assert read(decoder, line) == []
    assert decoder.counts.refused == {reason: 1}


def test_a_bandwidth_that_the_chip_has_not_is_refused() -> None:
    with pytest.raises(ConfigError, match="bandwidth_khz"):
        Sx1280Decoder(Sx1280Options(bandwidth_khz=800.0))


CHANNEL_SOUNDING = r"ifft: (?P<range_m>[\d.]+)"


@pytest.mark.parametrize(
    ("line", "range_m"),
    [
        (
            "I: Distance estimates on antenna path 0: ifft: 1.039173, phase_slope: 1.581897, "
            "rtt: 3.075647",
            1.039173,
        ),
        (
            "I: Latest distance estimates on antenna path 0: ifft: 0.50, phase_slope: 0.60, "
            "rtt: 1.20 meters",
            0.50,
        ),
    ],
)
def test_an_expression_reads_a_line_that_no_decoder_knows(line: str, range_m: float) -> None:
    decoder = LinesDecoder(LinesOptions(pattern=CHANNEL_SOUNDING))

    (reading,) = read(decoder, "*** Booting Zephyr OS ***", line, line.replace("ifft: ", "ifft: n"))
    assert reading == RadioReading(range_m=range_m)


def test_the_groups_of_an_expression_say_quantity_and_unit() -> None:
    pattern = (
        r"#(?P<emitter>\w+) t=(?P<time_ms>\d+)(?: d=(?P<range_cm>-?\d+))?"
        r" a=(?P<azimuth_deg>-?\d+)\+-(?P<azimuth_sigma_deg>\d+) (?P<line_of_sight>N?LOS)"
    )
    decoder = LinesDecoder(LinesOptions(pattern=pattern, frame="nose"))
    with_range, without = read(decoder, "#a1 t=1500 d=-50 a=90+-5 LOS", "#a1 t=1600 a=-90+-5 NLOS")

    assert with_range == RadioReading(
        emitter="a1",
        device_time_s=1.5,
        range_m=-0.5,
        azimuth_rad=math.radians(90),
        azimuth_sigma_rad=math.radians(5),
        frame=AngleFrame.NOSE,
        line_of_sight=True,
    )
    assert without.range_m is None
    assert without.line_of_sight is False


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("", "pattern: an expression, such as"),
        (r"(?P<range_m>[\d.]+", "pattern: missing \\), unterminated subpattern"),
        (r"(?P<distance>[\d.]+)", "`distance` is not a quantity with a unit"),
        (r"(?P<emitter>\w+)", "neither a range, an angle nor a power"),
    ],
)
def test_a_bad_expression_is_a_configuration_error(pattern: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        LinesDecoder(LinesOptions(pattern=pattern))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("r=inf", "range_m is not a number"),
        ("r=1_0", "range_m is not a number"),
        ("r=1.0e999", "range_m is not a number"),
        ("r=٣", "range_m is not a number"),
        ("r=4 a=361", "angle is beyond a full turn"),
        ("r=4 q=1.5", "quality is out of bounds"),
        ("r=4 s=-1", "sigma is negative"),
        ("r= q=1", "neither range, angle nor power"),
    ],
)
def test_values_that_cannot_be_are_counted_by_reason(text: str, reason: str) -> None:
    pattern = (
        r"r=(?P<range_m>\S*)(?: a=(?P<azimuth_deg>\S+))?(?: q=(?P<quality>\S+))?"
        r"(?: s=(?P<range_sigma_m>\S+))?"
    )
    decoder = LinesDecoder(LinesOptions(pattern=pattern))

    assert read(decoder, text) == []
    assert decoder.counts.refused == {reason: 1}


def test_what_is_sent_once_the_line_is_open_is_configured() -> None:
    options = LinesOptions(pattern=CHANNEL_SOUNDING, hello="start")

    assert LinesDecoder(options).hello() == b"start\r\n"
    assert LinesDecoder(LinesOptions(pattern=CHANNEL_SOUNDING)).hello() == b""


def test_blanks_behind_the_names_of_a_report_are_of_no_meaning() -> None:
    (line,) = MAKERFABS[:1]
    spaced = line.replace(":", ": ").replace(",", ", ")
    assert read(MakerfabsAtDecoder(), spaced) == read(MakerfabsAtDecoder(), line) != []


NONE = "ffffffff"


@pytest.mark.parametrize(
    ("line", "ranges_m"),
    [
        (f"mc 05 00000401 {NONE} 00000c02 {NONE} 0a1b 2c 00031f04 a0:0", {0: 1.025, 2: 3.074}),
        ("mc 03 00000401 00000802 00000000 00000000 0a1b 2c 0 t1:0", {0: 1.025, 1: 2.05}),
        (
            f"mc 81 00000401 {NONE} {NONE} {NONE} {NONE} {NONE} {NONE} 00000c02"
            " 0a1b 2c 00031f04 a0:0 22be",
            {0: 1.025, 7: 3.074},
        ),
        (
            f"mc 01 00000401 {NONE} {NONE} {NONE}  {NONE} {NONE} {NONE} 0a1b 2c 00031f04 a0:0 22be",
            {0: 1.025},
        ),
    ],
    ids=["four", "short time", "eight", "seven"],
)
def test_a_trek_report_has_four_to_eight_slots(line: str, ranges_m: dict[int, float]) -> None:
    readings = TrekDecoder().feed(f"{line}\r\n".encode(), 0.0)
    assert {each.emitter: each.range_m for each in readings} == ranges_m


LOCATOR, TAG_A, TAG_B = "silabs/aoa/angle/ble-pd-0C4314F46B2D", "0C4314F46CEB", "84FD27EEE588"


def silabs(printed: str) -> tuple[list[object], list[str]]:
    decoder = radio_kind("silabs_aoa").decoder()
    readings = decoder.feed(printed.encode(), 0.0)
    return [reading.emitter for reading in readings], [*decoder.counts.refused]


def angle(number: int = 1) -> str:
    return f'{{\n\t"azimuth":\t-10.2,\n\t"elevation":\t1.2,\n\t"sequence":\t{number}\n}}\n'


def test_a_topic_names_the_tag_of_the_object_behind_it_or_on_the_next_line() -> None:
    for end in (" ", "\n", " \n", "\r\n"):
        named = [f"{LOCATOR}/ble-pd-{tag}{end}{angle()}" for tag in (TAG_A, TAG_B)]
        assert silabs("".join(named)) == ([TAG_A, TAG_B], [])
    subscriber = f"Received {angle()!r} on topic '{LOCATOR}/ble-pd-{TAG_A}'\n".replace("\\n", "")
    assert silabs(subscriber.replace("\\t", "")) == ([TAG_A], [])
    assert silabs(angle()) == ([None], [])


def test_an_object_whose_topic_was_lost_is_of_no_tag() -> None:
    topic = f"{LOCATOR}/ble-pd-{TAG_A}\n"

    assert silabs(topic + angle() + angle(2)) == ([TAG_A], ["object without its topic"])
    torn = f"{LOCATOR}/ble-pd-{TAG_B}\n" + angle()[:15] + topic + angle()
    assert silabs(torn) == ([TAG_A], [])
    assert silabs(topic + f"{LOCATOR}/ble-pd-84FD\n" + angle())[0] == []
    for end in (" ", "\n"):  # the locator is no tag
        assert silabs(topic + angle() + LOCATOR + end + angle())[0] == [TAG_A]


def test_angles_of_another_program_are_not_taken_for_degrees() -> None:
    emitters, reasons = silabs('{"distance":1.23,"azimuth":0.1,"elevation":0.2}\n')

    assert emitters == []
    assert "sequence" in " ".join(reasons)
