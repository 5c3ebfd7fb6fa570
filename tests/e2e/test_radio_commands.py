"""The companion's commands that read a radio, as processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def companion_run(
    options: list[str], folder: Path, typed: str = ""
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "companion", *options]
    return subprocess.run(
        command,
        input=typed,
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=120,
        check=False,
    )


def test_what_a_program_prints_is_piped_into_the_companion(tmp_path: Path) -> None:
    line = json.dumps({"emitter_id": "tag", "range": 12.5})
    for name in ("watch", "record"):
        arguments = {"watch": ["ndjson@stdin:"], "record": ["r.jsonl", "--radio", "ndjson@stdin:"]}
        options = ["radio", name, *arguments[name], "--seconds", "3"]
        ended = companion_run(options, tmp_path, f"{line}\n" * 3)
        assert ended.returncode == 0, ended.stderr
        assert "12.50 m" in ended.stdout or name == "record"
    assert (tmp_path / "r.jsonl").read_text().count('"kind":"bytes"') >= 1


def test_a_broken_radio_is_named_and_the_exit_code_is_2(tmp_path: Path) -> None:
    ended = companion_run(["--connect", "udp:127.0.0.1:0", "--radio", "nothing@x"], tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.startswith("companion: ")
