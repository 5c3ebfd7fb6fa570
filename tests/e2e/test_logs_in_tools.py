"""The files of a flight, read by the usual tools for them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

from companion.io.log_files import read_tlog
from tests.loop.golden_flights import PLANS, fly


def test_mavlogdump_reads_every_frame_of_a_flight(tmp_path: Path) -> None:
    fly(PLANS["px4"], tmp_path)
    log = tmp_path / "0" / "flight.tlog"
    script = Path(sys.executable).with_name("mavlogdump.py")
    command = [sys.executable, "-W", "ignore", str(script), "--format", "json", str(log)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300.0)
    assert run.returncode == 0, run.stderr
    messages = [json.loads(line) for line in run.stdout.splitlines()]
    kinds = Counter(message["meta"]["type"] for message in messages)
    assert sum(kinds.values()) == len(list(read_tlog(log)))
    assert kinds["BAD_DATA"] == 0
    assert kinds["SET_POSITION_TARGET_LOCAL_NED"] > 50
    assert kinds["UNKNOWN_45010"] > 50, "RADIO_RANGING, of a dialect of its own"
    times = [message["meta"]["timestamp"] for message in messages]
    assert times == sorted(times)
    assert times[0] >= 1.8e9
    texts = [m["data"]["text"] for m in messages if m["meta"]["type"] == "STATUSTEXT"]
    assert any("searching" in text for text in texts)
