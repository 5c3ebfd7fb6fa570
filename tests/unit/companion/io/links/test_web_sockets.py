"""A web socket as a stream, over real sockets of this machine."""

from __future__ import annotations

import asyncio
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import pytest
from websockets.sync.server import Server, ServerConnection, serve

from companion.config.radios import RadioConfig, radio_setup
from companion.domain import RangingMeasurement
from companion.errors import ConfigError
from companion.io.links.transports import OwnLine, radio_link
from companion.io.links.waiting_links import WebSocketLink, on_the_wire
from companion.link.radio_stage import RadioStage
from companion.mav.endpoint import Chunk
from tests.ports import free_port

LOOP_IS_OFF = {"loop_is_off": True, "numerology": 1}
SHORT, LONG = bytes(range(100)), bytes(70_000)


@contextmanager
def served(port: int, heard: list[str], context: ssl.SSLContext | None = None) -> Iterator[Server]:
    """Two text lines are heard, then three messages are sent and the client is left waiting."""

    def answer(connection: ServerConnection) -> None:
        heard.extend(str(connection.recv()) for _ in range(2))
        for message in ("one\n", SHORT, LONG):
            connection.send(message)
        for _ in connection:
            pass

    with serve(answer, "127.0.0.1", port, ssl=context) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


async def received(url: str, expected: int) -> bytes:
    data = bytearray()

    def take(chunks: list[Chunk]) -> None:
        data.extend(b"".join(chunk.data for chunk in chunks))

    link = WebSocketLink(url, 0, take)
    link.greeting, link.signals_loss = b"AUTH:x\nSUBSCRIBE:FFT,DOA\n", True
    await link.open()
    async with asyncio.timeout(15.0):
        while len(data) < expected:
            await asyncio.sleep(0.02)
    link.close()
    return bytes(data)


EXPECTED = b"one\n" + on_the_wire(SHORT) + on_the_wire(LONG)


def test_messages_become_lines_and_frames_and_the_greeting_is_sent_line_by_line() -> None:
    port, heard = free_port(), list[str]()
    with served(port, heard):
        data = asyncio.run(received(f"ws://127.0.0.1:{port}/ws", len(EXPECTED)))

    assert data == EXPECTED
    assert heard == ["AUTH:x", "SUBSCRIBE:FFT,DOA"]


def test_a_certificate_that_the_device_signed_itself_is_accepted(tmp_path: Path) -> None:
    key, certificate = tmp_path / "server.key", tmp_path / "server.crt"
    words = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=kraken"]
    made = ["openssl", *words, "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(made, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    port, heard = free_port(), list[str]()
    with served(port, heard, context):
        data = asyncio.run(received(f"wss://127.0.0.1:{port}/ws", len(EXPECTED)))

    assert data == EXPECTED


def test_a_socket_that_is_not_there_yet_is_tried_again() -> None:
    port, heard = free_port(), list[str]()

    async def late() -> bytes:
        waiting = asyncio.create_task(received(f"ws://127.0.0.1:{port}/ws", len(EXPECTED)))
        await asyncio.sleep(0.5)
        with served(port, heard):
            return await waiting

    assert asyncio.run(late()) == EXPECTED


def test_a_stations_metrics_are_asked_for_and_read() -> None:
    """srsRAN Project sends a document a message."""
    port, setup = free_port(), radio_setup(RadioConfig(name="srsran", options=LOOP_IS_OFF), "test")
    document = (
        '{"timestamp":1718000000.0,"cells":[{"ue_list":[{"ue":0,"rnti":17921,"ta_ns":520.8}]}]}'
    )
    asked: list[str] = []

    def answer(connection: ServerConnection) -> None:
        asked.append(str(connection.recv()))
        connection.send(document)
        for _ in connection:
            pass

    async def heard() -> list[RangingMeasurement]:
        stage, found = RadioStage(setup), list[RangingMeasurement]()
        line = radio_link(setup, f"ws://127.0.0.1:{port}").transport
        assert isinstance(line, OwnLine)
        link = line.make(0, lambda chunks: found.extend(stage.receive(chunks[0].data, 1.0)))
        await link.open()
        async with asyncio.timeout(15.0):
            while not found:
                await asyncio.sleep(0.02)
        link.close()
        return found

    with serve(answer, "127.0.0.1", port) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        (measurement,) = asyncio.run(heard())
        server.shutdown()
        thread.join()

    assert asked == ['{"cmd":"metrics_subscribe"}']
    assert measurement.range_m == pytest.approx(78.07, abs=0.01)


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("192.168.1.10", "wss://192.168.1.10:8080/ws"),
        ("wss://192.168.1.10:8080", "wss://192.168.1.10:8080/ws"),
        ("ws://127.0.0.1:9000/other", "ws://127.0.0.1:9000/other"),
    ],
)
def test_an_address_is_completed_as_the_radio_has_it(url: str, address: str) -> None:
    setup = radio_setup(RadioConfig(name="kraken_ws"), "test")

    assert str(radio_link(setup, url).transport) == address


def test_an_address_without_a_host_shows_a_right_one() -> None:
    setup = radio_setup(RadioConfig(name="kraken_ws"), "test")

    with pytest.raises(ConfigError, match=r"wss://192\.168\.1\.10:8080/ws"):
        radio_link(setup, "wss://")
