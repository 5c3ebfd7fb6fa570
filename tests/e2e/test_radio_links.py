"""Radios on real ports, pages, programs and files: what they bring, how they end and come back."""

from __future__ import annotations

import http.server
import logging
import os
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest

from companion.errors import LinkError
from companion.io.links.transports import Transport, radio_link
from companion.io.radio_recording import (
    RadioBytes,
    RadioRecordingWriter,
    RecordedRadio,
    RecordingHeader,
)
from companion.io.shell import Shell
from companion.link.interface import RadioSettings, RadioSetup
from companion.link.radio_stage import RadioStage
from companion.mav.endpoint import Chunk
from companion.radios.decoder import LineDecoder, Poll, RadioKind, RadioReading
from tests.e2e.shell_helpers import drive, until

pytestmark = pytest.mark.slow


class Metres(LineDecoder):
    """A number a line; asks for it by `go`."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        del received_s
        return [RadioReading(range_m=float(line))] if line else []

    def hello(self) -> bytes:
        return b"go\r"


KIND = RadioKind("metres", Metres, "", "range", "", "serial:115200", poll=Poll("/metres", 0.05))
STREAM = RadioKind("metres", Metres, "", "range", "", "serial:115200")


class Listener:
    """An endpoint with one radio."""

    def __init__(self) -> None:
        self.stage = RadioStage(RadioSetup(STREAM, RadioSettings(rate_max_hz=None)))
        self.ranges_m: list[float] = []
        self.is_finished = False
        self.ticks = 0
        self._due_s = 0.0

    def receive(self, chunk: Chunk, now_s: float) -> None:
        found = self.stage.receive(chunk.data, now_s)
        self.ranges_m += [m.range_m for m in found if m.range_m is not None]

    def handle_timer(self, now_s: float) -> None:
        self.ticks += 1
        self._due_s = now_s + 0.02

    def next_timer_s(self) -> float:
        return self._due_s

    def take_output(self) -> list[Chunk]:
        return []

    def request_stop(self, now_s: float) -> None:
        del now_s
        self.is_finished = True


def at(url: str, kind: RadioKind = STREAM) -> list[Transport]:
    return [radio_link(RadioSetup(kind, RadioSettings()), url).transport]


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Iterator[list[str]]:
    """Yield the texts to the operator about links."""
    texts: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            texts.append(record.getMessage())

    handler = Keep()
    logger = logging.getLogger("companion.io")
    logger.addHandler(handler)
    level, logger.level = logger.level, logging.INFO
    with caplog.at_level(logging.INFO, "companion.io"):
        yield texts
    logger.level = level
    logger.removeHandler(handler)


def open_pty(name: Path) -> int:
    master, slave = os.openpty()
    tty.setraw(slave)
    name.unlink(missing_ok=True)
    name.symlink_to(os.ttyname(slave))
    os.close(slave)
    return master


def test_a_serial_radio_is_greeted_and_again_once_it_is_plugged_in_again(
    listener: Listener, said: list[str], tmp_path: Path
) -> None:
    name = tmp_path / "radio"
    first = open_pty(name)

    async def scene(shell: Shell) -> None:
        assert os.read(first, 100) == b"go\r"
        os.write(first, b"1.5\n2.")
        await until(lambda: listener.ranges_m == [1.5])
        os.close(first)
        await until(lambda: listener.stage.lost == 1)
        second = open_pty(name)
        os.set_blocking(second, False)
        await until(lambda: shell.links[0].counters.reconnects == 1)
        await until(lambda: len(said) >= 3)
        assert os.read(second, 100) == b"go\r"
        os.write(second, b"3.5\n")
        await until(lambda: len(listener.ranges_m) == 2)
        os.close(second)

    drive(listener, at(str(name)), scene)
    assert listener.ranges_m == [1.5, 3.5]
    assert [text for text in said if "lost" in text][:1] == said[1:2]


def test_a_serial_port_that_is_not_there_is_refused_at_the_start(listener: Listener) -> None:
    async def scene(shell: Shell) -> None:
        raise AssertionError(shell)

    with pytest.raises(LinkError, match="no such device"):
        drive(listener, at("/dev/ttyNOWHERE"), scene)


def test_a_service_waits_for_a_port_that_is_plugged_in_later(
    listener: Listener, said: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At boot a device is often late, and after a crash a radio may be pulled out just now."""
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
    name = tmp_path / "radio"

    async def scene(shell: Shell) -> None:
        await until(lambda: listener.ticks > 5)
        assert shell.links[0].is_open
        port = open_pty(name)
        await until(lambda: len(said) == 2)
        os.write(port, b"2.5\n")
        await until(lambda: listener.ranges_m == [2.5])
        os.close(port)

    drive(listener, at(str(name)), scene)
    assert said[0].startswith(f"serial {name}: not available yet (")
    assert said[1] == f"serial {name}: connected"


