"""The example for systemd says what the companion does."""

from __future__ import annotations

import configparser
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from companion.arguments import argument_parser

ROOT = Path(__file__).parents[4]
UNIT = ROOT / "configs/systemd/companion.service"
OPTIONS = ROOT / "packaging/debian/service.env"


def unit() -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(interpolation=None, strict=False)
    parsed.optionxform = str  # type: ignore[assignment, method-assign]
    parsed.read(UNIT)
    return parsed


def test_three_starts_within_a_minute_and_none_after_bad_input() -> None:
    assert unit()["Unit"]["StartLimitBurst"] == "3"
    assert unit()["Unit"]["StartLimitIntervalSec"] == "60"
    assert unit()["Service"]["Restart"] == "on-failure"
    assert unit()["Service"]["RestartPreventExitStatus"] == "2"


def test_it_is_watched_and_has_a_place_for_its_state() -> None:
    service = unit()["Service"]
    assert service["Type"] == "notify"
    assert float(service["WatchdogSec"]) >= 1.0
    assert service["StateDirectory"] == "companion"


def test_its_command_is_one_of_ours() -> None:
    _, _, options = OPTIONS.read_text().partition("COMPANION_OPTIONS=")
    started = unit()["Service"]["ExecStart"].replace("$COMPANION_OPTIONS", options.strip())
    _, *arguments = shlex.split(started)
    parsed = argument_parser().parse_args(arguments)
    assert parsed.connect.startswith("serial:")


MAX_EXPOSED = 3.5


def test_it_reaches_serial_ports_and_sockets_and_little_else() -> None:
    text = UNIT.read_text()
    allowed = re.findall(r"^DeviceAllow=(\S+) rw$", text, re.MULTILINE)
    assert {"char-ttyAMA", "char-ttyS", "char-ttyUSB", "char-ttyACM", "char-pts"} <= set(allowed)
    families = set(unit_values("RestrictAddressFamilies"))
    assert families == {"AF_INET", "AF_INET6", "AF_UNIX", "AF_NETLINK"}
    assert unit_values("CapabilityBoundingSet") == []
    for broken in ("PrivateDevices", "MemoryDenyWriteExecute", "PrivateUsers", "PrivateNetwork"):
        assert re.search(rf"^{broken}=", text, re.MULTILINE) is None


def unit_values(key: str) -> list[str]:
    """Return the words of a key of the unit that is given once."""
    (line,) = re.findall(rf"^{key}=(.*)$", UNIT.read_text(), re.MULTILINE)
    return str(line).split()


def test_setpoints_go_before_other_programs_and_the_page_does_not() -> None:
    text = UNIT.read_text()
    assert int(unit_values("Nice")[0]) < 0
    assert int(unit_values("OOMScoreAdjust")[0]) < 0
    assert unit_values("OOMPolicy") == ["continue"]
    assert "@resources" in text  # by which the page lowers itself


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_finds_it_hardly_exposed(tmp_path: Path) -> None:
    folder = tmp_path / "etc/systemd/system"
    folder.mkdir(parents=True)
    shutil.copy(UNIT, folder)
    command = ["systemd-analyze", "security", "--offline=true", f"--root={tmp_path}", UNIT.name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    if found is None:
        pytest.skip(f"this systemd-analyze cannot: {done.stderr[:200]}")
    assert float(found[1]) <= MAX_EXPOSED
