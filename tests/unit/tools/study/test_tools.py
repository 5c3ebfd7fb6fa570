from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[4] / "tools"


def _main(tool: str) -> Callable[[], int]:
    """The tool's `main`, without a process of its own."""
    name = tool.removesuffix(".py")
    spec = importlib.util.spec_from_file_location(name, TOOLS / tool)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look for it
    spec.loader.exec_module(module)
    main: Callable[[], int] = module.main
    return main


def _run(tool: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TOOLS / tool), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("verify_estimation.py", []),
    ],
)
def test_a_file_that_cannot_be_written_is_one_line(
    tool: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = str(tmp_path / "nowhere" / "figures.json")
    monkeypatch.setattr(sys, "argv", [tool, *arguments, "--json", path])
    assert _main(tool)() == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert "nowhere" in said.err


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("bench.py", ["filters", "--rounds", "0"]),
        ("bench.py", ["tick", "--seconds", "0"]),
        ("bench.py", ["filter"]),
        ("bench.py", []),
        ("verify_estimation.py", ["--runs", "0"]),
        ("verify_estimation.py", ["--seed", "-1"]),
        ("verify_estimation.py", ["--only", "planners"]),
    ],
)
def test_bad_input_is_refused_in_one_line(
    tool: str,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [tool, *arguments])
    with pytest.raises(SystemExit) as end:
        _main(tool)()
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert said.startswith(tool.removesuffix(".py"))


@pytest.mark.slow
def test_figures_are_printed() -> None:
    done = _run("bench.py", "filters", "--rounds", "1")
    assert done.returncode == 0
    assert "filterpy update" in done.stdout


@pytest.mark.parametrize(
    ("study", "words"),
    [
        ("area", "stopped; run the same command again"),
        ("step_size", "stopped; what is done is kept, run the same command again to go on"),
    ],
)
def test_only_what_can_go_on_is_said_to_be_kept(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    study: str,
    words: str,
) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    main = _main("run_study.py")
    module = sys.modules["run_study"]
    monkeypatch.setattr(module, "run", interrupted)
    monkeypatch.setattr(module, "run_simulated", interrupted)
    monkeypatch.setattr(module, "obey_termination", lambda: None)
    monkeypatch.setattr(sys, "argv", ["run_study.py", study, "--out", str(tmp_path)])
    assert main() == 1
    assert capsys.readouterr().err == f"run_study: {words}\n"
