"""`companion setup`: by flags or by answers; all of it or nothing; undone without a trace."""

from __future__ import annotations

import argparse
import getpass
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from companion.arguments import argument_parser
from companion.cli import main
from companion.config.schema import load_config
from companion.errors import EXIT_BAD_INPUT, EXIT_FAILED, LinkError
from companion.setup_tools.setup_commands import run

ROOT = Path(__file__).resolve().parents[4]
SERIAL = "serial:/dev/ttyAMA0:921600"
OFFLINE = ("--no-doctor", "--no-warm-up")
FENCE = (
    '{"fileType": "Plan", "geoFence": {"version": 2, "circles": [], "polygons": [{"version": 1, '
    '"inclusion": true, "polygon": [[47, 8], [47.01, 8], [47.01, 8.01], [47, 8.01]]}]}}'
)


def setup(directory: Path, *more: str) -> int:
    return main(["setup", "--directory", str(directory), *OFFLINE, *more])


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_by_flags_it_writes_what_a_flight_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, etc = tmp_path / "Site.plan", tmp_path / "etc"
    plan.write_text(FENCE)
    radio = ("--radio", "esp32_ftm:emitter=7@/dev/ttyUSB0")
    assert setup(etc, "--connect", SERIAL, *radio, "--fence", str(plan)) == 0
    plan.unlink()
    config = load_config(etc / "companion.yaml")
    assert config.radios[0].url == "/dev/ttyUSB0"
    assert config.radios[0].settings["emitter"] == 7
    assert config.estimation == load_config(ROOT / "configs/radios/esp32_ftm.yaml").estimation
    assert config.limits.fence_file == str(etc / "fence.plan")
    assert (etc / "service.env").read_text() == f"COMPANION_OPTIONS=--connect {SERIAL}\n"
    output = capsys.readouterr().out
    assert "COM_OBL_RC_ACT" in output
    assert f"companion --connect {SERIAL} --config {etc / 'companion.yaml'}" in output


def test_on_a_terminal_it_asks_for_what_no_flag_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = iter(["arducopter", "ardupilot", "tcp:127.0.0.1:5762", "", "", ""])
    asked: list[str] = []

    def ask(question: str) -> str:
        asked.append(question)
        return next(answers)

    arguments = argument_parser().parse_args(["setup", "--directory", str(tmp_path), *OFFLINE])
    assert run(arguments, ask) == 0
    assert [question.split(" [")[0] for question in asked] == [
        "Autopilot, px4 or ardupilot",
        "Autopilot, px4 or ardupilot",
        "Link to the autopilot",
        "Radio as NAME@URL (companion radio list)",
        "Preset",
        "Fence, a .plan or .kml file",
    ]
    output = capsys.readouterr().out
    assert "one of: px4, ardupilot" in output
    assert "set in ArduPilot" in output
    assert "SERIAL2_BAUD" not in output, "there is no serial port"


def test_a_setup_that_is_left_has_written_nothing(tmp_path: Path) -> None:
    def leave(_: str) -> str:
        raise EOFError

    arguments = argument_parser().parse_args(["setup", "--directory", str(tmp_path), *OFFLINE])
    assert complaint(arguments, leave) == "setup: no answer; nothing was written"
    assert tree(tmp_path) == {}


def complaint(arguments: argparse.Namespace, ask: object) -> str:
    with pytest.raises(Exception, match="setup") as refused:
        run(arguments, ask)  # type: ignore[arg-type]
    return str(refused.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "setup: specify the link to the autopilot"),
        (("--connect", "usb0"), "usb0"),
        (("--connect", SERIAL, "--radio", "esp32_ftm"), "give NAME@URL"),
        (("--connect", SERIAL, "--radio", "nobody@/dev/ttyUSB0"), "nobody"),
        (("--connect", SERIAL, "--fence", "/nowhere.plan"), "/nowhere.plan: no such file"),
        (("--connect", SERIAL, "--preset", "moon"), "preset moon: no such file"),
        (("--connect", SERIAL, "--ranging", "udp:x"), "udp:x"),
        (("--remove",), "no setup was made here"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], words: str
) -> None:
    assert setup(tmp_path, *options) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert tree(tmp_path) == {}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--connect", SERIAL, "--radio", "nlink@/dev/ttyAMA0"), "this link is given twice"),
        (("--connect", SERIAL, "--ranging", SERIAL), "this link is given twice"),
        (("--connect", "udp:0.0.0.0:14540"), "a --preset that has link.signing_key_file"),
    ],
)
def test_links_that_a_flight_would_refuse_are_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], words: str
) -> None:
    assert setup(tmp_path, *options) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert tree(tmp_path) == {}


