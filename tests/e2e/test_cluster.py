"""Missions and fault campaigns on a cluster come to what one process comes to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.dask_rig import LIMIT_S, ROOT, DaskCluster, dask_cluster

PLAIN = {"NUMBA_DISABLE_JIT": "1"}
"""As tools/faults.py flies; workers that compile would be refused."""
SCRIPT = """
name: short
steps:
  - connect
  - wait_ready
  - arm
"""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path_factory.mktemp("dask"), 2, **PLAIN) as found:
        yield found


def _run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, command)],
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
        cwd=ROOT,
        env={**os.environ, **PLAIN},
    )


@pytest.mark.slow
def test_missions_on_a_cluster_make_the_same_bytes(cluster: DaskCluster, tmp_path: Path) -> None:
    mission = tmp_path / "short.yaml"
    mission.write_text(SCRIPT)
    logs = []
    for name, where in {"here": [], "there": ["--backend", cluster.url]}.items():
        reports = tmp_path / name
        done = _run(
            "-m", "sim_link", "mission", "run", mission, "--repeat", 3, "--report", reports, *where
        )
        assert done.returncode == 0, done.stdout + done.stderr
        logs.append(
            {
                path.name: path.read_bytes()
                for path in reports.iterdir()
                if path.suffix in (".jsonl", ".tlog")
            }
        )
    assert len(logs[0]) == 6
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_a_fault_campaign_on_a_cluster_finds_the_same(cluster: DaskCluster, tmp_path: Path) -> None:
    figures = []
    parts = ["--campaign", "sample", "--only", "reaction"]
    for name, where in {"here": ["--jobs", "2"], "there": ["--backend", cluster.url]}.items():
        path = tmp_path / f"{name}.json"
        done = _run("tools/faults.py", *parts, "--json", path, *where)
        assert done.returncode == 0, done.stdout + done.stderr
        figures.append(json.loads(path.read_text()) | {"wall_s": 0.0})
    assert figures[0]["is_complete"]
    assert figures[0]["trials"] == 6
    assert figures[0] == figures[1]


@pytest.mark.slow
@pytest.mark.parametrize("speed", [["--speed", "4"], ["--connect", "udpin:127.0.0.1:14550"]])
def test_a_cluster_flies_in_lockstep_only(
    cluster: DaskCluster, tmp_path: Path, speed: list[str]
) -> None:
    mission = tmp_path / "short.yaml"
    mission.write_text(SCRIPT)
    done = _run("-m", "sim_link", "mission", "run", mission, "--backend", cluster.url, *speed)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.endswith("a cluster flies in lockstep only\n")
