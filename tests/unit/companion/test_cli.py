"""Refusals of the `companion` command before any socket opens: one line, exit code 2."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name

import pytest

from companion.cli import COMMANDS, FLY, main
from companion.errors import EXIT_BAD_INPUT, EXIT_FAILED
from companion.guidance.commands import Severity
from companion.io.flight_recorder import BlackBox
from companion.view.log_lines import set_up_logging
from tests.ports import free_port

OPEN = "udp:0.0.0.0:14999"


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that refuses these arguments."""
    assert main(arguments) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    return line


def key_file(folder: Path, mode: int = 0o600, text: str = "0123456789abcdef" * 4) -> Path:
    path = folder / "signing.key"
    path.write_text(text)
    path.chmod(mode)
    return path


def test_quiet_shows_what_takes_a_warning_back(capsys: pytest.CaptureFixture[str]) -> None:
    """A service's journal that says a radio is silent must say, too, that it is heard again."""
    set_up_logging(quiet=True)
    said = [(Severity.WARNING, "silent"), (Severity.NOTICE, "heard"), (Severity.INFO, "searching")]
    for number, (severity, text) in enumerate(said):
        BlackBox().text(severity, text, float(number))
    logging.getLogger("companion").handlers[0].close()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["    0.0 s  silent", "    1.0 s  heard"]


@pytest.mark.parametrize(
    "arguments", [("--connect", OPEN), ("--connect", "udp::1", "--ranging", OPEN)]
)
def test_a_port_open_to_the_network_needs_a_key(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]
) -> None:
    line = complaint(capsys, *arguments)
    assert line.startswith("companion: udpin:0.0.0.0:14999: anyone in the network could command it")
    assert "--signing-key FILE, or insist with --insecure" in line


@pytest.mark.parametrize(
    ("mode", "text", "problem"),
    [
        (0o644, "0123456789abcdef" * 4, "chmod 600 '/"),
        (0o600, "0" * 64, "zeros"),
        (0o600, "0123", "64 hexadecimal digits"),
    ],
)
def test_a_bad_key_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: int, text: str, problem: str
) -> None:
    (tmp_path / "a site").mkdir()
    path = key_file(tmp_path / "a site", mode, text)
    line = complaint(capsys, "--connect", OPEN, "--signing-key", str(path), "--quiet")
    assert line.startswith(f"companion: {path}: ")
    assert problem in line


def test_a_key_file_of_the_configuration_is_refused_the_same_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = key_file(tmp_path, 0o640)
    config = tmp_path / "site.yaml"
    config.write_text(f"link: {{signing_key_file: {path}}}")
    assert "chmod 600" in complaint(capsys, "--connect", OPEN, "--config", str(config), "--quiet")


