"""What every built-in radio's decoder must hold; its stream and readings are in tests/data/radios.

A stream is of the vectors of its unit test. `golden_lines` writes the readings.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.domain import Params
from companion.radios.catalogue import radio_kind
from companion.radios.cellular import SrsRanOptions
from companion.radios.text_radios import LinesOptions
from companion.testing.radio_contract import check_radio

STREAMS = Path(__file__).parents[1] / "data" / "radios"
OPTIONS: dict[str, Params] = {
    "lines": LinesOptions(pattern=r"ifft: (?P<range_m>[\d.]+)"),
    "srsran": SrsRanOptions(loop_is_off=True),
}
"""Of radios that are nothing without."""
CHECKSUMMED = {"nlink"}


@pytest.mark.parametrize("name", sorted(path.stem for path in STREAMS.glob("*.bin")))
def test_a_built_in_radio_holds_the_contract(name: str) -> None:
    check_radio(
        radio_kind(name),
        (STREAMS / f"{name}.bin").read_bytes(),
        STREAMS / f"{name}.jsonl",
        options=OPTIONS.get(name),
        has_checksum=name in CHECKSUMMED,
    )
