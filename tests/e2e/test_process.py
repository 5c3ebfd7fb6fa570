"""The companion as a process: killed, doubled, supervised, on a host that fails; few and short."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import pytest

from companion.guidance.phases import Phase
from companion.io.checkpoints import CheckpointError, decode_checkpoint
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.e2e.simulator_process import PATIENCE_S, running_simulator

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "companion"]
SPEED = 1.0
"""Faster, a stall of a busy machine lasts so much longer for the companion, which then waits."""
PX4_OFFBOARD = 6
GROUNDED = (Phase.WAITING, Phase.STANDBY, Phase.LAUNCHING)
STOP_S = 20.0
"""Time limit of a stop, which takes two seconds on an idle machine."""

RESTART_S = 2.0
"""Processor time from the start to the first heartbeat: so long the vehicle is alone."""


class Companion:
    """One companion process; what it says is read by a thread, so that it can be waited for."""

    started: ClassVar[list[Companion]] = []
    """Not closed yet."""

    def __init__(
        self,
        directory: Path,
        port: int,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        max_file_bytes: int | None = None,
    ) -> None:
        def limit_files() -> None:
            if max_file_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (max_file_bytes, max_file_bytes))

        state = {"XDG_STATE_HOME": str(directory / "state")}
        url = f"udp:127.0.0.1:{port}"
        self.process = subprocess.Popen(
            [*COMMAND, "--connect", url, "--speed", f"{SPEED:g}", *arguments],
            cwd=directory,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **state, **(environment or {})},
            preexec_fn=limit_files,
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.started.append(self)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip("\n"))

    def said(self, part: str) -> bool:
        return any(part in line for line in self.lines)

    def wait_for(self, part: str) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.said(part):
            assert time.monotonic() < deadline_s, "\n".join(self.lines)
            assert self.process.poll() is None, "\n".join(self.lines)
            time.sleep(0.01)

    def end(self, number: signal.Signals) -> float:
        """Send a signal; how many seconds the process took to end."""
        began_s = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(PATIENCE_S)
        took_s = time.monotonic() - began_s
        self.close()
        return took_s

    def processor_s(self) -> float:
        """Return the processor time that the process took until now, of user and system."""
        status = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(status[11]) + int(status[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        self.started.remove(self)
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stderr is not None
        self.process.stderr.close()

    def events(self, directory: Path) -> list[dict[str, object]]:
        newest = max(directory.glob("flights/*/events.jsonl"))
        return [json.loads(line) for line in newest.read_text().splitlines()]


@pytest.fixture(autouse=True)
def nobody_is_left() -> Iterator[None]:
    """End all processes of a test that fails half-way, and the threads that wait for them."""
    yield
    for companion in list(Companion.started):
        companion.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "auto.yaml").write_text("mission: {engage: auto}\n")
    return tmp_path


@pytest.fixture
def port() -> Iterator[int]:
    with running_simulator("px4", SPEED, bears_s=10.0) as opened:
        yield opened


def wait_until(condition: Callable[[], bool], otherwise: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, otherwise
        time.sleep(0.02)


def has_kept_a_belief(folder: Path) -> bool:
    """Return True if a checkpoint has an estimate for the next companion."""
    for path in folder.glob("state/companion/[!.]*.checkpoint-[01]"):  # whole ones
        with suppress(OSError, CheckpointError):
            memory = decode_checkpoint(path.read_bytes()).memory
            if memory.belief is not None and memory.phase not in GROUNDED:
                return True
    return False


def await_failsafe(port: int) -> None:
    """Listen in the companion's place until the autopilot has left OFFBOARD."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", port))
        listening.settimeout(PATIENCE_S)
        codec = MavCodec(1, 191)
        while not any(map(has_left_offboard, codec.decode(listening.recv(65_535)))):
            pass