def test_a_key_that_is_a_device_gets_no_other_permissions(
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = complaint(capsys, "--connect", OPEN, "--signing-key", os.devnull, "--quiet")
    assert line.startswith("companion: /dev/null: a signing key is 64 hexadecimal digits; make one")


BOW_TIE = (
    '{"fileType": "Plan", "geoFence": {"version": 2, "circles": [], "polygons": [{"version": 1, '
    '"inclusion": true, "polygon": [[47, 8], [47.01, 8.01], [47.01, 8], [47, 8.01]]}]}}'
)


def test_an_address_that_does_not_open_is_not_one_where_nothing_was_heard(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "needs HOST:PORT" in complaint(capsys, "radio", "identify", "nosuch")
    line = complaint(capsys, "radio", "identify", "serial:/dev/nosuch")
    assert line.startswith("companion: serial /dev/nosuch: no such device")


def test_a_fence_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "site.plan"
    line = complaint(capsys, "--connect", OPEN, "--fence", str(path), "--quiet")
    assert line == f"companion: {path}: no such file"
    path.write_text("")
    line = complaint(capsys, "--connect", OPEN, "--fence", str(path), "--quiet")
    assert line.startswith(f"companion: {path}: line 1, column 1: not JSON (")
    path.write_text(BOW_TIE)
    line = complaint(capsys, "--connect", OPEN, "--fence", str(path), "--quiet")
    assert (
        line
        == f"companion: {path}: geoFence.polygons[0]: two of its edges touch or cross each other"
    )
    config = tmp_path / "site.yaml"
    config.write_text("limits: {fence_file: site.plan}")
    again = complaint(capsys, "--connect", OPEN, "--config", str(config), "--quiet")
    assert again == line.replace("companion: ", f"companion: {config}: $.limits.fence_file: ")


@pytest.mark.parametrize(
    "option",
    [
        *(("--signing-key", "k"), ("--insecure",), ("--fence", "site.plan")),
        *(("--web-control",), ("--web-open",), ("--web-token", "12345678"), ("--web-tiles", "t")),
    ],
)
def test_options_of_flying_are_refused_in_front_of_a_subcommand(
    capsys: pytest.CaptureFixture[str], option: tuple[str, ...]
) -> None:
    line = complaint(capsys, *option, "replay", "walk.csv")
    assert f"{option[0]} in front of `replay` has no effect" in line


def test_a_report_of_no_flight_is_refused_in_words(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert "flight.json" in complaint(capsys, "report", str(tmp_path))
    walk = tmp_path / "walk.txt"
    walk.write_text("t_s,agent_x_m\n")
    line = complaint(capsys, "replay", str(walk))
    assert line.startswith(f"companion: {walk}: belongs to no flight")
    assert line.endswith("and a walk as .csv")


def test_options_of_the_map_need_the_map(capsys: pytest.CaptureFixture[str]) -> None:
    line = complaint(capsys, "--connect", "udp:127.0.0.1:0", "--web-control")
    assert "--web-control" in line
    for command in (("--connect", "udp:127.0.0.1:0"), ("demo",), ("replay", "flight")):
        line = complaint(capsys, *command, "--web-tiles", "tiles")
        assert line == "companion: --web-tiles: there is no map without --web PORT"


@pytest.mark.parametrize("command", [("demo",), ("replay", "flight")])
def test_tiles_of_demo_and_replay_are_looked_at_first(
    capsys: pytest.CaptureFixture[str], command: tuple[str, ...], tmp_path: Path
) -> None:
    line = complaint(capsys, *command, "--web", "8080", "--web-tiles", str(tmp_path))
    assert "contains no tiles" in line


@pytest.mark.parametrize("function", [FLY, *COMMANDS.values()])
def test_each_subcommand_has_its_function(function: str) -> None:
    assert callable(resolve_name(function))


@pytest.mark.parametrize("subcommand", COMMANDS)
def test_each_subcommand_has_arguments(subcommand: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main((subcommand, "--help"))
    assert f"companion {subcommand} " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("--conect udp::1", "--conect: no such option; did you mean --connect? (companion --help"),
        ("demo --sped 4", "--sped: no such option; did you mean --speed? (companion demo --help"),
        ("demo --sped=4", "--sped: no such option; did you mean --speed? (companion demo --help"),
        ("demo --fly", "--fly: no such option (companion demo --help shows how)"),
        ("replya walk.csv", "replya is none of demo, "),
        ("replya walk.csv", "; did you mean replay? (companion --help shows how)"),
        ("radio wacth", "; did you mean watch? (companion radio --help shows how)"),
        ("demo --autopilot PX4", "--autopilot: PX4 is none of px4, ardupilot; did you mean px4?"),
    ],
)
def test_a_mistyped_word_is_named_with_the_one_that_was_meant(
    capsys: pytest.CaptureFixture[str], typed: str, words: str
) -> None:
    assert words in complaint(capsys, *typed.split())


@pytest.mark.parametrize("command", ["replay --web flights/a", "demo --web site.yaml"])
def test_what_follows_the_map_and_is_no_port_is_named(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """An option that may stand alone takes the flight that was meant for the command."""
    what = command.split()[-1]
    words = f"companion: --web {what}: give a port, or HOST:PORT, for example 8080"
    assert complaint(capsys, *command.split()) == words


@pytest.mark.parametrize(
    "command", ["identify @udp::1", "watch ndjson@udp::1", "record a", "calibrate --beside 1"]
)
@pytest.mark.parametrize("seconds", ["nan", "inf", "0", "-1", "1e300", ""])
def test_a_radio_is_listened_to_for_a_time_that_can_be(
    capsys: pytest.CaptureFixture[str], command: str, seconds: str
) -> None:
    line = complaint(capsys, "radio", *command.split(), "--seconds", seconds)
    assert f"--seconds: `{seconds}` is not a number above 0" in line


@pytest.fixture
def restored_signals() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("listener", "command"),
    [
        ("doctor.probe.DoctorProbe", "doctor --connect udp::{0}"),
        ("doctor.probe.RadioProbe", "doctor --connect udp::{0} --radio ndjson@udp::{1}"),
        ("radio_tools.identify.RadioListener", "radio identify @tcp:127.0.0.1:{0}"),
        ("radio_tools.calibrate._Listener", "radio calibrate --beside 1 --radio ndjson@udp::{0}"),
    ],
)
@pytest.mark.usefixtures("restored_signals")
def test_what_was_heard_until_an_interrupt_is_no_result(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: signal.Signals,
    listener: str,
    command: str,
) -> None:
    """Neither fit to fly, nor silent, nor an offset."""

    def interrupt(*_: object) -> None:
        os.kill(os.getpid(), number)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setattr("companion.doctor.probe.TIMEOUT_S", 0.0)
    monkeypatch.setattr(f"companion.{listener}.handle_timer", interrupt)
    arguments = command.format(free_port(), free_port()).split()
    assert main(arguments) == EXIT_FAILED
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines()[-1] == "companion: interrupted"
