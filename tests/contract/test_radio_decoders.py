"""What every built-in radio's decoder must hold; its stream and readings are in tests/data/radios.

A stream is of the vectors of its unit test. `golden_lines` writes the readings.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.domain import Params
from companion.radios.catalogue import radio_kind
from companion.testing.radio_contract import check_radio

STREAMS = Path(__file__).parents[1] / "data" / "radios"
OPTIONS: dict[str, Params] = {}
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
