"""An example of what each built-in radio sends, and what its decoder must be told for it."""

from __future__ import annotations

from pathlib import Path

from companion.domain import Params
from companion.radios.cellular import SrsRanOptions
from companion.radios.text_radios import LinesOptions

STREAMS = Path(__file__).parents[1] / "data" / "radios"
"""By name: a stream (.bin) of the vectors of the radio's unit test, and its readings (.jsonl)."""
OPTIONS: dict[str, Params] = {
    "lines": LinesOptions(pattern=r"ifft: (?P<range_m>[\d.]+)"),
    "srsran": SrsRanOptions(loop_is_off=True),
}
"""Of radios that are nothing without."""
CHECKSUMMED = {"nlink"}
TELLS_NEW_FROM_OLD = {"kraken", "kraken_xml", "pans_tlv"}
"""Polled: they say the same again until there is something new."""
