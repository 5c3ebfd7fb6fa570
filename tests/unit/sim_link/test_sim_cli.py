"""The command line: bad input, without opening a port that could be in use."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_link.cli import main


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield int(other.getsockname()[1])


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--speed", "0"], "--speed"),
        (["--speed", "-1"], "--speed"),
        (["--speed", "nan"], "--speed"),
        (["--speed", "inf"], "--speed"),
        (["--speed", "fast"], "--speed"),
        (["--seed", "-1"], "--seed"),
        (["--seed", "1.5"], "--seed"),
        (["--listen", "14580"], "--listen"),
        (["--listen", "127.0.0.1:99999"], "--listen"),
        (["--send-to", "nowhere"], "--send-to"),
        (["--scenario", "no/such/file.yaml"], "no/such/file.yaml"),
        (["--report", "no/such/folder/report.json"], "no/such/folder"),
        (["--report", ""], "--report"),
        (["--nonsense"], "--nonsense"),
        (["misson", "run", "a.yaml"], "misson is none of mission, radio, proxy; did you mean m"),
        (["--autopilot", "betaflight"], "--autopilot"),
        (["--ready-after", "-1"], "--ready-after"),
        (["--ready-after", "nan"], "--ready-after"),
        (["--vehicles", "0"], "--vehicles"),
        (["--vehicles", "251"], "--vehicles"),
        (["--link", "carrier-pigeon"], "carrier-pigeon"),
        (["--vehicles", "2", "--link", "pty:/tmp/one"], "one vehicle only"),
        (["--parameters", "no/such/folder/p.parm"], "no/such/folder"),
        (["--signing-key", "no/such/key"], "no/such/key"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], arguments: list[str], word: str
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert word in captured.err


def test_a_bad_scenario_names_its_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("channel:\n  p_nlos: often\n", encoding="utf-8")
    assert main(["--scenario", str(path)]) == 2
    error = capsys.readouterr().err
    assert "$.channel.p_nlos" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"NO_SUCH_NAME 1\n", "line 1: there is no parameter"),
        (b"# fine\nCOM_OF_LOSS_T soon\n", "line 2: COM_OF_LOSS_T must be a number"),
        (b"COM_OBL_RC_ACT 1.5\n", "line 1: COM_OBL_RC_ACT"),
        (b"\xff\xfe\x00", "not a text of parameters"),
    ],
)
def test_a_bad_parameter_file_names_the_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: bytes, words: str
) -> None:
    path = tmp_path / "p.parm"
    path.write_bytes(text)
    assert main(["--parameters", str(path)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert words in error
    assert error.count("\n") == 1


def test_a_bad_fence_names_its_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("fence: {corners_enu_m: [[0, 0], [9, 9], [9, 0], [0, 9]]}\n", encoding="utf-8")
    assert main(["--scenario", str(path)]) == 2
    error = capsys.readouterr().err
    assert "$.fence: a fence has two edges that touch or cross each other" in error
    assert error.count("\n") == 1


def test_a_parameter_that_the_autopilot_lacks_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("autopilot: {parameters: {RTL_ALT: 2000}}\n", encoding="utf-8")
    assert main(["--scenario", str(path)]) == 2
    assert "parameter RTL_ALT: there is no such parameter" in capsys.readouterr().err


def test_a_taken_port_is_said_in_one_line(
    taken_port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--listen", f"127.0.0.1:{taken_port}"]) == 2
    error = capsys.readouterr().err
    assert str(taken_port) in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("option", "word"), [("--help", "example:"), ("--version", "0.")])
def test_help_and_version(option: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([option])
    assert caught.value.code == 0
    assert word in capsys.readouterr().out


def test_a_termination_is_an_interrupt() -> None:
    """A mission's vehicle is landed, and its results are written, as after Ctrl-C."""
    program = (
        "import os, signal, sys; from sim_link import cli\n"
        "cli.run_subcommand = lambda _: os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.exit(cli.main())"
    )
    command = [sys.executable, "-c", program, "mission"]
    done = subprocess.run(command, capture_output=True, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (1, b"sim-link: interrupted\n")


def test_a_full_disk_under_the_output_is_one_line_and_a_failed_run() -> None:
    command = [sys.executable, "-m", "sim_link", "--version"]
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, timeout=60.0, check=False
        )
    assert done.returncode == 1
    assert done.stderr == b"sim-link: standard output: No space left on device\n"
