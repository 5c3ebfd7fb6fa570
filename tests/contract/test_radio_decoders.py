"""Requirements on the decoder of every built-in radio."""

from __future__ import annotations

import re

import pytest

from companion.radios.decoder import BUILT_IN, LineDecoder, RadioReading, radio_kind
from companion.testing.radio_contract import check_radio, golden_lines
from tests.contract.radio_streams import CHECKSUMMED, DISCERNS_REPEATS, OPTIONS, STREAMS


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_built_in_radio_holds_the_contract(name: str) -> None:
    check_radio(
        radio_kind(name),
        (STREAMS / f"{name}.bin").read_bytes(),
        STREAMS / f"{name}.jsonl",
        options=OPTIONS.get(name),
        has_checksum=name in CHECKSUMMED,
        repeats=name not in DISCERNS_REPEATS,
    )


STAMPS = {
    "minicom": "[2026-01-02 10:11:12.345] ",
    "tio": "[10:11:12.345] ",
    "ts": "Jan 02 10:11:12 ",
    "ts -s": "00:01:12 ",
    "ts %.s": "1767348672.123456 ",
    "Arduino": "10:11:12.345 -> ",
    "PlatformIO": "10:11:12.345 > ",
    "CoolTerm": "2026-01-02 10:11:12.345 ",
    "ISO 8601": "2026-01-02T10:11:12.345+0100 ",
    "kernel": "[  123.456789] ",
    "journal": "Jan 02 10:11:12 pi uwb[123]: ",
    "logcat": "01-02 10:11:12.345  1234  5678 I uwb    : ",
    "ESP-IDF": "I (51234) uwb: ",
    "ESP-IDF under a monitor": "10:11:12.345 -> I (51234) uwb: ",
    "Zephyr": "[00:01:12.345,678] <inf> uwb: ",
    "C string": "\0",
}
"""Text that terminals and loggers print before each line of a radio, by its program."""
OWN_CLOCK = {"esp32_ftm"}
"""Radios whose format has such a stamp: it is the device's time."""
LINES = [name for name in BUILT_IN if issubclass(radio_kind(name).decoder, LineDecoder)]


@pytest.mark.parametrize("program", STAMPS)
@pytest.mark.parametrize("name", [name for name in LINES if name not in OWN_CLOCK])
def test_a_stamp_before_each_line_changes_no_reading(name: str, program: str) -> None:
    stream = (STREAMS / f"{name}.bin").read_bytes()
    lines = re.split(rb"\r\n|\n|\r", stream)
    stamped = b"\n".join(STAMPS[program].encode() + line if line else line for line in lines)
    make = radio_kind(name).decoder
    plain = make(OPTIONS.get(name)).feed(stream, 0.0)
    decoder = make(OPTIONS.get(name))
    read = [each for byte in stamped for each in decoder.feed(bytes([byte]), 0.0)]
    assert golden_lines(read) == golden_lines(plain)


def test_a_plugin_reads_its_lines_as_they_were_sent() -> None:
    lines: list[str] = []

    class Plugin(LineDecoder):
        def read_line(self, line: str, received_s: float) -> list[RadioReading]:
            del received_s
            lines.append(line)
            return []

    Plugin().feed(b"10:11:12.345 RANGE 7\n", 0.0)
    assert lines == ["10:11:12.345 RANGE 7"]