def failing(error: BaseException) -> Callable[..., Any]:
    def fail(*_: object) -> Any:
        raise error

    return fail


@pytest.mark.parametrize(
    ("part", "error", "said"),
    [
        (None, None, "no such device"),
        ("run_doctor", LinkError("udp: another companion (process 1) has this vehicle"), "process"),
        ("run_doctor", KeyboardInterrupt(), ""),
        ("compile_kernels", KeyboardInterrupt(), ""),
    ],
)
def test_what_goes_wrong_after_writing_leaves_the_files_and_the_advice(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    part: str | None,
    error: BaseException | None,
    said: str,
) -> None:
    """Exit code 1, never 2: without a replaced part the autopilot is unplugged."""
    if part is not None and error is not None:
        monkeypatch.setattr(f"companion.setup_tools.setup_commands.{part}", failing(error))
    unplugged = "serial:/dev/unplugged:921600"
    options = ("--autopilot", "ardupilot", "--connect", unplugged)
    assert main(["setup", "--directory", str(tmp_path), *options]) == EXIT_FAILED
    assert load_config(tmp_path / "companion.yaml")
    assert unplugged in (tmp_path / "service.env").read_text()
    out = capsys.readouterr().out
    assert said in out
    assert ("do not fly" in out) == bool(said)
    assert "SERIAL2_BAUD      921" in out
    assert "undo: companion setup --remove" in out


def test_a_unit_starts_from_a_folder_of_any_name(tmp_path: Path) -> None:
    folder = tmp_path / 'Flüge "1" 100% $5'
    folder.mkdir()
    options = ("--connect", SERIAL, "--unit-directory", str(folder), "--user", "pilot")
    assert setup(folder, *options) == 0
    lines = (folder / "companion.service").read_text(encoding="utf-8").splitlines()
    (start,) = (line for line in lines if line.startswith("ExecStart="))
    (environment,) = (line for line in lines if line.startswith("EnvironmentFile="))
    assert environment == f'EnvironmentFile={tmp_path}/Flüge "1" 100%% $5/service.env'
    assert f'--config "{tmp_path}/Flüge \\"1\\" 100%% $$5/companion.yaml" --quiet' in start


def test_the_advice_can_be_pasted_into_a_shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "two words"
    assert setup(folder, "--connect", SERIAL) == 0
    assert f"undo: companion setup --remove --directory '{folder}'" in capsys.readouterr().out


