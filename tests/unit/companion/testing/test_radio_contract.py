"""The contract finds what is planted: each of these decoders breaks it in one way."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from companion.domain import Params
from companion.radios.decoder import LineDecoder, RadioDecoder, RadioKind, RadioReading
from companion.testing import radio_contract
from companion.testing.radio_contract import (
    ContractError,
    check_radio,
    golden_lines,
    kept_bytes,
    read_golden,
)

STREAM = b"1.5\n2.25\n"
READINGS = [RadioReading(range_m=1.5), RadioReading(range_m=2.25)]


class Metres(LineDecoder):
    """A number a line; what every other decoder here was before it was broken."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        try:
            range_m = float(line)
        except ValueError:
            self.counts.refuse("not a number")
            return []
        return [RadioReading(range_m=range_m)] if math.isfinite(range_m) else []


class Raises(Metres):
    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        return [RadioReading(range_m=float(line))]


class SaysNan(Metres):
    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        return super().read_line(line, received_s) or [RadioReading(range_m=math.nan)]


class CutsWhereTheStreamIsCut(RadioDecoder):
    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        decoder = Metres()
        readings = decoder.feed(data, received_s)
        self.counts.readings += len(readings)
        return readings


class KeepsAll(Metres):
    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self.log: list[bytes] = []

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        self.log.append(data)
        return super().feed(data, received_s)


class ForgetsNothing(Metres):
    def reset(self) -> None:
        """Goes on where it was."""


class CountsNothing(Metres):
    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        readings = super().feed(data, received_s)
        self.counts.readings = 0
        return readings


class ReasonsAreBytes(Metres):
    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        self.counts.refused[line] += 1
        return super().read_line(line, received_s)


def kind_of(decoder: type[RadioDecoder]) -> RadioKind:
    return RadioKind("metres", decoder, "Metres", "range", "anything", "serial:9600")


@pytest.mark.parametrize(
    ("decoder", "words"),
    [
        (Raises, "feed raised ValueError"),
        (SaysNan, "range_m is nan; what was not measured is None"),
        (CutsWhereTheStreamIsCut, "byte by byte: 0 readings, not 2"),
        (KeepsAll, "bytes are kept of any bytes"),
        (ForgetsNothing, "line lost at byte 1: reading 1 is"),
        (CountsNothing, "counts.readings is 0"),
        (ReasonsAreBytes, "refused by too many reasons"),
    ],
)
def test_a_broken_decoder_is_found(decoder: type[RadioDecoder], words: str) -> None:
    with pytest.raises(ContractError, match=words):
        check_radio(kind_of(decoder), STREAM, READINGS)


def test_a_value_that_a_checksum_should_have_stopped_is_found() -> None:
    with pytest.raises(ContractError, match="byte 0 flipped by 0x01: read"):
        check_radio(kind_of(Metres), STREAM, READINGS, has_checksum=True)


def test_a_slow_decoder_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radio_contract, "MAX_NOISE_S", 0.0)
    with pytest.raises(ContractError, match="bytes of any bytes take"):
        check_radio(kind_of(Metres), STREAM, READINGS)


def test_other_readings_than_the_golden_ones_are_named(tmp_path: Path) -> None:
    golden = tmp_path / "golden.jsonl"
    golden.write_text(golden_lines([READINGS[0], replace(READINGS[1], range_m=2.5)]))
    with pytest.raises(ContractError, match=r'reading 2 is {"range_m":2.25}, not {"range_m":2.5}'):
        check_radio(kind_of(Metres), STREAM, golden)


def test_a_name_that_cannot_be_chosen_is_found() -> None:
    with pytest.raises(ContractError, match="lower case"):
        check_radio(replace(kind_of(Metres), name="My Radio"), STREAM, READINGS)


def test_an_honest_decoder_passes_and_its_figures_are_reported() -> None:
    figures = check_radio(kind_of(Metres), STREAM, READINGS)
    assert figures.readings == 2
    assert 0.0 < figures.slowest_noise_s < 1.0
    assert 0 <= figures.most_kept_bytes < 10_000


def test_golden_lines_are_read_back_as_they_were(tmp_path: Path) -> None:
    golden = tmp_path / "golden.jsonl"
    golden.write_text(golden_lines(READINGS))
    assert read_golden(golden) == READINGS


def test_what_a_decoder_keeps_is_measured() -> None:
    decoder = Metres()
    empty = kept_bytes(decoder)
    decoder.feed(b"1" * 4000, 0.0)
    assert 3900 < kept_bytes(decoder) - empty < 4200
