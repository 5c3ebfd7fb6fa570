"""The command's arguments, lines and exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_link.lab.conformance.cli import main
from tests.e2e.simulator_process import running_simulator
from tests.ports import free_port


def test_list_tells_every_rule_with_its_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    text = capsys.readouterr().out
    assert "frames.unknown_incompat_bit_is_dropped  (ardupilot, px4; asks)" in text
    assert text.count("    source: ") > 150


def test_list_of_a_companion(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list", "--role", "companion", "--only", "setpoints."]) == 0
    assert "frames." not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([], "--url is missing"),
        (["--url", "nonsense"], "must begin with"),
        (["--url", "udpout:127.0.0.1:1", "--only", "nothing.*"], "no rule of a vehicle"),
        (["--url", "udpout:127.0.0.1:1", "--signing-key", "no_such_file"], "cannot be read"),
        (["--url", "udpout:127.0.0.1:1", "--json", "nowhere/x.json"], "there is no folder nowhere"),
        (["--fly"], "--fly: no such option ("),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert part in error
    assert error.count("\n") == 1


def test_a_silent_peer_is_exit_code_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim_link.lab.conformance.vehicle_probe.FIRST_HEARTBEAT_S", 0.2)
    assert main(["--url", f"udpin:127.0.0.1:{free_port()}"]) == 2
    assert "no autopilot heard" in capsys.readouterr().err


@pytest.mark.slow
def test_rules_are_tried_on_a_running_simulator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    with running_simulator("ardupilot", 1.0) as port:
        arguments = ["--url", f"udpin:127.0.0.1:{port}", "--only", "commands.[il]*"]
        assert main([*arguments, "--json", str(report)]) in (0, 3)
    lines = capsys.readouterr().out.splitlines()
    assert "PASS  commands.interval_of_an_unknown_message_is_refused  " in "\n".join(lines)
    assert "NOTED" in "\n".join(lines)
    assert lines[-1].endswith(" passed, 0 failed, 1 deviate as noted, 2 skipped")
    assert "needs --allow-changes" in "\n".join(lines)
    assert json.loads(report.read_text(encoding="utf-8"))["summary"] == lines[-1]
