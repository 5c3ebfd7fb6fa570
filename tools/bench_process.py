"""Memory and processor time of the companion in flight, and of two libraries that only listen.

    .venv/bin/python tools/bench_process.py [--seconds 30] [--kernels FOLDER] [--json FILE]

Each client has its own simulated PX4, with the streams of PX4's onboard link, at real time.
The companion flies the canonical search on it; MAVSDK-Python (its position, attitude and health)
and pymavlink (`recv_match`) idle. FOLDER is the output of companion.kernel_builder. Figures
are for the process after it has settled, while it flies: resident memory and processor time as
/proc reports them. Flights alternate, one at a time.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from companion.entry import ignore_broken_pipe
from companion.io.child_processes import free_udp_port
from tools.console import OneLineParser, positive

ROOT = Path(__file__).resolve().parents[1]
SETTLING_S = 15.0
"""Time from the start of the client to the first look; the companion has taken off by then."""
CLIENTS = ("native", "quiet", "warm", "plain", "mavsdk", "pymavlink")
"""The companion with its kernels compiled ahead, the same where streams that it does not read stop,
with kernels that `warm-up` compiled, or not at all; and those that listen only."""
AHEAD = ("native", "quiet")
LISTENERS = ("mavsdk", "pymavlink")
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Use:
    """Resources that a client used."""

    client: str
    resident_mb: float
    """Resident memory at the end."""
    processor_pct: float
    """Load of one core, in percent."""


def main() -> int:
    """Measure each, and print a table."""
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=positive, default=30, help="duration of each")
    parser.add_argument("--only", action="append", choices=CLIENTS, help="repeatable")
    parser.add_argument("--kernels", type=Path, metavar="FOLDER", help="compiled ahead")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    print(f"{'client':10} {'memory':>8} {'processor':>10}")
    uses = []
    clients = [name for name in CLIENTS if options.kernels or name not in AHEAD]
    for client in options.only or clients:
        use = measure(client, options.seconds, options.kernels)
        uses.append(use)
        print(f"{client:10} {use.resident_mb:5.0f} MB {use.processor_pct:8.1f} %", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(use) for use in uses], indent=2) + "\n")
    return 0


def measure(client: str, seconds: int, kernels: Path | None) -> Use:
    """Run the client on a simulator, and sample it twice."""
    port = free_udp_port()
    path = f"{kernels.resolve()}:{ROOT}" if client in AHEAD and kernels else str(ROOT)
    switch = "1" if client == "plain" else "0"
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_DISABLE_JIT": switch}
    with (
        tempfile.TemporaryDirectory() as folder,
        simulator(port),
        running(command_of(client, port, Path(folder)), environment) as process,
    ):
        time.sleep(SETTLING_S)
        before_s, began_s = processor_s(process.pid), time.monotonic()
        time.sleep(seconds)
        used_s, took_s = processor_s(process.pid) - before_s, time.monotonic() - began_s
        return Use(client, round(resident_mb(process.pid), 1), round(100 * used_s / took_s, 2))


def command_of(client: str, port: int, folder: Path) -> Sequence[str]:
    """Return the command that starts it."""
    if client in LISTENERS:
        return sys.executable, str(ROOT / "tools/benches/listeners.py"), client, str(port)
    config = folder / "fly.yaml"
    lines = (
        "mission: {engage: auto, stop_confirm_s: 1000.0}",  # flies until it is stopped
        f"log: {{directory: {folder / 'flights'}}}",
        f"process: {{state_directory: {folder / 'state'}}}",
        f"link: {{stop_unread_streams: {str(client == 'quiet').lower()}}}",
    )
    config.write_text("\n".join(lines))
    program: tuple[str, ...] = (str(Path(sys.executable).with_name("companion")),)
    if client == "warm":
        subprocess.run([*program, "warm-up"], check=True, stdout=subprocess.DEVNULL)
    options = ("--connect", f"udp:127.0.0.1:{port}", "--config", str(config), "--quiet")
    return *program, *options


@contextmanager
def simulator(port: int) -> Iterator[None]:
    """Run a PX4 on separate ports that sends to this port."""
    program = Path(sys.executable).with_name("sim-link")
    addresses = ("--send-to", f"127.0.0.1:{port}", "--listen", f"127.0.0.1:{free_udp_port()}")
    with running((str(program), "--quiet", "--seed", "7", *addresses), dict(os.environ)):
        yield


@contextmanager
def running(
    command: Sequence[str], environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process; in the end ask it to stop, then kill it."""
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    try:
        yield process
        if process.poll() is not None:
            raise SystemExit(f"bench_process: {command[0]} ended with {process.returncode}")
    finally:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(5.0)
        process.kill()
        process.wait()


def processor_s(pid: int) -> float:
    """Return the user and system time of all its threads, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def resident_mb(pid: int) -> float:
    """Return the resident memory, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
