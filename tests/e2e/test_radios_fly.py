"""Every radio's own bytes, flown: `sim-link`, `sim-link radio --as ...`, `companion --radio ...`.

Real processes and real serial ports, sockets, pages, files and pipes: one of each in the slow
tests, all formats in the campaign. That the estimate is that of RADIO_RANGING to the format's step
is shown in lockstep, where nothing else differs (tests/loop/test_emulated_radios.py); here the
emitter is localised, and as well as it is said.
"""

from __future__ import annotations

import http.server
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from companion.domain import Params
from tests.ports import free_port
from tests.radio_flights import as_flown, setup_name, setup_of, sigmas
from tests.radio_formats import ALL, CELLS, FORMAT_OF, ONE_OF_EACH_LINE, Format

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
SPEED = float(os.environ.get("RADIO_SPEED", "3"))
SPEED_OF_BEARINGS = 0.5 * SPEED
"""Faster, a busy machine has stalls that end a launch; bearings alone cost more to work out."""
FLIGHT_S = 480.0 / SPEED
"""Wall seconds: a cell's steps take some five minutes of the flight."""
FIGURES = os.environ.get("RADIO_FIGURES")
"""A file to which each format's error and R95 are appended."""
POLL_S = 0.03
"""Period of polls: that of new readings at this speed."""
BY_PAGE = ("kraken", "kraken_suite", "kraken_xml")
BY_SOCKET = ("kraken_ws",)
BY_UDP = ("ndjson", "nlink_iot", "makerfabs_at", "lora_forwarder", "uavrt")
BY_TCP = ("lines", "srsran", "pans", "things_stack")
BY_FILE = ("android_rtt", "oai")
BY_PROGRAM = ("iw_ftm", "srsran_4g", "wifi_scan", "ble_scan", "chirpstack")
"""All others are plugged into a serial port."""


class Process:
    """One command; what it says is kept by a thread."""

    def __init__(self, directory: Path, *words: str, output: Path | None = None) -> None:
        with open(os.devnull if output is None else output, "ab") as stream:
            self.process = subprocess.Popen(
                [BIN / words[0], *words[1:]],
                cwd=directory,
                stdin=subprocess.DEVNULL,
                stdout=stream if output is not None else subprocess.PIPE,
                stderr=subprocess.PIPE if output is not None else subprocess.STDOUT,
                text=True,
                env={**os.environ, "XDG_STATE_HOME": str(directory / "state")},
            )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        stream = self.process.stdout or self.process.stderr
        assert stream is not None
        for line in stream:
            self.lines.append(line.rstrip("\n"))

    def count(self, part: str) -> int:
        return sum(part in line for line in self.lines)

    def wait_for(self, part: str, count: int = 1) -> None:
        deadline_s = time.monotonic() + FLIGHT_S
        while self.count(part) < count:
            last = "\n".join(self.lines[-20:])
            assert time.monotonic() < deadline_s, f"{part!r} not in time, but\n{last}"
            assert self.process.poll() is None or self.count(part) >= count, last
            time.sleep(0.02)

    def wait_to_end(self) -> None:
        """Assert that the process ends in order and in time."""
        deadline_s = time.monotonic() + FLIGHT_S
        while self.process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert self.process.poll() == 0, "\n".join(self.lines[-30:])

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