class Page(http.server.BaseHTTPRequestHandler):
    """Server that answers with a number that counts up; its status and delay are set."""

    protocol_version = "HTTP/1.1"
    status = 200
    hangs_s = 0.0
    connections: ClassVar[set[tuple[str, int]]] = set()
    paths: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        kind = type(self)
        kind.connections.add(self.client_address)
        kind.paths.append(self.path)
        time.sleep(kind.hangs_s)
        body = str(float(len(kind.paths))).encode()
        self.send_response(kind.status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        del arguments


@pytest.fixture
def page() -> Iterator[tuple[type[Page], int]]:
    Page.status, Page.hangs_s = 200, 0.0
    Page.connections.clear()
    Page.paths.clear()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield Page, server.server_address[1]
    server.shutdown()
    server.server_close()


def test_a_page_is_polled_over_one_connection_and_an_error_is_said_once(
    listener: Listener, said: list[str], page: tuple[type[Page], int]
) -> None:
    kind, port = page

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) > 5)
        assert len(kind.connections) == 1
        kind.status = 500
        count = len(kind.paths)
        await until(lambda: len(kind.paths) > count + 5)
        assert listener.stage.lost == 1
        kind.status = 200
        heard = len(listener.ranges_m)
        await until(lambda: len(listener.ranges_m) > heard)

    drive(listener, at(f"http://127.0.0.1:{port}", KIND), scene)
    assert set(kind.paths) == {"/metres"}
    assert len([text for text in said if "lost (HTTP 500" in text]) == 1
    assert len([text for text in said if "available again" in text]) == 1


def test_a_server_that_closes_idle_connections_is_no_loss(
    listener: Listener, said: list[str], page: tuple[type[Page], int]
) -> None:
    kind, port = page
    kind.timeout = 0.02

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(kind.connections) > 3)

    drive(listener, at(f"http://127.0.0.1:{port}", KIND), scene)
    kind.timeout = None
    assert said == []


def test_a_page_that_hangs_holds_up_no_tick(
    listener: Listener, page: tuple[type[Page], int]
) -> None:
    kind, port = page
    kind.hangs_s = 1.0

    async def scene(shell: Shell) -> None:
        await until(lambda: bool(kind.paths))
        ticks = listener.ticks
        await until(lambda: listener.ticks > ticks + 20)
        assert listener.ranges_m == []
        assert shell.timing.stalls == 0

    drive(listener, at(f"http://127.0.0.1:{port}", KIND), scene)


def test_a_program_is_read_run_again_and_ends_with_us(
    listener: Listener, said: list[str], tmp_path: Path
) -> None:
    mark = tmp_path / "pids"
    command = f"echo $$ >> {mark}; echo 4.5; sleep 0.1; echo no more >&2; exit 3"

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) >= 2)

    drive(listener, at(f"exec:{command}"), scene)
    assert set(listener.ranges_m) == {4.5}
    assert listener.stage.lost >= 1
    assert "lost (ended with 3: no more)" in said[0]


def test_a_program_that_would_go_on_for_ever_is_ended(listener: Listener, tmp_path: Path) -> None:
    mark = tmp_path / "pid"

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) == 1)

    drive(listener, at(f"exec:echo $$ > {mark}; echo 1.0; while true; do sleep 1; done"), scene)
    _wait_for_end(int(mark.read_text()))


