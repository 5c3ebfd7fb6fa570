"""Five hundred configuration files with mistakes: refused in lines, before any socket, or flown."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest

from companion import cli, flight_commands
from companion.config.schema import CompanionConfig
from companion.flight_setup import build_session
from companion.io.links.transports import Transport
from tests.unit.companion.config.mutations import mutants

pytestmark = pytest.mark.slow

FILES = 500
LIMIT_S = 1.0


class OpenedError(Exception):
    """The command went on to the links."""


def test_a_wrong_file_is_refused_in_lines_before_any_socket_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flown: list[CompanionConfig] = []

    def fly(config: CompanionConfig, _links: list[Transport], *_: object, **__: object) -> None:
        flown.append(config)
        raise OpenedError

    def no_socket(*_: object, **__: object) -> socket.socket:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(flight_commands, "fly", fly)
    monkeypatch.setattr(socket, "socket", no_socket)
    refused, slowest_s = 0, 0.0
    for number, text in enumerate(mutants(seed=20261121, count=FILES)):
        path = tmp_path / f"{number}.yaml"
        path.write_text(text, encoding="utf-8")
        began_s = time.process_time()
        try:
            code = cli.main(["--connect", "udp:127.0.0.1:14550", "--config", str(path)])
        except OpenedError:
            build_session(flown[-1])
            continue
        finally:
            slowest_s = max(slowest_s, time.process_time() - began_s)
        refused += 1
        errors = capsys.readouterr().err
        assert code == 2, text
        assert errors, text
        for line in errors.splitlines():
            assert line.startswith(f"companion: {path}: "), (text, line)
            assert "Traceback" not in line
    assert refused + len(flown) == FILES
    assert refused > FILES // 2
    assert len(flown) > FILES // 50
    assert slowest_s < LIMIT_S
