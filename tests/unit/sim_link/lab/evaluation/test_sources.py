from __future__ import annotations

import subprocess
import sys

from sim_link.lab.evaluation.backends import ROOT, sources, sources_digest

ALL_THAT_RUNS = """
import sys
import sim_link.lab.evaluation.campaign
import sim_link.lab.evaluation.filterpy_ekf
import sim_link.lab.evaluation.filterpy_ekf
for name, module in sys.modules.items():
    if name.partition(".")[0] in ("companion", "sim_link") and module.__file__:
        print(module.__file__)
"""
ONLY_CARRIES = {"sim_link/lab/evaluation/backends.py"}
"""Runs blocks, but has no part in what they come to."""


def test_whatever_a_run_imports_is_in_the_digest() -> None:
    command = [sys.executable, "-c", ALL_THAT_RUNS]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    imported = {line.removeprefix(f"{ROOT}/") for line in done.stdout.splitlines()}
    known = {path.relative_to(ROOT).as_posix() for path in sources()}
    missing = {name for name in imported - known if not name.endswith("__init__.py")}
    assert missing == ONLY_CARRIES


def test_what_reports_a_run_is_not() -> None:
    names = {path.relative_to(ROOT).as_posix() for path in sources()}
    assert "sim_link/lab/evaluation/study.py" not in names
    assert not any("reporting" in name for name in names)


def test_the_digest_stays() -> None:
    assert sources_digest() == sources_digest()
    assert len(sources_digest()) == 16