def has_left_offboard(message: Message) -> bool:
    return (
        isinstance(message, mavlink.MAVLink_heartbeat_message)
        and message.get_srcComponent() == 1
        and message.custom_mode >> 16 & 0xFF != PX4_OFFBOARD
    )


def test_a_killed_companion_is_taken_up_by_the_next_which_never_engages(
    folder: Path, port: int
) -> None:
    first = Companion(folder, port, "--config", "auto.yaml")
    first.wait_for("following the plan")
    wait_until(lambda: has_kept_a_belief(folder), "no belief was kept")
    first.end(signal.SIGKILL)
    await_failsafe(port)
    second = Companion(folder, port, "--config", "auto.yaml")
    second.wait_for("resumed after")
    assert second.processor_s() <= RESTART_S
    second.wait_for("estimate resumed")
    time.sleep(2.0)
    assert second.end(signal.SIGTERM) < STOP_S
    assert second.process.returncode == 0
    assert not second.said("in control")
    assert not second.said("  launching")
    requests = [event for event in second.events(folder) if event["kind"] == "answer"]
    assert requests == []
    fresh = Companion(folder, port, "--fresh")
    fresh.wait_for("autopilot heard")
    fresh.end(signal.SIGTERM)
    assert not fresh.said("resumed")


def test_a_second_companion_on_a_link_ends_with_one_line(folder: Path, port: int) -> None:
    first = Companion(folder, port)
    first.wait_for("waiting for an autopilot")
    second = Companion(folder, port)
    assert second.process.wait(PATIENCE_S) == 2
    second.close()
    assert second.lines == [
        f"companion: udp 127.0.0.1:{port}: another companion (process {first.process.pid}) has "
        "this vehicle; stop it, or choose another link or vehicle.system_id"
    ]
    first.end(signal.SIGTERM)
    assert first.process.returncode == 0


def test_a_disk_that_takes_no_more_costs_the_log_and_not_the_flight(
    folder: Path, port: int
) -> None:
    companion = Companion(folder, port, max_file_bytes=20_000)
    companion.wait_for("log entries lost")
    companion.wait_for("ready: switch to")
    assert companion.end(signal.SIGTERM) < STOP_S
    assert companion.process.returncode == 1
    (line,) = (line for line in companion.lines if "lost to a slow or full disk" in line)
    assert re.search(r"[0-9]+ entries of flight\.tlog after [0-9]+ s", line)
    assert all(path.stat().st_size <= 20_000 for path in folder.glob("flights/*/*"))


def test_the_service_manager_hears_that_it_is_ready_alive_and_stopping(
    folder: Path, port: int
) -> None:
    name = f"companion-e2e-{os.getpid()}"
    heard: list[str] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name}")
        manager.settimeout(PATIENCE_S)
        environment = {"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": "2000000"}
        companion = Companion(folder, port, environment=environment)
        while heard.count("WATCHDOG=1") < 6 or "STATUS=standby" not in heard:
            heard.append(manager.recv(4096).decode())
        companion.process.send_signal(signal.SIGTERM)
        while heard[-1] != "STOPPING=1":
            heard.append(manager.recv(4096).decode())
    companion.process.wait(PATIENCE_S)
    companion.close()
    assert heard[0] == "READY=1"


def test_a_terminal_that_is_not_read_blocks_nothing(folder: Path, port: int) -> None:
    url = f"udp:127.0.0.1:{port}"
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    try:
        while True:
            os.write(writer, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(writer, True)
    with subprocess.Popen(
        [*COMMAND, "--connect", url],
        cwd=folder,
        stderr=writer,
        env={**os.environ, "XDG_STATE_HOME": str(folder / "state")},
    ) as process:
        wait_until(
            lambda: any(folder.glob("state/companion/*.checkpoint-0")), "no checkpoint was kept"
        )
        assert process.poll() is None
        began_s = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
        assert time.monotonic() - began_s < STOP_S
    os.close(reader)
    os.close(writer)
