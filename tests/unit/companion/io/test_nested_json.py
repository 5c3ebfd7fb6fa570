"""Files of JSON that is nested deeper than it can be read: one line each, as any other damage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.flight_setup import open_flight
from companion.io.checkpoints import FILE as OFFSETS
from companion.io.checkpoints import kept_offsets
from companion.io.files import FLIGHT
from companion.io.radio_recording import read_radio_recording
from companion.replay.walk_replay import stated_accuracy
from companion.setup_tools.setup_commands import RECORD, remove_files

DEPTH = 100_000
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "flight": (FLIGHT, open_flight),
    "accuracy of a walk": ("walk.json", lambda folder: stated_accuracy(folder / "walk.csv")),
    "recording": ("radio.jsonl", lambda folder: read_radio_recording(folder / "radio.jsonl")),
    "offsets": (OFFSETS, kept_offsets),
    "setup": (RECORD, remove_files),
}


@pytest.mark.parametrize("content", ['{"a": ' * DEPTH, "[" * DEPTH, "\udcff{}"])
@pytest.mark.parametrize("name", READERS)
def test_a_file_that_is_nested_or_no_text_is_refused_in_one_line(
    tmp_path: Path, name: str, content: str
) -> None:
    file, read = READERS[name]
    (tmp_path / file).write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError) as refused:
        read(tmp_path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400
