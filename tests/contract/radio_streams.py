"""An example of each built-in radio's bytes, and the settings that its decoder needs for it.

`python -m tests.contract.radio_streams NAME` writes the readings of NAME's stream next to it: read
them, as they are what the contract asks for from then on.
"""

from __future__ import annotations

import sys
from pathlib import Path

from companion.domain import Params
from companion.radios.cellular import NrOptions, SrsRanOptions
from companion.radios.decoder import radio_kind
from companion.radios.text_radios import LinesOptions
from companion.testing.radio_contract import golden_lines

STREAMS = Path(__file__).parents[1] / "data" / "radios"
"""By name: a stream (.bin) of the vectors of the radio's unit test, and its readings (.jsonl)."""
OPTIONS: dict[str, Params] = {
    "lines": LinesOptions(pattern=r"ifft: (?P<range_m>[\d.]+)"),
    "oai": NrOptions(numerology=1),
    "srsran": SrsRanOptions(loop_is_off=True, numerology=1),
}
"""Options of the radios that need some."""
CHECKSUMMED = {"nlink"}
DISCERNS_REPEATS = {"kraken", "kraken_xml", "kraken_ws", "pans_tlv"}
"""Polled radios, which repeat a measurement until there is a new one."""


if __name__ == "__main__":
    name = sys.argv[1]
    decoder = radio_kind(name).decoder(OPTIONS.get(name))
    readings = decoder.feed((STREAMS / f"{name}.bin").read_bytes(), 0.0)
    (STREAMS / f"{name}.jsonl").write_text(golden_lines(readings))