def test_a_user_without_name_or_home_is_asked_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(getpass, "getuser", failing(KeyError("getpwuid(): uid not found: 5")))
    options = ("--connect", SERIAL, "--unit-directory", str(tmp_path))
    assert setup(tmp_path / "etc", *options) == EXIT_BAD_INPUT
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    monkeypatch.setattr(os, "geteuid", lambda: 5)
    monkeypatch.setattr(os.path, "expanduser", str)
    assert main(["setup", "--connect", SERIAL, *OFFLINE]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err.splitlines() == [
        "companion: setup: this user has no name; specify one with --user",
        "companion: setup: there is no HOME to write to; choose a folder with --directory",
    ]


def test_a_setup_of_another_owner_is_removed_as_a_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    etc, units = tmp_path / "etc", tmp_path / "units"
    units.mkdir()
    setup(etc, "--connect", SERIAL, "--unit-directory", str(units), "--user", "pilot")
    before = tree(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, _: path != units)
    assert main(["setup", "--directory", str(etc), "--remove"]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == (
        f"companion: {units}/companion.service: cannot be removed; run it as the owner of the "
        "folder, or with sudo\n"
    )
    assert tree(tmp_path) == before


def test_a_preset_of_schema_1_is_written_with_the_present_keys(tmp_path: Path) -> None:
    preset, etc = tmp_path / "own.yaml", tmp_path / "etc"
    preset.write_text("emitter_id: 3\n")

    assert setup(etc, "--connect", SERIAL, "--preset", str(preset)) == 0
    assert load_config(etc / "companion.yaml").emitters.listed == (3,)


def test_a_preset_without_keys_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "own.yaml"
    preset.write_text("- mission\n")

    assert setup(tmp_path / "etc", "--connect", SERIAL, "--preset", str(preset)) == EXIT_BAD_INPUT
    assert f"companion: {preset}: $: expected `key: value` lines" in capsys.readouterr().err


def test_a_preset_that_is_wrong_is_named_without_the_folder_it_was_tried_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "own.yaml"
    preset.write_text("mission: {altitude_m: 900}")
    assert setup(tmp_path / "etc", "--connect", SERIAL, "--preset", str(preset)) == EXIT_BAD_INPUT
    line = capsys.readouterr().err
    assert line.startswith("companion: companion.yaml: $.mission.altitude_m: 900 m is outside")
    assert not (tmp_path / "etc").exists()


def test_where_one_file_cannot_be_written_all_is_as_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    etc = tmp_path / "etc"
    etc.mkdir()
    (etc / "companion.yaml").write_text("mission: {altitude_m: 30}\n")
    before = tree(tmp_path)
    nowhere = ("--unit-directory", str(tmp_path / "nowhere"))
    assert setup(etc, "--connect", SERIAL, *nowhere) == EXIT_BAD_INPUT
    assert "cannot be written" in capsys.readouterr().err
    assert tree(tmp_path) == before


@pytest.mark.parametrize("number", [1, 2, 3])
def test_where_it_is_interrupted_while_it_writes_all_is_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """A slow card takes seconds for each file."""
    etc = tmp_path / "etc"
    etc.mkdir()
    (etc / "companion.yaml").write_text("mission: {altitude_m: 30}\n")
    before = tree(tmp_path)
    synced: list[int] = []

    def sync(descriptor: int) -> None:
        synced.append(descriptor)
        if len(synced) == 2 * number - 1:  # the file, then its folder
            raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", sync)
    assert setup(etc, "--connect", SERIAL) == EXIT_FAILED
    assert tree(tmp_path) == before


def test_the_service_is_the_projects_own_unit_for_this_installation(tmp_path: Path) -> None:
    etc, units = tmp_path / "etc", tmp_path / "units"
    units.mkdir()
    assert setup(etc, "--connect", SERIAL, "--unit-directory", str(units), "--user", "pilot") == 0
    ours = (ROOT / "configs/systemd/companion.service").read_text().splitlines()
    made = (units / "companion.service").read_text().splitlines()
    changed = [
        line for line, own in zip(made, ours, strict=True) if line != own and "#" not in line
    ]
    keys = [line.split("=")[0] for line in changed if not line.startswith("ProtectHome")]
    assert keys == ["EnvironmentFile", "ExecStartPre", "ExecStart", "User"]
    assert f"EnvironmentFile={etc}/service.env" in made


def test_remove_leaves_no_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    etc = tmp_path / "etc"
    etc.mkdir()
    (etc / "companion.yaml").write_text("mission: {altitude_m: 30}\n")
    before = tree(tmp_path)
    for altitude in ("uwb", "wifi_rtt"):  # twice: the second one must not forget what was there
        assert setup(etc, "--connect", SERIAL, "--preset", altitude) == 0
    assert setup(etc, "--remove") == 0
    assert f"as before the setup: {etc / 'companion.yaml'}" in capsys.readouterr().out
    assert tree(tmp_path) == before


def test_remove_keeps_files_changed_by_the_user(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert setup(tmp_path, "--connect", SERIAL) == 0
    (tmp_path / "companion.yaml").write_text("mission: {altitude_m: 30}\n")
    assert setup(tmp_path, "--remove") == 0
    assert "kept: " in capsys.readouterr().out
    assert list(tree(tmp_path)) == ["companion.yaml"]


def test_a_flight_loads_nothing_of_it() -> None:
    code = "import sys, companion.cli as cli; cli.resolve_name(cli.FLY); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name for name in done.stdout.split() if name.startswith("companion.")}
    assert "companion.arguments" in loaded
    assert {name for name in loaded if "_commands" in name and "setup_tools" in name} == set()
    assert not any(name.startswith("companion.doctor") for name in loaded)


def test_a_unit_is_never_taken_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = tmp_path / "configs" / "systemd" / "companion.service"
    planted.parent.mkdir(parents=True)
    planted.write_text("[Service]\nExecStart=/bin/false\n")
    monkeypatch.chdir(tmp_path)
    units = tmp_path / "units"
    units.mkdir()
    assert setup(tmp_path / "etc", "--connect", SERIAL, "--unit-directory", str(units)) == 0
    assert "/bin/false" not in (units / "companion.service").read_text()