class Rig:
    """A vehicle, an emulated radio next to it, and a companion that reads the radio."""

    def __init__(self, directory: Path, format_: Format, to: str, at: str) -> None:
        self.directory, self.format, self.to, self.at = directory, format_, to, at
        self.started: list[Process] = []
        is_by_bearings = format_.range_m is None and format_.azimuth_deg is not None
        self.speed = SPEED_OF_BEARINGS if is_by_bearings else SPEED
        self.setup = setup_of(setup_name(format_))
        self.port, self.follow_port = free_port(), free_port()
        self.radio_words = (
            *("sim-link", "radio", "--follow", f"tcp:127.0.0.1:{self.follow_port}"),
            *("--as", format_.name, "--to", to, "--scenario", "radio.yaml"),
            *("--seed", "1", "--speed", f"{self.speed:g}"),
        )
        self._write()

    def _write(self) -> None:
        scenario, config = self.setup.scenario, self.setup.config
        autopilot = msgspec.structs.replace(
            scenario.autopilot, offboard_loss_timeout_s=60.0, parameters={"COM_DISARM_PRFLT": 60}
        )
        patient = msgspec.structs.replace(scenario, autopilot=autopilot)
        deaf = msgspec.structs.replace(scenario.payload, max_range_m=1e-3)
        write(self.directory / "radio.yaml", patient)
        write(self.directory / "vehicle.yaml", msgspec.structs.replace(patient, payload=deaf))
        format_, emitter_id = self.format, scenario.emitter.emitter_id
        own: dict[str, object] = {"emitter": emitter_id}
        if not format_.names_nobody:
            own = {"emitters": {format_.kind.name_on_wire(emitter_id): emitter_id}}
        if format_.name in BY_PAGE or format_.kind.request:
            own["poll_s"] = POLL_S
        settings = {**own, **sigmas(format_, scenario)}
        radio = {
            "name": format_.radio,
            "settings": settings,
            "options": format_.options_for(emitter_id),
        }
        write(self.directory / "companion.yaml", config, radios=[radio])

    def start(self, *words: str, output: Path | None = None) -> Process:
        process = Process(self.directory, *words, output=output)
        self.started.append(process)
        return process

    def radio(self) -> Process:
        """The radio, for now by hand."""
        output = self.directory / "radio.log" if self.format.name in BY_FILE else None
        process = self.start(*self.radio_words, output=output)
        process.wait_for("sim-link: radio on")
        return process

    def companion(self, *options: str) -> Process:
        companion = self.start(
            *("companion", "--connect", f"udp:127.0.0.1:{self.port}", "--config", "companion.yaml"),
            *("--radio", f"{self.format.radio}@{self.at}", "--speed", f"{self.speed:g}", *options),
        )
        companion.wait_for("waiting for an autopilot")
        return companion

    def vehicle(self) -> Process:
        return self.start(
            *("sim-link", "--seed", "1", "--speed", f"{self.speed:g}"),
            *("--scenario", "vehicle.yaml"),
            *("--listen", f"127.0.0.1:{free_port()}", "--send-to", f"127.0.0.1:{self.port}"),
            *("--link", f"tcpin:127.0.0.1:{self.follow_port}"),
        )

    def result(self) -> dict[str, Any]:
        (path,) = self.directory.glob("flights/*/result.json")
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found

    def end(self) -> None:
        for process in reversed(self.started):
            process.end()


def write(path: Path, record: Params, **others: object) -> None:
    plain = {**msgspec.to_builtins(record), **others}
    path.write_text(yaml.safe_dump(plain), encoding="utf-8")


def rig_of(directory: Path, format_: Format) -> Rig:
    """Return a rig with the kind of line that the radio needs."""
    name, port = format_.name, free_port()
    if name in BY_PAGE:
        return Rig(directory, format_, f"http:127.0.0.1:{port}", f"http://127.0.0.1:{port}")
    if name in BY_SOCKET:
        return Rig(directory, format_, f"ws:127.0.0.1:{port}", f"ws://127.0.0.1:{port}")
    if name in BY_UDP:
        return Rig(directory, format_, f"udpout:127.0.0.1:{port}", f"udp:127.0.0.1:{port}")
    if name in BY_TCP:
        return Rig(directory, format_, f"tcpin:127.0.0.1:{port}", f"tcp:127.0.0.1:{port}")
    if name in BY_FILE:
        return Rig(directory, format_, "stdout:", "file:radio.log")
    rig = Rig(directory, format_, f"pty:{directory}/uwb", f"serial:{directory}/uwb:115200")
    if name in BY_PROGRAM:
        rig = Rig(directory, format_, "stdout:", "")
        rig.at = "exec:" + " ".join((str(BIN / rig.radio_words[0]), *rig.radio_words[1:]))
    return rig


