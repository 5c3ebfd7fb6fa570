"""The control side of the page: a taken port, and a child that is gone."""

from __future__ import annotations

import socket

import pytest

from companion.errors import CompanionError
from companion.web.process import listening_socket
from companion.web.settings import web_settings


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