def test_a_program_ends_even_where_the_companion_is_killed(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    source = (
        "import asyncio, sys\n"
        "from companion.io.links.stream_links import ExecLink\n"
        "async def run():\n"
        "    link = ExecLink(sys.argv[1], None, 0, lambda chunks: print('heard', flush=True))\n"
        "    await link.open()\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(run())\n"
    )
    command = f"echo $$ > {mark}; echo 1.0; while true; do sleep 1; done"
    child = subprocess.Popen(
        [sys.executable, "-c", source, command], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "heard\n"
    child.kill()
    child.wait()
    child.stdout.close()
    _wait_for_end(int(mark.read_text()))


def _wait_for_end(pid: int) -> None:
    """Wait until a process has ended; a zombie that is not reaped has ended, too."""
    until_s = time.monotonic() + 20.0
    while time.monotonic() < until_s:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return
        except OSError:
            return
        time.sleep(0.02)
    raise AssertionError(f"process {pid} lives on")


def test_a_program_that_says_nothing_is_complained_about_once(
    listener: Listener, said: list[str]
) -> None:
    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: listener.stage.lost >= 2)

    drive(listener, at("exec:nonsense_of_a_program; exit 127"), scene)
    (text,) = [text for text in said if "lost" in text]
    assert "nonsense_of_a_program" in text
    assert "not found" in text


def test_a_program_that_prints_and_ends_at_once_is_lost_once_and_run_ever_more_rarely(
    listener: Listener, said: list[str], tmp_path: Path
) -> None:
    ill = tmp_path / "ill"
    ill.touch()
    command = f"echo 4.5; [ -e {ill} ] && exit 3; while true; do sleep 0.2; echo 5.5; done"

    async def scene(shell: Shell) -> None:
        await until(lambda: listener.stage.lost >= 3)
        assert shell.links[0].counters.reconnects == 0
        ill.unlink()
        await until(lambda: shell.links[0].counters.reconnects == 1)

    drive(listener, at(f"exec:{command}"), scene)
    assert listener.ranges_m[:4] == [4.5] * 4
    assert [text.rpartition(": ")[2].partition(" (")[0] for text in said] == [
        "lost",
        "available again",
    ]


def test_a_program_that_is_not_there_is_refused_at_the_start(listener: Listener) -> None:
    async def scene(shell: Shell) -> None:
        raise AssertionError(shell)

    with pytest.raises(LinkError, match="no program `nonsense_of_a_program`"):
        drive(listener, at("exec:nonsense_of_a_program --fast"), scene)


def test_a_program_that_is_asked_periodically_is_never_lost(
    listener: Listener, said: list[str]
) -> None:
    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) >= 4)

    drive(listener, at("exec:echo 7.5", KIND), scene)
    assert said == []


def test_a_file_is_followed_from_its_end_and_when_it_is_begun_again(
    listener: Listener, tmp_path: Path
) -> None:
    path = tmp_path / "log.txt"
    path.write_text("1.0\n2.0\n")

    async def scene(shell: Shell) -> None:
        del shell

        def add_until_heard() -> bool:
            with path.open("a") as file:
                file.write("3.0\n")
            return bool(listener.ranges_m)

        await until(add_until_heard)
        path.unlink()
        path.write_text("4.0\n")
        await until(lambda: 4.0 in listener.ranges_m)

    drive(listener, at(f"file:{path}"), scene)
    assert set(listener.ranges_m) == {3.0, 4.0}


def test_a_file_is_played_back_line_by_line(listener: Listener, tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("1.0\n2.0\n3.0\n")

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) == 3)

    drive(listener, at(f"file:{path}?play=20"), scene)
    assert listener.ranges_m == [1.0, 2.0, 3.0]


def test_a_recording_is_played_back_in_its_times(listener: Listener, tmp_path: Path) -> None:
    path = tmp_path / "radio.jsonl"
    radios = (RecordedRadio(name="other", url=""), RecordedRadio(name="metres", url=""))
    with RadioRecordingWriter(path, RecordingHeader(started_unix_s=0.0, radios=radios)) as writer:
        for number in range(4):
            writer.write(RadioBytes(100.0 + number, number % 2, f"{number}.0\n".encode()))

    async def scene(shell: Shell) -> None:
        del shell
        await until(lambda: len(listener.ranges_m) == 2)

    drive(listener, at(f"file:{path}?play=50"), scene)
    assert listener.ranges_m == [1.0, 3.0]


def test_a_udp_radio_is_heard_line_by_line(listener: Listener) -> None:
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
    probe.close()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    async def scene(shell: Shell) -> None:
        del shell
        sender.sendto(b"1.0\n2.0\n", ("127.0.0.1", port))
        await until(lambda: listener.ranges_m == [1.0, 2.0])

    drive(listener, at(f"udp:127.0.0.1:{port}"), scene)
    sender.close()
