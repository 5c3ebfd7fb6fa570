"""The study tool as people run it: the same bytes however it was carried out, or one clear line."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.dask_rig import LIMIT_S, ROOT, dask_cluster, started, until

pytestmark = pytest.mark.slow

TOOL = ROOT / "tools" / "run_study.py"
STUDY = """
table: small
title: Small
runs: 100
metrics: [final_rmse_m, steps_to_2.5m, worst_final_m, rmse_ratio]
systems: [ekf/reactive, asymmetric_huber/reactive, asymmetric_huber/latched]
sweeps:
  - parameter: p_nlos
    case: {steps: 20}
    varies: [channel.p_nlos]
    values: [0.1, 0.9]
    paper: {Proposed (Reactive): {final_rmse_m: [0.119, 0.501]}}
"""
BLOCKS = 2 * 3 * 2
"""Two cases with three systems of two blocks."""
BEGUN = 2
"""Blocks after which a run is stopped: most are left, however late that is noticed."""


def _command(study: Path | str, out: Path, *arguments: str) -> list[str]:
    return [sys.executable, str(TOOL), str(study), "--out", str(out), *arguments]


def _run(study: Path | str, out: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = _command(study, out, *arguments)
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S)


def _kept(out: Path) -> int:
    """Blocks that a run has kept so far."""
    return len([path for path in out.glob("blocks/*") if not path.name.startswith(".")])


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "small.yaml"
    path.write_text(STUDY)
    return path


@pytest.fixture(scope="module")
def expected(study: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The results of a run in one process."""
    out = tmp_path_factory.mktemp("alone") / "deep" / "out"
    done = _run(study, out, "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert _kept(out) == BLOCKS
    assert {"results.csv", "costs.csv", "report.html"} <= {path.name for path in out.iterdir()}
    return (out / "results.csv").read_bytes()


def test_rows_are_ours_beside_the_papers(expected: bytes) -> None:
    lines = expected.decode().splitlines()
    assert lines[0] == "table,parameter,value,system,metric,paper,ours,ours_ci95,bound"
    (row,) = [line for line in lines if "0.9,Proposed (Reactive),final_rmse_m" in line]
    cells = row.split(",")
    low, high = map(float, cells[7].split(".."))
    assert cells[5] == "0.501"
    assert low < float(cells[6]) < high
    assert 0.0 < float(cells[8]) < high


def test_processes_make_the_same_bytes(study: Path, expected: bytes, tmp_path: Path) -> None:
    done = _run(study, tmp_path, "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results.csv").read_bytes() == expected


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_run_goes_on(
    how: signal.Signals, study: Path, expected: bytes, tmp_path: Path
) -> None:
    with started(_command(study, tmp_path, "--jobs", "2")) as process:
        until(lambda: _kept(tmp_path) >= BEGUN, process)
        process.send_signal(how)
        _, errors = process.communicate(timeout=LIMIT_S)
    if how != signal.SIGKILL:
        assert process.returncode == 1
        assert errors.splitlines()[-1:] == [
            "run_study: stopped; what is done is kept, run the same command again to go on"
        ]
        assert "Traceback" not in errors
    kept = _kept(tmp_path)
    assert BEGUN <= kept < BLOCKS
    assert not (tmp_path / "results.csv").exists()
    done = _run(study, tmp_path, "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert f"{BLOCKS} blocks of runs, {kept} of them done before" in done.stderr
    assert (tmp_path / "results.csv").read_bytes() == expected


def test_a_cluster_makes_the_same_bytes_though_a_worker_is_killed(
    study: Path, expected: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 2) as cluster:
        one, other = cluster.workers
        with started(_command(study, out, "--backend", cluster.url)) as process:
            until(lambda: _kept(out) >= BEGUN, process)
            one.kill()
            assert _kept(out) < BLOCKS
            _, errors = process.communicate(timeout=LIMIT_S)
            assert process.returncode == 0, errors
            assert (one.wait(), other.poll()) == (-signal.SIGKILL, None)
    assert (out / "results.csv").read_bytes() == expected


@pytest.mark.parametrize(
    ("old", "new", "arguments", "what"),
    [
        ("ekf/reactive", "ekf/reactiv", [], "'reactiv' is none of passive, reactive"),
        ("varies:", "varries:", [], "$.sweeps[0].varries: unknown key"),
        ("p_nlos]", "p_los]", [], "did you mean `p_nlos`?"),
        ("runs: 100", "runs: 0", [], "$.runs: expected a whole number >= 1"),
        ("", "", ["--backend", "dask://127.0.0.1:9"], "no dask scheduler answers there"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    old: str, new: str, arguments: list[str], what: str, tmp_path: Path
) -> None:
    path, out = tmp_path / "study.yaml", tmp_path / "out"
    path.write_text(STUDY.replace(old, new, 1))
    done = _run(path, out, *arguments)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("run_study: ")
    assert what in line
    assert not out.exists()


def test_zero_runs_are_refused(study: Path, tmp_path: Path) -> None:
    done = _run(study, tmp_path / "out", "--runs", "0")
    assert done.returncode == 2
    assert "--runs: must be at least 1" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_refused(study: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = _run(study, tmp_path / "file" / "out")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "choose another --out" in line


FLIGHTS = """
table: short
title: Short flights
runs: 8
flights:
  cut_s: {phone_ftm: 20.0, uwb_two_axis: 20.0}
"""


def test_a_study_of_flights_goes_on_where_it_was_and_tells_what_it_has(tmp_path: Path) -> None:
    path, out = tmp_path / "short.yaml", tmp_path / "out"
    path.write_text(FLIGHTS)
    only = ["--only", "phone_ftm", "--only", "configured"]
    with started(_command(path, out, "--jobs", "2", *only)) as process:
        until(lambda: _kept(out) >= BEGUN, process)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1
    assert "Traceback" not in errors
    kept = _kept(out)
    assert BEGUN <= kept < 8
    rows = (out / "flights.csv").read_text().splitlines()
    assert len(rows) == 1 + kept
    done = _run(path, out, "--jobs", "1", *only)
    assert done.returncode == 0, done.stderr
    assert f"8 flights, {kept} of them done before" in done.stderr
    assert set(rows) < set((out / "flights.csv").read_text().splitlines())
    assert len(json.loads((out / "flights.json").read_text())) == 8
    assert "| latched_crossing, configured | 8 | 0 % |" in (out / "results.md").read_text()
    assert (out / "report.html").exists()


@pytest.mark.parametrize(
    ("text", "word", "what"),
    [
        (FLIGHTS, "phone", "--only phone: there is no such thing here; did you mean `phone_ftm`?"),
        (
            FLIGHTS.replace("phone_ftm", "phone"),
            "configured",
            "scenarios/field/phone.yaml: no such file",
        ),
        (STUDY, "configured", "--only: this study has no flights to choose from"),
    ],
)
def test_flights_that_there_are_not_are_refused(
    text: str, word: str, what: str, tmp_path: Path
) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(text)
    done = _run(path, tmp_path / "out", "--only", word)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert what in line
    assert not (tmp_path / "out").exists()
