"""Addresses of radios: the parts that a kind adds, and those that are refused."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.config.radios import RadioConfig, radio_setup
from companion.errors import ConfigError, LinkError
from companion.io.links.link import Link
from companion.io.links.stream_links import StdinLink, TcpServerLink
from companion.io.links.transports import OwnLine, radio_link
from companion.link.interface import LinkRole, RadioSettings, RadioSetup
from companion.radios.decoder import LineDecoder, Poll, RadioDecoder, RadioKind, RadioReading
from tests.ports import free_port


class Mute(LineDecoder):
    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        del line, received_s
        return []

    def hello(self) -> bytes:
        return b"lec\r"


def setup_of(transport: str, poll: Poll | None = None, poll_s: float | None = None) -> RadioSetup:
    kind: type[RadioDecoder] = Mute
    return RadioSetup(
        RadioKind("mute", kind, "", "range", "", transport, poll=poll), RadioSettings(poll_s=poll_s)
    )


@pytest.mark.parametrize(
    ("transport", "url", "address"),
    [
        ("serial:115200", "/dev/ttyUSB0", "serial:/dev/ttyUSB0:115200"),
        ("serial:115200", "/tmp/uwb", "serial:/tmp/uwb:115200"),
        ("serial:115200", "serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0:115200"),
        ("serial:115200", "/dev/ttyUSB0:9600", "serial:/dev/ttyUSB0:9600"),
        ("serial", "/dev/ttyUSB0", "serial:/dev/ttyUSB0:921600"),
        ("udp", "udp:9000", None),
        ("udp", "127.0.0.1:9000", "udpin:127.0.0.1:9000"),
        ("udp", "udp://127.0.0.1:9000", "udpin:127.0.0.1:9000"),
        ("udp", "tcp:10.0.0.2:9000", "tcp:10.0.0.2:9000"),
        ("udp", "tcpin:127.0.0.1:9000", "tcpin:127.0.0.1:9000"),
        ("http:8081", "10.0.0.2", "http://10.0.0.2:8081/DOA.html"),
        ("http:8081", "10.0.0.2:80", "http://10.0.0.2:80/DOA.html"),
        ("http", "http://kraken:8081", "http://kraken:8081/DOA.html"),
        ("http", "http://kraken:8081/doa.xml?a=b", "http://kraken:8081/doa.xml?a=b"),
        ("udp", "stdin:", "stdin:"),
        ("udp", "exec:cat a.txt | head", "exec:cat a.txt | head"),
        ("file", "file:log.txt", "file:log.txt"),
        ("file", "file:/tmp/log.txt?play=2", "file:/tmp/log.txt?play=2"),
    ],
)
def test_an_address_is_completed_by_the_radios_kind(
    transport: str, url: str, address: str | None
) -> None:
    setup = setup_of(transport, Poll("/DOA.html", 0.5))
    if address is None:
        with pytest.raises(ConfigError):
            radio_link(setup, url)
        return
    link = radio_link(setup, url)
    assert str(link.transport) == address
    assert (link.spec.role, link.spec.radio) == (LinkRole.RANGING, setup)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "exec:",
        "http://",
        "http://a:b@host/",
        "file:",
        "file:x?speed=2",
        "file:x?play=0",
        "ftp:x",
    ],
)
def test_a_wrong_address_is_refused_in_one_line(url: str) -> None:
    with pytest.raises(ConfigError) as caught:
        radio_link(setup_of("serial:115200"), url)
    assert "\n" not in str(caught.value)


def test_the_link_greets_the_radio_and_tells_its_loss() -> None:
    link = made(setup_of("serial:115200"))
    assert (link.greeting, link.signals_loss, link.index) == (b"lec\r", True, 3)


def test_a_radio_that_only_answers_is_asked_over_a_stream_and_no_page_for_it() -> None:
    poll = Poll("", 0.3, b"?")
    asked = [made(setup_of("serial:115200", poll, settings)) for settings in (None, 0.02)]
    assert [(link.request, link.request_period_s) for link in asked] == [(b"?", 0.3), (b"?", 0.02)]
    assert made(setup_of("serial:115200")).request == b""
    assert str(radio_link(setup_of("http", poll), "http://a").transport) == "http://a/"


def test_requests_go_to_the_present_device_and_then_to_the_next() -> None:
    link = made(setup_of("serial:115200", Poll("", 0.01, b"?")))

    async def play() -> list[bytes]:
        assert isinstance(link, TcpServerLink)
        await link.open()
        heard = []
        for _ in range(2):
            reader, writer = await asyncio.open_connection(*link.local_address)
            heard.append(await asyncio.wait_for(reader.readexactly(8), 10.0))
            writer.close()
            await writer.wait_closed()
            while link.is_connected:
                await asyncio.sleep(0.0)
        link.close()
        return heard

    assert asyncio.run(play()) == [b"lec\r????", b"lec\r????"]


def made(setup: RadioSetup) -> Link:
    """The link of a radio that connects to us."""
    transport = radio_link(setup, f"tcpin:127.0.0.1:{free_port()}").transport
    assert isinstance(transport, OwnLine)
    return transport.make(3, lambda _: None)


@pytest.mark.parametrize("what", [os.devnull, "a file"])
def test_standard_input_that_cannot_be_waited_for_is_refused_in_one_line(
    what: str, tmp_path: Path
) -> None:
    path = Path(what) if what == os.devnull else tmp_path / what
    path.touch()
    before, given = os.dup(0), os.open(path, os.O_RDONLY)
    try:
        os.dup2(given, 0)
        with pytest.raises(LinkError, match="stdin: neither a pipe nor a terminal"):
            asyncio.run(StdinLink(0, lambda _: None).open())
    finally:
        os.dup2(before, 0)
        os.close(before)
        os.close(given)


@pytest.mark.parametrize("query", ["", "?play=1"])
@pytest.mark.parametrize(
    ("make", "problem"), [(os.mkfifo, "is no regular file"), (str, "there is no such file")]
)
def test_what_is_no_regular_file_is_not_followed(
    make: Callable[[Path], object], problem: str, query: str, tmp_path: Path
) -> None:
    path = tmp_path / "log"
    make(path)
    setup = radio_setup(RadioConfig(name="nlink"), "test")
    transport = radio_link(setup, f"file:{path}{query}").transport
    assert isinstance(transport, OwnLine)
    with pytest.raises(LinkError, match=f"^file {path}: {problem}$"):
        asyncio.run(transport.make(0, lambda _: None).open())


@pytest.mark.parametrize("name", ["makerfabs_at", "bu01", "bu03", "srsran"])
def test_nothing_is_written_to_standard_input(name: str) -> None:
    """Radios that are greeted or asked over a port are read from a pipe, too."""
    transport = radio_link(radio_setup(RadioConfig(name=name), "test"), "stdin:").transport
    assert isinstance(transport, OwnLine)

    link = transport.make(0, lambda _: None)

    assert link.greeting == link.request == b""