@pytest.fixture
def rigs() -> Iterator[list[Rig]]:
    made: list[Rig] = []
    yield made
    for rig in made:
        rig.end()


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Compile the kernels beforehand, so that it does not count against the time of a flight."""
    code = "from companion.run import compile_kernels; compile_kernels()"
    subprocess.run([sys.executable, "-c", code], check=True)


def every_format() -> list[object]:
    """One of each kind of line always; the others when there is time."""
    return [
        pytest.param(
            as_flown(each),
            id=each.name,
            marks=() if each.name in ONE_OF_EACH_LINE else pytest.mark.campaign,
        )
        for each in ALL
    ]


@pytest.mark.parametrize("format_", every_format())
def test_the_emitter_is_found_by_the_radios_own_bytes(
    format_: Format, tmp_path: Path, rigs: list[Rig]
) -> None:
    rig = rig_of(tmp_path, format_)
    rigs.append(rig)
    if format_.name not in BY_PROGRAM:
        rig.radio()
    companion = rig.companion("--once")
    rig.vehicle()
    companion.wait_to_end()
    result, scenario = rig.result(), rig.setup.scenario
    assert result["emitter_id"] == scenario.emitter.emitter_id
    east, north = scenario.emitter.position_enu_m
    error_m = math.hypot(result["east_m"] - east, result["north_m"] - north)
    if FIGURES is not None:
        with open(FIGURES, "a", encoding="utf-8") as stream:
            stream.write(f"{format_.name} {error_m:.2f} {result['r95_m']:.2f}\n")
    assert error_m <= (1.0 if format_.name in CELLS else 1.5) * result["r95_m"]


@pytest.mark.parametrize("name", ["nlink_aoa", "lines", "kraken"])
def test_a_radio_that_is_unplugged_is_waited_for_and_said_once(
    name: str, tmp_path: Path, rigs: list[Rig]
) -> None:
    """A serial port, a TCP port and a page that are gone, and there again."""
    rig = rig_of(tmp_path, as_flown(FORMAT_OF[name]))
    rigs.append(rig)
    radio, companion = rig.radio(), rig.companion("--once")
    unplug_in_flight(rig, companion, radio.process.terminate, rig.radio)


def test_a_page_that_answers_500_for_a_while_is_a_radio_unplugged(
    tmp_path: Path, rigs: list[Rig]
) -> None:
    rig = rig_of(tmp_path, as_flown(FORMAT_OF["kraken"]))
    rigs.append(rig)
    with Front(rig.at) as front:
        rig.at = front.url
        rig.radio()
        companion = rig.companion("--once")
        unplug_in_flight(rig, companion, front.answers_500.set, front.answers_500.clear)
    assert companion.count("lost (HTTP 500") == 1


def test_a_program_that_ends_in_flight_is_run_again_until_it_is_there(
    tmp_path: Path, rigs: list[Rig]
) -> None:
    """Meanwhile it is started in vain, as for a card that was pulled out."""
    rig = rig_of(tmp_path, as_flown(FORMAT_OF["iw_ftm"]))
    rigs.append(rig)
    gone, pid, command = tmp_path / "gone", tmp_path / "pid", rig.at.removeprefix("exec:")
    rig.at = f"exec:[ -e {gone} ] && echo no such device >&2 && exit 237; "
    rig.at += f"echo $$ > {pid}; exec {command}"

    def pull() -> None:
        gone.touch()
        os.kill(int(pid.read_text()), signal.SIGTERM)

    companion = rig.companion("--once")
    unplug_in_flight(rig, companion, pull, gone.unlink)
    assert companion.count("no such device") == 1


def unplug_in_flight(
    rig: Rig, companion: Process, pull: Callable[[], object], push: Callable[[], object]
) -> None:
    """Assert that it holds as for ranging loss, goes on by itself, and announces each once."""
    rig.vehicle()
    companion.wait_for("following the plan")
    silences, returns = companion.count("silent for"), companion.count("heard again")
    losses = companion.count(": lost (")
    pull()
    companion.wait_for("hold: no ranging")
    companion.wait_for("silent for", silences + 1)
    assert companion.count("heard again") == returns
    push()
    companion.wait_for("heard again", returns + 1)
    companion.wait_to_end()
    assert companion.count("silent for") == silences + 1
    assert companion.count("heard again") == returns + 1
    assert companion.count(": lost (") == losses + 1
    assert rig.result()["emitter_id"] == rig.setup.scenario.emitter.emitter_id


class Front:
    """A server before the radio's own, which may answer for it that it cannot."""

    def __init__(self, behind: str) -> None:
        self.answers_500 = threading.Event()
        is_ill = self.answers_500.is_set

        class Page(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                status, body = 500, b"no"
                if not is_ill():
                    status, body = page_of(f"{behind}{self.path}")
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *arguments: object) -> None:
                """Tests say enough."""

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> Front:
        self._thread.start()
        return self

    def __exit__(self, *problem: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def page_of(url: str) -> tuple[int, bytes]:
    """Return status and body of a page, also of an error."""
    try:
        with urllib.request.urlopen(url, timeout=5.0) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()
