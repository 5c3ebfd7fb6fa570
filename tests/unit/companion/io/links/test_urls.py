from __future__ import annotations

import pytest

from companion.errors import ConfigError
from companion.io.links.transports import (
    DEFAULT_BAUD,
    Pty,
    SerialPort,
    TcpClient,
    TcpServer,
    Transport,
    UdpBind,
    UdpConnect,
    parse_transport,
)
from companion.io.links.transports import is_exposed as exposed


@pytest.mark.parametrize(
    ("text", "link"),
    [
        ("udp:127.0.0.1:14550", UdpBind("127.0.0.1", 14550)),
        ("udpin:127.0.0.1:14550", UdpBind("127.0.0.1", 14550)),
        ("udp://127.0.0.1:14550", UdpBind("127.0.0.1", 14550)),
        ("udpin://127.0.0.1:14550", UdpBind("127.0.0.1", 14550)),
        ("UDP:localhost:1", UdpBind("localhost", 1)),
        (" udp:127.0.0.1:14550\n", UdpBind("127.0.0.1", 14550)),
        ("udp::14550", UdpBind("127.0.0.1", 14550)),
        ("udpin://:14550", UdpBind("127.0.0.1", 14550)),
        ("udpout:10.0.0.2:65535", UdpConnect("10.0.0.2", 65535)),
        ("udpout://10.0.0.2:14580", UdpConnect("10.0.0.2", 14580)),
        ("tcp:localhost:5760", TcpClient("localhost", 5760)),
        ("tcpout://localhost:5760", TcpClient("localhost", 5760)),
        ("tcpin::5760", TcpServer("127.0.0.1", 5760)),
        ("serial:/dev/ttyACM0:57600", SerialPort("/dev/ttyACM0", 57600)),
        ("serial:///dev/ttyACM0:57600", SerialPort("/dev/ttyACM0", 57600)),
        ("serial:/dev/ttyACM0", SerialPort("/dev/ttyACM0", DEFAULT_BAUD)),
        ("pty:/tmp/vehicle", Pty("/tmp/vehicle")),
        ("pty:///tmp/a:b", Pty("/tmp/a:b")),
        ("/dev/ttyTHS1", SerialPort("/dev/ttyTHS1", 921_600)),
        ("/dev/ttyTHS1:115200", SerialPort("/dev/ttyTHS1", 115_200)),
        (
            "/dev/serial/by-path/pci-0:14.0-usb-0:3:1.0",
            SerialPort("/dev/serial/by-path/pci-0:14.0-usb-0:3:1.0", DEFAULT_BAUD),
        ),
    ],
)
def test_every_spelling_means_one_link(text: str, link: Transport) -> None:
    assert parse_transport(text) == link
    assert parse_transport(str(link)) == link


@pytest.mark.parametrize(
    "text",
    [
        "",
        "pty:",
        "pty:vehicle",
        "14550",
        "udp",
        "udp:",
        "udp:127.0.0.1",
        "udp:127.0.0.1:",
        "udp:127.0.0.1:0",
        "udp:127.0.0.1:65536",
        "udp:127.0.0.1:-1",
        "udp:127.0.0.1:14550x",
        "udp:127.0.0.1:\uff11\uff14",
        "udp:127.0.0.1:" + "9" * 5000,
        "udp:[::1]:14550",
        "udp:::1:14550",
        "udp:a b:14550",
        "udp:user@host:14550",
        "udpout::14550",
        "tcp::5760",
        "http://example:80",
        "serial:ttyACM0",
        "serial:",
        "/dev/ttyACM0:fast",
        "/dev/ttyACM0:0",
        "COM3",
    ],
)
def test_a_wrong_address_is_refused_in_one_line_with_a_right_one(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_transport(text)
    message = str(caught.value)
    assert f"`{text}`" in message
    assert "\n" not in message
    example = message.rsplit("for example ", 1)[1]
    parse_transport(example)


def test_ipv6_is_named_as_the_reason() -> None:
    with pytest.raises(ConfigError, match="IPv6 is not supported"):
        parse_transport("udp:[::1]:14550")


@pytest.mark.parametrize(
    ("text", "is_exposed"),
    [
        ("udp:127.0.0.1:14550", False),
        ("udp:127.9.9.9:14550", False),
        ("udp::14550", False),
        ("udp:LocalHost:14550", False),
        ("udp:0.0.0.0:14550", True),
        ("udpin:192.168.1.7:14550", True),
        ("udp:drone.local:14550", True),
        ("tcpin:0.0.0.0:5760", True),
        ("tcpin:127.0.0.1:5760", False),
        ("udpout:192.168.1.7:14580", False),
        ("tcp:192.168.1.7:5760", False),
        ("serial:/dev/ttyACM0", False),
        ("pty:/tmp/vehicle", False),
    ],
)
def test_only_a_link_that_listens_beyond_this_machine_is_exposed(
    text: str, is_exposed: bool
) -> None:
    assert exposed(parse_transport(text)) is is_exposed
