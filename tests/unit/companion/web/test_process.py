"""The control side of the page: a taken port, and a child that is gone."""

from __future__ import annotations

import errno
import itertools
import socket
import subprocess
import sys
from time import sleep
from typing import Any
from unittest.mock import Mock

import pytest

from companion.errors import CompanionError
from companion.web.live_map import WebProcess, announced_url, listening_socket
from companion.web.settings import web_settings

WHOLE = (
    '{"fd": FD, "scene": {}, "settings": {"host": "127.0.0.1", "token": null, '
    '"is_control_on": false, "is_view_open": false, "tiles": null}}\n'
)
"""First message to the page's process."""


def test_a_taken_port_is_a_clear_error() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(CompanionError) as caught:
            listening_socket(web_settings(str(port)))
    text = str(caught.value)
    assert text.startswith(f"--web 127.0.0.1:{port}: cannot be opened")
    assert "is another program using the port?" in text
    assert "\n" not in text


def test_an_address_of_another_computer_is_refused() -> None:
    with pytest.raises(CompanionError, match=r"--web 192\.0\.2\.1:8080: cannot be opened"):
        listening_socket(web_settings("192.0.2.1:8080"))
    with pytest.raises(CompanionError, match="is it an address of this computer"):
        listening_socket(web_settings("192.0.2.1:8080"))


def test_a_port_that_is_not_ours_to_open_is_said_to_be_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refusal = Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(socket.socket, "bind", refusal)
    with pytest.raises(CompanionError, match="ports below 1024"):
        listening_socket(web_settings("80"))


def test_without_the_extra_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)
    with pytest.raises(CompanionError, match=r"pip .*install 'companion-guidance\[web\]'"):
        WebProcess(web_settings("8080"), {})


def test_the_address_that_is_reported_is_the_one_that_is_served() -> None:
    for address in ("8080", "192.168.1.7:8080", "field-laptop:8080"):
        settings = web_settings(address)
        assert announced_url(settings) == settings.url


def test_without_a_network_the_address_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    refusal = Mock(side_effect=OSError(errno.ENETUNREACH, "Network is unreachable"))
    monkeypatch.setattr(socket.socket, "connect", refusal)
    settings = web_settings("0.0.0.0:8080")
    assert announced_url(settings) == settings.url


def test_beside_the_network_the_address_is_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket.socket, "connect", Mock())
    monkeypatch.setattr(socket.socket, "getsockname", Mock(return_value=("192.168.1.7", 4)))
    settings = web_settings("0.0.0.0:8080", token="12345678")
    assert announced_url(settings) == "http://192.168.1.7:8080/?token=12345678"


def test_a_page_that_ends_is_started_again_ever_more_slowly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its process ends as soon as it begins; the flight goes on, and the port stays taken."""
    now_s, started_s = 0.0, []

    def start(_: object, **pipes: Any) -> subprocess.Popen[bytes]:
        started_s.append(now_s)
        return Popen(["true"], **pipes)

    Popen = subprocess.Popen
    monkeypatch.setattr("companion.web.live_map.subprocess.Popen", start)
    monkeypatch.setattr("companion.web.live_map.time.monotonic", lambda: now_s)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = WebProcess(web_settings(str(port)), {})
    try:
        for _ in range(150):
            assert process.update(now_s, dict) == []
            sleep(0.005)  # its pipe closes in real time
            now_s += 1.0
        with pytest.raises(CompanionError, match="another program"):
            listening_socket(web_settings(str(port)))
    finally:
        process.close()
    gaps_s = [later - earlier for earlier, later in itertools.pairwise(started_s)]
    assert len(gaps_s) >= 6
    for gap_s, least_s in zip(gaps_s, [1, 2, 4, 8, 16, 30, 30], strict=False):
        assert least_s <= gap_s <= least_s + 5


@pytest.mark.slow
@pytest.mark.parametrize("words", ["", '{"fd": 3, "ho', WHOLE, WHOLE + '{"t_s": 1.0, "ve'])
def test_a_flight_that_ends_in_the_middle_of_a_picture_ends_the_page_in_silence(words: str) -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        page = subprocess.run(
            [sys.executable, "-m", "companion.web.server"],
            input=words.replace("FD", str(listener.fileno())),
            capture_output=True,
            text=True,
            pass_fds=(listener.fileno(),),
            timeout=180.0,
        )
    assert (page.returncode, page.stdout, page.stderr) == (0, "", "")
