"""Requirements on the decoder of every built-in radio."""

from __future__ import annotations

import pytest

from companion.radios.decoder import BUILT_IN, radio_kind
from companion.testing.radio_contract import check_radio
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
