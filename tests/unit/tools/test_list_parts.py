"""The audit of a release's parts fails whenever it did not look everything up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.release.list_parts import audit

CLEAN = {"name": "numpy", "version": "2.4.6", "vulns": []}
OURS = {"name": "companion-guidance", "skip_reason": "not on the index"}
UNKNOWN = {"name": "rich", "skip_reason": "not on the index"}
WEAK = {"name": "lxml", "version": "6.1.3", "vulns": [{"id": "CVE-1"}]}


def auditor(folder: Path, said: str) -> Path:
    """A program that says so, whatever it is asked."""
    program = folder / "pip-audit"
    program.write_text(f"#!/bin/sh\ncat <<'end'\n{said}end\necho 'no such host' >&2\nexit 1\n")
    program.chmod(0o755)
    return program


@pytest.mark.parametrize(
    ("parts", "code", "line"),
    [
        ([CLEAN, OURS], 0, "1 parts looked up, 0 with known weaknesses"),
        ([CLEAN, UNKNOWN], 1, "not looked up, unknown to the package index: rich"),
        ([CLEAN, WEAK], 1, "lxml 6.1.3: CVE-1"),
    ],
)
def test_what_is_weak_or_unknown_fails(
    parts: list[object],
    code: int,
    line: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = auditor(tmp_path, json.dumps({"dependencies": parts}) + "\n")
    assert audit(program, tmp_path) == code
    assert line in capsys.readouterr().out.splitlines()


def test_a_service_that_cannot_be_reached_fails_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert audit(auditor(tmp_path, ""), tmp_path, ["--vulnerability-service", "osv"]) == 1
    assert capsys.readouterr().out.splitlines() == ["not looked up: no such host"]
