"""`sim-link radio --as NAME --to URL`: what a real radio would print, and where it goes."""

from __future__ import annotations

import asyncio
import json
import math
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ConfigError
from companion.io.links.transports import Pty, TcpServer, UdpConnect
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.scenario import PayloadParams
from sim_link.cli import main
from sim_link.emulators.catalogue import EMULATORS, check_emitters, kind_of, make_emulator
from sim_link.lab.radio_follower import FOLLOW, SEND, RadioFollower
from sim_link.lab.radio_outlets import HttpLink, PageAddress, parse_outlet, parse_page
from sim_link.world.environment import ChannelParams, Emitter, EmitterParams
from sim_link.world.radio_channel import AntennaModelParams

ROOT = Path(__file__).resolve().parents[4]
PEER = ("127.0.0.1", 14580)
EVERYTHING = PayloadParams()


class Ridden:
    """A radio on a vehicle whose position is given; emulated, or RADIO_RANGING."""

    def __init__(self, name: str | None, payload: PayloadParams = EVERYTHING) -> None:
        emulator = None if name is None else make_emulator(name, 3, 100.0)
        emitters = [Emitter(EmitterParams(emitter_id=7))]
        rng = np.random.default_rng(3)
        self.radio = RadioFollower(payload, ChannelParams(), emitters, rng, emulator=emulator)
        self._vehicle = MavCodec(42, 1)
        self.send(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))

    def send(self, message: Message, now_s: float = 0.0) -> None:
        self.radio.receive(Chunk(FOLLOW, self._vehicle.encode(message), PEER), now_s)

    def move(self, east: float, north: float, up: float, stamp_s: float) -> None:
        moved = (round(1e3 * stamp_s), north, east, -up, 0, 0, 0)
        self.send(mavlink.MAVLink_local_position_ned_message(*moved), stamp_s)

    def printed(self) -> bytes:
        return b"".join(chunk.data for chunk in self.radio.take_output() if chunk.link == SEND)


def fly(ridden: Ridden, rounds: int = 20) -> None:
    for step in range(rounds):
        ridden.move(10.0 + step, 20.0, 15.0, 1.0 + 0.1 * step)


def test_what_is_printed_was_drawn_as_radio_ranging_is() -> None:
    plain, emulated = Ridden(None), Ridden("ndjson")
    fly(plain)
    fly(emulated)
    reader = MavCodec(0, 0)
    messages = [
        message
        for chunk in plain.radio.take_output()
        for message in reader.decode(chunk.data)
        if isinstance(message, MAVLink_radio_ranging_message)
    ]
    lines = [json.loads(line) for line in emulated.printed().splitlines()]
    assert len(messages) == len(lines) == 20
    for message, line in zip(messages, lines, strict=True):
        assert line["range"] == pytest.approx(message.range, rel=1e-6)
        assert math.remainder(line["bearing"] - message.bearing, 2.0 * math.pi) == pytest.approx(
            0.0, abs=1e-6
        )
        assert line["emitter_id"] == message.emitter_id


def test_a_bearing_of_the_world_is_printed_from_the_nose() -> None:
    plain, emulated = Ridden("ndjson"), Ridden("kraken")
    for ridden in (plain, emulated):
        ridden.send(mavlink.MAVLink_attitude_message(900, 0.0, 0.0, 1.0, 0, 0, 0))
        ridden.move(10.0, 20.0, 15.0, 1.0)
    north_rad = json.loads(plain.printed())["bearing"]
    clockwise_deg = float(emulated.printed().split(b", ")[1])
    off_deg = math.remainder(clockwise_deg - math.degrees(north_rad - 1.0), 360.0)
    assert off_deg == pytest.approx(0.0, abs=0.5)


def test_it_asks_for_the_attitude_and_beats_no_heart_on_the_radios_line() -> None:
    ridden = Ridden("nlink_aoa")
    ridden.radio.handle_timer(0.5)
    chunks = ridden.radio.take_output()
    assert {chunk.link for chunk in chunks} == {FOLLOW}
    messages = [message for chunk in chunks for message in MavCodec(0, 0).decode(chunk.data)]
    asked = [int(message.to_dict()["param1"]) for message in messages]
    assert mavlink.MAVLINK_MSG_ID_ATTITUDE in asked


def test_it_boots_once_and_answers_what_it_is_reported() -> None:
    ridden = Ridden("pans")
    ridden.radio.handle_timer(0.5)
    ridden.radio.handle_timer(1.5)
    assert ridden.printed().count(b"dwm> ") == 1
    ridden.radio.receive(Chunk(SEND, b"\r\r"), 2.0)
    assert ridden.printed() == b"\r\ndwm> \r\ndwm> "
    ridden.move(10.0, 20.0, 15.0, 3.0)
    assert ridden.printed().startswith(b"DIST,1,AN0,0007,")
    ridden.radio.receive(Chunk(SEND, b"lec\r"), 4.0)
    ridden.printed()
    ridden.move(10.0, 20.0, 15.0, 5.0)
    assert ridden.printed() == b""


