"""The example for systemd says what the companion does."""

from __future__ import annotations

import configparser
import shlex
from pathlib import Path

from companion.arguments import argument_parser

ROOT = Path(__file__).parents[4]
UNIT = ROOT / "configs/systemd/companion.service"
OPTIONS = ROOT / "packaging/debian/service.env"


def unit() -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(interpolation=None)
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