def test_a_tag_with_tlv_answers_each_question_with_its_latest_and_is_silent_otherwise() -> None:
    ridden = Ridden("pans_tlv")
    fly(ridden, 2)
    assert ridden.printed() == b""
    ridden.radio.receive(Chunk(SEND, b"\x0c"), 3.0)
    assert ridden.printed() == b""
    ridden.radio.receive(Chunk(SEND, b"\x00\x0c\x00"), 3.1)
    answers = ridden.printed()
    assert len(answers) == 2 * 41
    assert answers[:41] == answers[41:]
    assert answers[:5] == b"\x40\x01\x00\x41\x0d"
    assert answers[18:23] == b"\x49\x15\x01\x07\x00"
    ridden.radio.receive(Chunk(SEND, b"\x15\x02\x01\x02\x0c\x00"), 3.2)
    assert ridden.printed() == b"\x40\x01\x01" + answers[:41]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("fira_uci", b"\x07\x00\x21\xff\xff\xff"),
        ("qorvo_cli", b'[mac_address=0x0007, status="RX_TIMEOUT"]}'),
        ("esp32_ftm", b"FTM procedure with Peer(02:00:00:00:00:07) failed! (Status - 5)"),
        ("iw_ftm", b"FTM failed: NO_RESPONSE (1)"),
        ("android_rtt", b",02:00:00:00:00:07,0,0,-127,8,0"),
        ("makerfabs_at", b"range:(0,0,0,0,0,0,0,0)"),
        ("sx1280", b"NotValid,Irq,"),
        ("srsran", b'"ta_ns":0.0'),
    ],
)
def test_it_reports_a_missing_answer_in_its_own_way(name: str, said: bytes) -> None:
    ridden = Ridden(name)
    ridden.move(10.0, 20.0, 1.0, 1.0)
    assert said in ridden.printed()
    assert ridden.radio.measurements == 0


def test_an_array_prints_what_its_antenna_measured() -> None:
    ridden = Ridden("pdoa_js", PayloadParams(antenna=AntennaModelParams(kind="line")))
    ridden.move(50.0, 20.0, 20.0, 1.0)
    frame = json.loads(ridden.printed()[6:])["TWR"]
    assert math.hypot(frame["Xcm"], frame["Ycm"]) == pytest.approx(frame["D"], abs=1.0)


@pytest.mark.parametrize(
    ("text", "outlet"),
    [
        ("pty:/tmp/uwb", Pty("/tmp/uwb")),
        ("udpout:127.0.0.1:14700", UdpConnect("127.0.0.1", 14700)),
        ("tcpin:127.0.0.1:14700", TcpServer("127.0.0.1", 14700)),
    ],
)
def test_an_outlet_is_an_address(text: str, outlet: object) -> None:
    assert parse_outlet(text, kind_of("kraken")) == outlet


@pytest.mark.parametrize(
    "text",
    ["http:127.0.0.1:8081", "http://127.0.0.1:8081/", "http://127.0.0.1:8081/DOA_value.html"],
)
def test_a_page_is_a_host_and_a_port(text: str) -> None:
    assert parse_page(text, kind_of("kraken")) == PageAddress("127.0.0.1", 8081, "/DOA_value.html")
    assert str(parse_outlet(text, kind_of("kraken"))) == "http:127.0.0.1:8081"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("kraken", "http:127.0.0.1", "give http:HOST:PORT"),
        ("kraken", "udp:127.0.0.1:14700", "give udpout:HOST:PORT"),
        ("nlink_aoa", "http:127.0.0.1:80", "is not polled"),
        ("nlink_aoa", "ws:127.0.0.1:80", "has no web socket"),
        ("kraken_ws", "tcpin:127.0.0.1:80", "is a web socket; give ws:HOST:PORT"),
        ("kraken_ws", "ws:127.0.0.1", "give ws:HOST:PORT"),
        ("pans_tlv", "stdout:", "only answers"),
        ("pans_tlv", "udpout:127.0.0.1:14700", "only answers"),
        ("kraken", "carrier-pigeon", "stdout:"),
    ],
)
def test_a_wrong_outlet_is_refused_in_a_line(name: str, text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as refused:
        parse_outlet(text, kind_of(name))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--as", "kraken"), "where to? give --to URL"),
        (("--as", "krakn", "--to", "stdout:"), "no such radio; known are "),
        (("--to", "stdout:"), "give --as NAME"),
        (("--clock", "5"), "give --as NAME"),
        (("--as", "kraken", "--to", "stdout:", "--send-to", "127.0.0.1:9"), "RADIO_RANGING"),
        (("--as", "oai", "--to", "stdout:", *2 * ("--emitter", "47.4,8.5")), "room for 1"),
    ],
)
def test_bad_options_end_with_one_line_and_2(
    options: tuple[str, ...], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["radio", "--follow", "udpin:127.0.0.1:14930", *options]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1


def test_a_format_that_cannot_name_an_emitter_says_so() -> None:
    with pytest.raises(ConfigError, match="names emitters 0 to 254, not 300"):
        check_emitters(EMULATORS["nlink_aoa"], [300])


def test_a_document_is_there_once_there_is_one_and_nowhere_else() -> None:
    async def play() -> list[tuple[int, bytes]]:
        link = HttpLink(PageAddress("127.0.0.1", 0, "/doa.xml"), 1)
        await link.open()
        base = f"http://127.0.0.1:{link.local_address[1]}"
        seen = [await asyncio.to_thread(ask, f"{base}/doa.xml")]
        link.send(Chunk(1, b"first"))
        link.send(Chunk(1, b"second"))
        paths = ("/doa.xml", "/doa.xml?t=1", "/", "/other")
        seen += [await asyncio.to_thread(ask, base + path) for path in paths]
        link.close()
        return seen

    found, missing = (200, b"second"), (404, b"not found\n")
    assert asyncio.run(play()) == [missing, found, found, found, missing]


def ask(url: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(url, timeout=10.0) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()
